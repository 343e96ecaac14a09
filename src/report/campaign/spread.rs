//! The spread of an axis: a list of values or a range of drawn ones; and the cells that it is divided into.
//!
//! Must not know metrics.

use super::number::few;
use crate::campaign::{AxisKind, Parameter, Table};
use crate::report::axis::Axis;

/// The largest number of distinct drawn values, such as whole numbers, that count as a list.
const WHOLE: usize = 24;
/// The largest number of listed values that an axis labels one by one; a longer list gets ticks at round numbers.
const NAMED: usize = 8;
/// The largest deviation of an even axis from equal steps, as a fraction of a step.
const EVEN: f64 = 1e-3;

/// An axis and its values.
#[derive(Debug, Clone)]
pub struct Spread {
    /// The label, or the key.
    pub name: String,
    /// The key.
    pub key: String,
    is_numeric: bool,
    logarithmic: bool,
    values: Values,
}

#[derive(Debug, Clone)]
enum Values {
    /// A list of values; numbers rise.
    Known(Vec<Parameter>),
    /// A range of drawn values.
    Between(f64, f64),
}

/// The cells that an axis is divided into.
#[derive(Debug, Clone, Copy)]
pub struct Cells<'a> {
    spread: &'a Spread,
    /// The number of listed values per cell.
    group: usize,
    /// The number of cells.
    pub count: usize,
}

impl Spread {
    /// Returns the spread of an axis of a table.
    pub fn new(table: &Table, axis: usize) -> Self {
        let varied = &table.axes[axis];
        let mut values: Vec<Parameter> = varied.values.clone();
        if values.is_empty() {
            values.extend(table.rows.iter().filter_map(|row| row.parameters.get(axis).cloned()));
        }
        let numbers = values.iter().all(|value| value.number().is_some_and(f64::is_finite));
        if numbers {
            values.sort_by(|a, b| at(a).total_cmp(&at(b)));
            values.dedup_by(|a, b| same(a, b));
        } else {
            let mut known: Vec<Parameter> = Vec::new();
            values.into_iter().for_each(|value| {
                if !known.contains(&value) {
                    known.push(value);
                }
            });
            values = known;
        }
        let continuous = varied.values.is_empty() && numbers && !few_values(&values, table);
        let logarithmic = varied.kind == AxisKind::Log && values.iter().all(|value| at(value) > 0.0);
        let ends = (values.first().map_or(0.0, at), values.last().map_or(0.0, at));
        Self {
            name: varied.name().to_owned(),
            key: varied.key.clone(),
            is_numeric: numbers,
            logarithmic,
            values: if continuous { Values::Between(ends.0, ends.1) } else { Values::Known(values) },
        }
    }

    /// Returns true if all values are numbers.
    pub fn is_numeric(&self) -> bool {
        self.is_numeric
    }

    /// Returns true if the axis has a list of values, not a range.
    pub fn is_known(&self) -> bool {
        matches!(self.values, Values::Known(_))
    }

    /// Returns true if the axis has more than one value.
    pub fn varies(&self) -> bool {
        match &self.values {
            Values::Known(values) => values.len() > 1,
            Values::Between(low, high) => low < high,
        }
    }

    /// Returns the values in words.
    pub fn words(&self) -> String {
        match &self.values {
            Values::Known(values) if values.is_empty() => "–".to_owned(),
            Values::Known(values) if values.len() <= 6 => values.iter().map(shown).collect::<Vec<_>>().join(", "),
            Values::Known(values) if self.is_numeric() => {
                format!("{} to {}, {} values", shown(&values[0]), shown(&values[values.len() - 1]), values.len())
            }
            Values::Known(values) => {
                format!("{}, … ({} values)", values[..5].iter().map(shown).collect::<Vec<_>>().join(", "), values.len())
            }
            Values::Between(low, high) => format!("drawn, {} to {}", few(*low), few(*high)),
        }
    }

    /// Returns the cells: one per value, but at most `most`.
    pub fn cells(&self, most: usize) -> Cells<'_> {
        match &self.values {
            Values::Known(values) => {
                let group = values.len().div_ceil(most).max(1);
                Cells { spread: self, group, count: values.len().div_ceil(group) }
            }
            Values::Between(..) => Cells { spread: self, group: 1, count: most },
        }
    }

    fn index(&self, value: &Parameter) -> Option<usize> {
        let Values::Known(values) = &self.values else { return None };
        let Some(number) = value.number().filter(|_| self.is_numeric) else {
            return values.iter().position(|known| known == value);
        };
        let place = values.partition_point(|known| at(known) < number && !same(known, value));
        values.get(place).filter(|known| same(known, value)).map(|_| place)
    }

    /// Returns the position of a value on the axis of cells, from 0 to 1.
    pub fn place(&self, value: &Parameter) -> Option<f64> {
        match &self.values {
            Values::Known(values) => Some((self.index(value)? as f64 + 0.5) / values.len() as f64),
            Values::Between(low, high) => {
                let (value, low, high) = match self.logarithmic {
                    true => (value.number()?.log10(), low.log10(), high.log10()),
                    false => (value.number()?, *low, *high),
                };
                if high > low { Some(((value - low) / (high - low)).clamp(0.0, 1.0)) } else { Some(0.5) }
            }
        }
    }

    /// Returns the axis of cells, `room` px long: of numbers if they are even, else of names.
    pub fn axis(&self, room: f64, across: bool) -> Axis {
        let linear = |low: f64, high: f64| Axis::linear(&self.name, low, high);
        let log = |low: f64, high: f64| Axis::log_between(&format!("{}, logarithmic", self.name), low, high);
        let values = match &self.values {
            Values::Between(low, high) => return if self.logarithmic { log(*low, *high) } else { linear(*low, *high) },
            Values::Known(values) => values,
        };
        let numbers: Vec<f64> = values.iter().filter_map(Parameter::number).collect();
        let last = numbers.len().max(1) - 1;
        if numbers.len() == values.len() && numbers.len() > NAMED {
            let scaled = |value: f64| if self.logarithmic { value.ln() } else { value };
            let (first, step) = (scaled(numbers[0]), (scaled(numbers[last]) - scaled(numbers[0])) / last as f64);
            let even = |(n, value): (usize, &f64)| (scaled(*value) - first - n as f64 * step).abs() <= EVEN * step;
            if numbers.iter().enumerate().all(even) {
                let [low, high] = [first - step / 2.0, first + (last as f64 + 0.5) * step];
                return if self.logarithmic { log(low.exp(), high.exp()) } else { linear(low, high) };
            }
        }
        Axis::names(&self.name, &values.iter().map(shown).collect::<Vec<_>>(), room, across)
    }

    /// Returns the axis of the numbers themselves.
    pub fn number_axis(&self) -> Axis {
        let (low, high) = match &self.values {
            Values::Known(values) => (values.first().map_or(0.0, at), values.last().map_or(0.0, at)),
            Values::Between(low, high) => (*low, *high),
        };
        if self.logarithmic && low < high {
            return Axis::log_between(&format!("{}, logarithmic", self.name), low, high);
        }
        Axis::linear(&self.name, low, high)
    }
}

impl Cells<'_> {
    /// Returns the index of the cell that contains a value.
    pub fn index_of(&self, value: &Parameter) -> Option<usize> {
        match self.spread.values {
            Values::Known(_) => self.spread.index(value).map(|index| index / self.group),
            Values::Between(..) => Some(((self.spread.place(value)? * self.count as f64) as usize).min(self.count - 1)),
        }
    }

    /// Returns the edges of a cell on the axis, from 0 to 1.
    pub fn edges(&self, cell: usize) -> (f64, f64) {
        let all = match &self.spread.values {
            Values::Known(values) => values.len() as f64 / self.group as f64,
            Values::Between(..) => self.count as f64,
        };
        (cell as f64 / all, ((cell + 1) as f64 / all).min(1.0))
    }

    /// Returns the smallest and largest value of a numeric cell.
    pub fn ends(&self, cell: usize) -> Option<(f64, f64)> {
        match &self.spread.values {
            Values::Known(values) => {
                let group = &values[cell * self.group..((cell + 1) * self.group).min(values.len())];
                Some((group.first()?.number()?, group.last()?.number()?))
            }
            Values::Between(low, high) => {
                let (from, to) = self.edges(cell);
                let between = |part: f64| match self.spread.logarithmic {
                    true => low * (high / low).powf(part),
                    false => low + part * (high - low),
                };
                Some((between(from), between(to)))
            }
        }
    }

    /// Returns the name of a cell.
    pub fn name(&self, cell: usize) -> String {
        if let Values::Known(values) = &self.spread.values {
            let group = &values[cell * self.group..((cell + 1) * self.group).min(values.len())];
            return match group {
                [] => String::new(),
                [value] => shown(value),
                [first, .., last] => format!("{} to {}", shown(first), shown(last)),
            };
        }
        self.ends(cell).map_or(String::new(), |(from, to)| format!("{} to {}", few(from), few(to)))
    }

    /// Selects at most `most` cells: the first, the last, and evenly spaced ones between them.
    pub fn some(&self, most: usize) -> Vec<usize> {
        if self.count <= most {
            return (0..self.count).collect();
        }
        (0..most).map(|n| n * (self.count - 1) / (most - 1)).collect()
    }
}

fn at(value: &Parameter) -> f64 {
    value.number().unwrap_or(0.0)
}

/// Returns true if two parameters are equal, up to the rounding of a conversion to text.
fn same(a: &Parameter, b: &Parameter) -> bool {
    match (a.number(), b.number()) {
        (Some(a), Some(b)) => (a - b).abs() <= 1e-12 * a.abs().max(b.abs()),
        _ => a == b,
    }
}

/// Formats a parameter in few letters.
pub fn shown(value: &Parameter) -> String {
    match value {
        Parameter::Number(number) if number.is_finite() => few(*number),
        parameter => parameter.to_string(),
    }
}

/// Returns true if there are so few distinct drawn values that they count as a list.
fn few_values(values: &[Parameter], table: &Table) -> bool {
    values.len() <= WHOLE && (values.len() < 2 || table.rows.len() >= 3 * values.len())
}

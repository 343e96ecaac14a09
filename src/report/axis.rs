//! Axes: from values to places between 0 and 1, with ticks that people can read.

/// About so many labels are on an axis; a time axis has room for more.
const LABELS: f64 = 7.0;
const TIME_LABELS: f64 = 10.0;
/// Of a logarithmic axis no more than so many decades below its top are shown.
const DECADES: f64 = 36.0;

/// An axis.
#[derive(Debug, Clone)]
pub struct Axis {
    /// What it shows, with its unit.
    pub label: String,
    low: f64,
    high: f64,
    logarithmic: bool,
    /// Values that are marked, with their labels.
    pub ticks: Vec<(f64, String)>,
}

impl Axis {
    /// A linear axis from one value to another.
    pub fn linear(label: &str, low: f64, high: f64) -> Self {
        let (low, high) = widened(low, high);
        Self { label: label.to_owned(), low, high, logarithmic: false, ticks: linear_ticks(low, high, LABELS) }
    }

    /// The time in the run up to its end, s.
    pub fn time(end_s: f64) -> Self {
        let axis = Self::linear("time in the run, s", 0.0, end_s);
        Self { ticks: linear_ticks(axis.low, axis.high, TIME_LABELS), ..axis }
    }

    /// A linear axis with some room on either side of the values.
    pub fn around(label: &str, (low, high): (f64, f64)) -> Self {
        let (low, high) = widened(low, high);
        let room = 0.05 * (high - low);
        Self::linear(label, low - room, high + room)
    }

    /// A logarithmic axis of whole decades over positive values. Values below it are drawn at its foot.
    pub fn decades(label: &str, (low, high): (f64, f64)) -> Self {
        let high = if high > 0.0 && high.is_finite() { high.log10().ceil() } else { 0.0 };
        let low = if low > 0.0 && low.is_finite() { low.log10().floor() } else { high - 1.0 };
        let low = low.min(high - 1.0).max(high - DECADES);
        let step = ((high - low) / LABELS).ceil().max(1.0);
        let first = (low / step).ceil() as i32;
        let exponents = (first..).map(|n| n * step as i32).take_while(|exponent| f64::from(*exponent) <= high);
        let ticks = exponents.map(|exponent| (f64::from(exponent), power_of_ten(exponent))).collect();
        Self { label: label.to_owned(), low, high, logarithmic: true, ticks }.in_values()
    }

    /// An axis of 1/(1 − p), labelled by p in percent.
    pub fn percentiles(greatest: f64) -> Self {
        let greatest = greatest.max(10.0);
        let mut axis = Self::decades("percentile, on an axis of 1/(1 − p)", (1.0, greatest));
        axis.high = greatest.log10();
        axis.ticks.retain(|(value, _)| *value <= greatest);
        for (index, (_, label)) in axis.ticks.iter_mut().enumerate() {
            *label = match index {
                0 => "0 %".to_owned(),
                1 => "90 %".to_owned(),
                2 => "99 %".to_owned(),
                more => format!("99.{} %", "9".repeat(more - 2)),
            };
        }
        axis
    }

    /// Ticks as values, where they were exponents.
    fn in_values(mut self) -> Self {
        self.ticks.iter_mut().for_each(|(value, _)| *value = 10_f64.powf(*value));
        self
    }

    /// Where a value is: 0 at the foot, 1 at the top; what is beyond is at the edge.
    pub fn place(&self, value: f64) -> f64 {
        let value = if !self.logarithmic {
            value
        } else if value > 0.0 {
            value.log10()
        } else {
            f64::NEG_INFINITY
        };
        ((value - self.low) / (self.high - self.low)).clamp(0.0, 1.0)
    }

    /// The least value on it.
    pub fn foot(&self) -> f64 {
        if self.logarithmic { 10_f64.powf(self.low) } else { self.low }
    }
}

/// A range that can be divided: neither empty nor beyond what a difference holds.
fn widened(low: f64, high: f64) -> (f64, f64) {
    let sane = |value: f64| if value.is_finite() { value.clamp(-1e30, 1e30) } else { 0.0 };
    let (low, high) = (sane(low.min(high)), sane(high.max(low)));
    let least = 1e-9 * low.abs().max(high.abs()).max(1e-6);
    if high - low < least { (low - least, high + least) } else { (low, high) }
}

fn linear_ticks(low: f64, high: f64, labels: f64) -> Vec<(f64, String)> {
    let raw = (high - low) / (labels - 1.0);
    let decade = 10_f64.powf(raw.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|m| m * decade).into_iter().find(|step| *step >= raw).unwrap_or(raw);
    let (first, last) = ((low / step - 1e-9).ceil(), (high / step + 1e-9).floor());
    let count = (last - first).clamp(0.0, 2.0 * labels) as usize;
    let label = |value: f64| {
        let largest = low.abs().max(high.abs());
        if !(1e-3..1e6).contains(&largest) {
            return if value == 0.0 { "0".to_owned() } else { format!("{:.2e}", value).replace('-', "−") };
        }
        let digits = (-step.log10().floor()).max(0.0) as usize;
        format!("{value:.digits$}").replace('-', "−")
    };
    let value = |n: usize| {
        let value = (first + n as f64) * step;
        // No label says −0.
        if value.abs() < 1e-9 * step { 0.0 } else { value }
    };
    (0..=count).map(|n| (value(n), label(value(n)))).collect()
}

/// 0.01 to 1000 as they are, the others with an exponent.
fn power_of_ten(exponent: i32) -> String {
    if (-2..=3).contains(&exponent) {
        return format!("{}", 10_f64.powi(exponent));
    }
    let raised = |digit: char| match digit {
        '-' => '⁻',
        '1' => '¹',
        '2' => '²',
        '3' => '³',
        digit => char::from_u32('⁰' as u32 + (digit as u32 - '0' as u32)).unwrap_or(digit),
    };
    format!("10{}", exponent.to_string().chars().map(raised).collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(axis: &Axis) -> Vec<&str> {
        axis.ticks.iter().map(|(_, label)| label.as_str()).collect()
    }

    #[test]
    fn ticks_are_round_numbers_within_the_axis() {
        assert_eq!(labels(&Axis::time(10.0)), ["0", "2", "4", "6", "8", "10"]);
        assert_eq!(labels(&Axis::time(18.0)).len(), 10);
        assert_eq!(labels(&Axis::linear("w", -0.31, 0.62)), ["−0.2", "0.0", "0.2", "0.4", "0.6"]);
        assert_eq!(labels(&Axis::decades("e", (3e-5, 0.7))), ["10⁻⁵", "10⁻⁴", "10⁻³", "0.01", "0.1", "1"]);
        assert_eq!(labels(&Axis::percentiles(20_000.0))[..5], ["0 %", "90 %", "99 %", "99.9 %", "99.99 %"]);
    }

    #[test]
    fn places_are_within_the_axis_whatever_the_values_are() {
        let strange = [0.0, -1.0, 1.0, 1e300, -1e300, f64::INFINITY, f64::NAN, f64::MIN_POSITIVE, 0.877, 0.877 + 1e-16];
        for low in strange {
            for high in strange {
                for axis in [Axis::linear("", low, high), Axis::around("", (low, high)), Axis::decades("", (low, high))]
                {
                    assert!(axis.ticks.len() < 40, "{axis:?}");
                    for value in strange.into_iter().filter(|value| !value.is_nan()) {
                        assert!((0.0..=1.0).contains(&axis.place(value)), "{axis:?} {value}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_logarithmic_axis_puts_decades_at_equal_distances() {
        let axis = Axis::decades("", (1e-4, 1.0));
        assert!((axis.place(1e-2) - 0.5).abs() < 1e-12 && axis.place(0.0) == 0.0 && axis.place(1e9) == 1.0);
    }
}

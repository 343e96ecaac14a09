//! Compares two recordings: finds the first difference, and the size of all differences per signal.
//!
//! Compares values at ticks that both recordings have, and counts the ticks that only one has. Ignores stamps, because
//! times and generations differ between any two runs.

use super::error::RecordError;
use super::reader::Recording;
use super::track::Track;
use crate::sample::{FieldKind, Stamp};

/// The largest difference at which two numbers count as equal: the sum of both tolerances.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Tolerances {
    /// In the field's unit.
    pub absolute: f64,
    /// As a fraction of the larger magnitude.
    pub relative: f64,
}

impl Tolerances {
    /// Returns true if two words have the same bits, or are numbers within the tolerances.
    fn allow(self, kind: FieldKind, a: f64, b: f64) -> bool {
        a.to_bits() == b.to_bits()
            || (kind == FieldKind::F64 && (a - b).abs() <= self.absolute + self.relative * a.abs().max(b.abs()))
    }
}

/// A value that differs.
#[derive(Debug, Clone, PartialEq)]
pub struct ValueDiff {
    /// The tick.
    pub tick: u64,
    /// The field and, for arrays, the element.
    pub field: String,
    /// The values in both recordings.
    pub values: [f64; 2],
}

/// Comparison of one signal.
#[derive(Debug, Clone, PartialEq)]
pub struct SignalDiff {
    /// Body and signal.
    pub name: String,
    /// Number of ticks that both recordings have.
    pub compared: u64,
    /// Number of ticks that only the first, or only the second, has.
    pub only: [u64; 2],
    /// The first value beyond the tolerances.
    pub first: Option<ValueDiff>,
    /// Number of values beyond the tolerances.
    pub beyond: u64,
    /// The largest difference of any number, with its field and tick.
    pub max: Option<(f64, String, u64)>,
    /// Root mean square of all differences.
    pub rms: f64,
}

impl SignalDiff {
    /// Returns true if both recordings have the same ticks, and all values are within the tolerances.
    pub fn same(&self) -> bool {
        self.beyond == 0 && self.only == [0, 0]
    }
}

/// Comparison of two recordings.
#[derive(Debug, Clone, PartialEq)]
pub struct Comparison {
    /// The signals that both recordings have.
    pub signals: Vec<SignalDiff>,
    /// Names of the signals that only the first, or only the second, has.
    pub only: [Vec<String>; 2],
}

impl Comparison {
    /// Returns true if both have the same signals and ticks, and all values are within the tolerances.
    pub fn same(&self) -> bool {
        self.only.iter().all(Vec::is_empty) && self.signals.iter().all(SignalDiff::same)
    }

    /// Returns the earliest difference of any signal.
    pub fn first(&self) -> Option<(&SignalDiff, &ValueDiff)> {
        let firsts = self.signals.iter().filter_map(|signal| Some((signal, signal.first.as_ref()?)));
        firsts.min_by_key(|(_, first)| first.tick)
    }
}

/// Compares two recordings signal by signal. Signals match by the names of their body and signal.
///
/// # Errors
/// [`RecordError::Layout`] if a signal has two layouts; [`RecordError::Read`].
pub fn diff(a: &Recording, b: &Recording, tolerances: Tolerances) -> Result<Comparison, RecordError> {
    let names = |recording: &Recording| -> Vec<(String, String)> {
        recording.signals().iter().map(|signal| (signal.body.clone(), signal.signal.clone())).collect()
    };
    let (names_a, names_b) = (names(a), names(b));
    let difference = |minuend: &[(String, String)], subtrahend: &[(String, String)]| {
        let left = minuend.iter().filter(|name| !subtrahend.contains(name));
        left.map(|(body, signal)| format!("{body}/{signal}")).collect()
    };
    let mut signals = Vec::new();
    for (body, signal) in names_a.iter().filter(|name| names_b.contains(name)) {
        let track = |recording: &Recording| {
            let mut tracks = recording.tracks(|info| info.body == *body && info.signal == *signal)?;
            Ok::<_, RecordError>(tracks.swap_remove(0))
        };
        let (a, b) = (track(a)?, track(b)?);
        if a.info.layout != b.info.layout {
            let (recorded, ours) = (a.info.layout.words(), b.info.layout.words());
            return Err(RecordError::Layout { service: format!("{body}/{signal}"), recorded, ours });
        }
        signals.push(compare(format!("{body}/{signal}"), &a, &b, tolerances));
    }
    Ok(Comparison { signals, only: [difference(&names_a, &names_b), difference(&names_b, &names_a)] })
}

fn compare(name: String, a: &Track, b: &Track, tolerances: Tolerances) -> SignalDiff {
    let mut result = SignalDiff { name, compared: 0, only: [0, 0], first: None, beyond: 0, max: None, rms: 0.0 };
    let (mut squares, mut numbers) = (0.0, 0_u64);
    let (mut indexes_a, mut indexes_b) = (a.regular().peekable(), b.regular().peekable());
    loop {
        let tick_a = indexes_a.peek().map(|index| a.stamp(*index).tick);
        let tick_b = indexes_b.peek().map(|index| b.stamp(*index).tick);
        match (tick_a, tick_b) {
            (None, None) => break,
            (Some(tick), Some(tick_b)) if tick == tick_b => {
                let (i, j) = (indexes_a.next().unwrap_or(0), indexes_b.next().unwrap_or(0));
                result.compared += 1;
                compare_sample(&mut result, [a, b], [i, j], tick, tolerances, &mut |difference: f64| {
                    squares += difference * difference;
                    numbers += 1;
                });
            }
            (Some(tick_a), tick_b) if tick_b.is_none_or(|tick_b| tick_a < tick_b) => {
                indexes_a.next();
                result.only[0] += 1;
            }
            _ => {
                indexes_b.next();
                result.only[1] += 1;
            }
        }
    }
    result.rms = if numbers > 0 { (squares / numbers as f64).sqrt() } else { 0.0 };
    result
}

/// Compares sample `i` of `a` with sample `j` of `b`, and passes the difference of every pair of numbers to `add`.
fn compare_sample(
    result: &mut SignalDiff,
    [a, b]: [&Track; 2],
    [i, j]: [usize; 2],
    tick: u64,
    tolerances: Tolerances,
    add: &mut dyn FnMut(f64),
) {
    let content = size_of::<Stamp>();
    let same = a.sample(i)[content..] == b.sample(j)[content..];
    for (index, column) in a.info.layout.columns.iter().enumerate().skip(Stamp::FIELDS.len()) {
        for element in 0..column.count {
            let is_number = column.kind == FieldKind::F64;
            if same {
                if is_number {
                    add(0.0);
                }
                continue;
            }
            let values = [a.value(i, index, element), b.value(j, index, element)];
            // Unequal values of which one is NaN differ by infinity.
            let difference = if values[0].to_bits() == values[1].to_bits() {
                0.0
            } else {
                Some((values[0] - values[1]).abs()).filter(|difference| !difference.is_nan()).unwrap_or(f64::INFINITY)
            };
            let field = || column.elements().nth(element).unwrap_or_default();
            if is_number {
                add(difference);
                if result.max.as_ref().is_none_or(|(max, ..)| difference > *max) && difference > 0.0 {
                    result.max = Some((difference, field(), tick));
                }
            }
            if !tolerances.allow(column.kind, values[0], values[1]) {
                result.beyond += 1;
                result.first.get_or_insert_with(|| ValueDiff { tick, field: field(), values });
            }
        }
    }
}

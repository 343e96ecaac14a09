//! Two recordings beside each other: where they differ first, and per signal by how much.
//!
//! Compares values at ticks that both have, and tells how many only one has. Times and generations are no values: no two
//! runs have the same.

use super::RecordError;
use super::reader::{Recording, Track};
use crate::sample::{FieldKind, Stamp};

/// By how much two numbers may differ and still be the same.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Tolerances {
    /// In the field's own unit.
    pub absolute: f64,
    /// As a part of the larger one.
    pub relative: f64,
}

impl Tolerances {
    /// Whether two words are the same: bit for bit, or as numbers within the tolerances.
    fn allow(self, kind: FieldKind, a: f64, b: f64) -> bool {
        a.to_bits() == b.to_bits()
            || (kind == FieldKind::F64 && (a - b).abs() <= self.absolute + self.relative * a.abs().max(b.abs()))
    }
}

/// A value that differs.
#[derive(Debug, Clone, PartialEq)]
pub struct ValueDiff {
    /// Where.
    pub tick: u64,
    /// Which element of which field.
    pub field: String,
    /// What both say.
    pub values: [f64; 2],
}

/// How one signal of two recordings compares.
#[derive(Debug, Clone, PartialEq)]
pub struct SignalDiff {
    /// Body and signal.
    pub name: String,
    /// Ticks that both have, and that only the first or the second has.
    pub compared: u64,
    /// Ticks that only one has.
    pub only: [u64; 2],
    /// The first value beyond the tolerances.
    pub first: Option<ValueDiff>,
    /// Values beyond the tolerances.
    pub beyond: u64,
    /// The largest difference of any number, with its field and tick.
    pub max: Option<(f64, String, u64)>,
    /// The root of the mean square of all differences.
    pub rms: f64,
}

impl SignalDiff {
    /// Whether all that both say is the same, and both say as much.
    pub fn same(&self) -> bool {
        self.beyond == 0 && self.only == [0, 0]
    }
}

/// How two recordings compare.
#[derive(Debug, Clone, PartialEq)]
pub struct Comparison {
    /// Per signal that both have.
    pub signals: Vec<SignalDiff>,
    /// Signals that only the first or the second has.
    pub only: [Vec<String>; 2],
}

impl Comparison {
    /// Whether they are the same, within the tolerances.
    pub fn same(&self) -> bool {
        self.only.iter().all(Vec::is_empty) && self.signals.iter().all(SignalDiff::same)
    }

    /// The first difference of all, with its signal.
    pub fn first(&self) -> Option<(&SignalDiff, &ValueDiff)> {
        let firsts = self.signals.iter().filter_map(|signal| Some((signal, signal.first.as_ref()?)));
        firsts.min_by_key(|(_, first)| first.tick)
    }
}

/// Compares two recordings, of one scenario or of two with bodies of the same names.
///
/// # Errors
/// [`RecordError::Layout`] if a signal has two layouts; [`RecordError::Read`].
pub fn diff(a: &Recording, b: &Recording, tolerances: Tolerances) -> Result<Comparison, RecordError> {
    let names = |recording: &Recording| -> Vec<(String, String)> {
        recording.signals().iter().map(|signal| (signal.body.clone(), signal.signal.clone())).collect()
    };
    let (of_a, of_b) = (names(a), names(b));
    let only = |these: &[(String, String)], those: &[(String, String)]| {
        let alone = these.iter().filter(|name| !those.contains(name));
        alone.map(|(body, signal)| format!("{body}/{signal}")).collect()
    };
    let mut signals = Vec::new();
    for (body, signal) in of_a.iter().filter(|name| of_b.contains(name)) {
        let one = |recording: &Recording| {
            let mut tracks = recording.tracks(|info| info.body == *body && info.signal == *signal)?;
            Ok::<_, RecordError>(tracks.swap_remove(0))
        };
        let (a, b) = (one(a)?, one(b)?);
        if a.info.layout != b.info.layout {
            let (recorded, ours) = (a.info.layout.words(), b.info.layout.words());
            return Err(RecordError::Layout { service: format!("{body}/{signal}"), recorded, ours });
        }
        signals.push(compare(format!("{body}/{signal}"), &a, &b, tolerances));
    }
    Ok(Comparison { signals, only: [only(&of_a, &of_b), only(&of_b, &of_a)] })
}

fn compare(name: String, a: &Track, b: &Track, tolerances: Tolerances) -> SignalDiff {
    let mut result = SignalDiff { name, compared: 0, only: [0, 0], first: None, beyond: 0, max: None, rms: 0.0 };
    let (mut squares, mut numbers) = (0.0, 0_u64);
    let (mut of_a, mut of_b) = (a.regular().peekable(), b.regular().peekable());
    loop {
        let ticks = [of_a.peek().map(|index| a.stamp(*index).tick), of_b.peek().map(|index| b.stamp(*index).tick)];
        match ticks {
            [None, None] => break,
            [Some(one), Some(other)] if one == other => {
                let (i, j) = (of_a.next().unwrap_or(0), of_b.next().unwrap_or(0));
                result.compared += 1;
                compare_sample(&mut result, [a, b], [i, j], one, tolerances, &mut |difference: f64| {
                    squares += difference * difference;
                    numbers += 1;
                });
            }
            [Some(one), other] if other.is_none_or(|other| one < other) => {
                of_a.next();
                result.only[0] += 1;
            }
            _ => {
                of_b.next();
                result.only[1] += 1;
            }
        }
    }
    result.rms = if numbers > 0 { (squares / numbers as f64).sqrt() } else { 0.0 };
    result
}

fn compare_sample(
    result: &mut SignalDiff,
    [a, b]: [&Track; 2],
    [i, j]: [usize; 2],
    tick: u64,
    tolerances: Tolerances,
    number: &mut dyn FnMut(f64),
) {
    let content = size_of::<Stamp>();
    let same = a.sample(i)[content..] == b.sample(j)[content..];
    for (index, column) in a.info.layout.columns.iter().enumerate().skip(Stamp::FIELDS.len()) {
        for element in 0..column.count {
            let is_number = column.kind == FieldKind::F64;
            if same {
                if is_number {
                    number(0.0);
                }
                continue;
            }
            let values = [a.value(i, index, element), b.value(j, index, element)];
            // What is no number on one side only differs by more than any number.
            let difference = if values[0].to_bits() == values[1].to_bits() {
                0.0
            } else {
                Some((values[0] - values[1]).abs()).filter(|difference| !difference.is_nan()).unwrap_or(f64::INFINITY)
            };
            let field = || column.elements().nth(element).unwrap_or_default();
            if is_number {
                number(difference);
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

//! Refuses a log whose assumed units are impossible, and names the likely ones. Must not change a unit.

use super::form::{DataError, Meaning, Row};
use super::unit::{RateUnit, TimeUnit};
use crate::identify::{Motion, wrong_scale};
use std::collections::VecDeque;
use std::f64::consts::PI;
use std::path::Path;

/// The range of a usual interval, s.
const INTERVALS_S: std::ops::Range<f64> = 1e-5..100.0;
/// The range of a likely one.
const LIKELY_INTERVALS_S: std::ops::Range<f64> = 1e-4..100.0;
/// The fastest rate of a body in a log without units, rad/s.
const FASTEST_RAD_S: f64 = 100.0;
/// The largest turn of a body between samples that are likely, rad.
const LIKELY_TURN_RAD: f64 = 1.0;

/// The bounds of a log's values if its assumed units are right.
#[derive(Debug, Clone, Copy)]
pub struct Plausible {
    /// The usual interval, s.
    usual_s: Option<f64>,
    /// The fastest rate that is possible, rad/s.
    fastest_rad_s: f64,
}

impl Plausible {
    /// Checks the usual interval and the first stamp.
    ///
    /// # Errors
    /// [`DataError::Unit`].
    pub fn new(path: &Path, meaning: &Meaning, usual_s: Option<f64>, head: &VecDeque<Row>) -> Result<Self, DataError> {
        let assumed = |what| meaning.assumed.contains(&what);
        if let Some(usual_s) = usual_s.filter(|usual_s| assumed("time") && !INTERVALS_S.contains(usual_s)) {
            let reason = format!("the usual interval would be {usual_s:.3e} s");
            let fastest_rad_s = head.iter().map(|row| speed_rad_s(row.rate_rad_s)).reduce(f64::max);
            // Beyond it, the rates are likely in deg/s.
            let in_rad = |rate: f64| if rate < FASTEST_RAD_S { rate } else { rate.to_radians() };
            let fastest_rad_s = fastest_rad_s.map(in_rad).filter(|rate_rad_s| *rate_rad_s < FASTEST_RAD_S);
            return Err(refuse(path, meaning, reason, likely(meaning, Some(usual_s), fastest_rad_s)));
        }
        let first = head.iter().find_map(|row| row.stamp).filter(|_| meaning.time.1 == TimeUnit::Seconds);
        if let Some((units, unit)) =
            first.filter(|_| assumed("time")).and_then(|first| Some((first.units(), since_1970(first.units())?)))
        {
            return Err(refuse(path, meaning, format!("the first stamp would be {units} s"), vec![stamps_in(&unit)]));
        }
        let by_turn = usual_s.filter(|_| !meaning.assumed.is_empty()).map_or(f64::INFINITY, |usual_s| PI / usual_s);
        let by_rate = if assumed("rate") { FASTEST_RAD_S } else { f64::INFINITY };
        Ok(Self { usual_s, fastest_rad_s: by_turn.min(by_rate) })
    }

    /// Checks a row.
    ///
    /// # Errors
    /// [`DataError::Unit`].
    pub fn check(&self, path: &Path, meaning: &Meaning, row: u64, rates_rad_s: [f64; 3]) -> Result<(), DataError> {
        let rate_rad_s = speed_rad_s(rates_rad_s);
        if rate_rad_s <= self.fastest_rad_s {
            return Ok(());
        }
        let turn = self
            .usual_s
            .map_or(String::new(), |usual_s| format!(", and turn by {:.1} rad between samples", rate_rad_s * usual_s));
        let reason = format!("row {row}: the body would turn at {rate_rad_s:.1} rad/s{turn}");
        Err(refuse(path, meaning, reason, likely(meaning, self.usual_s, Some(rate_rad_s))))
    }
}

/// Returns the angular speed without the unknown rates, rad/s.
fn speed_rad_s(rates_rad_s: [f64; 3]) -> f64 {
    rates_rad_s.iter().filter(|rate| rate.is_finite()).map(|rate| rate * rate).sum::<f64>().sqrt()
}

/// Returns the unit of a stamp that would be thousands of years after 1970 in s: about 1.8e9 s have passed.
pub fn since_1970(units: i64) -> Option<TimeUnit> {
    match units {
        ..100_000_000_000 => None,
        100_000_000_000..100_000_000_000_000 => Some(TimeUnit::Milliseconds),
        100_000_000_000_000..100_000_000_000_000_000 => Some(TimeUnit::Microseconds),
        _ => Some(TimeUnit::Nanoseconds),
    }
}

/// Checks the scale of a motion in a log with assumed units: Euler's equations hold only at one.
///
/// # Errors
/// [`DataError::Unit`].
pub fn check_scale(path: &Path, meaning: &Meaning, motion: &Motion) -> Result<(), DataError> {
    check_factor(path, meaning, || wrong_scale(motion))
}

/// Checks the factor by which rates in assumed units are too small.
///
/// # Errors
/// [`DataError::Unit`].
pub fn check_factor(path: &Path, meaning: &Meaning, factor: impl FnOnce() -> Option<f64>) -> Result<(), DataError> {
    let factor = if meaning.assumed.is_empty() { None } else { factor() };
    factor.map_or(Ok(()), |factor| Err(scaled(path, meaning, factor)))
}

/// Returns the error for a motion that is free if its rates, or its times, are `factor` times as large.
fn scaled(path: &Path, meaning: &Meaning, factor: f64) -> DataError {
    let same = |scale: f64| (scale / factor - 1.0).abs() < 1e-3;
    let mut found = Vec::new();
    let assumed = |what| meaning.assumed.contains(&what);
    if let Some(unit) = TimeUnit::NUMBERS.iter().find(|unit| assumed("time") && same(1.0 / unit.per_second())) {
        found.push(stamps_in(unit));
    }
    if let Some(unit) = RateUnit::NUMBERS.iter().find(|unit| assumed("rate") && same(unit.rad_s())) {
        found.push(rates_in(unit));
    }
    let reason = format!("Euler's equations hold only for rates, or times, that are {factor:.3e} times as large");
    refuse(path, meaning, reason, found)
}

fn stamps_in(unit: &TimeUnit) -> String {
    format!("the stamps are likely in {unit}: give --time-unit {unit}")
}

fn rates_in(unit: &RateUnit) -> String {
    format!("the rates are likely in {unit}: give --rate-unit {unit}")
}

/// Returns the error for assumed units; `likely` are other ones.
fn refuse(path: &Path, meaning: &Meaning, reason: String, likely: Vec<String>) -> DataError {
    let assumed = meaning.assumed_text().unwrap_or_default();
    let likely = match likely.is_empty() {
        true => "give the units with --time-unit and --rate-unit, or the rate of a counter with --rate-hz and the size of a \
                 sensor's counts with --rate-scale".to_owned(),
        false => likely.join("; or "),
    };
    DataError::Unit { path: path.to_owned(), reason, assumed, likely }
}

/// Returns the units that make interval and rate likely, with their options. One unit is replaced at a time.
fn likely(meaning: &Meaning, usual_s: Option<f64>, rate_rad_s: Option<f64>) -> Vec<String> {
    let fits = |time: f64, rate: f64| {
        let (usual_s, rate_rad_s) = (usual_s.map(|usual_s| usual_s * time), rate_rad_s.map(|own| own * rate));
        let turn_rad = usual_s.unwrap_or(0.0) * rate_rad_s.unwrap_or(0.0);
        usual_s.is_none_or(|usual_s| LIKELY_INTERVALS_S.contains(&usual_s))
            && rate_rad_s.is_none_or(|rate_rad_s| rate_rad_s < FASTEST_RAD_S)
            && turn_rad < LIKELY_TURN_RAD
    };
    let mut found = Vec::new();
    if meaning.assumed.contains(&"time") {
        let own = meaning.time.1.per_second();
        let unit = TimeUnit::NUMBERS[1..].iter().find(|unit| fits(own / unit.per_second(), 1.0));
        found.extend(match usual_s.filter(|_| meaning.time.0.eq_ignore_ascii_case("SampleTimeFine")) {
            // The devices of Xsens count units of 0.1 ms, newer ones of 1 us.
            Some(..=1000.0) => {
                Some(format!("the stamps likely count units of 0.1 ms: give --time {} --rate-hz 10000", meaning.time.0))
            }
            Some(_) => Some(stamps_in(&TimeUnit::Microseconds)),
            None => unit.map(stamps_in),
        });
    }
    if meaning.assumed.contains(&"rate") {
        let own = meaning.rates.1.rad_s();
        // Beside a unit of time only the most usual one.
        let units = if found.is_empty() { &RateUnit::NUMBERS[1..] } else { &RateUnit::NUMBERS[1..2] };
        let unit = units.iter().find(|unit| fits(1.0, unit.rad_s() / own));
        // Beyond deg/s the numbers do not tell them apart.
        let is_certain = unit == Some(&RateUnit::DegreesPerSecond);
        let rest = if is_certain { "" } else { ", mrad/s, or --rate-scale for a sensor's counts" };
        found.extend(unit.map(|unit| rates_in(unit) + rest));
    }
    found
}

//! A leader that plays back a recorded motion: angular velocities from a log, interpolated by cubics.
//!
//! This file knows no ticks, and does not repair the log: a segment is taken as the reader returns it.

use crate::data::{Cut, DataError, Log, Options, RateUnit, TimeUnit, check_scale};
use crate::identify::{self, Sample};
use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use xxhash_rust::xxh3::Xxh3Default;

/// The logs that ship with the program, by name, for its scenarios.
const SHIPPED: [(&str, &str); 1] = [("tumbling-throw.csv", include_str!("../../../config/tumbling-throw.csv"))];
/// The largest deviation of the axes from a rotation.
const ROTATION: f64 = 1e-6;

/// The options of reading and playing a log, as typed.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct RawPlayback {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub topic: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub time: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rates: Option<[String; 3]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub time_unit: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rate_unit: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rate_scale: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rate_hz: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub skip: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub by: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub between_s: Option<[f64; 2]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub segment: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gap_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub axes: Option<[[f64; 3]; 3]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub headerless: Option<bool>,
    pub at_end: AtEnd,
    /// The hash of the samples, filled in when a scenario is resolved.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hash: Option<String>,
}

/// The treatment of a run that is longer than the log.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum AtEnd {
    /// The run is refused.
    #[default]
    Refuse,
    /// The motion starts again; one usual interval joins its end and start.
    Repeat,
}

/// An error of loading a motion.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub(super) enum PlaybackError {
    #[error(transparent)]
    #[strum(transparent)]
    Data(#[from] DataError),
    #[error("`{0}` is not a unit {1}")]
    #[strum(serialize = "unknown-unit")]
    Unit(String, &'static str),
    #[error("{path} has {segments} segments; name one with leader.playback.segment, one of: {names}")]
    #[strum(serialize = "several-segments")]
    Several { path: String, segments: usize, names: String },
    #[error("{path} has no segment `{segment}`; it has: {names}")]
    #[strum(serialize = "no-such-segment")]
    NoSegment { path: String, segment: String, names: String },
    #[error("the motion in {path} has {samples} samples, and interpolation needs two; name a longer segment")]
    #[strum(serialize = "log-too-short")]
    Short { path: String, samples: usize },
    #[error(
        "{path} has changed since this scenario was resolved: its samples have the hash {found}; restore the old file, \
         or remove leader.playback.hash"
    )]
    #[strum(serialize = "log-changed")]
    Changed { path: String, found: String },
    #[error("the axes are not a rotation: their columns must have length 1, be at right angles, and be right-handed")]
    #[strum(serialize = "no-rotation")]
    Axes,
}

/// One sample with the slope of the motion at it.
#[derive(Debug, Clone, Copy)]
struct Knot {
    time_s: f64,
    rate: Vector3<f64>,
    slope: Vector3<f64>,
}

/// A recorded motion about the principal axes.
#[derive(Debug)]
pub(super) struct Playback {
    knots: Vec<Knot>,
    /// The number of samples, including those that are not kept.
    count: usize,
    /// The time at which the motion is over or starts again, s.
    end_s: f64,
    repeats: bool,
    hash: u64,
    /// The units that were assumed, as text.
    assumed: Option<String>,
}

/// The samples of a motion while they are read.
struct Motion {
    samples: Vec<(f64, Vector3<f64>)>,
    keep_s: f64,
    begin_s: f64,
    end_s: f64,
    count: usize,
    hash: Xxh3Default,
}

impl Motion {
    /// Creates an empty motion that keeps the samples needed up to `keep_s`.
    fn new(keep_s: f64) -> Self {
        Self { samples: Vec::new(), keep_s, begin_s: 0.0, end_s: 0.0, count: 0, hash: Xxh3Default::new() }
    }

    fn add(&mut self, time_s: f64, rate: Vector3<f64>) {
        if self.count == 0 {
            self.begin_s = time_s;
        }
        (self.count, self.end_s) = (self.count + 1, time_s - self.begin_s);
        [self.end_s, rate.x, rate.y, rate.z].iter().for_each(|value| self.hash.update(&value.to_bits().to_le_bytes()));
        // The slope at the sample after the end needs one more.
        let behind = self.samples.iter().rev().take(2).filter(|(time_s, _)| *time_s > self.keep_s).count();
        if behind < 2 {
            self.samples.push((self.end_s, rate));
        }
    }
}

/// The largest number of segment names in an error.
const NAMES_LISTED: usize = 12;

impl RawPlayback {
    fn options(&self) -> Result<Options, PlaybackError> {
        let unknown = |name: &str, quantity| PlaybackError::Unit(name.to_owned(), quantity);
        let time = |name: &str| TimeUnit::parse(name).ok_or_else(|| unknown(name, "of time: s, ms, us or ns"));
        let rates = "of angular velocity: rad/s, deg/s, mdps, mrad/s, rpm or rev/s";
        let rate = |name: &str| RateUnit::parse(name).ok_or_else(|| unknown(name, rates));
        let (time_unit, rate_unit) = (self.time_unit.as_deref().map(time), self.rate_unit.as_deref().map(rate));
        let number = |name: &'static str, given: Option<f64>| match given {
            Some(number) if !(number.is_finite() && number > 0.0) => {
                Err(DataError::Option { name, reason: format!("{number} is out of range; give a number above 0") })
            }
            given => Ok(given),
        };
        Ok(Options {
            topic: self.topic.clone(),
            time: self.time.clone(),
            rates: self.rates.clone(),
            time_unit: time_unit.transpose()?.or(number("rate_hz", self.rate_hz)?.map(TimeUnit::Count)),
            rate_unit: rate_unit.transpose()?.or(number("rate_scale", self.rate_scale)?.map(RateUnit::Scale)),
            by: self.by.clone(),
            gap_s: self.gap_s,
            unnamed: self.headerless.unwrap_or(false),
            skip: self.skip.unwrap_or(0),
            may_lack: [false; 3],
            cut: self.between_s.map_or(Cut::Whole, |between| Cut::Between(vec![between])),
        })
    }

    fn rotation(&self) -> Result<Matrix3<f64>, PlaybackError> {
        let axes = self.axes.map_or_else(Matrix3::identity, |rows| Matrix3::from_fn(|row, column| rows[row][column]));
        let defect = (axes.transpose() * axes - Matrix3::identity()).amax();
        // The comparison also rejects NaN.
        if defect < ROTATION && axes.determinant() > 0.0 { Ok(axes.transpose()) } else { Err(PlaybackError::Axes) }
    }

    /// Reads the motion in a file, or in a log that ships with the program if there is no such file. A log may be larger than
    /// memory: unless the motion repeats, only what is played in `duration_s` is kept.
    pub fn load(&self, path: &Path, duration_s: f64) -> Result<Playback, PlaybackError> {
        let (options, own) = (self.options()?, self.rotation()?);
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        let shipped = SHIPPED.iter().find(|(shipped, _)| *shipped == name && !path.exists());
        let mut log = match shipped {
            Some((name, text)) => Log::from_csv(text.as_bytes(), name.as_ref(), &options)?,
            None => Log::open(path, &options)?,
        };
        let (mut names, mut motion) =
            (Vec::new(), Motion::new(if self.at_end == AtEnd::Repeat { f64::INFINITY } else { duration_s }));
        let mut free = identify::Motion::default();
        while let Some(entry) = log.next() {
            let entry = entry?;
            if entry.begins {
                free.end_segment();
                names.push(log.segment_name());
            }
            let asked = self.segment.as_ref().map_or(names.len() == 1, |segment| names.last() == Some(segment));
            if asked {
                free.push(&Sample { time_s: entry.time_s, rate_rad_s: entry.rate_rad_s.into() });
                motion.add(entry.time_s, own * Vector3::from(entry.rate_rad_s));
            }
        }
        free.end_segment();
        check_scale(log.path(), log.meaning(), &free)?;
        let assumed = log.meaning().assumed_text();
        let path = log.path().display().to_string();
        let listed = || names.iter().take(NAMES_LISTED).cloned().collect::<Vec<_>>().join(", ");
        match &self.segment {
            None if names.len() > 1 => {
                return Err(PlaybackError::Several { path, segments: names.len(), names: listed() });
            }
            Some(segment) if motion.count == 0 => {
                return Err(PlaybackError::NoSegment { path, segment: segment.clone(), names: listed() });
            }
            _ if motion.count < 2 => return Err(PlaybackError::Short { path, samples: motion.count }),
            _ => {}
        }
        let playback = Playback { assumed, ..Playback::new(motion, self.at_end == AtEnd::Repeat) };
        match &self.hash {
            Some(hash) if *hash != playback.hash() => Err(PlaybackError::Changed { path, found: playback.hash() }),
            _ => Ok(playback),
        }
    }
}

/// Returns the path of a log: its name alone for a log that ships with the program, otherwise an absolute path.
pub(super) fn locate(path: PathBuf) -> PathBuf {
    let shipped = SHIPPED.iter().find(|(name, _)| path.file_name().is_some_and(|own| own == *name) && !path.exists());
    match shipped {
        Some((name, _)) => PathBuf::from(name),
        None => std::path::absolute(&path).unwrap_or(path),
    }
}

impl Playback {
    /// Creates the motion through at least two samples at rising times; it starts at the first. The slope at a sample is that of
    /// the parabola through it and its neighbours.
    fn new(motion: Motion, repeats: bool) -> Self {
        let Motion { samples, count, mut end_s, hash, .. } = motion;
        let mut knots = joined(&samples);
        if repeats {
            let mut intervals: Vec<f64> = samples.windows(2).map(|pair| pair[1].0 - pair[0].0).collect();
            intervals.sort_by(f64::total_cmp);
            end_s += intervals[intervals.len() / 2];
            // Repetition does not change the motion itself.
            knots.push(Knot { time_s: end_s, ..knots[0] });
        }
        Self { knots, count, end_s, repeats, hash: hash.digest(), assumed: None }
    }

    /// Returns the hash of the samples.
    pub fn hash(&self) -> String {
        format!("{:016x}", self.hash)
    }

    /// Returns the units that were assumed, as text; `None` if all are given.
    pub fn assumed(&self) -> Option<&str> {
        self.assumed.as_deref()
    }

    /// Returns the length of the motion, s. After it, the motion starts again or is over.
    pub fn length_s(&self) -> f64 {
        self.end_s
    }

    /// Returns the number of samples, and the largest interval between played ones, s.
    pub fn sampling(&self) -> (usize, f64) {
        let longest_s = self.knots.windows(2).map(|pair| pair[1].time_s - pair[0].time_s).fold(0.0, f64::max);
        (self.count, longest_s)
    }

    /// Returns true if the motion starts again at its end.
    pub fn repeats(&self) -> bool {
        self.repeats
    }

    /// Returns the angular velocity at a time since the start, rad/s. After the end it is the last one, or that of the repetition.
    pub fn at(&self, time_s: f64) -> Vector3<f64> {
        let time_s = if self.repeats { time_s % self.length_s() } else { time_s };
        at(&self.knots, time_s)
    }

    /// Returns bounds on the magnitude, rad/s, and on each component of the slope, rad/s², at all times.
    pub fn bounds(&self) -> (f64, Vector3<f64>) {
        let (mut rate, mut slope) = (0.0_f64, Vector3::zeros());
        for pair in self.knots.windows(2) {
            let ([from, to], span_s) = ([pair[0], pair[1]], pair[1].time_s - pair[0].time_s);
            // A cubic lies within the hull of its Bézier points, and its derivative within the hull of its own.
            let inner = [from.rate + from.slope * (span_s / 3.0), to.rate - to.slope * (span_s / 3.0)];
            for point in [from.rate, inner[0], inner[1], to.rate] {
                rate = rate.max(point.norm());
            }
            for point in [from.slope, (inner[1] - inner[0]) * (3.0 / span_s), to.slope] {
                slope = slope.sup(&point.abs());
            }
        }
        (rate, slope)
    }

    /// Returns the largest error of interpolating every second sample, measured at the others, rad/s. Interpolation of all samples
    /// errs by about an eighth of it, apart from noise.
    pub fn coarse_error_rad_s(&self) -> Option<f64> {
        // The knot that closes the repetition is not a sample.
        let own = &self.knots[..self.knots.len() - usize::from(self.repeats)];
        let samples: Vec<(f64, Vector3<f64>)> = own.iter().map(|knot| (knot.time_s, knot.rate)).collect();
        let kept: Vec<_> = samples.iter().step_by(2).copied().collect();
        if kept.len() < 3 {
            return None;
        }
        let (coarse, end_s) = (joined(&kept), kept[kept.len() - 1].0);
        let left_out = samples.iter().skip(1).step_by(2).filter(|(time_s, _)| *time_s < end_s);
        left_out.map(|(time_s, rate)| (at(&coarse, *time_s) - rate).norm()).reduce(f64::max)
    }
}

/// Returns the samples with their slopes.
fn joined(samples: &[(f64, Vector3<f64>)]) -> Vec<Knot> {
    let chord = |from: usize| (samples[from + 1].1 - samples[from].1) / (samples[from + 1].0 - samples[from].0);
    let last = samples.len() - 1;
    let slope = |at: usize| {
        if last == 1 {
            return chord(0);
        }
        // At an end, use the parabola through the three samples there.
        let middle = at.clamp(1, last - 1);
        let (before, after) = (chord(middle - 1), chord(middle));
        let [t0, t1, t2] = [middle - 1, middle, middle + 1].map(|index| samples[index].0);
        let curvature = (after - before) / (t2 - t0);
        before + curvature * ((samples[at].0 - t0) + (samples[at].0 - t1))
    };
    (0..samples.len()).map(|at| Knot { time_s: samples[at].0, rate: samples[at].1, slope: slope(at) }).collect()
}

/// Evaluates the cubic Hermite interpolant between the neighbouring knots; beyond the ends the rate of the end.
fn at(knots: &[Knot], time_s: f64) -> Vector3<f64> {
    let behind = knots.partition_point(|knot| knot.time_s <= time_s);
    let (Some(from), Some(to)) = (behind.checked_sub(1).map(|index| knots[index]), knots.get(behind)) else {
        return knots[behind.saturating_sub(1)].rate;
    };
    let span_s = to.time_s - from.time_s;
    let part = (time_s - from.time_s) / span_s;
    let rest = 1.0 - part;
    let (out, into) = (from.slope * (span_s * part * rest * rest), to.slope * (span_s * part * part * rest));
    from.rate * (rest * rest * (1.0 + 2.0 * part)) + to.rate * (part * part * (1.0 + 2.0 * rest)) + out - into
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a motion with known derivatives.
    fn wave(time_s: f64) -> Vector3<f64> {
        Vector3::new((3.0 * time_s).sin(), (2.0 * time_s).cos(), 0.3 * time_s)
    }

    fn sampled(step_s: f64, count: usize) -> Vec<(f64, Vector3<f64>)> {
        let time = |index: usize| step_s * (index as f64 + if index % 3 == 1 { 0.3 } else { 0.0 });
        (0..count).map(|index| (5.0 + time(index), wave(time(index)))).collect()
    }

    fn through(samples: &[(f64, Vector3<f64>)], repeats: bool) -> Playback {
        let mut motion = Motion::new(f64::INFINITY);
        samples.iter().for_each(|(time_s, rate)| motion.add(*time_s, *rate));
        Playback::new(motion, repeats)
    }

    fn worst(playback: &Playback, until_s: f64) -> f64 {
        (0..2000)
            .map(|i| until_s * f64::from(i) / 2000.0)
            .map(|t| (playback.at(t) - wave(t)).norm())
            .fold(0.0, f64::max)
    }

    #[test]
    fn the_motion_meets_its_samples_and_its_error_falls_with_their_distance() {
        let fine = through(&sampled(0.01, 201), false);
        for (time_s, rate) in sampled(0.01, 201) {
            assert!((fine.at(time_s - 5.0) - rate).norm() < 1e-12);
        }
        let coarse = through(&sampled(0.02, 101), false);
        let [fine_error, coarse_error] = [worst(&fine, 2.0), worst(&coarse, 2.0)];
        assert!(fine_error < coarse_error / 6.0, "{fine_error} {coarse_error}: at least of third order");
        let reported = fine.coarse_error_rad_s().unwrap();
        assert!(reported > fine_error && reported < 2.0 * coarse_error, "{reported} {fine_error} {coarse_error}");
    }

    #[test]
    fn the_bounds_hold_at_all_times() {
        let playback = through(&sampled(0.05, 40), true);
        let (rate, slope) = playback.bounds();
        let step_s = 1e-4;
        for tick in 0..60_000 {
            let [from, to] = [tick, tick + 1].map(|tick| playback.at(f64::from(tick) * step_s));
            assert!(from.norm() <= rate);
            assert!(((to - from) / step_s).abs() <= slope * (1.0 + 1e-9), "{tick}: {from} {to} {slope}");
        }
    }

    #[test]
    fn the_motion_ends_or_repeats() {
        let samples = [(1.0, Vector3::x()), (2.0, Vector3::y()), (3.0, Vector3::z())];
        let once = through(&samples, false);
        assert_eq!(
            (once.length_s(), once.at(0.0), once.at(2.0), once.at(9.0)),
            (2.0, Vector3::x(), Vector3::z(), Vector3::z())
        );
        let again = through(&samples, true);
        assert_eq!((again.length_s(), again.sampling()), (3.0, (3, 1.0)));
        assert_eq!((again.at(2.0), again.at(3.0), again.at(4.0)), (Vector3::z(), Vector3::x(), Vector3::y()));
    }

    fn load(text: &str, raw: &RawPlayback) -> Result<Playback, PlaybackError> {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("log.csv");
        std::fs::write(&path, text).unwrap();
        raw.load(&path, 10.0)
    }

    #[test]
    fn samples_that_are_not_played_are_counted_but_not_kept() {
        let mut motion = Motion::new(0.5);
        sampled(0.01, 1001).iter().for_each(|(time_s, rate)| motion.add(*time_s, *rate));
        assert_eq!(motion.samples.len(), 53);
        let (part, whole) = (Playback::new(motion, false), through(&sampled(0.01, 1001), false));
        assert_eq!((part.length_s(), part.sampling().0, part.hash()), (whole.length_s(), 1001, whole.hash()));
        assert!((0..=500).map(|tick| f64::from(tick) * 1e-3).all(|time_s| part.at(time_s) == whole.at(time_s)));
    }

    #[test]
    fn one_segment_is_played_and_errors_list_the_segments() {
        let text = "throw,t,wx,wy,wz\na,0,1,2,3\na,0.1,2,2,3\nb,0,5,0,0\nb,0.1,6,0,0\nb,0.2,7,0,0\nc,0,1,1,1\n";
        let by = RawPlayback { by: Some("throw".into()), ..RawPlayback::default() };
        let refused = load(text, &by).unwrap_err().to_string();
        assert!(refused.contains("3 segments") && refused.ends_with("one of: a, b, c"), "{refused}");
        let named = |segment: &str| RawPlayback { segment: Some(segment.into()), ..by.clone() };
        let found = load(text, &named("b")).unwrap();
        assert_eq!((found.sampling().0, found.at(0.1).x), (3, 6.0));
        assert!(load(text, &named("d")).unwrap_err().to_string().contains("no segment `d`; it has: a, b, c"));
        assert!(load(text, &named("c")).unwrap_err().to_string().contains("has 1 samples"));
        let kept = RawPlayback { hash: Some(found.hash()), ..named("b") };
        assert_eq!(load(text, &kept).unwrap().hash(), found.hash());
        assert!(matches!(load(&text.replace("6,0,0", "6,0,1"), &kept), Err(PlaybackError::Changed { .. })));
        let bad = RawPlayback { rate_unit: Some("Hz".into()), ..named("b") };
        assert_eq!(
            load(text, &bad).unwrap_err().to_string(),
            "`Hz` is not a unit of angular velocity: rad/s, deg/s, mdps, mrad/s, rpm or rev/s"
        );
    }

    #[test]
    fn axes_rotate_the_motion_and_must_be_a_rotation() {
        let text = "t,wx,wy,wz\n0,1,2,3\n0.1,1,2,3\n";
        let turned =
            RawPlayback { axes: Some([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), ..RawPlayback::default() };
        // The columns are the principal axes: the first one is the sensor's y.
        assert_eq!(load(text, &turned).unwrap().at(0.0), Vector3::new(2.0, -1.0, 3.0));
        let mirrored = RawPlayback { axes: Some([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]), ..turned };
        assert!(matches!(load(text, &mirrored), Err(PlaybackError::Axes)));
    }
}

//! A leader that repeats a motion which was recorded: angular velocities from a log, joined by cubics.
//!
//! Must not know of ticks, nor repair what the log lacks: its segment is taken as the reader gives it.

use crate::data::{DataError, Log, Options, RateUnit, TimeUnit};
use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use xxhash_rust::xxh3::Xxh3Default;

/// The logs that ship with the program, for its scenarios: name and text.
const SHIPPED: [(&str, &str); 1] = [("tumbling-throw.csv", include_str!("../../../config/tumbling-throw.csv"))];
/// By how much axes may miss being a rotation.
const ROTATION: f64 = 1e-6;

/// How a log is read and played, as typed.
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
    pub by: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub segment: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gap_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub axes: Option<[[f64; 3]; 3]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub headerless: Option<bool>,
    pub at_end: AtEnd,
    /// Of what was read; filled in when a scenario is resolved.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hash: Option<String>,
}

/// What becomes of a run that is longer than the log.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum AtEnd {
    /// It is refused.
    #[default]
    Refuse,
    /// The motion begins again, joined to its end over one usual interval.
    Repeat,
}

/// Why there is no motion to play.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub(super) enum PlaybackError {
    #[error(transparent)]
    #[strum(transparent)]
    Data(#[from] DataError),
    #[error("`{0}` is no unit {1}")]
    #[strum(serialize = "unknown-unit")]
    Unit(String, &'static str),
    #[error("{path} has {segments} segments; name one with leader.playback.segment, one of: {names}")]
    #[strum(serialize = "several-segments")]
    Several { path: String, segments: usize, names: String },
    #[error("{path} has no segment `{segment}`; it has: {names}")]
    #[strum(serialize = "no-such-segment")]
    NoSegment { path: String, segment: String, names: String },
    #[error(
        "the motion in {path} has {samples} samples, and two are the least that can be joined; name a longer segment"
    )]
    #[strum(serialize = "log-too-short")]
    Short { path: String, samples: usize },
    #[error(
        "{path} is not what it was when this scenario was resolved: its samples have the hash {found}; bring the old file \
         back, or remove leader.playback.hash"
    )]
    #[strum(serialize = "log-changed")]
    Changed { path: String, found: String },
    #[error("the axes are no rotation: their columns must be of length 1, at right angles, and right-handed")]
    #[strum(serialize = "no-rotation")]
    Axes,
}

/// One sample with the slope of the motion there.
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
    /// How many samples there are, also of those that are not kept.
    count: usize,
    /// When it is over, or begins again, s.
    end_s: f64,
    repeats: bool,
    hash: u64,
}

/// The samples of a motion as they are read.
struct Motion {
    samples: Vec<(f64, Vector3<f64>)>,
    keep_s: f64,
    begin_s: f64,
    end_s: f64,
    count: usize,
    hash: Xxh3Default,
}

impl Motion {
    /// None yet; those that are needed up to a time are kept.
    fn new(keep_s: f64) -> Self {
        Self { samples: Vec::new(), keep_s, begin_s: 0.0, end_s: 0.0, count: 0, hash: Xxh3Default::new() }
    }

    fn add(&mut self, time_s: f64, rate: Vector3<f64>) {
        if self.count == 0 {
            self.begin_s = time_s;
        }
        (self.count, self.end_s) = (self.count + 1, time_s - self.begin_s);
        [self.end_s, rate.x, rate.y, rate.z].iter().for_each(|value| self.hash.update(&value.to_bits().to_le_bytes()));
        // The slope at the sample behind the end takes one more.
        let behind = self.samples.iter().rev().take(2).filter(|(time_s, _)| *time_s > self.keep_s).count();
        if behind < 2 {
            self.samples.push((self.end_s, rate));
        }
    }
}

/// So many names of segments are told.
const NAMES_TOLD: usize = 12;

impl RawPlayback {
    fn options(&self) -> Result<Options, PlaybackError> {
        let unit = |name: &Option<String>, of: &'static str| name.clone().map(|name| (name, of));
        let time_unit = unit(&self.time_unit, "of time: s, ms, us or ns");
        let rate_unit = unit(&self.rate_unit, "of angular velocity: rad/s or deg/s");
        let unknown = |(name, of): (String, &'static str)| PlaybackError::Unit(name, of);
        Ok(Options {
            topic: self.topic.clone(),
            time: self.time.clone(),
            rates: self.rates.clone(),
            time_unit: time_unit.map(|named| TimeUnit::parse(&named.0).ok_or_else(|| unknown(named))).transpose()?,
            rate_unit: rate_unit.map(|named| RateUnit::parse(&named.0).ok_or_else(|| unknown(named))).transpose()?,
            by: self.by.clone(),
            gap_s: self.gap_s,
            header: !self.headerless.unwrap_or(false),
            needed: [true; 3],
        })
    }

    fn rotation(&self) -> Result<Matrix3<f64>, PlaybackError> {
        let axes = self.axes.map_or_else(Matrix3::identity, |rows| Matrix3::from_fn(|row, column| rows[row][column]));
        let defect = (axes.transpose() * axes - Matrix3::identity()).amax();
        // What is no number is no rotation either.
        if defect < ROTATION && axes.determinant() > 0.0 { Ok(axes.transpose()) } else { Err(PlaybackError::Axes) }
    }

    /// Reads the motion in a file, or in a log that ships with the program if there is no such file. A log may be larger than
    /// memory: unless it is repeated, nothing is kept of it that is not played in `duration_s`.
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
        while let Some(entry) = log.next() {
            let entry = entry?;
            if entry.begins {
                names.push(log.segment_name());
            }
            let asked = self.segment.as_ref().map_or(names.len() == 1, |segment| names.last() == Some(segment));
            if asked {
                motion.add(entry.time_s, own * Vector3::from(entry.rate_rad_s));
            }
        }
        let path = log.path().display().to_string();
        let told = || names.iter().take(NAMES_TOLD).cloned().collect::<Vec<_>>().join(", ");
        match &self.segment {
            None if names.len() > 1 => {
                return Err(PlaybackError::Several { path, segments: names.len(), names: told() });
            }
            Some(segment) if motion.count == 0 => {
                return Err(PlaybackError::NoSegment { path, segment: segment.clone(), names: told() });
            }
            _ if motion.count < 2 => return Err(PlaybackError::Short { path, samples: motion.count }),
            _ => {}
        }
        let playback = Playback::new(motion, self.at_end == AtEnd::Repeat);
        match &self.hash {
            Some(hash) if *hash != playback.hash() => Err(PlaybackError::Changed { path, found: playback.hash() }),
            _ => Ok(playback),
        }
    }
}

/// Where a log is: one that ships with the program by its name alone.
pub(super) fn locate(path: PathBuf) -> PathBuf {
    let shipped = SHIPPED.iter().find(|(name, _)| path.file_name().is_some_and(|own| own == *name) && !path.exists());
    match shipped {
        Some((name, _)) => PathBuf::from(name),
        None => std::path::absolute(&path).unwrap_or(path),
    }
}

impl Playback {
    /// The motion through at least two samples at rising times, which begins at the first. The slope at a sample is that
    /// of the parabola through it and its neighbours.
    fn new(motion: Motion, repeats: bool) -> Self {
        let Motion { samples, count, mut end_s, hash, .. } = motion;
        let mut knots = joined(&samples);
        if repeats {
            let mut intervals: Vec<f64> = samples.windows(2).map(|pair| pair[1].0 - pair[0].0).collect();
            intervals.sort_by(f64::total_cmp);
            end_s += intervals[intervals.len() / 2];
            // The motion itself is the same as if it were not repeated.
            knots.push(Knot { time_s: end_s, ..knots[0] });
        }
        Self { knots, count, end_s, repeats, hash: hash.digest() }
    }

    /// The samples' identity.
    pub fn hash(&self) -> String {
        format!("{:016x}", self.hash)
    }

    /// How long it is, s: after that it begins again, or there is nothing.
    pub fn length_s(&self) -> f64 {
        self.end_s
    }

    /// How many samples it has, and the largest distance of those that are played, s.
    pub fn sampling(&self) -> (usize, f64) {
        let longest_s = self.knots.windows(2).map(|pair| pair[1].time_s - pair[0].time_s).fold(0.0, f64::max);
        (self.count, longest_s)
    }

    /// Whether it begins again at its end.
    pub fn repeats(&self) -> bool {
        self.repeats
    }

    /// The angular velocity at a time since the beginning, rad/s; at the end the last one, or that of the motion begun again.
    pub fn at(&self, time_s: f64) -> Vector3<f64> {
        let time_s = if self.repeats { time_s % self.length_s() } else { time_s };
        at(&self.knots, time_s)
    }

    /// Bounds on the magnitude and on each component of the slope between all samples, rad/s and rad/s².
    pub fn bounds(&self) -> (f64, Vector3<f64>) {
        let (mut rate, mut slope) = (0.0_f64, Vector3::zeros());
        for pair in self.knots.windows(2) {
            let ([from, to], span_s) = ([pair[0], pair[1]], pair[1].time_s - pair[0].time_s);
            // A cubic lies within the hull of its Bézier points, and its derivative within that of its own.
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

    /// By how much the motion through every second sample misses the others, at the most, rad/s: with samples twice as far
    /// apart. That of all samples misses what lies between them by about an eighth of that, the noise aside.
    pub fn coarse_error_rad_s(&self) -> Option<f64> {
        // The knot by which it is repeated is no sample.
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

/// The samples with their slopes.
fn joined(samples: &[(f64, Vector3<f64>)]) -> Vec<Knot> {
    let chord = |from: usize| (samples[from + 1].1 - samples[from].1) / (samples[from + 1].0 - samples[from].0);
    let last = samples.len() - 1;
    let slope = |at: usize| {
        if last == 1 {
            return chord(0);
        }
        // At an end the parabola is that of the three samples there.
        let middle = at.clamp(1, last - 1);
        let (before, after) = (chord(middle - 1), chord(middle));
        let [t0, t1, t2] = [middle - 1, middle, middle + 1].map(|index| samples[index].0);
        let curvature = (after - before) / (t2 - t0);
        before + curvature * ((samples[at].0 - t0) + (samples[at].0 - t1))
    };
    (0..samples.len()).map(|at| Knot { time_s: samples[at].0, rate: samples[at].1, slope: slope(at) }).collect()
}

/// The cubic through both neighbours with their slopes (Hermite); beyond the ends what is there.
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

    /// A motion with known derivatives, sampled at uneven times.
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
    fn samples_are_met_and_the_error_between_them_falls_with_their_distance() {
        let fine = through(&sampled(0.01, 201), false);
        for (time_s, rate) in sampled(0.01, 201) {
            assert!((fine.at(time_s - 5.0) - rate).norm() < 1e-12);
        }
        let coarse = through(&sampled(0.02, 101), false);
        let [fine_error, coarse_error] = [worst(&fine, 2.0), worst(&coarse, 2.0)];
        assert!(fine_error < coarse_error / 6.0, "{fine_error} {coarse_error}: of third order at least");
        let told = fine.coarse_error_rad_s().unwrap();
        assert!(told > fine_error && told < 2.0 * coarse_error, "{told} {fine_error} {coarse_error}");
    }

    #[test]
    fn its_bounds_hold_everywhere() {
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
    fn it_ends_or_begins_again() {
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
    fn what_is_not_played_is_not_kept_and_yet_counted() {
        let mut motion = Motion::new(0.5);
        sampled(0.01, 1001).iter().for_each(|(time_s, rate)| motion.add(*time_s, *rate));
        assert_eq!(motion.samples.len(), 53);
        let (part, whole) = (Playback::new(motion, false), through(&sampled(0.01, 1001), false));
        assert_eq!((part.length_s(), part.sampling().0, part.hash()), (whole.length_s(), 1001, whole.hash()));
        assert!((0..=500).map(|tick| f64::from(tick) * 1e-3).all(|time_s| part.at(time_s) == whole.at(time_s)));
    }

    #[test]
    fn one_segment_is_played_and_it_is_said_which_there_are() {
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
        let bad = RawPlayback { rate_unit: Some("rpm".into()), ..named("b") };
        assert_eq!(load(text, &bad).unwrap_err().to_string(), "`rpm` is no unit of angular velocity: rad/s or deg/s");
    }

    #[test]
    fn axes_turn_the_motion_and_must_be_a_rotation() {
        let text = "t,wx,wy,wz\n0,1,2,3\n0.1,1,2,3\n";
        let turned =
            RawPlayback { axes: Some([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), ..RawPlayback::default() };
        // The columns are the principal axes: the first one is the sensor's y.
        assert_eq!(load(text, &turned).unwrap().at(0.0), Vector3::new(2.0, -1.0, 3.0));
        let mirrored = RawPlayback { axes: Some([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]), ..turned };
        assert!(matches!(load(text, &mirrored), Err(PlaybackError::Axes)));
    }
}

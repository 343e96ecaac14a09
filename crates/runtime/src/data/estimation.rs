//! Estimates a log's hidden component row by row: rotates into principal axes, chooses a rate, reconstructs, and scores.
//!
//! It reads ahead the samples from which it chooses the rate; beyond that, memory grows only with the number of segments.

use super::cut::resolved;
use super::form::{DataError, Options};
use super::identification::{LogAccount, sample};
use super::log::{Entry, Log};
use super::plausible;
use crate::estimate::{
    FilterKind, RateChoice, RateSurvey, Reconstructed, Reconstruction, ReconstructionError, ScaleSurvey, Score,
    SegmentScore, Setup, Wheel,
};
use crate::identify::{Motion, Sample};
use nalgebra::{Matrix3, Vector3};
use std::path::Path;

/// The most samples from which a rate is chosen.
const SURVEY_SAMPLES: usize = 100_000;
/// Rates above this multiple of their noise carry information.
const FLOOR_NOISES: f64 = 10.0;
const LEAST_FLOOR_RAD_S: f64 = 1e-6;
/// Smaller entries of a rotation count as zero.
const UNMIXED: f64 = 1e-9;
/// The largest deviation of a rotation matrix from orthogonality.
const ROTATION: f64 = 1e-3;
/// The turn in a step from which it is too long, rad.
const LONG_TURN_RAD: f64 = 1.5;
/// An estimate above this multiple of the fastest measured rate has diverged.
const DIVERGED: f64 = 1e3;

/// The kind of filter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum FilterOrder {
    /// The papers' filter of first order.
    #[default]
    First,
    /// The filter of second order.
    Second,
    /// The Kalman filter of the relation.
    Kalman,
}

/// The settings of an estimate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Request {
    /// The hidden axis, 1 to 3, among the principal ones.
    pub axis: usize,
    /// The coefficients a of \[D\](2).
    pub coefficients: Vector3<f64>,
    /// Damping by a torque −c I ω, 1/s.
    pub damping_per_s: f64,
    /// A wheel in the body, with its momentum in the sensor's axes.
    pub wheel: Option<Wheel>,
    /// The principal axes as columns in the sensor's axes; `None` if both are the same.
    pub axes: Option<Matrix3<f64>>,
    /// The filter.
    pub order: FilterOrder,
    /// The rate of the filter, 1/s; chosen from the log's start if `None`.
    pub decay_per_s: Option<f64>,
    /// Standard deviation of one measured rate, rad/s; that of the log's start if `None`. Only the Kalman filter uses it.
    pub noise_rad_s: Option<f64>,
    /// The first estimate of every segment, rad/s.
    pub guess_rad_s: Option<f64>,
    /// The level below which the measured rates carry no information, rad/s; ten times the noise of the log's start if `None`.
    pub floor_rad_s: Option<f64>,
}

impl Request {
    /// Returns the wheel about the principal axes.
    fn principal_wheel(&self) -> Option<Wheel> {
        let turned = |wheel: Wheel| Wheel {
            momentum: self.axes.map_or(wheel.momentum, |axes| axes.transpose() * wheel.momentum),
            ..wheel
        };
        self.wheel.map(turned)
    }

    /// Checks the axes, and allows a log to lack the sensors that do not contribute to the two rates about the other principal axes.
    fn sensors(&self, options: &Options) -> Result<Options, EstimateError> {
        let axes = self.axes.unwrap_or_else(Matrix3::identity);
        let defect = (axes.transpose() * axes - Matrix3::identity()).amax();
        if !(defect < ROTATION && axes.determinant() > 0.0) {
            return Err(EstimateError::Axes);
        }
        let contributes = |sensor, axis| axis + 1 != self.axis && axes[(sensor, axis)].abs() > UNMIXED;
        let needed = [0, 1, 2].map(|sensor| (0..3).any(|axis| contributes(sensor, axis)));
        let absent = |sensor: &usize| options.rates.as_ref().is_some_and(|names| names[*sensor] == "-");
        if let Some(sensor) = (0..3).filter(|sensor| needed[*sensor]).find(absent).filter(|_| self.axes.is_some()) {
            return Err(EstimateError::Mixed { axis: ["x", "y", "z"][sensor] });
        }
        Ok(Options { may_lack: needed.map(|needed| !needed), ..options.clone() })
    }

    /// Returns the measured rates about the principal axes, rad/s.
    fn principal_rates(&self, entry: &Entry) -> Vector3<f64> {
        let measured = Vector3::from(entry.rate_rad_s);
        let Some(axes) = &self.axes else { return measured };
        // An unknown rate does not affect rates to which it does not contribute.
        Vector3::from_fn(|axis, _| {
            let parts = (0..3).map(|sensor| (axes[(sensor, axis)], measured[sensor]));
            parts.filter(|(part, _)| part.abs() > UNMIXED).map(|(part, rate)| part * rate).sum()
        })
    }
}

/// An error of an estimate.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum EstimateError {
    /// The log cannot be read.
    #[error(transparent)]
    #[strum(transparent)]
    Data(#[from] DataError),
    /// The settings are impossible.
    #[error(transparent)]
    #[strum(serialize = "impossible-estimate")]
    Setup(#[from] ReconstructionError),
    /// The axes are not a rotation.
    #[error(
        "the axes are no rotation: their columns must be of length 1, at right angles, and right-handed; take them from \
         `corotate identify --json`"
    )]
    #[strum(serialize = "no-rotation")]
    Axes,
    /// The principal axes are turned, and a sensor is missing.
    #[error(
        "the principal axes are turned against the sensor's, and the log has no column of the rate about {axis}: it takes all \
         three to know two rates about principal axes; leave the axes out if the sensor is nearly aligned"
    )]
    #[strum(serialize = "mixed-axes")]
    Mixed {
        /// The letter of the axis.
        axis: &'static str,
    },
    /// No rate can be chosen.
    #[error("{path}: no rate can be chosen, because nothing moves in the first rows; give one with --decay")]
    NoRate {
        /// The log.
        path: String,
    },
    /// The receiver of the rows failed.
    #[error(transparent)]
    #[strum(serialize = "cannot-write")]
    Sink(std::io::Error),
}

/// A row with its estimate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimated {
    /// The row.
    pub entry: Entry,
    /// The angular velocity about the principal axes, rad/s; NaN where it was not measured.
    pub principal_rad_s: Vector3<f64>,
    /// The reconstructed hidden component.
    pub estimate: Reconstructed,
}

/// The result for a log.
#[derive(Debug, Clone)]
pub struct Estimation {
    /// The log.
    pub log: LogAccount,
    /// The filter that was used.
    pub filter: FilterKind,
    /// The level below which the measured rates counted as carrying no information, rad/s.
    pub floor_rad_s: f64,
    /// The rate choice from the log's start, if one was possible, with the data that it rests on.
    pub choice: Option<RateChoice>,
    /// True if the filter uses the chosen rate.
    pub chosen: bool,
    /// The number of samples at which the estimate is not finite, or a thousand times the fastest measured rate.
    pub diverged: u64,
    /// The segments with their names and scores, in the order of the log.
    pub segments: Vec<(String, SegmentScore)>,
}

/// Estimates the hidden component of a log, and gives every row to `each`.
///
/// # Errors
/// [`EstimateError`].
pub fn estimate_log(
    path: &Path,
    options: &Options,
    request: &Request,
    mut each: impl FnMut(&Estimated, &str) -> std::io::Result<()>,
) -> Result<Estimation, EstimateError> {
    let (options, forces) = resolved(path, &request.sensors(options)?)?;
    let mut log = Log::open(path, &options)?;
    let (head, survey) = survey(&mut log, request)?;
    let choice = survey.choose();
    let filter = filter(request, choice.as_ref(), path)?;
    let noise_rad_s = choice.map_or(0.0, |choice| choice.noise_rad_s);
    let floor_rad_s = request.floor_rad_s.unwrap_or((FLOOR_NOISES * noise_rad_s).max(LEAST_FLOOR_RAD_S));
    let mut progress = Progress::new(Reconstruction::new(&Setup {
        coefficients: request.coefficients,
        axis: request.axis,
        damping_per_s: request.damping_per_s,
        wheel: request.principal_wheel(),
        filter,
        guess_rad_s: request.guess_rad_s,
        floor_rad_s,
    })?);
    let mut take = |entry: Entry, segment: Option<String>| {
        segment.into_iter().for_each(|name| progress.end_segment(name));
        let estimated = progress.push(entry, request);
        each(&estimated, &progress.segment).map_err(EstimateError::Sink)
    };
    head.into_iter().try_for_each(|(entry, segment)| take(entry, segment))?;
    while let Some(entry) = log.next().transpose()? {
        take(entry, entry.begins.then(|| log.segment_name()))?;
    }
    let mut account = LogAccount { path: path.to_owned(), ..LogAccount::new(&log) };
    account.meaning.forces = forces;
    progress.end_segment(String::new());
    let Progress { diverged, segments, .. } = progress;
    let chosen = request.decay_per_s.is_none();
    Ok(Estimation { log: account, filter, floor_rad_s, choice, chosen, diverged, segments })
}

/// The reconstruction of a log up to a row.
struct Progress {
    reconstruction: Reconstruction,
    score: Score,
    /// The name of the present segment.
    segment: String,
    segments: Vec<(String, SegmentScore)>,
    fastest_rad_s: f64,
    /// True once the present segment was observed.
    begun: bool,
    diverged: u64,
    last_s: f64,
}

impl Progress {
    fn new(reconstruction: Reconstruction) -> Self {
        Self {
            reconstruction,
            score: Score::default(),
            segment: String::new(),
            segments: Vec::new(),
            fastest_rad_s: 0.0,
            begun: false,
            diverged: 0,
            last_s: 0.0,
        }
    }

    /// Ends the present segment; `next` is the name of the one that begins.
    fn end_segment(&mut self, next: String) {
        let ended = std::mem::replace(&mut self.segment, next);
        self.segments.extend(self.score.end_segment().map(|score| (ended, score)));
        self.reconstruction.end_segment();
        self.begun = false;
    }

    fn push(&mut self, entry: Entry, request: &Request) -> Estimated {
        let principal_rad_s = request.principal_rates(&entry);
        let mut estimate = self.reconstruction.push(&Sample { time_s: entry.time_s, rate_rad_s: principal_rad_s });
        let known = || principal_rad_s.iter().copied().filter(|rate| rate.is_finite());
        let turn_rad = known().map(|rate| rate * rate).sum::<f64>().sqrt() * (entry.time_s - self.last_s);
        // Where steps turn so far, the differences that give noise and floor are motion.
        estimate.too_long |= !estimate.observed && !entry.begins && turn_rad > LONG_TURN_RAD;
        self.last_s = entry.time_s;
        self.score.push(&estimate, principal_rad_s[request.axis - 1]);
        self.fastest_rad_s = known().fold(self.fastest_rad_s, |fastest, rate| fastest.max(rate.abs()));
        self.begun |= estimate.observed;
        // False for NaN.
        let near = estimate.rate_rad_s.abs() <= DIVERGED * self.fastest_rad_s;
        self.diverged += u64::from(self.begun && !near && !entry.begins);
        Estimated { entry, principal_rad_s, estimate }
    }
}

/// Reads a log's start, with the name of each segment that begins there.
#[allow(clippy::type_complexity, reason = "it is taken apart at once")]
fn survey(log: &mut Log, request: &Request) -> Result<(Vec<(Entry, Option<String>)>, RateSurvey), EstimateError> {
    let (mut head, mut survey) = (Vec::new(), RateSurvey::new(&request.coefficients, request.axis));
    let (mut motion, wheel) =
        (Motion::with_wheel(request.wheel.map_or(Vector3::zeros(), |wheel| wheel.momentum)), request.principal_wheel());
    // Without a third rate, its course comes from the body.
    let mut scale = ScaleSurvey::new(&request.coefficients, request.axis).filter(|_| wheel.is_none());
    while head.len() < SURVEY_SAMPLES {
        let Some(entry) = log.next().transpose()? else { break };
        if entry.begins {
            survey.end_segment();
            motion.end_segment();
            scale.iter_mut().for_each(ScaleSurvey::end_segment);
        }
        let measured = request.principal_rates(&entry);
        if entry.rate_rad_s.iter().all(|rate| rate.is_finite()) {
            motion.push(&sample(&entry));
        } else if let Some(scale) = &mut scale {
            scale.push(&Sample { rate_rad_s: measured, ..sample(&entry) });
        }
        let rate_rad_s = wheel.map_or(measured, |wheel| wheel.shifted(&measured, request.axis));
        survey.push(&Sample { rate_rad_s, ..sample(&entry) });
        head.push((entry, entry.begins.then(|| log.segment_name())));
    }
    motion.end_segment();
    scale.iter_mut().for_each(ScaleSurvey::end_segment);
    plausible::check_scale(log.path(), log.meaning(), &motion)?;
    let two = scale.filter(|_| motion.summary().samples == 0);
    plausible::check_factor(log.path(), log.meaning(), || two?.wrong_scale())?;
    Ok((head, survey))
}

/// Returns the requested filter; a missing rate or noise is that of the log's start.
fn filter(request: &Request, choice: Option<&RateChoice>, path: &Path) -> Result<FilterKind, EstimateError> {
    let none = || EstimateError::NoRate { path: path.display().to_string() };
    let decay_per_s = request.decay_per_s.or(choice.map(|choice| choice.decay_per_s)).ok_or_else(none)?;
    Ok(match request.order {
        FilterOrder::First => FilterKind::First { decay_per_s },
        FilterOrder::Second => FilterKind::Second { bandwidth_rad_s: decay_per_s },
        FilterOrder::Kalman => {
            let choice = choice.ok_or_else(none)?;
            // A log without noise still has rounding.
            let rounding = f64::EPSILON * choice.fastest_rad_s;
            let noise_rad_s = request.noise_rad_s.unwrap_or(choice.noise_rad_s.max(rounding));
            let density = choice.density(decay_per_s, noise_rad_s);
            FilterKind::Kalman { noise_rad_s, density, guess_deviation_rad_s: 2.0 * choice.fastest_rad_s }
        }
    })
}

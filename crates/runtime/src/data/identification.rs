//! Identifies a body from logs: runs every method of [`identify`](crate::identify) along the rows, in bounded memory.

use super::cut::resolved;
use super::form::{DataError, Meaning, Options};
use super::log::{Counts, Entry, Log};
use super::plausible;
use crate::identify::{
    AxesFit, Finding, Motion, MotionSummary, RecursiveAxisymmetricIdentifier, RecursiveFit, RecursiveIdentifier,
    Sample, TensorFit, findings, has_no_scale,
};
use nalgebra::Vector3;
use std::path::{Path, PathBuf};

/// The settings of an identification.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ways {
    /// True if the fit includes the torque of the air.
    pub damping: bool,
    /// The recursive identifiers' decay rate per unit of excitation; `None` to forget nothing.
    pub decay: Option<f64>,
    /// The axis of symmetry, 1 to 3, if the body is known to have one.
    pub symmetry_axis: Option<usize>,
    /// The momentum of a wheel in the sensor's axes, N m s; zero without one.
    pub wheel: Vector3<f64>,
}

/// A log that was read.
#[derive(Debug, Clone)]
pub struct LogAccount {
    /// The path of the log, or its name.
    pub path: PathBuf,
    /// The columns with their units.
    pub meaning: Meaning,
    /// The counts of its rows.
    pub counts: Counts,
    /// The parts that were read, s since the first row; `None` for all.
    pub parts: Option<Vec<[f64; 2]>>,
}

impl LogAccount {
    /// Returns the account of a log that was read to its end.
    pub(super) fn new(log: &Log) -> Self {
        let parts = log.parts().map(<[_]>::to_vec);
        Self { path: log.path().to_owned(), meaning: log.meaning().clone(), counts: *log.counts(), parts }
    }
}

/// The result of an identification.
#[derive(Debug, Clone)]
pub struct Identified {
    /// The logs.
    pub logs: Vec<LogAccount>,
    /// A summary of the motion in the logs.
    pub account: MotionSummary,
    /// Least squares about the sensor's axes, each axis separately.
    pub axes: Option<AxesFit>,
    /// Least squares about the sensor's axes, for one rigid body.
    pub body: Option<TensorFit>,
    /// Least squares of the whole tensor.
    pub tensor: Option<TensorFit>,
    /// The papers' filter; absent if it used no step, and for a body with a wheel, which it does not know.
    pub recursive: Option<RecursiveFit<3>>,
    /// The papers' filter for an axisymmetric body; absent if it used no step.
    pub axisymmetric: Option<RecursiveFit<1>>,
    /// The damping assumed by the recursive filters, 1/s.
    pub recursive_damping_per_s: f64,
    /// Findings about the quality of the result.
    pub findings: Vec<Finding>,
}

/// Reads logs of one body and identifies it. Files are read twice: the recursive filters run second, with the damping from the
/// least squares. A source that can be read only once (`-`) counts as undamped for them.
///
/// # Errors
/// [`DataError`].
pub fn identify_logs(paths: &[PathBuf], options: &Options, ways: &Ways) -> Result<Identified, DataError> {
    let all = Options { may_lack: [false; 3], ..options.clone() };
    let rereadable = paths.iter().all(|path| path.is_file());
    let mut motion = Motion::with_wheel(ways.wheel);
    let mut recursive = Filters::new(ways, 0.0)?;
    let mut logs = Vec::new();
    // The free motion of each log is found once.
    let found = paths.iter().map(|path| resolved(path, &all)).collect::<Result<Vec<_>, _>>()?;
    for (path, (all, forces)) in paths.iter().zip(&found) {
        let mut log = read(path, all, |sample| {
            match sample {
                Some(sample) => motion.push(sample),
                None => motion.end_segment(),
            }
            if !rereadable {
                recursive.take(sample);
            }
        })?;
        log.meaning.forces.clone_from(forces);
        logs.push(log);
    }
    let (axes, body) = (motion.about_known_axes(ways.damping), motion.moments_about_known_axes(ways.damping));
    let tensor = motion.about_unknown_axes(ways.damping);
    let mut findings = findings(&motion, axes.as_ref(), body.as_ref(), tensor.as_ref());
    logs.iter().try_for_each(|log| plausible::check_scale(&log.path, &log.meaning, &motion))?;
    if logs.iter().any(|log| !log.meaning.assumed.is_empty()) && has_no_scale(&motion) {
        findings.push(Finding::Units);
    }
    let mut recursive_damping_per_s = 0.0;
    if rereadable && !motion.has_wheel() {
        recursive_damping_per_s = body.map_or(0.0, |fit| fit.damping_per_s);
        recursive = Filters::new(ways, recursive_damping_per_s)?;
        for (path, (all, _)) in paths.iter().zip(&found) {
            read(path, all, |sample| recursive.take(sample))?;
        }
    }
    Ok(Identified {
        logs,
        account: *motion.summary(),
        findings,
        axes,
        body,
        tensor,
        recursive: Some(recursive.all.fit()).filter(|fit| fit.steps[0] > 0 && !motion.has_wheel()),
        axisymmetric: recursive.symmetric.map(|filter| filter.fit()).filter(|fit| fit.steps[0] > 0),
        recursive_damping_per_s,
    })
}

/// The recursive filters.
struct Filters {
    all: RecursiveIdentifier,
    symmetric: Option<RecursiveAxisymmetricIdentifier>,
}

impl Filters {
    fn new(ways: &Ways, damping_per_s: f64) -> Result<Self, DataError> {
        if let Some(decay) = ways.decay.filter(|decay| !(decay.is_finite() && *decay > 0.0)) {
            let reason = format!("a decay rate of {decay} is out of range; give a number above 0");
            return Err(DataError::Option { name: "decay", reason });
        }
        let new = |axis| RecursiveAxisymmetricIdentifier::new(axis, ways.decay, damping_per_s);
        let symmetric = ways.symmetry_axis.map(new).transpose();
        let symmetric =
            symmetric.map_err(|error| DataError::Option { name: "symmetry axis", reason: error.to_string() })?;
        Ok(Self { all: RecursiveIdentifier::new(ways.decay, damping_per_s), symmetric })
    }

    /// Adds a sample; `None` ends a segment.
    fn take(&mut self, sample: Option<&Sample>) {
        let Self { all, symmetric } = self;
        match sample {
            Some(sample) => {
                all.push(sample);
                symmetric.iter_mut().for_each(|filter| filter.push(sample));
            }
            None => {
                all.end_segment();
                symmetric.iter_mut().for_each(RecursiveAxisymmetricIdentifier::end_segment);
            }
        }
    }
}

/// Returns a row as a sample.
pub(super) fn sample(entry: &Entry) -> Sample {
    Sample { time_s: entry.time_s, rate_rad_s: entry.rate_rad_s.into() }
}

/// Reads a log; `None` ends a segment.
fn read(path: &Path, options: &Options, mut each: impl FnMut(Option<&Sample>)) -> Result<LogAccount, DataError> {
    let mut log = Log::open(path, options)?;
    while let Some(entry) = log.next().transpose()? {
        if entry.begins {
            each(None);
        }
        each(Some(&sample(&entry)));
    }
    each(None);
    Ok(LogAccount::new(&log))
}

//! The input of a report: a run's directory, or a recording alone. Notes the parts that are missing.
//!
//! Must not guess: a file that exists but cannot be read is an error.

use super::error::ReportError;
use super::percentiles::{Curve, read_curve};
use crate::config::{ClockKind, RunId};
use crate::files;
use crate::inputs::{AppliedChange, applied};
use crate::late::LateReport;
use crate::launch::{LATE, LATENCY, RECORDING, SCENARIO, SUMMARY, Summary};
use crate::record::Recording;
use crate::scenario::Scenario;
use crate::score::StepResponse;
use std::fs;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};

/// The files of a run.
#[derive(Debug)]
pub struct Source {
    pub summary: Option<Summary>,
    pub scenario: Option<Scenario>,
    pub recording: Option<Recording>,
    pub curves: Vec<Curve>,
    pub late: Option<LateReport>,
    /// A remark for each missing part: what is missing, and how to get it.
    pub missing: Vec<String>,
}

impl Source {
    /// Opens a run's directory, or a recording.
    pub fn open(path: &Path) -> Result<Self, ReportError> {
        let about = fs::metadata(path).map_err(|source| match source.kind() {
            ErrorKind::NotFound => ReportError::Nothing { path: path.to_owned() },
            _ => ReportError::Read { path: path.to_owned(), source },
        })?;
        if about.is_dir() { Self::directory(path) } else { Self::recording(path) }
    }

    fn recording(path: &Path) -> Result<Self, ReportError> {
        let recording = Recording::open(path)?;
        let late = recorded_late_ticks(&recording)?;
        let missing = "verdict, counters and latencies are missing: a recording does not contain them; give the run's \
                       directory, with summary.json and latency/, to `corotate report`";
        Ok(Self {
            summary: None,
            scenario: Some(recording.scenario()?),
            recording: Some(recording),
            curves: Vec::new(),
            late,
            missing: vec![missing.to_owned()],
        })
    }

    fn directory(path: &Path) -> Result<Self, ReportError> {
        let (at, mut missing) = (|name: &str| path.join(name), Vec::new());
        let summary = text(&at(SUMMARY))?;
        let recording = at(RECORDING).exists().then(|| Recording::open(&at(RECORDING))).transpose()?;
        if summary.is_none() && recording.is_none() {
            return Err(ReportError::NoRun { path: path.to_owned() });
        }
        let refused = |reason| ReportError::Summary { path: at(SUMMARY), reason };
        let summary = summary.map(|text| Summary::parse(&text)).transpose().map_err(refused)?;
        if summary.is_none() {
            missing.push("summary.json is missing: the run was aborted, or is still running".to_owned());
        }
        let scenario = scenario(&at(SCENARIO), recording.as_ref())?;
        if recording.is_none() {
            missing.push(
                "charts over time are missing: the samples were not recorded; `corotate run FILE --record` writes them \
                 to run.mcap"
                    .to_owned(),
            );
        }
        let curves = curves(&at(LATENCY), summary.as_ref())?;
        if curves.is_empty() {
            let clock = scenario.as_ref().map(|scenario| scenario.clock);
            let reason = match clock {
                Some(ClockKind::InProcess) => "a run with clock = \"in-process\" measures none",
                Some(ClockKind::Lockstep) => "a run with clock = \"lockstep\" measures none",
                Some(ClockKind::Realtime) | None => "there is no latency/ in the directory",
            };
            missing.push(format!("latencies are missing: {reason}"));
        }
        let recorded = || recording.as_ref().map_or(Ok(None), recorded_late_ticks);
        let late = late_ticks(&at(LATE))?.map_or_else(recorded, |late| Ok(Some(late)))?;
        if late.is_none() && summary.as_ref().is_some_and(|summary| summary.clock == ClockKind::Realtime.name()) {
            let reason = "realtime.trace was \"off\", or an older version made the run";
            missing.push(format!("the causes of late ticks are missing: {reason}"));
        }
        let found = Self { summary, scenario, recording, curves, late, missing };
        found.require_one_run(path)?;
        Ok(found)
    }

    /// Checks that all files belong to the same run.
    fn require_one_run(&self, directory: &Path) -> Result<(), ReportError> {
        let file = |name: &str, run: Option<RunId>| (directory.join(name), run);
        let mut files: Vec<(PathBuf, Option<RunId>)> = Vec::new();
        files.extend(self.summary.as_ref().map(|summary| file(SUMMARY, summary.run)));
        files.extend(self.recording.as_ref().map(|recording| file(RECORDING, recording.info().run)));
        // Without scenario.toml the scenario comes from the recording, and has no run identifier.
        let scenario = self.scenario.as_ref().filter(|_| directory.join(SCENARIO).exists());
        files.extend(scenario.map(|scenario| file(SCENARIO, scenario.run)));
        files.extend(self.late.as_ref().map(|late| file(LATE, late.run)));
        let curve = |curve: &Curve| file(&format!("{LATENCY}/{}.{}.hgrm", curve.role, curve.stage), curve.run);
        files.extend(self.curves.iter().map(curve));
        let Some((first, rest)) = files.split_first() else { return Ok(()) };
        match rest.iter().find(|file| file.1 != first.1) {
            Some(second) => Err(ReportError::TwoRuns { files: Box::new([first.clone(), second.clone()]) }),
            None => Ok(()),
        }
    }

    /// Returns the changes of inputs in the order of their ticks.
    pub fn changes(&self) -> Vec<AppliedChange> {
        let of_scenario = || self.scenario.as_ref().map_or(Vec::new(), |scenario| applied(scenario));
        self.summary.as_ref().map_or_else(of_scenario, |summary| summary.inputs.clone())
    }

    /// Returns the responses to steps of inputs; empty without a summary.
    pub fn responses(&self) -> &[StepResponse] {
        self.summary.as_ref().map_or(&[], |summary| &summary.score.responses)
    }

    /// The identifier of the run.
    pub fn run(&self) -> Option<RunId> {
        let recorded = self.recording.as_ref().and_then(|recording| recording.info().run);
        self.summary.as_ref().map_or(recorded, |summary| summary.run)
    }
}

/// Reads a file; returns `None` if it does not exist.
fn text(path: &Path) -> Result<Option<String>, ReportError> {
    match files::open(path).and_then(io::read_to_string) {
        Ok(text) => Ok(Some(text)),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(source) => Err(ReportError::Read { path: path.to_owned(), source }),
    }
}

/// Reads a scenario, or that of the recording, with the changes of inputs that the recorded run received.
fn scenario(path: &Path, recording: Option<&Recording>) -> Result<Option<Scenario>, ReportError> {
    let Some(text) = text(path)? else { return Ok(recording.map(Recording::scenario).transpose()?) };
    let scenario = Scenario::parse(&text, &path.display().to_string(), &[])?;
    scenario.inputs.received().append(recording.map_or(&[], Recording::changes), || true);
    Ok(Some(scenario))
}

/// Reads the late ticks; returns `None` if the file does not exist.
fn late_ticks(path: &Path) -> Result<Option<LateReport>, ReportError> {
    match files::read(path) {
        Ok(bytes) => LateReport::parse(&bytes)
            .map(Some)
            .map_err(|reason| ReportError::LateTicks { path: path.to_owned(), reason }),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(source) => Err(ReportError::Read { path: path.to_owned(), source }),
    }
}

/// Returns the late ticks in a recording, if it has them.
fn recorded_late_ticks(recording: &Recording) -> Result<Option<LateReport>, ReportError> {
    recording.late_ticks().map_err(|reason| ReportError::LateTicks { path: recording.path().to_owned(), reason })
}

/// Reads all `<role>.<stage>.hgrm` of a directory, in the order of the summary.
fn curves(directory: &Path, summary: Option<&Summary>) -> Result<Vec<Curve>, ReportError> {
    let failed = |source| ReportError::Read { path: directory.to_owned(), source };
    let entries = match fs::read_dir(directory) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries.map_err(failed)?,
    };
    let mut curves = Vec::new();
    for entry in entries {
        let path = entry.map_err(failed)?.path();
        let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        if let Some((role, stage)) = name.strip_suffix(".hgrm").and_then(|stem| stem.rsplit_once('.'))
            && let Some(text) = text(&path)?
        {
            let points = read_curve(&text).map_err(|reason| ReportError::Latency { path: path.clone(), reason })?;
            let (role, stage, run) = (role.to_owned(), stage.to_owned(), RunId::in_comments_of(&text));
            curves.push(Curve { role, stage, run, points });
        }
    }
    let stages = summary.map_or(&[][..], |summary| &summary.latencies);
    let place = |curve: &Curve| stages.iter().position(|stage| stage.role == curve.role && stage.stage == curve.stage);
    curves.sort_by_cached_key(|curve| (place(curve).unwrap_or(usize::MAX), curve.role.clone(), curve.stage.clone()));
    Ok(curves)
}

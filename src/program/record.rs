//! `corotate record`: every sample of a running loop to a file, as `corotate run --record` starts it or by hand.

use super::output::{Ended, Exit, Failure, fail, remark, say};
use super::runs::{self, join};
use crate::record::{RecordError, RecorderOptions, Recording, RecordingReport, run_recorder};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// Options of `corotate record`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// The run: the directory that its results go to, or its domain [default: the newest run of this user]
    #[arg(long, value_name = "DIR")]
    domain: Option<PathBuf>,
    /// The file to write
    #[arg(long, value_name = "FILE", default_value = "run.mcap")]
    out: PathBuf,
    /// Replace a recording that is there
    #[arg(long)]
    overwrite: bool,
    /// Die with this process (the launcher gives its own id)
    #[arg(long, value_name = "PID", hide = true)]
    parent: Option<i32>,
    /// Print what was recorded as one JSON object (corotate/record/v1)
    #[arg(long)]
    json: bool,
}

/// Layout version of the JSON.
const SCHEMA: &str = "corotate/record/v1";

const EXAMPLES: &str = "\
Examples:
  corotate run --record            record a run from its first tick to its last
  corotate record --out part.mcap  the newest run that is under way, from now
                                   on; Ctrl-C ends the recording in order
  corotate record --domain runs/pair
                                   the run that `run --out runs/pair` began";

/// Records to the end of the run.
pub fn record(arguments: &Arguments) -> Ended {
    let is_there = || std::fs::metadata(&arguments.out).is_ok_and(|file| file.is_file() && file.len() > 0);
    if arguments.parent.is_none() && !arguments.overwrite && is_there() {
        let file = arguments.out.display();
        let reason = format!("{file} is there; name another file with --out, or give --overwrite");
        return Err(fail(Exit::Usage, Failure::new("file-exists", reason)));
    }
    let (domain, terminated) = join(arguments.parent, arguments.domain.as_deref())?;
    let options = RecorderOptions { domain, file: arguments.out.clone() };
    let report = run_recorder(&options, &terminated).map_err(|error| fail(exit_of(&error), error))?;
    told(&report, arguments)
}

fn told(report: &RecordingReport, arguments: &Arguments) -> Ended {
    let part = if report.whole { "" } else { ", from the midst of the run on" };
    let text = if arguments.json {
        format!("{}\n", serde_json::json!({ "schema": SCHEMA, "recording": report }))
    } else {
        format!("{}: {} samples, {} bytes{part}\n", report.file, report.messages, report.bytes)
    };
    let said = say(&text);
    if arguments.parent.is_none() {
        said?;
    }
    report
        .problem
        .as_ref()
        .map_or(Ok(Exit::Ok), |problem| Err(fail(Exit::Failure, Failure::new("incomplete-recording", problem))))
}

/// Opens the recording of a run as [`open`] does. Returns it with its file.
///
/// # Errors
/// The exit code, once the reason is printed.
pub fn open_run(run: Option<&Path>, accept_incomplete: bool) -> Result<(PathBuf, Recording), Exit> {
    let file = runs::recording(run).map_err(|failure| fail(Exit::Usage, failure))?;
    let recording = open(&file, accept_incomplete).map_err(|error| fail(exit_of(&error), error))?;
    Ok((file, recording))
}

/// Opens a recording that is all there; another one too where the user says so, with a remark.
pub fn open(file: &Path, accept_incomplete: bool) -> Result<Recording, RecordError> {
    let recording = Recording::open(file)?;
    match recording.require_whole() {
        Err(error) if !accept_incomplete => return Err(error),
        Err(RecordError::Damaged { reason, .. }) => {
            let text = format!("{} is damaged, and read as far as it can be believed: {reason}", file.display());
            remark(&Failure::new("damaged-recording", text));
        }
        Err(RecordError::Incomplete { missing, .. }) => {
            let text = format!("{} is not complete, and read as far as it goes: {missing}", file.display());
            remark(&Failure::new("incomplete-recording", text));
        }
        _ => {}
    }
    Ok(recording)
}

/// The exit code of what was done with a recording: a damaged one is a failure, however much of it could be read.
pub fn exit_with(recording: &Recording, exit: Exit) -> Exit {
    if recording.damage().is_some() { Exit::Failure } else { exit }
}

/// Whether it lies with the file, or with what was asked.
pub fn exit_of(error: &RecordError) -> Exit {
    match error {
        RecordError::Run(_)
        | RecordError::Domain(_)
        | RecordError::NotARecording { .. }
        | RecordError::Scenario { .. } => Exit::Usage,
        RecordError::Layout { .. } | RecordError::NotRecorded { .. } | RecordError::UnknownRole { .. } => Exit::Usage,
        RecordError::Read { source, .. } if source.kind() == ErrorKind::NotFound => Exit::Usage,
        RecordError::Damaged { .. } | RecordError::Incomplete { .. } => Exit::Failure,
        RecordError::Bus(_)
        | RecordError::Node(_)
        | RecordError::Full { .. }
        | RecordError::Write { .. }
        | RecordError::Read { .. } => Exit::Failure,
    }
}

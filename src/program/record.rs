//! `corotate record`: records every sample of a running loop. `corotate run --record` starts it too.

use super::output::{CommandResult, Exit, Failure, fail, remark, say};
use super::runs::{self, join};
use crate::record::{RECORDER, RecordError, RecorderOptions, Recording, RecordingReport, run_recorder};
use crate::system::name_thread;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// Options of `corotate record`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// The run's results directory or domain [default: your newest run]
    #[arg(long, value_name = "DIR")]
    domain: Option<PathBuf>,
    /// File to write
    #[arg(long, value_name = "FILE", default_value = "run.mcap")]
    out: PathBuf,
    /// Replace an existing recording
    #[arg(long)]
    overwrite: bool,
    /// Die with this process (set by the launcher)
    #[arg(long, value_name = "PID", hide = true)]
    parent: Option<i32>,
    /// Print counts as one JSON object (corotate/record/v1)
    #[arg(long)]
    json: bool,
}

/// Layout version of the JSON.
const SCHEMA: &str = "corotate/record/v1";

const EXAMPLES: &str = "\
Examples:
  corotate run --record            a whole run, from the first tick to the last
  corotate record --out part.mcap  your newest run, from now on; Ctrl-C closes
                                   the recording
  corotate record --domain runs/pair
                                   the run started by `run --out runs/pair`";

/// Records a run to its end.
pub fn record(arguments: &Arguments) -> CommandResult {
    let exists = || std::fs::metadata(&arguments.out).is_ok_and(|file| file.is_file() && file.len() > 0);
    if arguments.parent.is_none() && !arguments.overwrite && exists() {
        let file = arguments.out.display();
        let reason = format!("{file} exists; name another file with --out, or add --overwrite");
        return Err(fail(Exit::Usage, Failure::new("file-exists", reason)));
    }
    name_thread(RECORDER);
    let (domain, terminated) = join(arguments.parent, arguments.domain.as_deref())?;
    let options = RecorderOptions { domain, file: arguments.out.clone() };
    let report = run_recorder(&options, &terminated).map_err(|error| fail(exit_of(&error), error))?;
    print_report(&report, arguments)
}

fn print_report(report: &RecordingReport, arguments: &Arguments) -> CommandResult {
    let part = if report.whole { "" } else { ", without the beginning of the run" };
    let text = if arguments.json {
        format!("{}\n", serde_json::json!({ "schema": SCHEMA, "recording": report }))
    } else {
        format!("{}: {} samples, {} bytes{part}\n", report.file, report.messages, report.bytes)
    };
    let printed = say(&text);
    if arguments.parent.is_none() {
        printed?;
    }
    report
        .problem
        .as_ref()
        .map_or(Ok(Exit::Ok), |problem| Err(fail(Exit::Failure, Failure::new("incomplete-recording", problem))))
}

/// Opens the recording of a run like [`open`], and returns it with its file.
///
/// # Errors
/// The exit code, once the reason is printed.
pub fn open_run(run: Option<&Path>, accept_incomplete: bool) -> Result<(PathBuf, Recording), Exit> {
    let file = runs::recording(run).map_err(|failure| fail(Exit::Usage, failure))?;
    let recording = open(&file, accept_incomplete).map_err(|error| fail(exit_of(&error), error))?;
    Ok((file, recording))
}

/// Opens a recording. An incomplete or damaged one is an error unless `accept_incomplete`, then it is a remark.
pub fn open(file: &Path, accept_incomplete: bool) -> Result<Recording, RecordError> {
    let recording = Recording::open(file)?;
    match recording.require_whole() {
        Err(error) if !accept_incomplete => return Err(error),
        Err(RecordError::Damaged { reason, .. }) => {
            let text = format!("{} is damaged; only its intact part is read: {reason}", file.display());
            remark(&Failure::new("damaged-recording", text));
        }
        Err(RecordError::Incomplete { missing, .. }) => {
            let text = format!("{} is incomplete; only what it contains is read: {missing}", file.display());
            remark(&Failure::new("incomplete-recording", text));
        }
        _ => {}
    }
    Ok(recording)
}

/// Returns `exit`, or `Failure` for a damaged recording.
pub fn exit_with(recording: &Recording, exit: Exit) -> Exit {
    if recording.damage().is_some() { Exit::Failure } else { exit }
}

/// Returns the exit code for an error: `Usage` if the user can correct the request.
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

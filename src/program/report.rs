//! `corotate report`: a run, or a recording, as one page.

use super::record;
use super::{Exit, fail, remark, say};
use crate::report::{ReportError, report as compose};
use indicatif::ProgressBar;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Options of `corotate report`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// The directory of a run, or a recording
    source: PathBuf,
    /// The page to write [default: report.html in that directory, or beside the recording]
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

const EXAMPLES: &str = "\
The page needs no network and no script; it is light or dark as the reader's screen is, and prints. Motion, errors over time
and lateness over time are drawn from the recording; without one the page has the rest and says so.

Examples:
  corotate run config/rigid-pair.toml --record --out runs/pair
  corotate report runs/pair                                  runs/pair/report.html
  corotate report runs/pair/run.mcap --out motion.html       the recording alone";

/// Makes the page.
pub fn report(arguments: &Arguments) -> Exit {
    let source = &arguments.source;
    let directory = if source.is_dir() { source } else { source.parent().unwrap_or(Path::new("")) };
    let out = arguments.out.clone().unwrap_or_else(|| directory.join("report.html"));
    // Drawn on stderr, and only if that is a terminal.
    let spinner = ProgressBar::new_spinner().with_message(format!("reading {}", source.display()));
    spinner.enable_steady_tick(Duration::from_millis(100));
    let composed = compose(source);
    spinner.finish_and_clear();
    let written = composed.and_then(|report| {
        report.remarks().iter().for_each(|text| remark(text));
        report.write(&out).map(|()| if report.is_damaged() { Exit::Failure } else { Exit::Ok })
    });
    match written {
        Ok(exit) => say(&format!("{}\n", out.display())).err().unwrap_or(exit),
        Err(error) => fail(exit_of(&error), &error),
    }
}

fn exit_of(error: &ReportError) -> Exit {
    match error {
        ReportError::Record(error) => record::exit_of(error),
        ReportError::Read { .. } | ReportError::Write { .. } | ReportError::Counterpart { .. } => Exit::Failure,
        ReportError::Nothing { .. }
        | ReportError::NoRun { .. }
        | ReportError::Summary { .. }
        | ReportError::Latency { .. }
        | ReportError::TwoRuns { .. }
        | ReportError::Scenario(_) => Exit::Usage,
    }
}

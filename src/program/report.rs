//! `corotate report`: a run, a recording, or a campaign as one page; or two runs over each other.

use super::output::{Ended, Exit, Failure, fail, remark, say};
use super::record;
use super::runs;
use crate::campaign::JournalError;
use crate::report::{ReportError, report as compose, report_pair};
use indicatif::ProgressBar;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use std::{fs, io};

/// Options of `corotate report`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// A run's directory, a recording, or a campaign's directory [default: runs/latest]
    run: Option<PathBuf>,
    /// Another, to be drawn over the first: the page shows both, and where they differ first
    other: Option<PathBuf>,
    /// The page to write [default: report.html in that directory, or beside the recording; of two runs, comparison.html here]
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Show this field too, such as leader/estimate.omega_rad_s or one element of it, …[2]; again for more
    #[arg(long, value_name = "FIELD")]
    show: Vec<String>,
    /// Write every figure as a picture of its own to this directory, as SVG
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
    /// Show the page in a browser (xdg-open)
    #[arg(long)]
    open: bool,
    /// Print where the page is as one JSON object (corotate/report/v1)
    #[arg(long)]
    json: bool,
}

/// Layout version of the JSON.
const SCHEMA: &str = "corotate/report/v1";
/// How long a program that opens a page may take to say that it cannot.
const OPENING: Duration = Duration::from_secs(2);

const EXAMPLES: &str = "\
The page needs no network; it is light or dark as the reader's screen is, and
prints. In pictures over time, drag to look at a part, double click for all. Motion, errors over time and lateness over time are drawn
from the recording; without one the page has the rest and says so.

Examples:
  corotate run rigid-pair --record --out runs/pair
  corotate report --open           the newest run here, in a browser
  corotate report runs/pair        runs/pair/report.html
  corotate report runs/pair/run.mcap --out motion.html
                                   the recording alone
  corotate report runs/map         a campaign: maps, margins, worst cases
  corotate report runs/before runs/after
                                   both over each other, in comparison.html";

/// Makes the page.
pub fn report(arguments: &Arguments) -> Ended {
    let source = runs::results(arguments.run.as_deref()).map_err(|failure| fail(Exit::Usage, failure))?;
    let directory = if source.is_dir() { &source } else { source.parent().unwrap_or(Path::new("")) };
    let page = if arguments.other.is_some() { "comparison.html".into() } else { directory.join("report.html") };
    let out = arguments.out.clone().unwrap_or(page);
    // Drawn on stderr, and only if that is a terminal.
    let spinner = ProgressBar::new_spinner().with_message(format!("reading {}", source.display()));
    spinner.enable_steady_tick(Duration::from_millis(100));
    let composed = match &arguments.other {
        None => compose(&source, &arguments.show),
        Some(other) => report_pair(&source, other, &arguments.show),
    };
    spinner.finish_and_clear();
    let written = composed.and_then(|report| {
        report.remarks().iter().for_each(|text| remark(text));
        arguments.figures.iter().try_for_each(|directory| report.write_figures(directory))?;
        report.write(&out).map(|()| if report.is_damaged() { Exit::Failure } else { Exit::Ok })
    });
    let exit = written.map_err(|error| fail(exit_of(&error), error))?;
    say(&words(arguments.json, &out))?;
    show(arguments.open, &out).map(|()| exit)
}

fn words(json: bool, out: &Path) -> String {
    let page = out.display().to_string();
    if json { format!("{}\n", serde_json::json!({ "schema": SCHEMA, "page": page })) } else { page + "\n" }
}

/// Shows the page, if that is asked for, in whatever this desktop opens pages with.
fn show(wanted: bool, page: &Path) -> Result<(), Exit> {
    let open = || -> io::Result<()> {
        let mut opener = Command::new("xdg-open")
            .arg(fs::canonicalize(page)?)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()?;
        // A browser that it becomes stays; one that is not there is told at once.
        let end = Instant::now() + OPENING;
        while Instant::now() < end {
            match opener.try_wait()? {
                Some(status) if status.success() => return Ok(()),
                Some(status) => return Err(io::Error::other(status.to_string())),
                None => std::thread::sleep(Duration::from_millis(20)),
            }
        }
        Ok(())
    };
    let failed = |error| {
        let reason = format!("xdg-open: {error}; open {} in a browser", page.display());
        fail(Exit::Failure, Failure::new("no-browser", reason))
    };
    if wanted { open().map_err(failed) } else { Ok(()) }
}

fn exit_of(error: &ReportError) -> Exit {
    match error {
        ReportError::Record(error) => record::exit_of(error),
        ReportError::Read { .. }
        | ReportError::Write { .. }
        | ReportError::Counterpart { .. }
        | ReportError::Campaign(JournalError::Read { .. }) => Exit::Failure,
        ReportError::Nothing { .. }
        | ReportError::NoRun { .. }
        | ReportError::Summary { .. }
        | ReportError::Latency { .. }
        | ReportError::TwoRuns { .. }
        | ReportError::Campaign(_)
        | ReportError::CampaignWith { .. }
        | ReportError::Field { .. }
        | ReportError::Scenario(_) => Exit::Usage,
    }
}

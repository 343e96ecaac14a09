//! `corotate report`: writes the page of a run, a recording, a campaign, or two runs.

use super::output::{CommandResult, Exit, Failure, fail, remark, say};
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
    /// A second run, drawn over the first, with their first difference
    #[arg(value_name = "OTHER")]
    second: Option<PathBuf>,
    /// Page to write [default: report.html beside the results; comparison.html here for two runs]
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Also draw this field, such as leader/estimate.omega_rad_s, or one element, …[2]; repeatable
    #[arg(long, value_name = "FIELD")]
    show: Vec<String>,
    /// Write every figure to this directory, as SVG
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
    /// Show the page in a browser (xdg-open)
    #[arg(long)]
    open: bool,
    /// Print the page's path as one JSON object (corotate/report/v1)
    #[arg(long)]
    json: bool,
}

/// Layout version of the JSON.
const SCHEMA: &str = "corotate/report/v1";
/// Time in which xdg-open must report an error.
const OPENING: Duration = Duration::from_secs(2);

const EXAMPLES: &str = "\
The page needs no network, is light or dark like the desktop, and can be
printed. In charts over time, drag to zoom; double-click resets. Motion, errors
and lateness over time need a recording.

Examples:
  corotate run rigid-pair --record --out runs/pair
  corotate report --open           the newest run in runs/, in a browser
  corotate report runs/pair        runs/pair/report.html
  corotate report runs/pair/run.mcap --out motion.html
                                   the recording alone
  corotate report runs/map         a campaign: maps, margins, worst cases
  corotate report runs/before runs/after
                                   both in the same charts: comparison.html";

/// Writes the page.
pub fn report(arguments: &Arguments) -> CommandResult {
    let source = runs::results(arguments.run.as_deref()).map_err(|failure| fail(Exit::Usage, failure))?;
    let directory = if source.is_dir() { &source } else { source.parent().unwrap_or(Path::new("")) };
    let page = if arguments.second.is_some() { "comparison.html".into() } else { directory.join("report.html") };
    let out = arguments.out.clone().unwrap_or(page);
    // Drawn on stderr, and only if that is a terminal.
    let spinner = ProgressBar::new_spinner().with_message(format!("reading {}", source.display()));
    spinner.enable_steady_tick(Duration::from_millis(100));
    let composed = match &arguments.second {
        None => compose(&source, &arguments.show),
        Some(second) => report_pair(&source, second, &arguments.show),
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

/// Opens the page with xdg-open, if wanted.
fn show(wanted: bool, page: &Path) -> Result<(), Exit> {
    let open = || -> io::Result<()> {
        let mut opener = Command::new("xdg-open")
            .arg(fs::canonicalize(page)?)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()?;
        // xdg-open may become the browser and keep running; it reports a missing browser at once.
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
        let reason = format!("cannot open a browser: xdg-open: {error}; open {} yourself", page.display());
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
        | ReportError::LateTicks { .. }
        | ReportError::Latency { .. }
        | ReportError::TwoRuns { .. }
        | ReportError::Campaign(_)
        | ReportError::CampaignWith { .. }
        | ReportError::Field { .. }
        | ReportError::Scenario(_) => Exit::Usage,
    }
}

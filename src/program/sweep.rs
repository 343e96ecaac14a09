//! `corotate sweep`: a campaign from file to table.

use super::campaign;
use super::output::{Ended, Exit, Failure, fail, print, remark};
use super::signals::catch_signals;
use crate::campaign::{
    Axis, Campaign, Case, Counts, JournalError, Margin, Shard, Sweep, SweepError, Swept, Table, merge, worst,
};
use crate::config::ClockKind;
use crate::launch::{Launch, Progress, RUNS, Summary, claim, make_directory, new_run, plain, write_run};
use indicatif::{ProgressBar, ProgressStyle};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicUsize;
use std::time::{Duration, Instant, SystemTime};

/// Options of `corotate sweep`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES, args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
#[command(disable_help_subcommand = true)]
pub struct Arguments {
    #[command(subcommand)]
    merge: Option<Merge>,
    /// A shipped campaign's name, a file (x.toml, ./x), or - for stdin
    #[arg(value_name = "CAMPAIGN", required = true)]
    file: Option<PathBuf>,
    /// Override a key of the scenario, in every case
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Directory, new or to go on with [default: runs/<utc>-<name>]
    #[arg(long, value_name = "DIR", conflicts_with = "resume")]
    out: Option<PathBuf>,
    /// Go on with the newest results of this campaign in runs/
    #[arg(long)]
    resume: bool,
    /// How many cases run at a time [default: one per core]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=4096))]
    threads: Option<u16>,
    /// Run every N-th case alone, from the I-th, from 0
    #[arg(long, value_name = "I/N")]
    shard: Option<Shard>,
    /// What drives the ticks: lockstep is for few cases
    #[arg(long, value_name = "CLOCK", value_parser = ["in-process", "lockstep"], default_value = "in-process", hide_short_help = true)]
    clock: String,
    /// Run the N worst once more, with every sample recorded
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true)]
    record: usize,
    /// Print the summary as JSON, all else on stderr
    #[arg(long)]
    json: bool,
    /// Print nothing but errors
    #[arg(short, long)]
    quiet: bool,
}

#[derive(clap::Subcommand)]
enum Merge {
    /// Put the results of all shards of a campaign together
    Merge(MergeArguments),
}

/// Options of `corotate sweep merge`.
#[derive(clap::Args)]
struct MergeArguments {
    /// The directories of the shards
    #[arg(required = true, value_name = "DIR")]
    directories: Vec<PathBuf>,
    /// Directory for the whole
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Print the summary as JSON
    #[arg(long)]
    json: bool,
    /// Print nothing but errors
    #[arg(short, long)]
    quiet: bool,
}

const EXAMPLES: &str = "\
What is interrupted, by Ctrl-C or by kill -9, goes on where it was when the
command is given again with the same --out, and ends with the same table.

Examples:
  corotate sweep timing-map        a campaign that ships with the program; a
                                   table in runs/<utc>-timing-map/
  corotate sweep map.toml --out map --threads 2
                                   your own, two cases at a time
  corotate run map.toml --case 17  one of its cases, as any run
  corotate sweep map.toml --out map --record 3
                                   the three worst with every sample
  corotate sweep map.toml --shard 0/4 --out part-0
                                   the first of four machines
  corotate sweep merge part-0 part-1 part-2 part-3 --out map";

/// How results are told.
#[derive(Clone, Copy)]
struct Telling {
    json: bool,
    quiet: bool,
}

/// Runs a campaign, or puts the parts of one together.
pub fn sweep(arguments: &Arguments) -> Ended {
    match (&arguments.merge, &arguments.file) {
        (Some(Merge::Merge(given)), _) => put_together(given),
        (None, Some(file)) => run(arguments, file),
        (None, None) => Err(fail(Exit::Usage, Failure::new("no-campaign", "name a campaign"))),
    }
}

fn put_together(given: &MergeArguments) -> Ended {
    let telling = Telling { json: given.json, quiet: given.quiet };
    let swept = merge(&given.directories, &given.out).map_err(|error| fail(exit_of(&error), error))?;
    let head = format!("{} directories put together", given.directories.len());
    tell(telling, &given.out, &head, &swept.counts.unwrap_or_default()).map(|()| Exit::Ok)
}

fn run(arguments: &Arguments, file: &Path) -> Result<Exit, Exit> {
    let campaign = campaign::load(file, &arguments.set).map_err(|error| fail(Exit::Usage, error))?;
    let directory = directory(arguments, &campaign)?;
    if cfg!(debug_assertions) && !arguments.quiet {
        remark(&"this is a debug build, about 50 times as slow as a release build: `cargo build --release`");
    }
    let signal = catch_signals().map_err(|error| fail(Exit::Failure, error))?;
    let threads = arguments.threads.map(usize::from);
    let threads = threads.or_else(|| std::thread::available_parallelism().ok().map(usize::from)).unwrap_or(1);
    let began = Instant::now();
    let (bar, mut before) = (bar(arguments.quiet, pieces(&campaign)), None);
    let swept = campaign.sweep(
        &directory,
        &mut Sweep {
            threads,
            shard: arguments.shard,
            clock: if arguments.clock == "lockstep" { ClockKind::Lockstep } else { ClockKind::InProcess },
            signal: &signal,
            progress: &mut |done, all| {
                if before.is_none() {
                    before = Some(done);
                    bar.set_length(all);
                    bar.set_position(done);
                    bar.reset_eta();
                }
                bar.set_position(done);
            },
        },
    );
    bar.finish_and_clear();
    let swept = swept.map_err(|error| fail(exit_of(&error), error))?;
    let Some(counts) = &swept.counts else {
        return Ok(interrupted(arguments, &campaign, &directory, &swept, &signal));
    };
    let done = swept.done - before.unwrap_or(0);
    let telling = Telling { json: arguments.json, quiet: arguments.quiet };
    tell(telling, &directory, &head(&campaign, &swept, counts, done, began.elapsed(), threads), counts)?;
    record_worst(arguments, &campaign, &directory, &signal)?;
    Ok(Exit::Ok)
}

/// Where the results go.
fn directory(arguments: &Arguments, campaign: &Campaign) -> Result<PathBuf, Exit> {
    if let Some(out) = &arguments.out {
        return Ok(out.clone());
    }
    if arguments.resume {
        let found = newest(campaign);
        return found.ok_or_else(|| {
            let name = campaign.name();
            let text = format!("--resume: {RUNS}/ has no results of this campaign `{name}`; begin without it");
            fail(Exit::Usage, Failure::new("nothing-to-resume", text))
        });
    }
    let made = make_directory(None, campaign.name(), SystemTime::now());
    made.map_err(|error| {
        fail(Exit::Failure, Failure::new("cannot-write", format!("{error}; name another directory with --out")))
    })
}

/// The newest results of a campaign; their names begin with the time.
fn newest(campaign: &Campaign) -> Option<PathBuf> {
    let entries = fs::read_dir(RUNS).ok()?.filter_map(|entry| Some(entry.ok()?.path()));
    let mut found: Vec<PathBuf> = entries.filter(|path| campaign.began(path)).collect();
    found.sort();
    found.pop()
}

/// The noun for a campaign's pieces of work.
fn pieces(campaign: &Campaign) -> &'static str {
    if campaign.table().margins.is_empty() { "cases" } else { "cases and margin points" }
}

fn bar(quiet: bool, pieces: &str) -> ProgressBar {
    if quiet {
        return ProgressBar::hidden();
    }
    let style =
        ProgressStyle::with_template(&format!("{{bar:40}} {{pos}}/{{len}} {pieces}, {{per_sec}}, {{eta}} left"));
    // Drawn on stderr, and only if that is a terminal.
    ProgressBar::new(0).with_style(style.expect("the template parses"))
}

fn interrupted(
    arguments: &Arguments,
    campaign: &Campaign,
    directory: &Path,
    swept: &Swept,
    signal: &AtomicUsize,
) -> Exit {
    let number = signal.load(std::sync::atomic::Ordering::Relaxed);
    let file = arguments.file.as_deref().unwrap_or(Path::new(campaign.name())).display();
    let words = format!(
        "ended in order by signal {number}: {} of {} {} are done; go on with `corotate sweep {file} --out {}` \
         and the other options as they were",
        swept.done,
        swept.all,
        pieces(campaign),
        directory.display()
    );
    fail(Exit::Signal(number), Failure::new("interrupted", words))
}

/// The first line: what was done, and how fast.
fn head(campaign: &Campaign, swept: &Swept, counts: &Counts, done: u64, took: Duration, threads: usize) -> String {
    let counted = |count: u64, one: &str| if count == 1 { format!("1 {one}") } else { format!("{count} {one}s") };
    let mut all = counted(counts.rows, "case");
    if counts.margin_points > 0 {
        all += &format!(" and {}", counted(counts.margin_points, "margin point"));
    }
    let threads = counted(threads as u64, "thread");
    match done {
        0 => format!("{}: {all}, all of them done before", campaign.name()),
        _ => {
            let (seconds, before) = (took.as_secs_f64(), swept.done - done);
            let before = if before > 0 { format!(", {before} of them done before") } else { String::new() };
            let rate = done as f64 / seconds;
            format!("{}: {all}{before}; {seconds:.2} s, {rate:.1} per second, {threads}", campaign.name())
        }
    }
}

/// Prints what there is.
fn tell(telling: Telling, directory: &Path, head: &str, counts: &Counts) -> Result<(), Exit> {
    let failed = |failure| fail(Exit::Failure, failure);
    let path = directory.join("summary.json");
    let summary: serde_json::Value = fs::read(&path)
        .map_err(|error| error.to_string())
        .and_then(|bytes| serde_json::from_slice(&bytes).map_err(|error| error.to_string()))
        .map_err(|error| failed(Failure::new("unreadable-summary", format!("{}: {error}", path.display()))))?;
    if !telling.quiet {
        let axes: Vec<Axis> = serde_json::from_value(summary["axes"].clone()).unwrap_or_default();
        let margins: Vec<Margin> = serde_json::from_value(summary["margins"].clone()).unwrap_or_default();
        let margins = margin_words(&axes, &margins);
        let text = format!("{head}\n{}\n{margins}results in {}\n", words(counts), directory.display());
        if telling.json {
            text.lines().for_each(crate::system::tell);
        } else {
            print(&text).map_err(failed)?;
        }
    }
    if telling.json {
        let mut summary = summary;
        summary["directory"] = directory.display().to_string().into();
        print(&format!("{summary}\n")).map_err(failed)?;
    }
    Ok(())
}

fn words(counts: &Counts) -> String {
    let Counts { accepted, not_accepted, not_judged, otherwise, .. } = counts;
    let verdicts = [("accepted", accepted), ("not accepted", not_accepted), ("not judged", not_judged)];
    let verdict = |((verdict, count), otherwise): ((&str, &u64), &BTreeMap<&str, u64>)| {
        let ends: Vec<String> = otherwise.iter().map(|(end, count)| format!("{count} {end}")).collect();
        let ends = if ends.is_empty() { String::new() } else { format!(" ({})", ends.join(", ")) };
        format!("{verdict} {count}{ends}")
    };
    verdicts.into_iter().zip(otherwise).map(verdict).collect::<Vec<_>>().join(", ")
}

/// The margins as a table: one row per point, by what is varied, as many as fit a screen.
fn margin_words(axes: &[Axis], margins: &[Margin]) -> String {
    const SHOWN: usize = 20;
    let mut text = String::new();
    for margin in margins {
        let find = format!("{:?}", margin.find).to_lowercase();
        let _ = writeln!(text, "\n{find} {} such that {}, to {}", margin.key, margin.such_that, margin.tolerance);
        let (head, rows) = margin.rows(axes);
        let mut shown = plain(&head.iter().map(String::as_str).collect::<Vec<_>>());
        shown.add_rows(rows.into_iter().take(SHOWN));
        let _ = writeln!(text, "{shown}");
        if margin.points.len() > SHOWN {
            let _ = writeln!(text, "and {} more in summary.json", margin.points.len() - SHOWN);
        }
    }
    text
}

/// Runs the worst cases once more, with every sample recorded.
fn record_worst(
    arguments: &Arguments,
    campaign: &Campaign,
    directory: &Path,
    signal: &AtomicUsize,
) -> Result<(), Exit> {
    if arguments.record == 0 {
        return Ok(());
    }
    let table = Table::read(directory).map_err(|error| fail(Exit::Failure, error))?;
    for number in worst(&table, arguments.record) {
        let Some(case) = campaign.case(number) else { continue };
        let path = directory.join(format!("case-{number}"));
        record(campaign, &case, &path, signal).map_err(|error| fail(Exit::Failure, error))?;
        let number = signal.load(std::sync::atomic::Ordering::Relaxed);
        if number != 0 {
            return Err(Exit::Signal(number));
        }
        if !arguments.quiet {
            remark(&format!("case {} is recorded in {}", case.number, path.display()));
        }
    }
    Ok(())
}

fn record(campaign: &Campaign, case: &Case, path: &Path, signal: &AtomicUsize) -> Result<(), Failure> {
    let mut scenario = campaign.scenario(case)?;
    let run = new_run().map_err(|error| Failure::new("no-random-numbers", format!("no random numbers: {error}")))?;
    (scenario.run, scenario.record) = (Some(run), true);
    // The samples of a case are the same whenever it runs.
    let claim = claim(path, run, true)?;
    if let Some(names) = claim.removed_names() {
        remark(&format!("removed from {}: {names}", path.display()));
    }
    let (started, mut silent) = (SystemTime::now(), |_: &Progress<'_>| {});
    let mut launch = Launch { record: Some(path.join("run.mcap")), ..Launch::new(signal, &mut silent) };
    let outcome = crate::launch::run(&scenario, &mut launch)?;
    write_run(path, &scenario, &Summary::new(&scenario, &outcome, started))
        .map_err(|error| Failure::new("cannot-write", format!("{}: {error}", path.display())))
}

fn exit_of(error: &SweepError) -> Exit {
    match error {
        SweepError::Journal(JournalError::Read { .. } | JournalError::Write { .. })
        | SweepError::Write { .. }
        | SweepError::Disagree { .. } => Exit::Failure,
        SweepError::Journal(_)
        | SweepError::Config(_)
        | SweepError::Foreign { .. }
        | SweepError::Mixed { .. }
        | SweepError::Missing { .. } => Exit::Usage,
    }
}

//! `corotate sweep`: runs a campaign and writes its table.

use super::campaign;
use super::output::{CommandResult, Exit, Failure, fail, print, remark};
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
    /// Directory of the results, new or to be resumed [default: runs/<utc>-<name>]
    #[arg(long, value_name = "DIR", conflicts_with = "resume")]
    out: Option<PathBuf>,
    /// Resume the newest results of this campaign in runs/
    #[arg(long)]
    resume: bool,
    /// Run N cases at a time [default: one per core]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=4096))]
    threads: Option<u16>,
    /// Run only every N-th case, beginning with case I
    #[arg(long, value_name = "I/N")]
    shard: Option<Shard>,
    /// Clock of the ticks; lockstep is slow, for few cases
    #[arg(long, value_name = "CLOCK", value_parser = ["in-process", "lockstep"], default_value = "in-process", hide_short_help = true)]
    clock: String,
    /// Run the N worst cases again and record every sample
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
    /// Merge the results of all shards of a campaign
    Merge(MergeArguments),
}

/// Options of `corotate sweep merge`.
#[derive(clap::Args)]
struct MergeArguments {
    /// Directories of the shards
    #[arg(required = true, value_name = "DIR")]
    directories: Vec<PathBuf>,
    /// Directory of the merged results
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
An interrupted campaign (Ctrl-C, kill -9) resumes if the command is repeated
with the same --out. The table is the same.

Examples:
  corotate sweep timing-map        a shipped campaign; the table is in
                                   runs/<utc>-timing-map/
  corotate sweep map.toml --out map --threads 2
                                   a file, two cases at a time
  corotate run map.toml --case 17  a single case, as a run
  corotate sweep map.toml --out map --record 3
                                   also record the three worst cases
  corotate sweep map.toml --shard 0/4 --out part-0
                                   on the first of four machines
  corotate sweep merge part-0 part-1 part-2 part-3 --out map";

/// Options of the output.
#[derive(Clone, Copy)]
struct OutputOptions {
    json: bool,
    quiet: bool,
}

/// Runs a campaign or merges its shards.
pub fn sweep(arguments: &Arguments) -> CommandResult {
    match (&arguments.merge, &arguments.file) {
        (Some(Merge::Merge(given)), _) => merge_shards(given),
        (None, Some(file)) => run(arguments, file),
        (None, None) => Err(fail(Exit::Usage, Failure::new("no-campaign", "name a campaign"))),
    }
}

fn merge_shards(given: &MergeArguments) -> CommandResult {
    let output = OutputOptions { json: given.json, quiet: given.quiet };
    let swept = merge(&given.directories, &given.out).map_err(|error| fail(exit_of(&error), error))?;
    let head = format!("merged {} directories", given.directories.len());
    print_results(output, &given.out, &head, &swept.counts.unwrap_or_default()).map(|()| Exit::Ok)
}

fn run(arguments: &Arguments, file: &Path) -> Result<Exit, Exit> {
    let campaign = campaign::load(file, &arguments.set).map_err(|error| fail(Exit::Usage, error))?;
    let directory = directory(arguments, &campaign)?;
    if cfg!(debug_assertions) && !arguments.quiet {
        remark(&"slow: this is a debug build, about 50 times slower than `cargo build --release`");
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
    let output = OutputOptions { json: arguments.json, quiet: arguments.quiet };
    print_results(output, &directory, &head(&campaign, &swept, counts, done, began.elapsed(), threads), counts)?;
    record_worst(arguments, &campaign, &directory, &signal)?;
    Ok(Exit::Ok)
}

/// Returns the directory of the results.
fn directory(arguments: &Arguments, campaign: &Campaign) -> Result<PathBuf, Exit> {
    if let Some(out) = &arguments.out {
        return Ok(out.clone());
    }
    if arguments.resume {
        let found = newest(campaign);
        return found.ok_or_else(|| {
            let name = campaign.name();
            let text = format!("--resume: {RUNS}/ has no results of the campaign `{name}`; leave out --resume");
            fail(Exit::Usage, Failure::new("nothing-to-resume", text))
        });
    }
    let made = make_directory(None, campaign.name(), SystemTime::now());
    made.map_err(|error| {
        fail(Exit::Failure, Failure::new("cannot-write", format!("{error}; name another directory with --out")))
    })
}

/// Returns the newest results of a campaign; directory names begin with the time.
fn newest(campaign: &Campaign) -> Option<PathBuf> {
    let entries = fs::read_dir(RUNS).ok()?.filter_map(|entry| Some(entry.ok()?.path()));
    let mut found: Vec<PathBuf> = entries.filter(|path| campaign.began(path)).collect();
    found.sort();
    found.pop()
}

/// Returns the noun for a campaign's pieces of work.
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
        "interrupted by signal {number}: {} of {} {} are done; resume with `corotate sweep {file} --out {}` \
         and the same other options",
        swept.done,
        swept.all,
        pieces(campaign),
        directory.display()
    );
    fail(Exit::Signal(number), Failure::new("interrupted", words))
}

/// Returns the first line: number of cases, duration and rate.
fn head(campaign: &Campaign, swept: &Swept, counts: &Counts, done: u64, took: Duration, threads: usize) -> String {
    let counted = |count: u64, noun: &str| if count == 1 { format!("1 {noun}") } else { format!("{count} {noun}s") };
    let mut all = counted(counts.rows, "case");
    if counts.margin_points > 0 {
        all += &format!(" and {}", counted(counts.margin_points, "margin point"));
    }
    let threads = counted(threads as u64, "thread");
    match done {
        0 => format!("{}: {all}, all done before", campaign.name()),
        _ => {
            let (seconds, before) = (took.as_secs_f64(), swept.done - done);
            let before = if before > 0 { format!(", {before} done before") } else { String::new() };
            let rate = done as f64 / seconds;
            format!("{}: {all}{before}; {seconds:.2} s, {rate:.1} per second, {threads}", campaign.name())
        }
    }
}

/// Prints counts and margins as text, the summary as JSON.
fn print_results(output: OutputOptions, directory: &Path, head: &str, counts: &Counts) -> Result<(), Exit> {
    let failed = |failure| fail(Exit::Failure, failure);
    let path = directory.join("summary.json");
    let summary: serde_json::Value = fs::read(&path)
        .map_err(|error| error.to_string())
        .and_then(|bytes| serde_json::from_slice(&bytes).map_err(|error| error.to_string()))
        .map_err(|error| failed(Failure::new("unreadable-summary", format!("{}: {error}", path.display()))))?;
    if !output.quiet {
        let axes: Vec<Axis> = serde_json::from_value(summary["axes"].clone()).unwrap_or_default();
        let margins: Vec<Margin> = serde_json::from_value(summary["margins"].clone()).unwrap_or_default();
        let margins = margin_words(&axes, &margins);
        let text = format!("{head}\n{}\n{margins}results in {}\n", words(counts), directory.display());
        if output.json {
            text.lines().for_each(crate::system::tell);
        } else {
            print(&text).map_err(failed)?;
        }
    }
    if output.json {
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

/// Returns a table of the margins, one row per point, at most a screen.
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

/// Runs the worst cases again and records every sample.
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
            remark(&format!("case {} recorded in {}", case.number, path.display()));
        }
    }
    Ok(())
}

fn record(campaign: &Campaign, case: &Case, path: &Path, signal: &AtomicUsize) -> Result<(), Failure> {
    let mut scenario = campaign.scenario(case)?;
    let run = new_run().map_err(|error| Failure::new("no-random-numbers", format!("no random numbers: {error}")))?;
    (scenario.run, scenario.record) = (Some(run), true);
    // Overwrites: a case has the same samples in every run.
    let claim = claim(path, run, true)?;
    if let Some(names) = claim.removed_names() {
        remark(&format!("removed from {}: {names}", path.display()));
    }
    let (started, mut silent) = (SystemTime::now(), |_: &Progress<'_>| {});
    let mut launch = Launch { record: Some(path.join("run.mcap")), ..Launch::new(signal, &mut silent) };
    let outcome = crate::launch::run(&scenario, &mut launch)?;
    write_run(path, &scenario, &Summary::new(&scenario, &outcome, started), outcome.late.as_ref())
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

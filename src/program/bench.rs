//! `corotate bench`: measures rows and writes a table, JSON and histograms.

use super::output::{Exit, Failure, fail, print};
use super::scenario::load;
use super::shipped::scenarios;
use super::signals::catch_signals;
use super::signals::die_with;
use crate::bench::{Bench, BenchError, Results, Row, run, serve_peer, table, write_results};
use crate::launch::make_directory;
use indicatif::ProgressBar;
use std::cell::RefCell;
use std::path::PathBuf;
use std::time::{Duration, SystemTime};

/// Options of `corotate bench`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// Rows to measure: hop, chain, tick, lockstep, run, overhead, processor [default: all]
    #[arg(value_name = "ROW")]
    rows: Vec<String>,
    /// Run a smoke test of a few seconds; its figures are meaningless
    #[arg(long)]
    quick: bool,
    /// Exit with code 3 if a target is not met
    #[arg(long)]
    check: bool,
    /// Directory of the results [default: runs/<utc>-bench]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Print the results as one JSON object on stdout, everything else on stderr
    #[arg(long)]
    json: bool,
}

const EXAMPLES: &str = "\
Examples:
  corotate bench                            every row, about five minutes
  corotate bench chain hop --quick          two rows, as a smoke test
  corotate bench hop --check                exit code 3 if a target is missed";

/// Options of the hidden command that is the other end of a hop.
#[derive(clap::Args)]
pub struct PeerArguments {
    /// The suite's domain
    #[arg(long)]
    domain: PathBuf,
    /// Die with this process
    #[arg(long)]
    parent: i32,
    /// Replace the observer, not the controller
    #[arg(long)]
    observer: bool,
}

/// Measures the selected rows.
pub fn bench(arguments: &Arguments, rows: &[Row]) -> Exit {
    match attempt(arguments, rows) {
        Ok(results) if arguments.check && !results.met() => Exit::NotAccepted,
        Ok(_) => Exit::Ok,
        Err((exit, reason)) => fail(exit, reason),
    }
}

fn attempt(arguments: &Arguments, rows: &[Row]) -> Result<Results, (Exit, Failure)> {
    let broken = |code, reason: String| (Exit::Failure, Failure::new(code, reason));
    let known = rows.iter().map(|row| row.name).collect::<Vec<_>>();
    if let Some(name) = arguments.rows.iter().find(|name| !known.contains(&name.as_str())) {
        let text = format!("there is no row `{name}`; choose from {}", known.join(", "));
        return Err((Exit::Usage, Failure::new("unknown-row", text)));
    }
    let asked = |row: &&Row| arguments.rows.is_empty() || arguments.rows.iter().any(|name| name == row.name);
    let started = SystemTime::now();
    let signal = catch_signals().map_err(|error| (Exit::Failure, error))?;
    // Drawn on stderr, and only if that is a terminal.
    let spinner = ProgressBar::new_spinner();
    let last = RefCell::new(String::new());
    let mut bench = Bench {
        rows: rows.iter().filter(asked).copied().collect(),
        quick: arguments.quick,
        scenarios: scenarios(),
        signal: &signal,
        progress: &mut |what| {
            spinner.set_message(what.to_owned());
            last.replace(what.to_owned());
        },
    };
    bench.scenario(&[]).map_err(|error| (Exit::Usage, error.into()))?;
    if let (true, Some(reason)) = (arguments.check, bench.unjudged().first()) {
        return Err((Exit::Usage, Failure::new("nothing-to-judge", format!("--check has nothing to judge: {reason}"))));
    }
    let directory = make_directory(arguments.out.as_deref(), "bench", started)
        .map_err(|error| broken("cannot-write", format!("{error}; name another directory with --out")))?;
    spinner.enable_steady_tick(Duration::from_millis(200));
    let measured = run(&mut bench);
    spinner.finish_and_clear();
    let (board, privileges) = measured.map_err(|error| match error {
        BenchError::Interrupted(signal) => (Exit::Signal(signal), error.into()),
        error => (Exit::Failure, Failure::prefixed(last.borrow(), error)),
    })?;
    let results = Results::new(&bench, board, privileges, started);
    write_results(&directory, &results)
        .map_err(|error| broken("cannot-write", format!("cannot write the results: {error}")))?;
    let text = format!("{}results in {}\n", table(&results), directory.display());
    let printed = if arguments.json {
        crate::system::tell(text.trim_end());
        print(&format!("{}\n", serde_json::to_string(&results).expect("results of plain values are JSON")))
    } else {
        print(&text)
    };
    printed.map_err(|failure| (Exit::Failure, failure))?;
    Ok(results)
}

/// Serves as the other end of a hop.
pub fn peer(arguments: &PeerArguments) -> Exit {
    if let Err(exit) = die_with(arguments.parent) {
        return exit;
    }
    let PeerArguments { domain, observer, .. } = arguments;
    let served = load(None, []).and_then(|scenario| {
        serve_peer(domain, &scenario, *observer).map_err(|reason| Failure::new("peer-failed", reason))
    });
    match served {
        Ok(()) => Exit::Ok,
        Err(failure) => fail(Exit::Failure, failure),
    }
}

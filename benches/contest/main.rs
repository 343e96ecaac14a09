//! The product beside others that do the same: its step beside straight-line C, an extended Kalman filter and the bare copy of the
//! samples; the law of its fleets beside a copy of the same bytes.
//!
//! `cargo bench --bench contest [-- [ROW]... [--quick] [--check] [--json] [--out DIR]]`, as of `corotate bench`, which measures the
//! rest. C code is compiled when it runs. Must not be part of the library, nor keep anything that the library needs.

mod compiled;
mod ekf;
mod fleet;
mod product;
mod recording;
pub mod step;

use clap::Parser;
use corotate::bench::Bound::{AtLeast, AtMost};
use corotate::bench::Of::Median;
use corotate::bench::{Bench, Results, Row, run, table, target, write_results};
use corotate::config::SHIPPED;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::atomic::AtomicUsize;

/// Every row, each with the one place where a target of its stands.
pub const ROWS: [Row; 2] = [
    Row {
        name: "step",
        title: "estimate-and-control step: samples in, command out",
        targets: &[
            target("first order", Some("first order in C"), Median, AtMost(1.05)),
            target("first order", None, Median, AtMost(15.0)),
            target("first order by an EKF", Some("first order"), Median, AtLeast(3.0)),
            target("second order", Some("first order"), Median, AtMost(1.3)),
        ],
        measure: step::measure,
    },
    Row {
        name: "fleet",
        title: "the law of N followers in one controller's step, per follower",
        targets: &[
            target("law, N = 1000", Some("copy, N = 1000"), Median, AtMost(1.3)),
            target("law, N = 1000", None, Median, AtMost(0.7)),
        ],
        measure: fleet::measure,
    },
];

/// The product's step and the law of its fleets beside others
#[derive(Parser)]
struct Arguments {
    /// Rows to measure: step, fleet [default: both]
    #[arg(value_name = "ROW", value_parser = ["step", "fleet"])]
    rows: Vec<String>,
    /// A smoke run of a few seconds, whose figures mean nothing
    #[arg(long)]
    quick: bool,
    /// Exit code 3 if a target is not met
    #[arg(long)]
    check: bool,
    /// Print the results as one JSON object on stdout, everything else on stderr
    #[arg(long)]
    json: bool,
    /// Directory for the results, made if it is not there [default: none]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Given by `cargo bench`
    #[arg(long, hide = true)]
    bench: bool,
}

fn main() -> ExitCode {
    measure(&Arguments::parse()).unwrap_or_else(|reason| {
        eprintln!("contest: {reason}");
        ExitCode::FAILURE
    })
}

fn measure(arguments: &Arguments) -> Result<ExitCode, Box<dyn std::error::Error>> {
    let asked = |row: &Row| arguments.rows.is_empty() || arguments.rows.iter().any(|name| name == row.name);
    let started = jiff::Timestamp::now();
    let mut bench = Bench {
        rows: ROWS.into_iter().filter(asked).collect(),
        quick: arguments.quick,
        program: PathBuf::new(),
        scenarios: &SHIPPED,
        signal: &AtomicUsize::new(0),
        progress: &mut |_| {},
    };
    if let (true, Some(reason)) = (arguments.check, bench.unjudged().first()) {
        eprintln!("contest: --check has nothing to judge: {reason}");
        return Ok(ExitCode::from(2));
    }
    let (board, privileges) = run(&mut bench)?;
    let results = Results::new(&bench, board, privileges, started);
    if let Some(directory) = &arguments.out {
        std::fs::create_dir_all(directory)?;
        write_results(directory, &results)?;
    }
    if arguments.json {
        eprint!("{}", table(&results));
        println!("{}", serde_json::to_string(&results)?);
    } else {
        print!("{}", table(&results));
    }
    Ok(if arguments.check && !results.met() { ExitCode::from(3) } else { ExitCode::SUCCESS })
}

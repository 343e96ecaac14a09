//! Measures start time, stop time and memory of a whole run, beside a bare process and a bare node.

use super::board::Board;
use super::session::{Bench, BenchError};
use super::watch::Watch;
use crate::bus::domain::OwnedDomain;
use crate::bus::raw::RawNode;
use crate::system::this_program;
use std::process::Stdio;
use std::time::Instant;

/// Measures the row.
pub(super) fn measure(bench: &mut Bench<'_>, board: &mut Board) -> Result<(), BenchError> {
    let rounds = bench.size(5, 1);
    for round in 1..=rounds {
        bench.next(&format!("run: round {round} of {rounds}"))?;
        let observed =
            Watch { overrides: &["duration_s=1.0", "clock=realtime"], environment: Vec::new(), midway: &mut |_, _| {} }
                .run(bench)?;
        for (name, floor, value) in [
            ("start to first tick", Some("bare process"), observed.start_ms),
            ("last tick to end", Some("bare process"), observed.stop_ms),
        ] {
            value.into_iter().for_each(|value| board.add(name, "ms", floor, value));
        }
        board.add("bare process", "ms", None, bare_process()?);
        board.add("bare iceoryx2 node", "ms", None, bare_node()?);
        let roles = || observed.resident_mib.iter().filter(|(name, _)| *name != "launcher");
        let largest = |index: usize| roles().map(|(_, mib)| mib[index]).fold(f64::NAN, f64::max);
        board.add("memory of the largest role", "MiB", None, largest(0));
        board.add("of it not the program's own file", "MiB", None, largest(1));
        for (name, [mib, _]) in &observed.resident_mib {
            board.add(&format!("memory of {name}"), "MiB", None, *mib);
        }
        board.add("shared memory", "MiB", None, observed.shared_mib);
    }
    Ok(())
}

/// Measures the time to start this program and wait for its immediate end, ms.
fn bare_process() -> Result<f64, BenchError> {
    let began = Instant::now();
    let mut command = this_program().map_err(BenchError::system("find this program"))?;
    command.arg("--version").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command.status().map_err(BenchError::system("start a process"))?;
    Ok(began.elapsed().as_secs_f64() * 1e3)
}

/// Measures the time to create and drop a node in its own domain, ms.
fn bare_node() -> Result<f64, BenchError> {
    let domain = OwnedDomain::create(0)?;
    let began = Instant::now();
    drop(RawNode::enter(domain.domain(), "bare")?);
    Ok(began.elapsed().as_secs_f64() * 1e3)
}

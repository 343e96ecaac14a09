//! `corotate replay`: a recording through the live roles.

use super::output::{Ended, Exit, Failure, fail, harmless, say};
use super::record::{exit_of, exit_with, open_run};
use super::signals::catch_signals;
use crate::launch::{LaunchError, replay_as_process};
use crate::record::{RecordError, Recording, RoleReplay, replay_in_process};
use crate::runtime::RoleId;
use crate::scenario::Scenario;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

/// Options of `corotate replay`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// A run's directory, a recording, or latest [default: runs/latest]
    run: Option<PathBuf>,
    /// observer, controller, a body's name, or all
    #[arg(long, value_name = "ROLE", default_value = "all")]
    role: String,
    /// Replay each role as a process of its own, as it takes part in runs, instead of in one thread
    #[arg(long)]
    processes: bool,
    /// Go on with what there is of a recording that is not complete
    #[arg(long)]
    accept_incomplete: bool,
    /// Print one JSON object on stdout (corotate/replay/v1)
    #[arg(long)]
    json: bool,
}

/// Layout version of the JSON.
const SCHEMA: &str = "corotate/replay/v1";

const EXAMPLES: &str = "\
Each role gets the inputs that it had, and misses what it missed; everything
that it publishes but the time of sending is compared with what was recorded.
Exit code 3 if anything differs. What cannot be told is said.

Examples:
  corotate replay                  the newest run here, every role
  corotate replay runs/20261121T150000Z-rigid-pair
  corotate replay run.mcap --role observer --processes";

/// Replays.
pub fn replay(arguments: &Arguments) -> Ended {
    let (file, recording) = open_run(arguments.run.as_deref(), arguments.accept_incomplete)?;
    // In one thread a signal ends the process.
    let signal = arguments.processes.then(catch_signals).transpose().map_err(|error| fail(Exit::Failure, error))?;
    let replays = attempt(arguments, &recording, signal.as_deref()).map_err(|error| match error {
        LaunchError::Record(error) => fail(exit_of(&error), error),
        error => fail(super::output::exit_of(&error), error),
    })?;
    let number = signal.map_or(0, |signal| signal.load(Ordering::Relaxed));
    if number != 0 {
        let text = "ended by a signal before all was replayed";
        return Err(fail(Exit::Signal(number), Failure::new("interrupted", text)));
    }
    let words = || harmless(&replays.iter().map(words).collect::<String>());
    say(&if arguments.json { json(&file, &replays) } else { words() })?;
    let differs = replays.iter().any(|replay| replay.difference.is_some());
    Ok(exit_with(&recording, if differs { Exit::NotAccepted } else { Exit::Ok }))
}

fn attempt(
    arguments: &Arguments,
    recording: &Recording,
    signal: Option<&AtomicUsize>,
) -> Result<Vec<RoleReplay>, LaunchError> {
    let scenario = recording.scenario_for_replay()?;
    recording.check_layouts(&scenario)?;
    let roles = roles(&arguments.role, &scenario)?;
    let Some(signal) = signal else {
        return Ok(roles
            .into_iter()
            .map(|role| replay_in_process(recording, &scenario, role))
            .collect::<Result<_, _>>()?);
    };
    let mut replays = Vec::new();
    for role in roles {
        replays.push(replay_as_process(recording, &scenario, role, signal)?);
        if signal.load(Ordering::Relaxed) != 0 {
            break;
        }
    }
    Ok(replays)
}

fn roles(name: &str, scenario: &Scenario) -> Result<Vec<RoleId>, RecordError> {
    if name == "all" {
        return Ok(RoleId::all(scenario));
    }
    RoleId::named(scenario, name).map(|role| vec![role]).ok_or_else(|| {
        let known = scenario.rig.roles().join(", ");
        RecordError::UnknownRole { role: name.to_owned(), known }
    })
}

/// All of it for programs.
fn json(file: &Path, replays: &[RoleReplay]) -> String {
    let role = |replay: &RoleReplay| {
        let RoleReplay { role, ticks, lives, samples, difference, limit } = replay;
        let difference = difference.as_ref().map(|first| {
            serde_json::json!({
                "tick": first.tick,
                "service": first.service,
                "field": first.field,
                "recorded": first.recorded,
                "replayed": first.replayed,
            })
        });
        let limit = limit.as_ref().map(|limit| serde_json::json!({ "tick": limit.tick, "reason": limit.reason }));
        serde_json::json!({
            "role": role,
            "ticks": ticks,
            "lives": lives,
            "samples": samples,
            "same": difference.is_none(),
            "difference": difference,
            "limit": limit,
        })
    };
    let same = replays.iter().all(|replay| replay.difference.is_none());
    let roles: Vec<_> = replays.iter().map(role).collect();
    let file = file.display().to_string();
    format!("{}\n", serde_json::json!({ "schema": SCHEMA, "file": file, "same": same, "roles": roles }))
}

/// One role's replay for people.
fn words(replay: &RoleReplay) -> String {
    let RoleReplay { role, ticks, lives, samples, difference, limit } = replay;
    let lives = if *lives > 1 { format!(" in {lives} lives") } else { String::new() };
    let verdict = match difference {
        None => "the same to the last bit".to_owned(),
        Some(first) => {
            let field = first.field.as_ref().map_or(String::new(), |field| format!(" {field}"));
            format!(
                "first difference at tick {}, {}{field}:\n  recorded {}\n  replayed {}",
                first.tick, first.service, first.recorded, first.replayed
            )
        }
    };
    let limit = limit.as_ref().map_or(String::new(), |limit| {
        format!("  from tick {} on nothing can be compared: {}\n", limit.tick, limit.reason)
    });
    format!("{role}: {ticks} ticks{lives}, {samples} samples: {verdict}\n{limit}")
}

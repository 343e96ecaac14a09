//! `corotate replay`: a recording through the live roles.

use crate::record::exit_of;
use crate::{Exit, fail, say};
use corotate::config::Scenario;
use corotate::launch::{LaunchError, replay_as_process};
use corotate::record::{RecordError, Recording, RoleReplay, replay_in_process};
use corotate::runtime::RoleId;
use corotate::system::tell;
use std::path::PathBuf;
use std::sync::atomic::Ordering;

/// Options of `corotate replay`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// The recording
    file: PathBuf,
    /// observer, controller, a body's name, or all
    #[arg(long, value_name = "ROLE", default_value = "all")]
    role: String,
    /// Replay each role as a process of its own, as it takes part in runs, instead of in one thread
    #[arg(long)]
    processes: bool,
}

const EXAMPLES: &str = "\
Each role gets the inputs that it had, and misses what it missed; everything that it publishes but the time of sending is
compared with what was recorded. Exit code 3 if anything differs. What cannot be told is said.

Examples:
  corotate replay runs/20261121T150000Z-rigid-pair/run.mcap
  corotate replay run.mcap --role observer --processes";

/// Replays.
pub fn replay(arguments: &Arguments) -> Exit {
    match attempt(arguments) {
        Ok(replays) => {
            let text: String = replays.iter().map(words).collect();
            match say(&text) {
                Err(exit) => exit,
                Ok(()) if replays.iter().any(|replay| replay.difference.is_some()) => Exit::NotAccepted,
                Ok(()) => Exit::Ok,
            }
        }
        Err(LaunchError::Record(error)) => fail(exit_of(&error), &error),
        Err(error) => fail(crate::run::exit_of(&error), &error),
    }
}

fn attempt(arguments: &Arguments) -> Result<Vec<RoleReplay>, LaunchError> {
    let recording = Recording::open(&arguments.file)?;
    if let Some(damage) = recording.damage() {
        tell(format_args!("corotate: {} is read as far as it goes: {damage}", arguments.file.display()));
    }
    let scenario = recording.scenario_for_replay()?;
    recording.check_layouts(&scenario)?;
    let roles = roles(&arguments.role, &scenario)?;
    if !arguments.processes {
        return Ok(roles
            .into_iter()
            .map(|role| replay_in_process(&recording, &scenario, role))
            .collect::<Result<_, _>>()?);
    }
    let spawn = |source| LaunchError::Spawn { role: "a role".to_owned(), source };
    let program = std::env::current_exe().map_err(spawn)?;
    let signal = crate::run::catch_signals().map_err(spawn)?;
    let mut replays = Vec::new();
    for role in roles {
        replays.push(replay_as_process(&recording, &scenario, role, &program, &signal)?);
        if signal.load(Ordering::Relaxed) != 0 {
            return Err(RecordError::Missing { reason: "ended by a signal before all was replayed".to_owned() }.into());
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
        RecordError::Missing {
            reason: format!("--role {name}: there is no such role; this recording has: {known}, all"),
        }
    })
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

//! `corotate watch`: a screen on a running loop.

use super::run::catch_signals;
use super::{Exit, fail, say};
use crate::launch::SUMMARY;
use crate::watch::{Session, WatchError, show, text};
use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Options of `corotate watch`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// The run's domain [default: the newest run of this user]
    #[arg(value_name = "DIR")]
    domain: Option<PathBuf>,
    /// Watch for so long, s [default: 2], print one screen of 80 by 24, leave
    #[arg(long, value_name = "S", num_args = 0..=1, default_missing_value = "2", value_parser = seconds)]
    once: Option<f64>,
}

fn seconds(text: &str) -> Result<f64, String> {
    let seconds = text.parse().ok().filter(|seconds| (0.1..=86_400.0).contains(seconds));
    seconds.ok_or_else(|| "give 0.1 to 86400 s".to_owned())
}

const EXAMPLES: &str = "\
Keys: q quits, space lets the screen stand still, up, down and tab select a
signal, left and right scroll its fields. Times are those of the samples' own
stamps: due-sent from when a tick was due until the role's sample was sent,
in-sent from when the sample that it waits for was sent; median/99 % of the last
4096.

Examples:
  corotate run & corotate watch    the newest run of this user
  corotate watch $XDG_RUNTIME_DIR/corotate/<id>
                                   the run in that domain
  corotate watch --once 5 > screen.txt
                                   one screen as text, after five seconds";

/// Watches until it is enough.
pub fn watch(arguments: &Arguments) -> Exit {
    if let Some(run) = arguments.domain.as_deref().filter(|directory| directory.join(SUMMARY).exists()) {
        let run = run.display();
        return fail(
            Exit::Usage,
            &format!("{run} has the results of a run that is over; `corotate report {run}` shows it"),
        );
    }
    let signal = match catch_signals() {
        Ok(signal) => signal,
        Err(error) => return fail(Exit::Failure, &error),
    };
    match attempt(arguments, &signal) {
        Ok(exit) => exit,
        Err(error) => fail(exit_of(&error), &error),
    }
}

fn attempt(arguments: &Arguments, signal: &AtomicUsize) -> Result<Exit, WatchError> {
    let mut session = Session::open(arguments.domain.as_deref())?;
    match arguments.once {
        None => show(&mut session, signal)?,
        Some(seconds) => {
            session.follow((seconds * 1e9) as u64, || signal.load(Ordering::Relaxed) != 0)?;
            if let Err(exit) = say(&text(&session.model, 80, 24)) {
                return Ok(exit);
            }
        }
    }
    Ok(match signal.load(Ordering::Relaxed) {
        0 => Exit::Ok,
        number => Exit::Signal(number),
    })
}

fn exit_of(error: &WatchError) -> Exit {
    match error {
        WatchError::NoRun | WatchError::Domain(_) | WatchError::Run(_) | WatchError::Terminal { .. } => Exit::Usage,
        WatchError::Join { .. } | WatchError::Bus(_) => Exit::Failure,
    }
}

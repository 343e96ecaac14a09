//! Sets up the terminal, draws on it, and restores it however the program ends.
//!
//! ratatui's hook restores it after a panic. A signal handler only sets a number, which the loop here reads.

use super::error::WatchError;
use super::feed::POLL_NS;
use super::input::{Action, action};
use super::model::Model;
use super::screen::draw;
use super::session::Session;
use super::tune::Tune;
use crate::clock::monotonic_ns;
use ratatui::DefaultTerminal;
use ratatui::crossterm::event::{self, Event, KeyEventKind};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use std::io::{self, IsTerminal};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

/// The time between two drawings, ns: a user can read them, and a slow line can carry them.
const DRAW_NS: u64 = 200_000_000;

/// Shows a run until the user quits or a signal arrives; with `tunes` its inputs in the place of its signals.
///
/// # Errors
/// [`WatchError`].
pub fn show(session: &mut Session, tunes: bool, signal: &AtomicUsize) -> Result<(), WatchError> {
    let failed = |source| WatchError::Terminal { source };
    if !io::stdout().is_terminal() || !io::stdin().is_terminal() {
        return Err(failed(io::Error::other("stdin and stdout are not a terminal")));
    }
    let mut terminal = ratatui::try_init().map_err(failed)?;
    let tune = if tunes { session.tune() } else { None };
    let shown = watch(&mut terminal, session, tune, signal);
    ratatui::restore();
    shown
}

fn watch(
    terminal: &mut DefaultTerminal,
    session: &mut Session,
    mut tune: Option<Tune>,
    signal: &AtomicUsize,
) -> Result<(), WatchError> {
    let failed = |source| WatchError::Terminal { source };
    let (mut paused, mut next_draw_ns): (Option<Model>, u64) = (None, 0);
    while signal.load(Ordering::Relaxed) == 0 {
        // Polls while paused too, so that the queues do not fill up.
        session.poll()?;
        let now_ns = monotonic_ns();
        if now_ns >= next_draw_ns {
            session.refresh();
            session.model.tune = tune.as_mut().map(Tune::view);
            let model = paused.as_ref().unwrap_or(&session.model);
            terminal.draw(|frame| draw(model, frame)).map_err(failed)?;
            next_draw_ns = now_ns + DRAW_NS;
        }
        if hung_up(POLL_NS) {
            return Ok(());
        }
        if !event::poll(Duration::ZERO).map_err(failed)? {
            continue;
        }
        let wanted = match event::read().map_err(failed)? {
            Event::Key(key) if key.kind != KeyEventKind::Release && tune.as_mut().is_some_and(|tune| tune.key(key)) => {
                None
            }
            Event::Key(key) => action(key),
            _ => None,
        };
        match wanted {
            Some(Action::Quit) => return Ok(()),
            Some(Action::Pause) => {
                let snapshot = Model { paused: true, ..session.model.clone() };
                paused = if paused.is_some() { None } else { Some(snapshot) };
            }
            Some(Action::Tune) => tune = if tune.is_some() { None } else { session.tune() },
            Some(Action::Select(by)) => apply(&mut paused, session, |model| model.select(by)),
            Some(Action::Scroll(by)) => apply(&mut paused, session, |model| model.scroll(by)),
            None => {}
        }
        next_draw_ns = 0;
    }
    Ok(())
}

/// Waits for input for at most the given time; returns true if the terminal has hung up. Reading events of such a terminal
/// makes crossterm loop for ever.
fn hung_up(wait_ns: u64) -> bool {
    let stdin = io::stdin();
    let mut terminal = [PollFd::new(&stdin, PollFlags::IN)];
    let timeout = Timespec { tv_sec: 0, tv_nsec: wait_ns as _ };
    // An interrupted wait, for example by a resize, needs no handling.
    let _ = poll(&mut terminal, Some(&timeout));
    terminal[0].revents().intersects(PollFlags::HUP | PollFlags::ERR | PollFlags::NVAL)
}

/// Applies a change to the live model and to the paused one.
fn apply(paused: &mut Option<Model>, session: &mut Session, change: impl Fn(&mut Model)) {
    change(&mut session.model);
    paused.iter_mut().for_each(change);
}

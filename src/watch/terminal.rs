//! The terminal: taken, drawn on, and given back however the program ends.
//!
//! A panic gives it back too (ratatui's hook); a signal that asks for the end only sets a number, which is looked at here.

use super::WatchError;
use super::feed::LOOK_NS;
use super::input::{Action, action};
use super::model::Model;
use super::screen::draw;
use super::session::Session;
use crate::clock::monotonic_ns;
use ratatui::DefaultTerminal;
use ratatui::crossterm::event::{self, Event};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use std::io::{self, IsTerminal};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

/// Between two pictures, ns: what a person can read, and a slow line carry.
const DRAW_NS: u64 = 200_000_000;

/// Shows a run until a key or a signal says that it is enough.
///
/// # Errors
/// [`WatchError`].
pub fn show(session: &mut Session, signal: &AtomicUsize) -> Result<(), WatchError> {
    let failed = |source| WatchError::Terminal { source };
    if !io::stdout().is_terminal() || !io::stdin().is_terminal() {
        return Err(failed(io::Error::other("stdin and stdout are to be one")));
    }
    let mut terminal = ratatui::try_init().map_err(failed)?;
    let shown = watch(&mut terminal, session, signal);
    ratatui::restore();
    shown
}

fn watch(terminal: &mut DefaultTerminal, session: &mut Session, signal: &AtomicUsize) -> Result<(), WatchError> {
    let failed = |source| WatchError::Terminal { source };
    let (mut paused, mut next_draw_ns): (Option<Model>, u64) = (None, 0);
    while signal.load(Ordering::Relaxed) == 0 {
        // Also while the screen stands still: samples are not kept waiting.
        session.look()?;
        let now_ns = monotonic_ns();
        if now_ns >= next_draw_ns {
            session.refresh();
            let model = paused.as_ref().unwrap_or(&session.model);
            terminal.draw(|frame| draw(model, frame)).map_err(failed)?;
            next_draw_ns = now_ns + DRAW_NS;
        }
        if hung_up(LOOK_NS) {
            return Ok(());
        }
        if !event::poll(Duration::ZERO).map_err(failed)? {
            continue;
        }
        let wanted = match event::read().map_err(failed)? {
            Event::Key(key) => action(key),
            _ => None,
        };
        match wanted {
            Some(Action::Quit) => return Ok(()),
            Some(Action::Pause) => {
                let still = Model { paused: true, ..session.model.clone() };
                paused = if paused.is_some() { None } else { Some(still) };
            }
            Some(Action::Select(by)) => each(&mut paused, session, |model| model.select(by)),
            Some(Action::Scroll(by)) => each(&mut paused, session, |model| model.scroll(by)),
            None => {}
        }
        next_draw_ns = 0;
    }
    Ok(())
}

/// Waits for input, at most so long, and tells whether there is nobody at the other end any more: asked for events of such a
/// terminal, crossterm would look for them without end.
fn hung_up(wait_ns: u64) -> bool {
    let stdin = io::stdin();
    let mut terminal = [PollFd::new(&stdin, PollFlags::IN)];
    let timeout = Timespec { tv_sec: 0, tv_nsec: wait_ns as _ };
    // Interrupted, as by a change of the window's size: the caller looks for itself.
    let _ = poll(&mut terminal, Some(&timeout));
    terminal[0].revents().intersects(PollFlags::HUP | PollFlags::ERR | PollFlags::NVAL)
}

/// What is selected is so on the screen that stands still and on the one that goes on.
fn each(paused: &mut Option<Model>, session: &mut Session, act: impl Fn(&mut Model)) {
    act(&mut session.model);
    paused.iter_mut().for_each(act);
}

//! Named places in a role's life at which a test makes it die or stand still. Empty unless the feature `hooks` is on, which
//! is for tests alone.
//!
//! `COROTATE_HOOK="observer sent 1500 KILL"`: the observer, the 1500th time that it has just sent a sample, gets SIGKILL
//! from itself, once in a run. `STOP` is SIGSTOP, `HANG` an endless sleep. Must not do anything else to a role.

/// A place in a role's life.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Failpoint {
    /// Before it opens its links.
    Opening,
    /// All is open and warm; it waits for the word to run.
    Ready,
    /// It has made a sample that it has not committed itself to.
    Staged,
    /// It is about to commit its state, has written part of it, or has just committed it.
    Committing,
    /// See there.
    InCommit,
    /// See there.
    Committed,
    /// It has just sent a sample.
    Sent,
    /// It has nothing to do but to wait.
    Waiting,
}

#[cfg(not(feature = "hooks"))]
pub use off::{at, enter};

#[cfg(not(feature = "hooks"))]
mod off {
    use super::Failpoint;

    /// Nothing.
    #[inline(always)]
    pub fn enter(_roles: &[&str], _generation: u64) {}

    /// Nothing.
    #[inline(always)]
    pub fn at(_place: Failpoint) {}
}

#[cfg(feature = "hooks")]
pub use on::{at, enter};

#[cfg(feature = "hooks")]
mod on {
    use super::Failpoint;
    use rustix::process::{Signal, getpid, kill_process};
    use std::sync::OnceLock;
    use std::sync::atomic::{AtomicU64, Ordering};

    struct Hook {
        place: Failpoint,
        left: AtomicU64,
        /// None for a hang.
        signal: Option<Signal>,
    }

    static HOOK: OnceLock<Option<Hook>> = OnceLock::new();

    /// Arms the hook if it is meant for one of these roles, which are this process, and for nobody before it.
    pub fn enter(roles: &[&str], generation: u64) {
        HOOK.get_or_init(|| parse(&std::env::var("COROTATE_HOOK").ok()?, roles).filter(|_| generation == 1));
    }

    fn parse(text: &str, roles: &[&str]) -> Option<Hook> {
        let mut words = text.split_whitespace();
        if !roles.contains(&words.next()?) {
            return None;
        }
        let place = match words.next()? {
            "opening" => Failpoint::Opening,
            "ready" => Failpoint::Ready,
            "staged" => Failpoint::Staged,
            "committing" => Failpoint::Committing,
            "in-commit" => Failpoint::InCommit,
            "committed" => Failpoint::Committed,
            "sent" => Failpoint::Sent,
            "waiting" => Failpoint::Waiting,
            _ => return None,
        };
        let left = AtomicU64::new(words.next()?.parse().ok()?);
        let signal = match words.next()? {
            "KILL" => Some(Signal::KILL),
            "STOP" => Some(Signal::STOP),
            "HANG" => None,
            _ => return None,
        };
        Some(Hook { place, left, signal })
    }

    /// Passes a place.
    #[inline]
    pub fn at(place: Failpoint) {
        if let Some(Some(hook)) = HOOK.get()
            && hook.place == place
            && hook.left.fetch_sub(1, Ordering::Relaxed) == 1
        {
            match hook.signal {
                Some(signal) => _ = kill_process(getpid(), signal),
                None => loop {
                    std::thread::park();
                },
            }
        }
    }
}

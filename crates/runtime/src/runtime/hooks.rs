//! Failpoints: named places where a test kills or stops a role. Empty unless the feature `hooks` is on, which is for
//! tests only.
//!
//! `COROTATE_HOOK="observer sent 1500 KILL"`: the observer sends itself SIGKILL after its 1500th sent sample, once per
//! run. `STOP` is SIGSTOP, `HANG` sleeps forever. Must not affect a role in any other way.

/// A place in the life of a role.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Failpoint {
    /// Before the links are opened.
    Opening,
    /// Links are open and warm; the role waits for the run phase.
    Ready,
    /// A sample is staged and not committed.
    Staged,
    /// Directly before the state is committed.
    Committing,
    /// While the state is written.
    InCommit,
    /// Directly after the commit.
    Committed,
    /// Directly after a sample is sent.
    Sent,
    /// The role waits for input.
    Waiting,
}

#[cfg(not(feature = "hooks"))]
pub use off::{at, enter};

#[cfg(not(feature = "hooks"))]
mod off {
    use super::Failpoint;

    /// Does nothing.
    #[inline(always)]
    pub fn enter(_roles: &[&str], _generation: u64) {}

    /// Does nothing.
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
        /// The signal to send; `None` hangs.
        signal: Option<Signal>,
    }

    static HOOK: OnceLock<Option<Hook>> = OnceLock::new();

    /// Arms the hook if it names one of this process's roles and the generation is 1.
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

    /// Triggers the hook if it is armed for this place.
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

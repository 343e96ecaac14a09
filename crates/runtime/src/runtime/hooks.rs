//! Failpoints: named places where a test kills or stops a role. Empty unless the feature `hooks` is on, which is for
//! tests only.
//!
//! `COROTATE_HOOK="observer sent 1500 KILL"`: the observer sends itself SIGKILL after its 1500th sent sample, once per
//! run. `STOP` is SIGSTOP, `HANG` sleeps forever. `BURN` computes for 300 µs at every 1500th time, and `FAULT` takes page
//! faults for about as long. Must not affect a role in any other way.

/// A place in the life of a role.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Failpoint {
    /// Before the links are opened.
    Opening,
    /// Links are open and warm; the role waits for the run phase.
    Ready,
    /// All inputs are there, and the role computes.
    Computing,
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
    use std::time::{Duration, Instant};

    /// The time for which `BURN` computes.
    const BURN: Duration = Duration::from_micros(300);
    /// The pages that `FAULT` touches after they were dropped, bytes.
    const DROPPED: usize = 1 << 20;

    #[derive(Clone, Copy)]
    enum Action {
        Signal(Signal),
        Hang,
        Burn,
        Fault,
    }

    struct Hook {
        place: Failpoint,
        left: AtomicU64,
        /// The number of passes from one action to the next, for actions that repeat.
        every: u64,
        action: Action,
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
            "computing" => Failpoint::Computing,
            "staged" => Failpoint::Staged,
            "committing" => Failpoint::Committing,
            "in-commit" => Failpoint::InCommit,
            "committed" => Failpoint::Committed,
            "sent" => Failpoint::Sent,
            "waiting" => Failpoint::Waiting,
            _ => return None,
        };
        let every = words.next()?.parse().ok()?;
        let action = match words.next()? {
            "KILL" => Action::Signal(Signal::KILL),
            "STOP" => Action::Signal(Signal::STOP),
            "HANG" => Action::Hang,
            "BURN" => Action::Burn,
            "FAULT" => Action::Fault,
            _ => return None,
        };
        Some(Hook { place, left: AtomicU64::new(every), every, action })
    }

    /// Triggers the hook if it is armed for this place.
    #[inline]
    pub fn at(place: Failpoint) {
        if let Some(Some(hook)) = HOOK.get()
            && hook.place == place
            && hook.left.fetch_sub(1, Ordering::Relaxed) == 1
        {
            match hook.action {
                Action::Signal(signal) => _ = kill_process(getpid(), signal),
                Action::Hang => loop {
                    std::thread::park();
                },
                Action::Burn => {
                    hook.left.store(hook.every, Ordering::Relaxed);
                    let begun = Instant::now();
                    while begun.elapsed() < BURN {
                        std::hint::spin_loop();
                    }
                }
                Action::Fault => {
                    hook.left.store(hook.every, Ordering::Relaxed);
                    if let Ok(mut pages) = memmap2::MmapMut::map_anon(DROPPED) {
                        pages.iter_mut().step_by(4096).for_each(|byte| *byte = std::hint::black_box(1));
                    }
                }
            }
        }
    }
}

//! Futex notifiers: a reader that has nothing to do sleeps on the notifier of the signal it lacks, and its writer wakes it.
//!
//! A notifier is a futex in memory that the processes of a run share. It has no owner, so nobody's death can lock it. A writer
//! that finds nobody asleep makes no system call. Must not carry anything: who is woken looks at the link.

use super::Topic;
use super::domain::Domain;
use crate::clock::monotonic_ns;
use crate::shared::SharedHalves;
use rustix::thread::futex;
use rustix::time::Timespec;
use std::io;
use std::rc::Rc;
use std::sync::atomic::{AtomicU32, Ordering};
use xxhash_rust::xxh3::xxh3_64;

/// Notifiers of a run. Where there are more signals, some share one and wake each other's readers in vain.
const NOTIFIERS: usize = 512;
/// Notifiers are a cache line apart: one writer's notifications must not slow another down.
const STRIDE: usize = 16;
/// Beside a notifier: whose it is.
const OWNER: usize = 1;
/// Set while somebody is asleep; the count of notifications is above it.
const ASLEEP: u32 = 1;
const NOTIFICATION: u32 = 2;
/// A writer that has never notified is perhaps none of ours and never will: its reader looks again after so long, ns.
const SILENT_NS: u64 = 50_000;
/// One that has may have died before it notified: its reader looks again after so long, ns. Not after a tick: two that wake at
/// one time are in each other's way.
const NOTIFIED_NS: u64 = 10_000_000;

/// Bytes of shared memory for the notifiers of a run.
pub const NOTIFIERS_BYTES: usize = NOTIFIERS * STRIDE * size_of::<u32>();

/// The notifiers of a run.
#[derive(Debug, Clone)]
pub struct Notifiers {
    memory: Rc<SharedHalves>,
}

impl Notifiers {
    /// Those of a domain.
    ///
    /// # Errors
    /// The system's reason.
    pub fn open(domain: &Domain) -> io::Result<Self> {
        Self::over(SharedHalves::open(&domain.shared("notifiers"), NOTIFIERS * STRIDE)?)
    }

    /// Those of a domain that has some already.
    ///
    /// # Errors
    /// The system's reason.
    pub fn join(domain: &Domain) -> io::Result<Self> {
        Self::over(SharedHalves::existing(&domain.shared("notifiers"))?)
    }

    fn over(memory: SharedHalves) -> io::Result<Self> {
        if memory.halves().len() < NOTIFIERS * STRIDE {
            return Err(io::Error::other("the notifiers of this run are another version's"));
        }
        Ok(Self { memory: Rc::new(memory) })
    }

    /// The notifier of a signal.
    pub fn notifier_for(&self, topic: &Topic) -> Notifier {
        // XXH3 with seed 0 of the service's name: every build of this program must find the same.
        let hash = xxh3_64(topic.to_string().as_bytes());
        let (home, owner) = (hash as usize % NOTIFIERS, (hash >> 32) as u32 | 1);
        let index = (home..NOTIFIERS).chain(0..home).find(|index| self.claim(*index, owner)).unwrap_or(home);
        Notifier { memory: self.memory.clone(), index: index * STRIDE }
    }

    /// Takes a notifier for a signal, unless it is another one's.
    fn claim(&self, index: usize, owner: u32) -> bool {
        let present = self.memory.halves()[index * STRIDE + OWNER].compare_exchange(
            0,
            owner,
            Ordering::Relaxed,
            Ordering::Relaxed,
        );
        present.is_ok() || present == Err(owner)
    }
}

/// The notifier of one signal.
#[derive(Debug)]
pub struct Notifier {
    memory: Rc<SharedHalves>,
    index: usize,
}

impl Notifier {
    #[inline]
    fn word(&self) -> &AtomicU32 {
        &self.memory.halves()[self.index]
    }

    /// Wakes whoever sleeps. After the sample is there.
    #[inline]
    pub fn notify(&self) {
        if self.word().fetch_add(NOTIFICATION, Ordering::SeqCst) & ASLEEP != 0 {
            self.wake();
        }
    }

    #[cold]
    fn wake(&self) {
        self.word().fetch_and(!ASLEEP, Ordering::SeqCst);
        // A reader that is not woken looks again by itself.
        let _ = futex::wake(self.word(), futex::Flags::empty(), i32::MAX as u32);
    }

    /// Sleeps until it is notified, at most until `until_ns`, and not at all if `news` says that there is something. May end
    /// early.
    #[inline]
    pub fn sleep<E>(&self, until_ns: u64, news: impl FnOnce() -> Result<bool, E>) -> Result<(), E> {
        let seen = self.word().fetch_or(ASLEEP, Ordering::SeqCst) | ASLEEP;
        // Looked at after the mark is set: what arrives from here on wakes.
        if news()? {
            return Ok(());
        }
        let longest_ns = if seen >= NOTIFICATION { NOTIFIED_NS } else { SILENT_NS };
        let wait_ns = until_ns.saturating_sub(monotonic_ns()).min(longest_ns);
        let timeout = Timespec { tv_sec: 0, tv_nsec: wait_ns as _ };
        // Rung, interrupted or over: the caller looks for itself.
        let _ = futex::wait(self.word(), futex::Flags::empty(), seen, Some(&timeout));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::Signal;
    use super::super::domain::OwnedDomain;
    use super::*;
    use std::convert::Infallible;

    fn topic(body: &str) -> Topic {
        Topic { scenario: "s".to_owned(), body: body.to_owned(), signal: Signal::Estimate }
    }

    const FAR_NS: u64 = 10_000_000_000;

    #[test]
    fn whoever_sleeps_is_woken_by_the_ring_and_not_by_the_clock() {
        let domain = OwnedDomain::create(0).unwrap();
        let (notifies, waits) = (domain.domain().clone(), domain.domain().clone());
        let (said, heard) = std::sync::mpsc::channel();
        let ringer = std::thread::spawn(move || {
            let notifier = Notifiers::open(&notifies).unwrap().notifier_for(&topic("b"));
            notifier.notify();
            while heard.try_recv().is_err() {
                notifier.notify();
                std::thread::yield_now();
            }
        });
        let notifier = Notifiers::open(&waits).unwrap().notifier_for(&topic("b"));
        for _ in 0..200 {
            notifier.sleep(monotonic_ns() + FAR_NS, || Ok::<_, Infallible>(false)).unwrap();
        }
        said.send(()).unwrap();
        ringer.join().unwrap();
        assert!(notifier.word().load(Ordering::SeqCst) >= NOTIFICATION);
    }

    #[test]
    fn nobody_sleeps_over_news_or_longer_than_told() {
        let domain = OwnedDomain::create(0).unwrap();
        let notifier = Notifiers::open(domain.domain()).unwrap().notifier_for(&topic("b"));
        notifier.sleep(monotonic_ns() + FAR_NS, || Ok::<_, Infallible>(true)).unwrap();
        notifier.sleep(0, || Ok::<_, Infallible>(false)).unwrap();
        assert_eq!(notifier.sleep(0, || Err(7)), Err(7));
    }

    #[test]
    fn when_no_bell_is_left_signals_share() {
        let domain = OwnedDomain::create(0).unwrap();
        let notifiers = Notifiers::open(domain.domain()).unwrap();
        let indices: Vec<usize> =
            (0..2 * NOTIFIERS).map(|n| notifiers.notifier_for(&topic(&n.to_string())).index).collect();
        assert!(indices.iter().all(|index| *index < NOTIFIERS * STRIDE));
    }

    #[test]
    fn the_bells_of_a_signal_are_one_for_every_process() {
        let domain = OwnedDomain::create(0).unwrap();
        let (one, other) = (Notifiers::open(domain.domain()).unwrap(), Notifiers::open(domain.domain()).unwrap());
        let indices: Vec<usize> = (0..400).map(|n| one.notifier_for(&topic(&n.to_string())).index).collect();
        assert_eq!(indices, (0..400).map(|n| other.notifier_for(&topic(&n.to_string())).index).collect::<Vec<_>>());
        let distinct: std::collections::HashSet<usize> = indices.iter().copied().collect();
        assert_eq!(distinct.len(), indices.len(), "none is shared");
    }

    /// The hash is a contract between processes, which may have been built by different compilers.
    #[test]
    fn a_signal_has_the_same_place_in_every_build() {
        let domain = OwnedDomain::create(0).unwrap();
        let notifier = Notifiers::open(domain.domain()).unwrap().notifier_for(&topic("b"));
        // XXH3-64 of "corotate/s/b/estimate", by the reference implementation.
        const HASH: u64 = 0x4c41_63f9_45f3_9fcc;
        assert_eq!(notifier.index, HASH as usize % NOTIFIERS * STRIDE);
        assert_eq!(notifier.memory.halves()[notifier.index + OWNER].load(Ordering::SeqCst), (HASH >> 32) as u32 | 1);
    }
}

//! Futex notifiers: an idle reader sleeps on the notifier of the signal it lacks, and the writer wakes it.
//!
//! A notifier is a futex in the shared memory of a run. It has no owner, so no death can lock it. A writer makes no
//! system call if no reader sleeps. Must not carry data: a woken reader polls its link.

use super::domain::Domain;
use super::names::Topic;
use crate::clock::monotonic_ns;
use crate::shared::SharedHalves;
use rustix::thread::futex;
use rustix::time::Timespec;
use std::io;
use std::rc::Rc;
use std::sync::atomic::{AtomicU32, Ordering};
use xxhash_rust::xxh3::xxh3_64;

/// Number of notifiers of a run. With more signals some share a notifier and cause useless wakes.
const NOTIFIERS: usize = 512;
/// Notifiers are a cache line apart, so that writers do not slow each other down.
const STRIDE: usize = 16;
/// Word beside a notifier: hash of its signal.
const OWNER: usize = 1;
/// Set while a reader sleeps; the bits above count notifications.
const ASLEEP: u32 = 1;
const NOTIFICATION: u32 = 2;
/// Longest sleep if the writer has never notified, as foreign programs do, ns.
const SILENT_NS: u64 = 50_000;
/// Longest sleep if the writer has notified, because it may have died since, ns. Longer than a tick, so that two
/// readers do not wake together.
const NOTIFIED_NS: u64 = 10_000_000;

/// Size of a run's notifiers in shared memory, bytes.
pub const NOTIFIERS_BYTES: usize = NOTIFIERS * STRIDE * size_of::<u32>();

/// The notifiers of a run.
#[derive(Debug, Clone)]
pub struct Notifiers {
    memory: Rc<SharedHalves>,
}

impl Notifiers {
    /// Opens or creates the notifiers of a domain.
    ///
    /// # Errors
    /// The system's reason.
    pub fn open(domain: &Domain) -> io::Result<Self> {
        Self::over(SharedHalves::open(&domain.shared("notifiers"), NOTIFIERS * STRIDE)?)
    }

    /// Opens the existing notifiers of a domain.
    ///
    /// # Errors
    /// The system's reason.
    pub fn join(domain: &Domain) -> io::Result<Self> {
        Self::over(SharedHalves::existing(&domain.shared("notifiers"))?)
    }

    fn over(memory: SharedHalves) -> io::Result<Self> {
        if memory.halves().len() < NOTIFIERS * STRIDE {
            return Err(io::Error::other("the notifiers of this run are of another version"));
        }
        Ok(Self { memory: Rc::new(memory) })
    }

    /// Returns the notifier of a signal.
    pub fn notifier_for(&self, topic: &Topic) -> Notifier {
        // XXH3 with seed 0 of the service name: every build of this program must compute the same index.
        let hash = xxh3_64(topic.to_string().as_bytes());
        let (home, owner) = (hash as usize % NOTIFIERS, (hash >> 32) as u32 | 1);
        let index = (home..NOTIFIERS).chain(0..home).find(|index| self.claim(*index, owner)).unwrap_or(home);
        Notifier { memory: self.memory.clone(), index: index * STRIDE }
    }

    /// Claims a notifier for a signal; returns false if it belongs to another one.
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

    /// Wakes sleeping readers. Must follow the sample.
    #[inline]
    pub fn notify(&self) {
        if self.word().fetch_add(NOTIFICATION, Ordering::SeqCst) & ASLEEP != 0 {
            self.wake();
        }
    }

    #[cold]
    fn wake(&self) {
        self.word().fetch_and(!ASLEEP, Ordering::SeqCst);
        // A reader that is not woken polls again by itself.
        let _ = futex::wake(self.word(), futex::Flags::empty(), i32::MAX as u32);
    }

    /// Sleeps until notified, at most until `until_ns`; returns at once if `news` is true. May end early.
    #[inline]
    pub fn sleep<E>(&self, until_ns: u64, news: impl FnOnce() -> Result<bool, E>) -> Result<(), E> {
        let seen = self.word().fetch_or(ASLEEP, Ordering::SeqCst) | ASLEEP;
        // Checked after the mark is set: a sample that arrives from here on wakes the reader.
        if news()? {
            return Ok(());
        }
        let longest_ns = if seen >= NOTIFICATION { NOTIFIED_NS } else { SILENT_NS };
        let wait_ns = until_ns.saturating_sub(monotonic_ns()).min(longest_ns);
        let timeout = Timespec { tv_sec: 0, tv_nsec: wait_ns as _ };
        // Notified, interrupted or timed out: the caller polls.
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
    fn a_sleeping_reader_is_woken_by_a_notification() {
        let domain = OwnedDomain::create(0).unwrap();
        let (notifies, waits) = (domain.domain().clone(), domain.domain().clone());
        let (stop, stopped) = std::sync::mpsc::channel();
        let notifying = std::thread::spawn(move || {
            let notifier = Notifiers::open(&notifies).unwrap().notifier_for(&topic("b"));
            notifier.notify();
            while stopped.try_recv().is_err() {
                notifier.notify();
                std::thread::yield_now();
            }
        });
        let notifier = Notifiers::open(&waits).unwrap().notifier_for(&topic("b"));
        for _ in 0..200 {
            notifier.sleep(monotonic_ns() + FAR_NS, || Ok::<_, Infallible>(false)).unwrap();
        }
        stop.send(()).unwrap();
        notifying.join().unwrap();
        assert!(notifier.word().load(Ordering::SeqCst) >= NOTIFICATION);
    }

    #[test]
    fn a_sleep_ends_with_news_and_at_its_limit() {
        let domain = OwnedDomain::create(0).unwrap();
        let notifier = Notifiers::open(domain.domain()).unwrap().notifier_for(&topic("b"));
        notifier.sleep(monotonic_ns() + FAR_NS, || Ok::<_, Infallible>(true)).unwrap();
        notifier.sleep(0, || Ok::<_, Infallible>(false)).unwrap();
        assert_eq!(notifier.sleep(0, || Err(7)), Err(7));
    }

    #[test]
    fn signals_share_notifiers_when_none_is_left() {
        let domain = OwnedDomain::create(0).unwrap();
        let notifiers = Notifiers::open(domain.domain()).unwrap();
        let indices: Vec<usize> =
            (0..2 * NOTIFIERS).map(|n| notifiers.notifier_for(&topic(&n.to_string())).index).collect();
        assert!(indices.iter().all(|index| *index < NOTIFIERS * STRIDE));
    }

    #[test]
    fn every_process_finds_the_same_notifier() {
        let domain = OwnedDomain::create(0).unwrap();
        let (first, second) = (Notifiers::open(domain.domain()).unwrap(), Notifiers::open(domain.domain()).unwrap());
        let indices: Vec<usize> = (0..400).map(|n| first.notifier_for(&topic(&n.to_string())).index).collect();
        assert_eq!(indices, (0..400).map(|n| second.notifier_for(&topic(&n.to_string())).index).collect::<Vec<_>>());
        let distinct: std::collections::HashSet<usize> = indices.iter().copied().collect();
        assert_eq!(distinct.len(), indices.len(), "notifiers are not shared");
    }

    /// The hash is a contract between processes that different compilers may have built.
    #[test]
    fn a_signal_has_the_same_index_in_every_build() {
        let domain = OwnedDomain::create(0).unwrap();
        let notifier = Notifiers::open(domain.domain()).unwrap().notifier_for(&topic("b"));
        // XXH3-64 of "corotate/s/b/estimate", by the reference implementation.
        const HASH: u64 = 0x4c41_63f9_45f3_9fcc;
        assert_eq!(notifier.index, HASH as usize % NOTIFIERS * STRIDE);
        assert_eq!(notifier.memory.halves()[notifier.index + OWNER].load(Ordering::SeqCst), (HASH >> 32) as u32 | 1);
    }
}

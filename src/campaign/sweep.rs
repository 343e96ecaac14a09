//! Runs a campaign on all cores, and continues an interrupted one.
//!
//! A result is in the journal before it is counted. Memory depends on the number of cores, plus eight bytes per case. Must not do
//! a work item twice, nor let the result depend on the process that did it.

use super::error::SweepError;
use super::file::Campaign;
use super::journal::{Entry, FILE, Head, Journal, Reader};
use super::results::{self, CAMPAIGN, Counts};
use super::table::{MarginPoint, Row};
use crate::config::{ClockKind, ConfigError};
use crate::files;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::sync_channel;

/// Results that wait for the journal, per thread.
const WAITING: usize = 2;

/// The options of a sweep.
pub struct Sweep<'a> {
    /// The number of cases that run at a time.
    pub threads: usize,
    /// The part of the campaign to run; `None` for the whole.
    pub shard: Option<Shard>,
    /// The clock: in one thread, or lockstep.
    pub clock: ClockKind,
    /// The signal that interrupts the sweep; 0 until one arrives.
    pub signal: &'a AtomicUsize,
    /// Called after every work item with the number of finished and of all items.
    pub progress: &'a mut dyn FnMut(u64, u64),
}

/// One of `count` equal parts of a campaign: every `count`-th work item.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shard {
    /// The index, from 0.
    pub index: u64,
    /// The number of parts.
    pub count: u64,
}

/// The text does not name a shard.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("expected I/N with I from 0 and below N, for example 0/4 to 3/4 for four shards")]
pub struct NoShard;

impl FromStr for Shard {
    type Err = NoShard;

    fn from_str(text: &str) -> Result<Self, NoShard> {
        let (index, count) = text.split_once('/').ok_or(NoShard)?;
        let (index, count) = (index.parse().map_err(|_| NoShard)?, count.parse().map_err(|_| NoShard)?);
        if index < count { Ok(Self { index, count }) } else { Err(NoShard) }
    }
}

/// The result of a sweep.
#[derive(Debug, Clone, PartialEq)]
pub struct Swept {
    /// Finished work items: cases and points of margins.
    pub done: u64,
    /// The number of all work items.
    pub all: u64,
    /// The counts in the tables; `None` if the sweep was interrupted and they are not written.
    pub counts: Option<Counts>,
}

impl Shard {
    const ALL: Self = Self { index: 0, count: 1 };

    /// Returns the number of its work items among all.
    fn pieces(self, all: u64) -> u64 {
        (all + self.count - 1 - self.index) / self.count
    }

    /// Returns the position of a work item among its own.
    fn place(self, piece: u64) -> Option<u64> {
        (piece % self.count == self.index).then_some(piece / self.count)
    }

    fn indices(self) -> Option<[u64; 2]> {
        (self != Self::ALL).then_some([self.index, self.count])
    }
}

impl Campaign {
    /// Runs the remaining work items, and writes the tables once all are done. The directory is new, or holds the results of an
    /// earlier run of the same campaign.
    ///
    /// # Errors
    /// [`SweepError`]. Finished work remains in the journal.
    pub fn sweep(&self, directory: &Path, sweep: &mut Sweep<'_>) -> Result<Swept, SweepError> {
        let shard = sweep.shard.unwrap_or(Shard::ALL);
        let mut journal = self.open(directory, shard)?;
        let all = shard.pieces(self.pieces());
        (sweep.progress)(journal.done(), all);
        self.work_on(&mut journal, shard, sweep)?;
        let done = journal.done();
        let counts = if done == all { Some(results::write(directory, self, shard.indices(), &journal)?) } else { None };
        Ok(Swept { done, all, counts })
    }

    /// Returns true if a directory holds results of this whole campaign.
    pub fn began(&self, directory: &Path) -> bool {
        let head = Head::new(self.identity(), None, &self.table());
        Reader::open(directory).is_ok_and(|reader| *reader.head() == head)
    }

    /// Opens the journal in a directory, a new one or one of this campaign.
    fn open(&self, directory: &Path, shard: Shard) -> Result<Journal, SweepError> {
        let refuse = |source| SweepError::Write { path: directory.to_owned(), source };
        files::create_directories(directory).map_err(refuse)?;
        let empty = fs::read_dir(directory).map_err(refuse)?.next().is_none();
        if !empty && !directory.join(FILE).is_file() {
            return Err(SweepError::Foreign { path: directory.to_owned() });
        }
        let head = Head::new(self.identity(), shard.indices(), &self.table());
        let place = |entry: &Entry| self.piece(entry).and_then(|piece| shard.place(piece));
        let journal = Journal::open(directory, &head, shard.pieces(self.pieces()), place)?;
        results::write_file(&directory.join(CAMPAIGN), |out| io::Write::write_all(out, self.to_toml().as_bytes()))?;
        Ok(journal)
    }

    /// Does the remaining work items, until all are done or a signal interrupts.
    fn work_on(&self, journal: &mut Journal, shard: Shard, sweep: &mut Sweep<'_>) -> Result<(), SweepError> {
        let places = shard.pieces(self.pieces());
        let left: Vec<u64> = (0..places).filter(|place| !journal.has(*place)).collect();
        let (next, threads) = (AtomicU64::new(0), sweep.threads.clamp(1, left.len().max(1)));
        let (sender, receiver) = sync_channel(WAITING * threads);
        let (clock, signal, mut done) = (sweep.clock, sweep.signal, places - left.len() as u64);
        std::thread::scope(|scope| {
            for _ in 0..threads {
                let (sender, next, left) = (sender.clone(), &next, &left);
                scope.spawn(move || {
                    while signal.load(Ordering::Relaxed) == 0
                        && let Some(place) = left.get(next.fetch_add(1, Ordering::Relaxed) as usize)
                        && let Some(entry) = self.work(place * shard.count + shard.index, clock, signal)
                        // The receiver is gone if the journal could not be written.
                        && sender.send((*place, entry)).is_ok()
                    {}
                });
            }
            drop(sender);
            for (place, entry) in receiver {
                journal.add(place, &entry)?;
                done += 1;
                (sweep.progress)(done, places);
            }
            Ok(())
        })
    }
}

/// Merges the results of all shards of a campaign, with the same result as one run of the whole.
///
/// # Errors
/// [`SweepError`], also if a case is missing, or differs between two directories.
pub fn merge(directories: &[PathBuf], out: &Path) -> Result<Swept, SweepError> {
    let Some(first) = directories.first() else { return Ok(Swept { done: 0, all: 0, counts: None }) };
    let head = Reader::open(first)?.head().whole();
    // The campaign contains its scenario.
    let unknown = |name: &str| {
        let text = format!("the campaign contains its scenario, but names `{name}`");
        Err(ConfigError::Unknown { code: "unknown-scenario", text })
    };
    let mut whole = Campaign::load(&first.join(CAMPAIGN), &[], &unknown)?.collect(out)?;
    for directory in directories {
        let mut reader = Reader::open(directory)?;
        if reader.head().whole() != head || head.identity != whole.campaign.identity() {
            return Err(SweepError::Mixed { first: first.clone(), path: directory.clone() });
        }
        while let Some(entry) = reader.next()? {
            whole.take(&entry, directory)?;
        }
    }
    whole.finish()
}

/// Collects the results of a campaign whose work is done elsewhere, in order of arrival.
pub struct Collection {
    campaign: Campaign,
    directory: PathBuf,
    journal: Journal,
}

impl Campaign {
    /// Opens a directory for results: a new one, or one with results of the same campaign. No other process can write to it
    /// meanwhile.
    ///
    /// # Errors
    /// [`SweepError`].
    pub fn collect(self, directory: &Path) -> Result<Collection, SweepError> {
        let journal = self.open(directory, Shard::ALL)?;
        Ok(Collection { campaign: self, directory: directory.to_owned(), journal })
    }
}

impl Collection {
    /// Returns the [work items](Campaign::pieces) that are not done.
    pub fn left(&self) -> Vec<u64> {
        (0..self.campaign.pieces()).filter(|piece| !self.journal.has(*piece)).collect()
    }

    /// Adds the [result of a work item](Campaign::work), unless it is present.
    ///
    /// # Errors
    /// [`SweepError::Disagree`] if a different result is present; [`SweepError::Journal`].
    pub fn add(&mut self, entry: &Entry) -> Result<(), SweepError> {
        self.take(entry, Path::new("what came"))
    }

    /// Like [`add`](Self::add), for an entry of the directory `from`.
    fn take(&mut self, entry: &Entry, from: &Path) -> Result<(), SweepError> {
        let Some(piece) = self.campaign.piece(entry) else { return Ok(()) };
        if !self.journal.has(piece) {
            return Ok(self.journal.add(piece, entry)?);
        }
        if self.journal.lines()?.entry(piece)?.is_some_and(|known| known == *entry) {
            return Ok(());
        }
        let (Entry::Row(Row { case, .. }) | Entry::Margin { point: MarginPoint { case, .. }, .. }) = *entry;
        Err(SweepError::Disagree { path: from.to_owned(), case })
    }

    /// Writes the tables.
    ///
    /// # Errors
    /// [`SweepError`], also if a work item is missing.
    pub fn finish(&self) -> Result<Swept, SweepError> {
        let (done, all) = (self.journal.done(), self.campaign.pieces());
        if let Some(first) = (0..all).find(|piece| !self.journal.has(*piece)) {
            return Err(SweepError::Missing { count: all - done, all, first });
        }
        let counts = results::write(&self.directory, &self.campaign, None, &self.journal)?;
        Ok(Swept { done, all, counts: Some(counts) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn every_piece_is_in_one_shard_and_has_a_place_in_it(all in 0..500_u64, count in 1..20_u64) {
            let mut pieces = Vec::new();
            for index in 0..count {
                let shard = Shard { index, count };
                let own: Vec<u64> = (0..all).filter(|piece| shard.place(*piece).is_some()).collect();
                let places: Vec<u64> = own.iter().filter_map(|piece| shard.place(*piece)).collect();
                prop_assert_eq!(places, (0..shard.pieces(all)).collect::<Vec<_>>());
                pieces.extend(own);
            }
            pieces.sort_unstable();
            prop_assert_eq!(pieces, (0..all).collect::<Vec<_>>());
        }
    }

    #[test]
    fn a_shard_is_written_as_a_part_of_several() {
        assert_eq!("3/4".parse(), Ok(Shard { index: 3, count: 4 }));
        for text in ["4/4", "1", "-1/4", "1/0", "a/b", ""] {
            assert_eq!(text.parse::<Shard>(), Err(NoShard), "{text}");
        }
    }
}

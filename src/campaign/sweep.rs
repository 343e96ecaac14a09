//! Runs a campaign on all cores, and goes on where it was interrupted.
//!
//! What is done is in the journal before it is counted. Memory follows from the cores and not from the cases, but for eight bytes per
//! case. Must not do a piece of work twice, nor let the result depend on who did it.

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

/// How a campaign is run.
pub struct Sweep<'a> {
    /// How many cases run at a time.
    pub threads: usize,
    /// The part of the campaign to run; none for all of it.
    pub shard: Option<Shard>,
    /// What drives the ticks: in one thread, or in lockstep.
    pub clock: ClockKind,
    /// The signal that asked for the end; 0 while none has.
    pub signal: &'a AtomicUsize,
    /// Called for every piece of work that is done: how many are, and how many there are.
    pub progress: &'a mut dyn FnMut(u64, u64),
}

/// One of several equal parts of a campaign: every so-manyth piece of work.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shard {
    /// Which, from 0.
    pub index: u64,
    /// Of how many.
    pub count: u64,
}

/// A text is no shard.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a shard is I/N: I from 0, below N; as 0/4 to 3/4 for four")]
pub struct NoShard;

impl FromStr for Shard {
    type Err = NoShard;

    fn from_str(text: &str) -> Result<Self, NoShard> {
        let (index, count) = text.split_once('/').ok_or(NoShard)?;
        let (index, count) = (index.parse().map_err(|_| NoShard)?, count.parse().map_err(|_| NoShard)?);
        if index < count { Ok(Self { index, count }) } else { Err(NoShard) }
    }
}

/// What a sweep came to.
#[derive(Debug, Clone, PartialEq)]
pub struct Swept {
    /// Pieces of work that are done: cases, and points of margins.
    pub done: u64,
    /// How many there are.
    pub all: u64,
    /// What is in the tables; none where the sweep was interrupted and they are not written.
    pub counts: Option<Counts>,
}

impl Shard {
    const ALL: Self = Self { index: 0, count: 1 };

    /// How many of all pieces are its.
    fn pieces(self, all: u64) -> u64 {
        (all + self.count - 1 - self.index) / self.count
    }

    /// The position of a piece among its own.
    fn place(self, piece: u64) -> Option<u64> {
        (piece % self.count == self.index).then_some(piece / self.count)
    }

    fn told(self) -> Option<[u64; 2]> {
        (self != Self::ALL).then_some([self.index, self.count])
    }
}

impl Campaign {
    /// Runs it, or what is left of it, and writes its tables once all is done. The directory is made, or has what an earlier run of
    /// the same campaign left.
    ///
    /// # Errors
    /// [`SweepError`]. What had been done is in the journal.
    pub fn sweep(&self, directory: &Path, sweep: &mut Sweep<'_>) -> Result<Swept, SweepError> {
        let shard = sweep.shard.unwrap_or(Shard::ALL);
        let mut journal = self.open(directory, shard)?;
        let all = shard.pieces(self.pieces());
        (sweep.progress)(journal.done(), all);
        self.work_on(&mut journal, shard, sweep)?;
        let done = journal.done();
        let counts = if done == all { Some(results::write(directory, self, shard.told(), &journal)?) } else { None };
        Ok(Swept { done, all, counts })
    }

    /// Whether a directory has results of this campaign, all of it.
    pub fn began(&self, directory: &Path) -> bool {
        let head = Head::new(self.identity(), None, &self.table());
        Reader::open(directory).is_ok_and(|reader| *reader.head() == head)
    }

    /// The journal in a directory, which is made, or is one of this campaign's.
    fn open(&self, directory: &Path, shard: Shard) -> Result<Journal, SweepError> {
        let refuse = |source| SweepError::Write { path: directory.to_owned(), source };
        files::create_directories(directory).map_err(refuse)?;
        let empty = fs::read_dir(directory).map_err(refuse)?.next().is_none();
        if !empty && !directory.join(FILE).is_file() {
            return Err(SweepError::Foreign { path: directory.to_owned() });
        }
        let head = Head::new(self.identity(), shard.told(), &self.table());
        let place = |entry: &Entry| self.piece(entry).and_then(|piece| shard.place(piece));
        let journal = Journal::open(directory, &head, shard.pieces(self.pieces()), place)?;
        results::write_file(&directory.join(CAMPAIGN), |out| io::Write::write_all(out, self.to_toml().as_bytes()))?;
        Ok(journal)
    }

    /// Does what is not done, until all is or a signal asks for the end.
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
                        // Nobody waits for it where the journal could not be written.
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

/// Puts the results of all shards of a campaign together, as if it had been run in one place.
///
/// # Errors
/// [`SweepError`], also where a case is missing or is in two directories and not the same.
pub fn merge(directories: &[PathBuf], out: &Path) -> Result<Swept, SweepError> {
    let Some(first) = directories.first() else { return Ok(Swept { done: 0, all: 0, counts: None }) };
    let head = Reader::open(first)?.head().of_all();
    // It names no other file.
    let unknown = |name: &str| {
        let text = format!("the campaign has its scenario in it, and names `{name}`");
        Err(ConfigError::Unknown { code: "unknown-scenario", text })
    };
    let mut whole = Campaign::load(&first.join(CAMPAIGN), &[], &unknown)?.collect(out)?;
    for directory in directories {
        let mut reader = Reader::open(directory)?;
        if reader.head().of_all() != head || head.identity != whole.campaign.identity() {
            return Err(SweepError::Mixed { first: first.clone(), other: directory.clone() });
        }
        while let Some(entry) = reader.next()? {
            whole.take(&entry, directory)?;
        }
    }
    whole.finish()
}

/// The results of a campaign whose work is done by others, wherever, as they come in.
pub struct Collection {
    campaign: Campaign,
    directory: PathBuf,
    journal: Journal,
}

impl Campaign {
    /// Opens a directory for results, which is made, or has what an earlier run of the same campaign left. Nobody else can write to
    /// it as long as it is open.
    ///
    /// # Errors
    /// [`SweepError`].
    pub fn collect(self, directory: &Path) -> Result<Collection, SweepError> {
        let journal = self.open(directory, Shard::ALL)?;
        Ok(Collection { campaign: self, directory: directory.to_owned(), journal })
    }
}

impl Collection {
    /// The [pieces of work](Campaign::pieces) that are not done.
    pub fn left(&self) -> Vec<u64> {
        (0..self.campaign.pieces()).filter(|piece| !self.journal.has(*piece)).collect()
    }

    /// Writes down what [came of a piece](Campaign::work), unless it is there.
    ///
    /// # Errors
    /// [`SweepError::Disagree`] if it is there and not the same; [`SweepError::Journal`].
    pub fn add(&mut self, entry: &Entry) -> Result<(), SweepError> {
        self.take(entry, Path::new("what came"))
    }

    /// The same of an entry that comes `from` a directory.
    fn take(&mut self, entry: &Entry, from: &Path) -> Result<(), SweepError> {
        let Some(piece) = self.campaign.piece(entry) else { return Ok(()) };
        if !self.journal.has(piece) {
            return Ok(self.journal.add(piece, entry)?);
        }
        if self.journal.lines()?.of(piece)?.is_some_and(|known| known == *entry) {
            return Ok(());
        }
        let (Entry::Row(Row { case, .. }) | Entry::Margin { point: MarginPoint { case, .. }, .. }) = *entry;
        Err(SweepError::Disagree { path: from.to_owned(), case })
    }

    /// Writes the tables.
    ///
    /// # Errors
    /// [`SweepError`], also where a piece is missing.
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

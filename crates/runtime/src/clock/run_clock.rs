//! The clock of a run on several hosts: each host's monotonic clock plus a correction, so that all ticks and stamps
//! have the time base of the launching host.
//!
//! The correction is a linear function of time without steps: a new line begins where the old one is. One process of
//! each host writes it to shared memory, the others read it. Must not know how the correction is found.

use crate::shared::SharedWords;
use std::io;
use std::path::Path;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering, fence};

/// Number of lines written. Its parity selects the current of two slots; the next line goes into the other slot.
const SEQUENCE: usize = 0;
/// Words of a line: reference, offset, slope.
const LINE: usize = 3;
const WORDS: usize = 1 + 2 * LINE;

/// Fraction bits of a slope, in units of 2⁻⁴⁰.
const FRACTION: u32 = 40;
/// The steepest slope, ns per ns: bounds the rate at which a clock catches up.
pub const STEEPEST: f64 = 500e-6;

/// A line: the correction of the monotonic clock as a function of that clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Correction {
    reference_ns: u64,
    offset_ns: i64,
    /// Slope in ns per ns, as a multiple of 2⁻⁴⁰.
    slope: i64,
}

impl Correction {
    /// Creates a line through `offset_ns` at `reference_ns`, with a slope in ns per ns that is limited to
    /// ±[`STEEPEST`].
    pub fn new(reference_ns: u64, offset_ns: i64, slope: f64) -> Self {
        Self::within(reference_ns, offset_ns, slope, STEEPEST)
    }

    /// Creates a line with a slope that is limited to ±`steepest` ns per ns, which is below 1 so that time never goes back.
    pub fn within(reference_ns: u64, offset_ns: i64, slope: f64, steepest: f64) -> Self {
        let slope = (slope.clamp(-steepest, steepest) * (1_u64 << FRACTION) as f64) as i64;
        Self { reference_ns, offset_ns, slope }
    }

    /// Returns the correction at a time on the monotonic clock, ns.
    #[inline]
    pub fn at(&self, raw_ns: u64) -> i64 {
        let elapsed_ns = i128::from(raw_ns) - i128::from(self.reference_ns);
        self.offset_ns + ((elapsed_ns * i128::from(self.slope)) >> FRACTION) as i64
    }

    /// Returns the time of the run at a time on the monotonic clock, ns.
    #[inline]
    pub fn apply(&self, raw_ns: u64) -> u64 {
        raw_ns.saturating_add_signed(self.at(raw_ns))
    }
}

/// The correction in shared memory.
#[derive(Debug)]
pub struct RunClock(SharedWords);

impl RunClock {
    /// The file name of a clock that a device may set.
    pub const PACE: &'static str = "pace";

    /// Makes this process the only writer until it ends; returns false if another process is.
    pub fn own(&self) -> bool {
        self.0.file().try_lock().is_ok()
    }

    /// Opens the correction in a file; creates one without effect if the file is missing.
    ///
    /// # Errors
    /// The system's reason.
    pub fn open(path: &Path) -> io::Result<Self> {
        SharedWords::open(path, WORDS).and_then(Self::whole)
    }

    fn existing(path: &Path) -> io::Result<Self> {
        SharedWords::existing(path).and_then(Self::whole)
    }

    fn whole(words: SharedWords) -> io::Result<Self> {
        if words.words().len() == WORDS {
            Ok(Self(words))
        } else {
            Err(io::Error::other("it is a file of another version"))
        }
    }

    fn line(&self, sequence: u64) -> &[AtomicU64] {
        let place = 1 + (sequence % 2) as usize * LINE;
        &self.0.words()[place..place + LINE]
    }

    /// Replaces the correction. One writer only; if it dies while writing, the previous correction stays valid.
    pub fn set(&self, correction: Correction) {
        let next = self.0.words()[SEQUENCE].load(Ordering::Relaxed) + 1;
        // A reader that sees a word of the new line also sees the sequence number that made its old line invalid.
        fence(Ordering::Release);
        let words = [correction.reference_ns, correction.offset_ns as u64, correction.slope as u64];
        self.line(next).iter().zip(words).for_each(|(place, word)| place.store(word, Ordering::Relaxed));
        self.0.words()[SEQUENCE].store(next, Ordering::Release);
    }

    /// Returns the correction without blocking: reads again only if a new one was written meanwhile.
    #[inline]
    pub fn get(&self) -> Correction {
        let sequence = &self.0.words()[SEQUENCE];
        loop {
            let before = sequence.load(Ordering::Acquire);
            let [reference, offset, slope] =
                [0, 1, 2].map(|word: usize| self.line(before)[word].load(Ordering::Relaxed));
            fence(Ordering::Acquire);
            if sequence.load(Ordering::Relaxed) == before {
                return Correction { reference_ns: reference, offset_ns: offset as i64, slope: slope as i64 };
            }
        }
    }
}

/// The clocks that this process has used, in turn, and the number of the present one; number 0 stays empty.
static USED: [OnceLock<RunClock>; USED_MAX] = [const { OnceLock::new() }; USED_MAX];
static PRESENT: AtomicUsize = AtomicUsize::new(0);
/// The most clocks that a process uses: it may launch one run after the other.
const USED_MAX: usize = 256;

/// Makes this process use the correction in a file, if the file exists, until [`release`]. A process takes part in one run
/// at a time that has such a file.
///
/// # Errors
/// The system's reason, except for a missing file; also after 255 clocks.
pub fn adopt(path: &Path) -> io::Result<()> {
    let mut clock = match RunClock::existing(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        clock => clock?,
    };
    for (number, place) in USED.iter().enumerate().skip(1) {
        match place.set(clock) {
            Ok(()) => {
                PRESENT.store(number, Ordering::Release);
                return Ok(());
            }
            Err(refused) => clock = refused,
        }
    }
    Err(io::Error::other("this process has used too many clocks of runs; start another one"))
}

/// Makes this process use its monotonic clock again.
pub fn release() {
    PRESENT.store(0, Ordering::Release);
}

/// Returns the correction of this process's clock; `None` in a run on one host, and on the launching host.
#[inline]
pub(super) fn correction() -> Option<Correction> {
    USED.get(PRESENT.load(Ordering::Acquire)).and_then(OnceLock::get).map(RunClock::get)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_followed_over_hours_to_the_nanosecond() {
        let line = Correction::new(1_000, -1_000_000_000_000, 50e-6);
        assert_eq!(line.at(1_000), -1_000_000_000_000);
        let ten_hours_ns = 36_000_000_000_000;
        let drifted_ns = line.at(1_000 + ten_hours_ns) - line.at(1_000);
        assert!((drifted_ns - 1_800_000_000).abs() <= 100, "{drifted_ns}");
        assert_eq!(Correction::new(0, 5, -1.0).at(1_000_000) - 5, -500, "the slope is limited");
        assert_eq!(Correction::new(0, -10, 0.0).apply(3), 0, "time does not become negative");
    }

    #[test]
    fn readers_see_whole_lines() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("clock");
        let writer = RunClock::open(&path).unwrap();
        let reader = RunClock::existing(&path).unwrap();
        assert_eq!(reader.get(), Correction::default());
        let written = std::thread::spawn(move || {
            (1..=100_000_i64).for_each(|n| writer.set(Correction { reference_ns: n as u64, offset_ns: n, slope: n }));
        });
        while !written.is_finished() {
            let Correction { reference_ns, offset_ns, slope } = reader.get();
            assert_eq!((reference_ns as i64, offset_ns), (offset_ns, slope));
        }
        written.join().unwrap();
        assert_eq!(reader.get().offset_ns, 100_000);
    }
}

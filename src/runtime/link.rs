//! The two ends of a link: what was sent, received, lost, not believed, and its hash.

mod input;
mod kept;
mod output;

pub use input::{AcceptedTicks, Input, Seek};
pub use kept::Kept;
pub(super) use output::written;
pub use output::{Extent, Output};

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::memory::MemoryBus;
    use crate::bus::{Depths, Reader, Signal, Topic};
    use crate::sample::RateCommand;
    use crate::state::{Persist, Restore, Words};
    use crate::telemetry::{Ledger, LinkRead, LinkWritten};

    struct Ends {
        bus: MemoryBus,
        ledger: Ledger,
        output: Output<MemoryBus, RateCommand>,
        input: Input<MemoryBus, RateCommand>,
    }

    /// Keeps a state.
    struct Store(Vec<u64>);

    impl Words for Store {
        fn word(&mut self, value: &mut u64) {
            self.0.push(*value);
        }
    }

    const EXTENT: Extent = Extent { last_tick: 100, kept_ticks: 4 };
    const WORDS: usize = size_of::<RateCommand>() / size_of::<u64>();

    fn topic() -> Topic {
        Topic { scenario: "s".to_owned(), body: "b".to_owned(), signal: Signal::Command }
    }

    fn output(bus: &MemoryBus, ledger: &Ledger, generation: u64) -> Output<MemoryBus, RateCommand> {
        Output::open(bus, &topic(), 1, generation, &ledger.reopened(), EXTENT).unwrap()
    }

    fn ends_with(ledger: Ledger, depth: usize) -> Ends {
        let bus = MemoryBus::new(Depths { role: depth, scorer: 1, history: 0 });
        let output = output(&bus, &ledger, 1);
        let input = Input::watch(&bus, &topic(), Reader::Role).unwrap();
        Ends { bus, ledger, output, input }
    }

    fn ends(depth: usize) -> Ends {
        ends_with(Ledger::private(EXTENT.words(WORDS)), depth)
    }

    impl Ends {
        fn send(&mut self, ticks: &[u64]) {
            for &tick in ticks {
                self.output.send(|sample| sample.stamp.tick = tick).unwrap();
            }
        }

        fn counters(&mut self) -> (LinkWritten, LinkRead) {
            (self.output.counters().report(""), self.input.counters().report(""))
        }

        /// The writing end of a successor of which this was committed.
        fn successor(&self, committed: &Store) -> Output<MemoryBus, RateCommand> {
            let mut output = output(&self.bus, &self.ledger, 2);
            output.persist(&mut Restore(&committed.0));
            output
        }
    }

    #[test]
    fn the_counters_of_both_ends_agree() {
        let mut ends = ends(8);
        ends.output.warm_up().unwrap();
        ends.send(&[0, 1, 4, 5]);
        assert_eq!(ends.input.seek(4).unwrap(), Seek::Found);
        assert_eq!(ends.input.seek(2).unwrap(), Seek::Passed);
        assert_eq!(ends.input.seek(6).unwrap(), Seek::NotYet);
        let (written, read) = ends.counters();
        assert_eq!((written.published, written.skipped, written.last_tick), (4, 2, Some(5)));
        assert_eq!((read.received, read.gaps, read.stale, read.last_tick), (4, 2, 0, Some(5)));
    }

    #[test]
    fn a_shallow_reader_counts_what_it_was_too_late_for() {
        let mut ends = ends(1);
        ends.send(&[0, 1, 2, 3]);
        assert_eq!(ends.input.seek(3).unwrap(), Seek::Found);
        let read = ends.counters().1;
        assert_eq!((read.received, read.gaps), (1, 3));
    }

    #[test]
    fn an_older_sample_is_counted_and_never_seen() {
        let mut ends = ends(8);
        ends.send(&[3, 2, 3, 4]);
        assert!(ends.input.advance().unwrap());
        assert!(ends.input.advance().unwrap());
        assert_eq!(ends.input.sample().unwrap().stamp.tick, 4);
        ends.send(&[4]);
        assert!(
            !ends.input.advance().unwrap() && ends.input.sample().is_none(),
            "displaced, not mistaken for the good one"
        );
        assert_eq!(ends.counters().1.stale, 3);
    }

    /// A writer that dies anywhere on its way leaves a successor what it needs: everything is sent and counted once.
    #[test]
    fn whatever_a_writer_was_committed_to_is_sent_and_counted_once() {
        let directory = tempfile::tempdir().unwrap();
        for (case, sent) in [("staged", false), ("sent", true)] {
            let path = directory.path().join(format!("{case}.books"));
            let ledger = Ledger::shared(&path, EXTENT.words(WORDS)).unwrap();
            let mut ends = ends_with(ledger, 8);
            ends.send(&[0, 1]);
            ends.output.stage(|sample| (sample.stamp.tick, sample.acceleration_rad_s2[0]) = (2, 0.5)).unwrap();
            let mut committed = Store(Vec::new());
            ends.output.persist(&mut committed);
            if sent {
                ends.output.dispatch().unwrap();
            }
            let as_told = written(&mut Restore(&committed.0), "", WORDS, true, (&ends.ledger.reopened(), EXTENT));
            let mut successor = ends.successor(&committed);
            successor.dispatch().unwrap();
            successor.finish().unwrap();
            successor.send(|sample| (sample.stamp.tick, sample.acceleration_rad_s2[0]) = (3, 0.0)).unwrap();
            let mut seen = Vec::new();
            while ends.input.advance().unwrap() {
                let sample = ends.input.sample().unwrap();
                seen.push((sample.stamp.tick, sample.stamp.generation, sample.acceleration_rad_s2[0]));
            }
            let generation = if sent { 1 } else { 2 };
            assert_eq!(seen, [(0, 1, 0.0), (1, 1, 0.0), (2, generation, 0.5), (3, 2, 0.0)], "{case}");
            assert_eq!((successor.counters().report("").published, ends.counters().1.stale), (4, 0), "{case}");
            assert_eq!(
                (as_told.published, as_told.last_tick),
                (3, Some(2)),
                "{case}: what is committed counts as sent"
            );
            let mut straight = self::ends(8);
            straight.send(&[0, 1]);
            straight.output.send(|sample| (sample.stamp.tick, sample.acceleration_rad_s2[0]) = (2, 0.5)).unwrap();
            assert_eq!(as_told.hash, straight.counters().0.hash, "{case}");
            straight.output.send(|sample| (sample.stamp.tick, sample.acceleration_rad_s2[0]) = (3, 0.0)).unwrap();
            assert_eq!(successor.counters().report("").hash, straight.counters().0.hash, "{case}");
        }
    }

    /// A reader that continues another's counts neither what that one counted nor anything less.
    #[test]
    fn what_a_link_repeats_to_a_successor_is_not_counted_again() {
        let mut ends = ends(8);
        ends.send(&[0, 1, 0, 2]);
        assert_eq!(ends.input.seek(2).unwrap(), Seek::Found);
        let (mut counters, mut state) = (Store(Vec::new()), Store(Vec::new()));
        ends.input.counters().persist(&mut counters);
        ends.input.persist(&mut state);
        let Ends { bus, mut output, .. } = ends;
        let mut input = Input::<_, RateCommand>::watch(&bus, &topic(), Reader::Role).unwrap();
        input.counters().persist(&mut Restore(&counters.0));
        input.persist(&mut Restore(&state.0));
        input.repeated = true;
        // All again, as a link with history does, then what is new: a stale one and tick 5.
        for tick in [0, 1, 0, 2, 1, 5] {
            output.send(|sample| sample.stamp.tick = tick).unwrap();
        }
        assert_eq!((input.seek(2).unwrap(), input.seek(5).unwrap()), (Seek::Passed, Seek::Found));
        let read = input.counters().report("");
        assert_eq!((read.received, read.gaps, read.stale, read.last_tick), (4, 2, 2, Some(5)));
    }

    /// Reader and writer die, and what was between them with them: their successors go on as if nothing had happened.
    #[test]
    fn what_was_under_way_when_both_ends_died_is_found_in_the_ledger() {
        let directory = tempfile::tempdir().unwrap();
        let ledger = Ledger::shared(&directory.path().join("x.books"), EXTENT.words(WORDS)).unwrap();
        let mut ends = ends_with(ledger, 8);
        ends.output = ends.output.with_voids(true);
        ends.send(&[0, 1]);
        assert_eq!(ends.input.seek(1).unwrap(), Seek::Found);
        ends.send(&[2]);
        ends.output.stage_void(3);
        ends.output.dispatch().unwrap();
        ends.output.finish().unwrap();
        ends.output.stage(|sample| (sample.stamp.tick, sample.acceleration_rad_s2[0]) = (4, 0.5)).unwrap();
        let (mut committed, mut counters, mut state) = (Store(Vec::new()), Store(Vec::new()), Store(Vec::new()));
        ends.output.persist(&mut committed);
        ends.output.dispatch().unwrap();
        ends.input.counters().persist(&mut counters);
        ends.input.persist(&mut state);

        ends.bus = MemoryBus::new(Depths { role: 8, scorer: 1, history: 0 });
        let mut output = ends.successor(&committed).with_voids(true);
        let shared = ends.ledger.reopened();
        shared.take(EXTENT.words(WORDS) - Kept::words(EXTENT.kept_ticks, WORDS));
        let mut input = Input::<_, RateCommand>::watch(&ends.bus, &topic(), Reader::Role)
            .unwrap()
            .inheriting(Kept::open(&shared, EXTENT.kept_ticks, WORDS), 1);
        input.counters().persist(&mut Restore(&counters.0));
        input.persist(&mut Restore(&state.0));
        output.dispatch().unwrap();
        output.finish().unwrap();
        output.send(|sample| sample.stamp.tick = 5).unwrap();
        let mut seen = Vec::new();
        for tick in 2..=5 {
            let sought = input.seek(tick).unwrap();
            seen.push((sought, input.sample().map(|sample| (sample.stamp.tick, sample.acceleration_rad_s2[0]))));
        }
        let found = |tick, value| (Seek::Found, Some((tick, value)));
        assert_eq!(seen, [found(2, 0.0), (Seek::Passed, None), found(4, 0.5), found(5, 0.0)]);
        let read = input.counters().report("");
        assert_eq!((read.received, read.void, read.gaps, read.stale, read.rejected), (5, 1, 0, 0, 0));
    }
}

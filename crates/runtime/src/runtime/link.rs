//! The two ends of a link with their counters: sent, received, lost and rejected samples, and a hash.

#[cfg(test)]
mod balance;
mod input;
mod output;
mod retained;

pub use input::{AcceptedTicks, Input, Seek};
pub(super) use output::written;
pub use output::{Extent, Output};
pub use retained::RetainedSamples;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::memory::MemoryBus;
    use crate::bus::{Bus, Depths, Read, Reader, Signal, Topic, Write};
    use crate::config::SHIPPED;
    use crate::runtime::disturb::Disturbance;
    use crate::sample::RateCommand;
    use crate::scenario::Scenario;
    use crate::state::{Persist, StoredWords, Words};
    use crate::telemetry::{Ledger, LinkRead, LinkWritten};

    struct Ends {
        bus: MemoryBus,
        ledger: Ledger,
        output: Output<MemoryBus, RateCommand>,
        input: Input<MemoryBus, RateCommand>,
    }

    /// Collects the words of a state.
    #[derive(Clone, Default)]
    pub(super) struct Store(pub(super) Vec<u64>);

    impl Words for Store {
        fn word(&mut self, value: &mut u64) {
            self.0.push(*value);
        }
    }

    const EXTENT: Extent = Extent { last_tick: 100, retained_samples: 24 };
    pub(super) const WORDS: usize = size_of::<RateCommand>() / size_of::<u64>();

    fn topic() -> Topic {
        Topic { scenario: "s".to_owned(), body: "b".to_owned(), signal: Signal::Command }
    }

    fn output(bus: &MemoryBus, ledger: &Ledger, generation: u64) -> Output<MemoryBus, RateCommand> {
        Output::open(bus, &topic(), 1, generation, &ledger.reopened(), EXTENT).unwrap()
    }

    fn ends_with(ledger: Ledger, depth: usize) -> Ends {
        let bus = MemoryBus::new(Depths { role: depth, scorer: 1, history: 0 });
        let output = output(&bus, &ledger, 1);
        let input = Input::open(&bus, &topic(), Reader::Role).unwrap();
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

        /// Opens the writing end of a successor and restores the committed state.
        fn successor(&self, committed: &Store) -> Output<MemoryBus, RateCommand> {
            let mut output = output(&self.bus, &self.ledger, 2);
            output.persist(&mut StoredWords(&committed.0));
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
    fn a_shallow_reader_counts_overwritten_samples_as_gaps() {
        let mut ends = ends(1);
        ends.send(&[0, 1, 2, 3]);
        assert_eq!(ends.input.seek(3).unwrap(), Seek::Found);
        let read = ends.counters().1;
        assert_eq!((read.received, read.gaps), (1, 3));
    }

    #[test]
    fn an_older_sample_is_counted_as_stale_and_not_returned() {
        let mut ends = ends(8);
        ends.send(&[3, 2, 3, 4]);
        assert!(ends.input.advance().unwrap());
        assert!(ends.input.advance().unwrap());
        assert_eq!(ends.input.sample().unwrap().stamp.tick, 4);
        ends.send(&[4]);
        assert!(
            !ends.input.advance().unwrap() && ends.input.sample().is_none(),
            "the older sample is not returned as the newest one"
        );
        assert_eq!(ends.counters().1.stale, 3);
    }

    /// Wherever the writer dies, its successor sends and counts every sample once.
    #[test]
    fn every_committed_sample_is_sent_and_counted_once() {
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
            let as_told = written(&mut StoredWords(&committed.0), "", WORDS, true, (&ends.ledger.reopened(), EXTENT));
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
                "{case}: a committed sample counts as sent"
            );
            let mut straight = self::ends(8);
            straight.send(&[0, 1]);
            straight.output.send(|sample| (sample.stamp.tick, sample.acceleration_rad_s2[0]) = (2, 0.5)).unwrap();
            assert_eq!(as_told.hash, straight.counters().0.hash, "{case}");
            straight.output.send(|sample| (sample.stamp.tick, sample.acceleration_rad_s2[0]) = (3, 0.0)).unwrap();
            assert_eq!(successor.counters().report("").hash, straight.counters().0.hash, "{case}");
        }
    }

    /// A reader that continues another one counts every sample exactly once.
    #[test]
    fn samples_repeated_to_a_successor_are_counted_once() {
        let mut ends = ends(8);
        ends.send(&[0, 1, 0, 2]);
        assert_eq!(ends.input.seek(2).unwrap(), Seek::Found);
        let (mut counters, mut state) = (Store(Vec::new()), Store(Vec::new()));
        ends.input.counters().persist(&mut counters);
        ends.input.persist(&mut state);
        let Ends { bus, mut output, .. } = ends;
        let mut input = Input::<_, RateCommand>::open(&bus, &topic(), Reader::Role).unwrap();
        input.counters().persist(&mut StoredWords(&counters.0));
        input.persist(&mut StoredWords(&state.0));
        input.repeated = true;
        // All samples again, as on a link with history; then a stale one and tick 5.
        for tick in [0, 1, 0, 2, 1, 5] {
            output.send(|sample| sample.stamp.tick = tick).unwrap();
        }
        assert_eq!((input.seek(2).unwrap(), input.seek(5).unwrap()), (Seek::Passed, Seek::Found));
        let read = input.counters().report("");
        assert_eq!((read.received, read.gaps, read.stale, read.last_tick), (4, 2, 2, Some(5)));
    }

    /// Opens a reading end that recovers samples from the writer's ledger.
    fn recovering_input(bus: &MemoryBus, ledger: &Ledger, generation: u64) -> Input<MemoryBus, RateCommand> {
        let shared = ledger.reopened();
        shared.take(EXTENT.words(WORDS) - RetainedSamples::words(EXTENT.retained_samples, WORDS));
        let retained = RetainedSamples::open(&shared, EXTENT.retained_samples, WORDS);
        let input = Input::<_, RateCommand>::open(bus, &topic(), Reader::Role).unwrap();
        let mut input = input.with_recovery(retained, 1, generation > 1);
        input.expect(AcceptedTicks::Next);
        input
    }

    #[test]
    fn samples_of_a_writer_that_ended_before_the_reader_connected_are_received() {
        let directory = tempfile::tempdir().unwrap();
        let ledger = Ledger::shared(&directory.path().join("x.books"), EXTENT.words(WORDS)).unwrap();
        let depths = Depths { role: 100, scorer: 100, history: 0 };
        let (unconnected, bus) = (MemoryBus::new(depths), MemoryBus::new(depths));
        let mut first = output(&unconnected, &ledger, 1);
        for tick in [0, 1] {
            first.send(|sample| sample.stamp.tick = tick).unwrap();
        }
        let mut committed = Store(Vec::new());
        first.persist(&mut committed);
        drop(first);
        let mut input = recovering_input(&bus, &ledger, 1);
        let mut successor = output(&bus, &ledger, 2);
        successor.persist(&mut StoredWords(&committed.0));
        successor.dispatch().unwrap();
        successor.finish().unwrap();
        successor.send(|sample| sample.stamp.tick = 2).unwrap();
        for tick in [0, 1, 2] {
            assert_eq!(input.seek(tick).unwrap(), Seek::Found, "{tick}");
        }
        let read = input.counters().report("");
        assert_eq!((read.received, read.gaps, read.stale), (3, 0, 0));
    }

    /// Twenty ticks on a link with delays, duplicates and drops. Reader or writer dies at one tick.
    #[derive(Debug, Default)]
    struct Course {
        tick: u64,
        reader_dies: bool,
        /// The writer dies after this number of samples of the tick, of which this number at the end is not recorded as
        /// sent.
        writer_dies: Option<(usize, u64)>,
        /// The number of past samples that the link repeats to the reader's successor.
        history: usize,
    }

    /// The ticks of deaths with the number of samples sent then: one; two delayed ones and one; two; a no-sample
    /// marker.
    const DEATHS: [(u64, usize); 4] = [(11, 1), (12, 3), (13, 2), (14, 1)];

    impl Course {
        /// Returns the reader's counters at the end, and its value for every tick.
        fn run(&self) -> (LinkRead, Vec<Option<f64>>) {
            let faults = "fault=[{kind='delay', role='controller', delay_ticks=3, from_tick=9}, \
                {kind='delay', role='controller', delay_ticks=2, from_tick=10}, \
                {kind='drop', role='controller', from_tick=14}, \
                {kind='duplicate', role='controller', from_tick=5, ticks=6}, \
                {kind='duplicate', role='controller', from_tick=13, ticks=4}]";
            let scenario = Scenario::parse(SHIPPED[0].1, "pair", &[faults.to_owned()]).unwrap();
            let directory = tempfile::tempdir().unwrap();
            let ledger = Ledger::shared(&directory.path().join("x.books"), EXTENT.words(WORDS)).unwrap();
            // Samples sent on one bus are copied to the other.
            let depths = Depths { role: 100, scorer: 100, history: 0 };
            let (sends, mut brings) = (MemoryBus::new(depths), MemoryBus::new(depths));
            let mut from = sends.reader::<RateCommand>(&topic(), Reader::Role).unwrap();
            let mut sent: Vec<RateCommand> = Vec::new();
            let mut collect = |sent: &mut Vec<RateCommand>| {
                while from.advance().unwrap() {
                    sent.push(*from.current().unwrap());
                }
            };
            let bring = |bus: &MemoryBus, samples: &[RateCommand]| {
                let mut writer = bus.writer::<RateCommand>(&topic(), 1).unwrap();
                samples.iter().for_each(|sample| writer.send(|slot| *slot = *sample).unwrap());
            };
            let writer = |generation, next_tick| {
                let faults = Disturbance::for_signal(&scenario, "controller", "follower", 1, next_tick);
                output(&sends, &ledger, generation).with_markers(true).disturbed(faults)
            };
            let reader = |bus: &MemoryBus, generation| recovering_input(bus, &ledger, generation);
            let (mut output, mut input, mut seen) = (writer(1, 0), reader(&brings, 1), Vec::new());
            for tick in 0..20 {
                let fill = |sample: &mut RateCommand| {
                    (sample.stamp.tick, sample.acceleration_rad_s2[0]) = (tick, 0.5 + tick as f64);
                };
                output.stage(fill).unwrap();
                let mut committed = Store(Vec::new());
                output.persist(&mut committed);
                output.persist_late(&mut committed);
                output.dispatch().unwrap();
                let before = sent.len();
                collect(&mut sent);
                if tick == self.tick {
                    let (of_tick, unmarked) = self.writer_dies.unwrap_or((sent.len() - before, 0));
                    assert!(of_tick <= sent.len() - before);
                    sent.truncate(before + of_tick);
                    if self.reader_dies {
                        let (mut counters, mut state) = (Store(Vec::new()), Store(Vec::new()));
                        input.counters().persist(&mut counters);
                        input.persist(&mut state);
                        brings = MemoryBus::new(depths);
                        input = reader(&brings, 2);
                        input.counters().persist(&mut StoredWords(&counters.0));
                        input.persist(&mut StoredWords(&state.0));
                        input.expect_repeats();
                        bring(&brings, &sent[sent.len().saturating_sub(self.history)..]);
                    } else {
                        bring(&brings, &sent[before..]);
                    }
                    if self.writer_dies.is_some() {
                        ledger.reopened().take(1).set(0, sent.len() as u64 - unmarked);
                        output = writer(2, tick + 1);
                        let mut words = StoredWords(&committed.0);
                        output.persist(&mut words);
                        output.persist_late(&mut words);
                        output.dispatch().unwrap();
                        let before = sent.len();
                        collect(&mut sent);
                        bring(&brings, &sent[before..]);
                    }
                } else {
                    bring(&brings, &sent[before..]);
                }
                output.finish().unwrap();
                // The reader lags by three ticks and catches up at the end.
                let due = (tick + 1).saturating_sub(if tick < 16 { 3 } else { 0 });
                for due in seen.len() as u64..due {
                    assert_ne!(input.seek(due).unwrap(), Seek::NotYet, "{due} {self:?}");
                    seen.push(input.sample().map(|sample| sample.acceleration_rad_s2[0]));
                }
            }
            let written = output.counters().report("");
            let read = input.counters().report("");
            assert_eq!(read.received + read.void, 20, "{self:?}");
            assert_eq!(written.extra, read.stale, "{self:?}");
            assert_eq!(input.counters().taken(), 20 + written.extra, "{self:?}");
            (read, seen)
        }
    }

    /// Wherever a process dies and whatever the link loses or repeats, the successors continue as if nothing had
    /// happened.
    #[test]
    fn every_sent_sample_is_received_once_after_a_death() {
        let undisturbed = Course::default().run();
        let (read, seen) = &undisturbed;
        assert_eq!((read.received, read.void, read.gaps, read.stale, read.rejected), (17, 3, 0, 9, 0));
        assert_eq!(seen.iter().flatten().count(), 17);
        for (tick, samples) in DEATHS {
            let last =
                (0..=samples).flat_map(|sent| (0..=sent.min(1) as u64).map(move |unmarked| Some((sent, unmarked))));
            for writer_dies in last.chain([None]) {
                let course = |reader_dies, history| Course { tick, reader_dies, writer_dies, history };
                for course in (0..=24).map(|history| course(true, history)).chain([course(false, 0)]) {
                    assert_eq!(course.run(), undisturbed, "{course:?}");
                }
            }
        }
    }
}

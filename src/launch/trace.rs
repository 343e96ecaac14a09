//! The samples of an external role, as the launcher sees them.
//!
//! They are the only source of the state of a role without heartbeat, such as hardware: it is ready once all its signals have
//! a writer, runs once they carry samples, and is done once all of them have reached the last tick. They also show which
//! sample of any external role is missing. Must not judge a role that sends heartbeats.

use crate::bus::iox::IoxBus;
use crate::bus::{BusError, Reader, Signal, Topic, WordReader, WriterProcess};
use crate::runtime::{RoleId, ports};
use crate::sample::{Health, NO_SAMPLE, RoleState, Stamp};
use crate::scenario::Scenario;
use std::fmt;

/// The signals of an external role.
pub(super) struct Trace {
    signals: Vec<Traced>,
    last_tick: u64,
}

/// One signal, and the roles that read it.
struct Traced {
    signal: Signal,
    end: WordReader,
    seen: Seen,
    readers: Vec<RoleId>,
}

/// The thing of an external role for which the run waits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Lack {
    /// The role's next state.
    State(RoleState),
    /// A sample, in lockstep, with the stamp that came last.
    Sample { signal: Signal, tick: u64, came: Option<Stamp> },
    /// Any new sample, in real time; that of `tick` is due.
    AnySample { signal: Signal, tick: u64, came: Option<Stamp> },
}

impl Lack {
    /// Returns true if the same thing is still missing.
    pub fn is_still(&self, now: &Self) -> bool {
        match (self, now) {
            (Self::Sample { signal, tick, .. }, Self::Sample { signal: signal_now, tick: tick_now, .. }) => {
                (signal, tick) == (signal_now, tick_now)
            }
            (Self::AnySample { signal, came, .. }, Self::AnySample { signal: signal_now, came: came_now, .. }) => {
                (signal, came) == (signal_now, came_now)
            }
            _ => self == now,
        }
    }

    /// Returns the tick whose sample is missing.
    pub fn tick(&self) -> Option<u64> {
        match self {
            Self::State(_) => None,
            Self::Sample { tick, .. } | Self::AnySample { tick, .. } => Some(*tick),
        }
    }
}

impl fmt::Display for Lack {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (signal, tick, came) = match self {
            Self::State(RoleState::Absent) => return f.write_str("it has not connected"),
            Self::State(RoleState::Running | RoleState::Done) => {
                return f.write_str("it has not reported the end of its work");
            }
            Self::State(_) => return f.write_str("it has connected but is not ready"),
            Self::Sample { signal, tick, came } | Self::AnySample { signal, tick, came } => (signal, tick, came),
        };
        write!(f, "its {} of tick {tick} is missing; ", signal.name())?;
        match came {
            None => f.write_str("no sample has come"),
            Some(stamp) if stamp.generation == 0 => {
                write!(f, "tick {} came instead, with generation 0, which marks a warm-up", stamp.tick)
            }
            Some(stamp) if stamp.tick < *tick => write!(f, "the last sample is of tick {}", stamp.tick),
            Some(stamp) => write!(f, "tick {} came instead", stamp.tick),
        }
    }
}

impl Trace {
    /// Opens the signals that a role writes.
    pub fn open(scenario: &Scenario, role: RoleId, bus: &IoxBus) -> Result<Self, BusError> {
        let roles = RoleId::all(scenario);
        let reads = |role: &RoleId, topic: &Topic| ports(scenario, *role).reads.iter().any(|port| port.topic == *topic);
        let signals = ports(scenario, role).writes.into_iter().map(|port| {
            let readers = roles.iter().copied().filter(|role| reads(role, &port.topic)).collect();
            let (signal, end) = (port.topic.signal, port.reader(bus, Reader::Role)?);
            Ok(Traced { signal, end, seen: Seen::default(), readers })
        });
        Ok(Self { signals: signals.collect::<Result<_, BusError>>()?, last_tick: scenario.last_tick })
    }

    /// Returns the process that writes the first signal.
    pub fn writer(&self) -> Option<WriterProcess> {
        self.signals.first()?.end.writer()
    }

    /// Returns the tick after the newest sample of that signal, and the first and the last tick of its newest samples without a
    /// gap.
    pub fn newest(&self) -> (u64, Option<(u64, u64)>) {
        self.signals.first().map_or((0, None), |traced| (traced.seen.next_tick, traced.seen.run))
    }

    /// Returns true if all signals have a writer.
    pub fn written(&self) -> bool {
        self.signals.iter().all(|traced| traced.end.has_writer())
    }

    /// Returns the first sample for which others waited at the last [look](Self::look). `next_tick` returns a role's next tick;
    /// `scored` is the scorer's. In real time any new sample will do.
    pub fn lack(
        &self,
        next_tick: impl Fn(RoleId) -> Option<u64> + Copy,
        scored: Option<u64>,
        realtime: bool,
    ) -> Option<Lack> {
        self.signals.iter().find_map(|traced| {
            let (signal, seen) = (traced.signal, &traced.seen);
            let (tick, came) = (traced.needed(next_tick, scored)?, seen.came);
            match realtime {
                true => Some(Lack::AnySample { signal, tick, came }),
                false => (!seen.has(tick)).then_some(Lack::Sample { signal, tick, came }),
            }
        })
    }

    /// Reads the signals, and returns the heartbeat that the role would send.
    pub fn look(&mut self) -> Result<Health, BusError> {
        let mut next_tick = u64::MAX;
        for traced in &mut self.signals {
            next_tick = next_tick.min(traced.look()?);
        }
        let written = self.written();
        let state = match next_tick {
            tick if tick > self.last_tick => RoleState::Done,
            1.. => RoleState::Running,
            0 if written => RoleState::Ready,
            0 => RoleState::Absent,
        };
        let stamp = Stamp { tick: next_tick, generation: 1, ..Stamp::default() };
        Ok(Health { stamp, state: state as u64, ..Health::default() })
    }
}

impl Traced {
    /// Reads the samples that have come, and returns the tick after the newest.
    fn look(&mut self) -> Result<u64, BusError> {
        while let Some(words) = self.end.next()? {
            self.seen.take(bytemuck::pod_read_unaligned(&bytemuck::cast_slice(words)[..size_of::<Stamp>()]));
        }
        Ok(self.seen.next_tick)
    }

    /// Returns the earliest tick whose sample is still needed. A body needs the command of the tick before its own.
    fn needed(&self, next_tick: impl Fn(RoleId) -> Option<u64>, scored: Option<u64>) -> Option<u64> {
        let needed_by = |role: &RoleId| match role {
            RoleId::Plant(_) => next_tick(*role)?.checked_sub(1),
            RoleId::Observer(_) | RoleId::Controller => next_tick(*role),
        };
        let scored = scored.filter(|_| self.signal != Signal::Measurement);
        self.readers.iter().filter_map(needed_by).chain(scored).min()
    }
}

/// The samples that have come from one signal.
#[derive(Debug, Default)]
struct Seen {
    /// The tick after the newest sample.
    next_tick: u64,
    /// The first and the last tick of the newest samples without a gap. It covers all that a reader can still need, because the
    /// launcher's queue is as long as a reader's.
    run: Option<(u64, u64)>,
    /// The last stamp, valid or not.
    came: Option<Stamp>,
}

impl Seen {
    fn take(&mut self, stamp: Stamp) {
        self.came = Some(Stamp { generation: stamp.generation & !NO_SAMPLE, ..stamp });
        // For readers generation 0 is a warm-up before the first sample, and a lower generation after it.
        if stamp.generation == 0 && self.run.is_none() {
            return;
        }
        self.next_tick = self.next_tick.max(stamp.tick.saturating_add(1));
        self.run = match self.run {
            Some((first, last)) if last.checked_add(1) == Some(stamp.tick) => Some((first, stamp.tick)),
            Some((first, last)) if (first..=last).contains(&stamp.tick) => Some((first, last)),
            _ => Some((stamp.tick, stamp.tick)),
        };
    }

    fn has(&self, tick: u64) -> bool {
        self.run.is_some_and(|(first, last)| (first..=last).contains(&tick))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::domain::OwnedDomain;
    use crate::bus::{Bus, Signal, Write};
    use crate::config::SHIPPED;
    use crate::runtime::{depths, topic};
    use crate::sample::{RateMeasurement, RateTruth};

    fn seen(ticks: &[u64]) -> Seen {
        let mut seen = Seen::default();
        ticks.iter().for_each(|&tick| seen.take(Stamp { tick, generation: 1, ..Stamp::default() }));
        seen
    }

    /// A sample that a reader can no longer receive is missing, even if later ones come.
    #[test]
    fn a_tick_is_missing_if_it_was_not_among_the_last_in_a_row() {
        let has = |ticks: &[u64], tick| seen(ticks).has(tick);
        assert!(!has(&[], 0));
        assert!(has(&[0, 1, 2], 2) && has(&[0, 1, 2], 0) && !has(&[0, 1, 2], 3));
        assert!(!has(&[0, 1, 3], 2) && !has(&[0, 1, 3, 4, 5], 2), "the next tick came instead");
        assert!(has(&[0, 1, 3, 2], 2), "it came late");
        assert!(has(&[0, 1, 2, 1], 2), "an earlier tick is repeated");
        assert!(has(&[7, 8, 9], 8), "the first ticks had passed before the launcher looked");
        assert!(!has(&[u64::MAX, u64::MAX], 0) && has(&[u64::MAX], u64::MAX));
    }

    /// Generation 0 is a warm-up before the first sample; after it readers count it as a sample.
    #[test]
    fn generation_0_is_a_warm_up_only_before_the_first_sample() {
        let mut seen = Seen::default();
        seen.take(Stamp::default());
        assert!(!seen.has(0) && seen.next_tick == 0);
        seen.take(Stamp { generation: 1 | NO_SAMPLE, ..Stamp::default() });
        seen.take(Stamp { tick: 1, ..Stamp::default() });
        assert!(seen.has(0) && seen.has(1) && seen.came.is_some_and(|came| came.generation == 0));
    }

    #[test]
    fn the_missing_and_the_received_sample_are_printed() {
        let stamp = |tick, generation| Some(Stamp { tick, generation, ..Stamp::default() });
        let words = |came| Lack::Sample { signal: Signal::Measurement, tick: 41, came }.to_string();
        assert_eq!(words(None), "its measurement of tick 41 is missing; no sample has come");
        assert!(words(stamp(40, 1)).ends_with("; the last sample is of tick 40"));
        assert!(words(stamp(43, 1)).ends_with("; tick 43 came instead"));
        assert!(words(stamp(41, 0)).ends_with("; tick 41 came instead, with generation 0, which marks a warm-up"));
    }

    #[test]
    fn samples_show_the_state_of_a_role_without_heartbeat() {
        let overrides = ["clock=lockstep", "duration_s=0.002", "accept={}"].map(str::to_owned);
        let scenario = Scenario::parse(SHIPPED[0].1, "test", &overrides).unwrap();
        let domain = OwnedDomain::create(0).unwrap();
        let bus = || IoxBus::enter(domain.domain(), "test", depths(&scenario)).unwrap();
        let (ours, theirs) = (bus(), bus());
        let mut trace = Trace::open(&scenario, RoleId::named(&scenario, "follower").unwrap(), &ours).unwrap();
        let mut expect = |state: RoleState, tick: u64| {
            let health = trace.look().unwrap();
            assert_eq!((RoleState::from_number(health.state), health.stamp.tick), (state, tick));
        };
        expect(RoleState::Absent, 0);
        let mut measurement =
            theirs.writer::<RateMeasurement>(&topic(&scenario, "follower", Signal::Measurement), 1).unwrap();
        expect(RoleState::Absent, 0);
        let mut truth = theirs.writer::<RateTruth>(&topic(&scenario, "follower", Signal::Truth), 1).unwrap();
        expect(RoleState::Ready, 0);
        measurement.send(|sample| sample.stamp.generation = 0).unwrap();
        truth.send(|sample| sample.stamp.generation = 0).unwrap();
        expect(RoleState::Ready, 0);
        for tick in 0..=scenario.last_tick {
            measurement.send(|sample| (sample.stamp.generation, sample.stamp.tick) = (1, tick)).unwrap();
            expect(if tick == 0 { RoleState::Ready } else { RoleState::Running }, tick);
            truth.send(|sample| (sample.stamp.generation, sample.stamp.tick) = (1, tick)).unwrap();
            let last = tick == scenario.last_tick;
            expect(if last { RoleState::Done } else { RoleState::Running }, tick + 1);
        }
        drop((measurement, truth));
        expect(RoleState::Done, scenario.last_tick + 1);
    }
}

//! How far an external role is that says nothing of itself: told by the signals that it writes.
//!
//! Hardware need not know of health. It is there once all its signals have a writer, runs once they carry samples, and is
//! done when all of them have reached the last tick. Must not judge a role that reports its health.

use crate::bus::iox::{IoxBus, IoxFleetReader, IoxReader};
use crate::bus::{Bus, BusError, Read, Reader, Topic};
use crate::config::Scenario;
use crate::runtime::{RoleId, Visit, visit_writes};
use crate::sample::{FleetLayout, Health, Message, RoleState, Sample, Stamp};

/// The signals of an external role, watched.
pub(super) struct Trace {
    ends: Vec<Box<dyn End>>,
    last_tick: u64,
}

impl Trace {
    /// Watches the signals that a role writes.
    pub fn open(scenario: &Scenario, role: RoleId, bus: &IoxBus) -> Result<Self, BusError> {
        let ends = visit_writes(scenario, role, &mut Open(bus)).into_iter().collect::<Result<_, _>>()?;
        Ok(Self { ends, last_tick: scenario.last_tick })
    }

    /// Whether all signals have a writer.
    pub fn written(&self) -> bool {
        self.ends.iter().all(|end| end.written())
    }

    /// What the signals tell by now, as the role itself would.
    pub fn look(&mut self) -> Result<Health, BusError> {
        let mut next_tick = u64::MAX;
        for end in &mut self.ends {
            next_tick = next_tick.min(end.next_tick()?);
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

/// One watched signal.
trait End {
    fn written(&self) -> bool;
    /// The tick after the last whose sample has come.
    fn next_tick(&mut self) -> Result<u64, BusError>;
}

struct Watched<T> {
    reader: T,
    next_tick: u64,
}

impl<S: Sample> End for Watched<IoxReader<S>> {
    fn written(&self) -> bool {
        self.reader.written()
    }

    fn next_tick(&mut self) -> Result<u64, BusError> {
        follow(&mut self.reader, &mut self.next_tick)
    }
}

impl<L: FleetLayout> End for Watched<IoxFleetReader<L>> {
    fn written(&self) -> bool {
        self.reader.written()
    }

    fn next_tick(&mut self) -> Result<u64, BusError> {
        follow(&mut self.reader, &mut self.next_tick)
    }
}

/// Takes what has come and moves the next tick on accordingly.
fn follow<S: Message + ?Sized>(reader: &mut impl Read<S>, next_tick: &mut u64) -> Result<u64, BusError> {
    while reader.advance()? {
        let stamp = reader.current().map(S::stamp);
        if let Some(stamp) = stamp.filter(|stamp| stamp.generation != 0) {
            *next_tick = (*next_tick).max(stamp.tick + 1);
        }
    }
    Ok(*next_tick)
}

/// Opens signals to watch them.
struct Open<'a>(&'a IoxBus);

impl Visit for Open<'_> {
    type Made = Result<Box<dyn End>, BusError>;

    fn visit<S: Sample>(&mut self, topic: Topic) -> Self::Made {
        Ok(Box::new(Watched { reader: self.0.reader::<S>(&topic, Reader::Role)?, next_tick: 0 }))
    }

    fn visit_fleet<L: FleetLayout>(&mut self, topic: Topic, bodies: usize) -> Self::Made {
        Ok(Box::new(Watched { reader: self.0.fleet_reader::<L>(&topic, Reader::Role, bodies)?, next_tick: 0 }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::domain::OwnedDomain;
    use crate::bus::{Signal, Write};
    use crate::config::SHIPPED;
    use crate::runtime::{depths, topic};
    use crate::sample::{RateMeasurement, RateTruth};

    #[test]
    fn a_silent_role_is_there_runs_and_is_done_by_its_samples() {
        let overrides = ["clock=lockstep", "duration_s=0.002", "accept={}"].map(str::to_owned);
        let scenario = Scenario::parse(SHIPPED[0].1, "test", &overrides).unwrap();
        let domain = OwnedDomain::create(0).unwrap();
        let bus = || IoxBus::enter(domain.domain(), "test", depths(&scenario)).unwrap();
        let (ours, theirs) = (bus(), bus());
        let mut trace = Trace::open(&scenario, RoleId::named(&scenario, "follower").unwrap(), &ours).unwrap();
        let mut expect = |state: RoleState, tick: u64| {
            let told = trace.look().unwrap();
            assert_eq!((RoleState::from_number(told.state), told.stamp.tick), (state, tick));
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

//! The scorer that follows a run: reads truths and estimates, and scores each tick once its samples have arrived.

use super::result::Score;
use super::scoring::{Scoring, further_observed};
use crate::bus::{Bus, BusError, Carried, Reader, Signal, Topic};
use crate::clock::Grid;
use crate::config::Settings;
use crate::rig::{BodyInfo, Estimate, FleetTruth, Rig, Truth};
use crate::role::Guard;
use crate::runtime::{AcceptedTicks, Input, LateSamples, Seek, topic};
use crate::sample::{Message, Stamp};

/// A scorer that follows a run.
pub trait Scorer {
    /// Scores up to `budget` ticks whose samples have arrived. Returns the number of ticks scored.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    fn poll(&mut self, budget: u64) -> Result<u64, BusError>;
    /// Returns the next tick to score; every tick before it has been consumed.
    fn next_tick(&self) -> u64;
    /// Returns the latest value of the first metric.
    fn latest(&self) -> f64;
    /// Sets the time grid once the epoch is known. Samples of ticks that are not yet due are refused from then on.
    fn start(&mut self, grid: Grid);
    /// Records that a role failed at a tick; `id` is the incident number in [`Score::recoveries_s`].
    fn incident(&mut self, id: u64, tick: u64);
    /// Scores the remaining samples, complete or not, and returns the score.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    fn finish(&mut self) -> Result<Score, BusError>;
}

/// Opens the scorer of a rig.
pub(crate) fn score_rig<R: Rig, B: Bus + 'static>(
    rig: &R,
    scenario: &Settings,
    bus: &B,
) -> Result<Box<dyn Scorer>, BusError> {
    Ok(Box::new(RigScorer::open(rig, scenario, bus)?))
}

/// The truth signal of a body or a fleet.
enum TruthInput<R: Rig, B: Bus> {
    One(Input<B, Truth<R>>),
    Fleet(Input<B, FleetTruth<R>>),
}

impl<R: Rig, B: Bus> TruthInput<R, B> {
    fn open(bus: &B, topic: &Topic, fleet: Option<usize>) -> Result<Self, BusError> {
        Ok(match fleet {
            None => Self::One(Input::open(bus, topic, Reader::Scorer)?),
            Some(bodies) => Self::Fleet(Input::open_many(bus, topic, bodies, Reader::Scorer)?),
        })
    }

    fn expect(&mut self, accepted_ticks: AcceptedTicks) {
        match self {
            Self::One(input) => input.expect(accepted_ticks),
            Self::Fleet(input) => input.expect(accepted_ticks),
        }
    }

    fn seek(&mut self, tick: u64) -> Result<Seek, BusError> {
        match self {
            Self::One(input) => input.seek(tick),
            Self::Fleet(input) => input.seek(tick),
        }
    }

    fn last_tick(&self) -> Option<u64> {
        match self {
            Self::One(input) => input.last_tick(),
            Self::Fleet(input) => input.last_tick(),
        }
    }

    fn refresh(&mut self) {
        match self {
            Self::One(input) => input.refresh(),
            Self::Fleet(input) => input.refresh(),
        }
    }

    /// Returns the number of samples received.
    fn samples(&mut self) -> u64 {
        match self {
            Self::One(input) => input.counters().samples(),
            Self::Fleet(input) => input.counters().samples(),
        }
    }

    /// Returns the stamp of the current sample.
    fn stamp(&self) -> Option<&Stamp> {
        match self {
            Self::One(input) => input.sample().map(Message::stamp),
            Self::Fleet(input) => input.sample().map(Message::stamp),
        }
    }

    /// Returns the current sample if it belongs to that tick and to a single body.
    fn body_sample(&self, tick: u64) -> Option<&Truth<R>> {
        if let Self::One(input) = self { at(input, tick) } else { None }
    }

    /// Returns the current sample if it belongs to that tick and to a fleet.
    fn fleet_sample(&self, tick: u64) -> Option<&FleetTruth<R>> {
        if let Self::Fleet(input) = self { at(input, tick) } else { None }
    }
}

/// The estimate signal of a body.
type EstimateInput<R, B> = Input<B, Estimate<R>, <R as Rig>::EstimateGuard>;

struct RigScorer<R: Rig, B: Bus> {
    truths: Vec<TruthInput<R, B>>,
    estimate: EstimateInput<R, B>,
    /// The estimates of other bodies than the first, with the indices of these.
    further_estimates: Vec<(usize, EstimateInput<R, B>)>,
    last_tick: u64,
    scoring: Scoring<R>,
}

impl<R: Rig, B: Bus> RigScorer<R, B> {
    fn open(rig: &R, scenario: &Settings, bus: &B) -> Result<Self, BusError> {
        // Guard and lateness are those of the roles: a sample that they refuse is not scored.
        let estimate = |body: &BodyInfo| {
            let topic = topic(scenario, &body.name, Signal::Estimate);
            let late = LateSamples::for_signal(scenario, Signal::Estimate, &body.name);
            let input = Input::open(bus, &topic, Reader::Scorer)?.with_late(late);
            let mut input = input.with_guard(rig.estimate_guard());
            input.expect(crate::runtime::accepted_ticks(scenario, None));
            Ok(input)
        };
        let further = further_observed(scenario).map(|(index, body)| Ok((index, estimate(body)?)));
        let truth = |body: &BodyInfo| TruthInput::open(bus, &topic(scenario, &body.name, Signal::Truth), body.fleet);
        Ok(Self {
            truths: rig.bodies().iter().map(truth).collect::<Result<_, _>>()?,
            estimate: estimate(&scenario.bodies[0])?,
            further_estimates: further.collect::<Result<_, BusError>>()?,
            last_tick: scenario.last_tick,
            scoring: Scoring::new(rig, scenario, true),
        })
    }

    /// Returns true if no sample of the next tick can still arrive.
    fn settled(&mut self) -> Result<bool, BusError> {
        let next = self.scoring.next_tick;
        let mut waiting = self.estimate.seek(next)? == Seek::NotYet;
        for (_, estimate) in &mut self.further_estimates {
            waiting = waiting || estimate.seek(next)? == Seek::NotYet;
        }
        for truth in &mut self.truths {
            waiting = waiting || truth.seek(next)? == Seek::NotYet;
        }
        Ok(!waiting)
    }

    fn estimates(&mut self) -> impl Iterator<Item = &mut EstimateInput<R, B>> {
        std::iter::once(&mut self.estimate).chain(self.further_estimates.iter_mut().map(|(_, estimate)| estimate))
    }

    /// Connects every input to its current writer: a writer that ends unconnected takes its samples with it.
    fn connect(&mut self) {
        self.estimates().for_each(Input::refresh);
        self.truths.iter_mut().for_each(TruthInput::refresh);
    }

    fn score_tick(&mut self) {
        let tick = self.scoring.next_tick;
        let (truths, first, further) = (&self.truths, at(&self.estimate, tick), &self.further_estimates);
        let arrived = |(_, estimate): &(usize, EstimateInput<R, B>)| at(estimate, tick).is_some();
        let complete = first.is_some()
            && further.iter().all(arrived)
            && truths.iter().all(|truth| truth.stamp().is_some_and(|stamp| stamp.tick == tick));
        let estimate = |body: usize| match body {
            0 => first,
            _ => further.iter().find(|(index, _)| *index == body).and_then(|(_, estimate)| at(estimate, tick)),
        };
        self.scoring.take(
            |body| truths[body].body_sample(tick),
            |body| truths[body].fleet_sample(tick),
            estimate,
            complete,
        );
    }
}

impl<R: Rig, B: Bus> Scorer for RigScorer<R, B> {
    fn poll(&mut self, budget: u64) -> Result<u64, BusError> {
        let before = self.next_tick();
        while self.next_tick() <= self.last_tick
            && self.next_tick() < before.saturating_add(budget)
            && self.settled()?
        {
            self.score_tick();
        }
        let scored = self.next_tick() - before;
        if scored == 0 {
            self.connect();
        }
        Ok(scored)
    }

    fn next_tick(&self) -> u64 {
        self.scoring.next_tick
    }

    fn latest(&self) -> f64 {
        self.scoring.latest()
    }

    fn start(&mut self, grid: Grid) {
        let accepted_ticks = AcceptedTicks::Due(grid);
        self.truths.iter_mut().for_each(|truth| truth.expect(accepted_ticks));
        self.estimates().for_each(|estimate| estimate.expect(accepted_ticks));
    }

    fn incident(&mut self, id: u64, tick: u64) {
        self.scoring.incidents.push((id, tick, tick));
    }

    fn finish(&mut self) -> Result<Score, BusError> {
        // A sample that has not arrived by now is lost: continue while any input holds a newer one.
        loop {
            self.poll(u64::MAX)?;
            let newest = |tick: Option<u64>| tick.is_some_and(|tick| tick >= self.scoring.next_tick);
            let more = newest(self.estimate.last_tick())
                || self.further_estimates.iter().any(|(_, estimate)| newest(estimate.last_tick()))
                || self.truths.iter().any(|truth| newest(truth.last_tick()));
            if !more || self.next_tick() > self.last_tick {
                break;
            }
            self.score_tick();
        }
        let estimates = self.estimate.counters().samples();
        let truths = self.truths.iter_mut().map(TruthInput::samples);
        let further = self.further_estimates.iter_mut().map(|(_, estimate)| estimate.counters().samples());
        Ok(self.scoring.finish(core::iter::once(estimates).chain(truths).chain(further)))
    }
}

/// Returns the current sample if it belongs to that tick.
fn at<B: Bus, S: Carried + ?Sized, G: Guard<S>>(input: &Input<B, S, G>, tick: u64) -> Option<&S> {
    input.sample().filter(|sample| sample.stamp().tick == tick)
}

#[cfg(test)]
mod tests {
    use crate::bus::domain::OwnedDomain;
    use crate::bus::iox::IoxBus;
    use crate::config::SHIPPED;
    use crate::runtime::{Poll, RoleId, RunCondition, depths, private_ledger};
    use crate::scenario::{Scenario, build, scorer};

    /// A follower sends the first truth and ends before any estimate has arrived.
    #[test]
    fn a_truth_whose_writer_has_ended_is_scored() {
        let (name, text) = SHIPPED[0];
        let overrides = ["clock=lockstep", "duration_s=0.002", "accept={}"].map(str::to_owned);
        let scenario = &Scenario::parse(text, name, &overrides).unwrap();
        let domain = OwnedDomain::create(0).unwrap();
        let bus = IoxBus::enter(domain.domain(), "test", depths(scenario)).unwrap();
        let mut scorer = scorer(scenario, &bus).unwrap();
        let roles = RoleId::all(scenario);
        let ledgers: Vec<_> = roles.iter().map(|role| private_ledger(scenario, *role)).collect();
        let nodes = roles.iter().zip(&ledgers).map(|(role, ledger)| build(scenario, *role, &bus, ledger).unwrap());
        let mut nodes: Vec<_> = nodes.collect();
        assert_eq!(scorer.poll(u64::MAX).unwrap(), 0);
        let follower = roles.iter().position(|role| *role == RoleId::Plant(1)).unwrap();
        let mut follower = nodes.remove(follower);
        for node in std::iter::once(&mut follower).chain(&mut nodes) {
            assert_eq!(node.poll(RunCondition::Inputs { up_to: 0 }).unwrap(), Poll::Executed);
            node.finish_tick().unwrap();
        }
        drop(follower);
        assert_eq!(scorer.poll(u64::MAX).unwrap(), 1);
        assert_eq!(scorer.finish().unwrap().unscored_ticks, 0);
    }
}

//! Samples as words, for readers that do not know the rig's sample types.
//!
//! A sample of another length than the rig's own is never interpreted.

use super::contract::{Command, Estimate, FleetCommand, FleetMeasurement, FleetTruth, Measurement, Rig, Truth};
use crate::bus::{Carried, Port, Signal, Topic};
use crate::config::BodyInfo;
use crate::role::Guard;
use crate::sample::{FleetSample, Sample};

/// A guard of one reading end that checks a sample's words.
pub trait WordGuard {
    /// Returns true if the sample is accepted.
    fn accepts(&mut self, words: &[u64]) -> bool;
}

/// A view of a rig's samples as words. Bodies are given by their index.
pub trait WordView {
    /// Returns the signals of all bodies in a scenario of this name; `bodies` are those of the rig with their observers.
    fn signals(&self, scenario: &str, bodies: &[BodyInfo]) -> Vec<Port>;
    /// Returns the number of words of a body's sample; `None` if the body cannot have such a signal or the signal has another type.
    fn length(&self, body: usize, signal: Signal) -> Option<usize>;
    /// Returns the guard of a reader that observes a body's signal; `None` for a signal without one.
    fn guard(&self, body: usize, signal: Signal) -> Option<Box<dyn WordGuard>>;
    /// Returns the number of leading components covered by the `valid` word of measurements and estimates.
    fn axes(&self) -> usize;
    /// Returns the fields of the reference, as [`Rig::reference`].
    fn reference(&self) -> Vec<(&'static str, usize)>;
    /// Writes one tick's value of every metric, as [`Rig::score`] does; `words` returns the samples.
    fn score_words<'a>(&self, words: &dyn Fn(usize, Signal) -> Option<&'a [u64]>, reference: &[f64], out: &mut [f64]);
    /// Returns V and the bound on V̇ that a command carries, as [`Rig::lyapunov`].
    fn lyapunov_words(&self, command: &[u64]) -> Option<(f64, f64)>;
    /// Returns true if the bound on V̇ applies to a driven body, as [`Rig::bound_applies`].
    fn bound_applies(&self, body: usize) -> bool;
    /// Returns how the motion of a single body has ended, as [`Rig::loss`].
    fn loss_words(&self, truth: &[u64]) -> Option<&'static str>;
}

impl<R: Rig> WordView for R {
    fn signals(&self, scenario: &str, bodies: &[BodyInfo]) -> Vec<Port> {
        let topic = |body: &str, signal| Topic { scenario: scenario.to_owned(), body: body.to_owned(), signal };
        let estimate = |body: &BodyInfo| Port::new::<Estimate<R>>(topic(&body.name, Signal::Estimate), None);
        let observed = || bodies.iter().filter(|body| body.observer.is_some());
        let of_body = |body: &BodyInfo| {
            let command = topic(&body.name, Signal::Command);
            let command = body.driven.then(|| either::<Command<R>, FleetCommand<R>>(command, body.fleet));
            let measurement = topic(&body.name, Signal::Measurement);
            let truth = topic(&body.name, Signal::Truth);
            [
                Some(either::<Measurement<R>, FleetMeasurement<R>>(measurement, body.fleet)),
                Some(either::<Truth<R>, FleetTruth<R>>(truth, body.fleet)),
                command,
            ]
        };
        let further = observed().skip(1).map(estimate);
        observed().take(1).map(estimate).chain(bodies.iter().flat_map(of_body).flatten()).chain(further).collect()
    }

    fn length(&self, body: usize, signal: Signal) -> Option<usize> {
        let info = self.bodies().get(body)?;
        let bytes = match (signal, info.fleet) {
            (Signal::Truth, None) => size_of::<Truth<R>>(),
            (Signal::Truth, Some(bodies)) => return Some(FleetTruth::<R>::length(bodies)),
            (Signal::Measurement, None) => size_of::<Measurement<R>>(),
            (Signal::Estimate, None) => size_of::<Estimate<R>>(),
            (Signal::Command, None) if info.driven => size_of::<Command<R>>(),
            _ => return None,
        };
        Some(bytes / size_of::<u64>())
    }

    fn guard(&self, body: usize, signal: Signal) -> Option<Box<dyn WordGuard>> {
        Some(match signal {
            Signal::Measurement => boxed(self.measurement_guard(body, false)),
            Signal::Estimate => boxed(self.estimate_guard()),
            Signal::Command => boxed(self.command_guard(body)),
            _ => return None,
        })
    }

    fn axes(&self) -> usize {
        R::AXES
    }

    fn reference(&self) -> Vec<(&'static str, usize)> {
        R::reference()
    }

    fn score_words<'a>(&self, words: &dyn Fn(usize, Signal) -> Option<&'a [u64]>, reference: &[f64], out: &mut [f64]) {
        let bodies = self.bodies();
        let truth = |index: usize| words(index, Signal::Truth);
        let single = |index: usize| truth(index).filter(|_| bodies[index].fleet.is_none()).and_then(cast::<Truth<R>>);
        let fleet = |index: usize| truth(index).filter(|_| bodies[index].fleet.is_some()).map(FleetSample::over);
        let estimate = |index: usize| words(index, Signal::Estimate).and_then(cast::<Estimate<R>>);
        self.score(single, fleet, estimate, reference, out);
    }

    fn lyapunov_words(&self, command: &[u64]) -> Option<(f64, f64)> {
        R::lyapunov(cast(command)?)
    }

    fn bound_applies(&self, body: usize) -> bool {
        Rig::bound_applies(self, body)
    }

    fn loss_words(&self, truth: &[u64]) -> Option<&'static str> {
        self.loss(cast(truth)?)
    }
}

/// Creates the port of a single body's signal, or of a fleet's.
fn either<Single: Carried, Fleet: Carried + ?Sized>(topic: Topic, fleet: Option<usize>) -> Port {
    if fleet.is_some() { Port::new::<Fleet>(topic, fleet) } else { Port::new::<Single>(topic, None) }
}

/// Returns the words as a sample; `None` if their number differs.
fn cast<S: Sample>(words: &[u64]) -> Option<&S> {
    bytemuck::try_from_bytes(bytemuck::cast_slice(words)).ok()
}

struct Typed<G, S>(G, core::marker::PhantomData<S>);

fn boxed<S: Sample, G: Guard<S> + 'static>(guard: G) -> Box<dyn WordGuard> {
    Box::new(Typed(guard, core::marker::PhantomData::<S>))
}

impl<S: Sample, G: Guard<S>> WordGuard for Typed<G, S> {
    fn accepts(&mut self, words: &[u64]) -> bool {
        cast(words).is_some_and(|sample| self.0.accepts(sample))
    }
}

#[cfg(test)]
mod tests {
    use crate::bus::Signal;
    use crate::config::SHIPPED;
    use crate::sample::{Message, RateEstimate, RateTruth};
    use crate::scenario::Scenario;

    #[test]
    fn words_score_as_their_samples() {
        let scenario = Scenario::parse(SHIPPED[0].1, "test", &[]).unwrap();
        let truth = |rate: f64| RateTruth { omega_rad_s: [rate, 0.0, 0.0], ..RateTruth::default() };
        let (leader, follower) = (truth(1.0), truth(3.0));
        let estimate = RateEstimate { omega_rad_s: [1.0, 0.0, 0.5], ..RateEstimate::default() };
        let words = |body: usize, signal: Signal| match (body, signal) {
            (0, Signal::Truth) => Some(leader.words()),
            (1, Signal::Truth) => Some(follower.words()),
            (0, Signal::Estimate) => Some(estimate.words()),
            _ => None,
        };
        let (view, mut values) = (scenario.rig, [f64::NAN; 2]);
        view.score_words(&words, &[], &mut values);
        assert_eq!(values, [2.0, 0.5]);
        assert_eq!(view.lyapunov_words(&[0; 3]), None, "too short for a command");
        assert_eq!(view.length(0, Signal::Command), None, "the leader is not driven");
        assert!(!view.guard(0, Signal::Measurement).unwrap().accepts(&[0; 3]), "too short for a measurement");
    }
}

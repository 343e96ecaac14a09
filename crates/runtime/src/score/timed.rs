//! A rig's view of samples as words that follows the inputs of a run, for readers of whole runs.

use super::scoring::take_input;
use crate::config::Settings;
use crate::rig::{Rig, WordView};
use crate::runtime::RoleInputs;

/// A view of samples as words with the inputs of one tick.
pub trait TimedView {
    /// Applies the inputs of a tick; returns true if one changes at it. An earlier tick than the last one is slow.
    fn advance(&mut self, tick: u64) -> bool;
    /// Returns the view at the tick of the last [`advance`](Self::advance).
    fn words(&self) -> &dyn WordView;
    /// Returns the numbers of the reference at that tick.
    fn reference(&self) -> &[f64];
}

/// Opens the view of a rig.
pub(crate) fn timed_view<R: Rig>(rig: &R, scenario: &Settings) -> Box<dyn TimedView> {
    let inputs = RoleInputs::new(&scenario.inputs, |_| true);
    let first = RigAtTick { rig: rig.clone(), reference: scenario.reference.clone(), inputs, next: 0 };
    Box::new(Timed { now: first.clone(), first })
}

#[derive(Clone)]
struct RigAtTick<R> {
    rig: R,
    reference: Vec<f64>,
    inputs: RoleInputs,
    next: u64,
}

struct Timed<R> {
    now: RigAtTick<R>,
    /// The rig before tick 0, from which an earlier tick is reached again.
    first: RigAtTick<R>,
}

impl<R: Rig> TimedView for Timed<R> {
    fn advance(&mut self, tick: u64) -> bool {
        if tick + 1 < self.now.next {
            self.now = self.first.clone();
        }
        let RigAtTick { rig, reference, inputs, next } = &mut self.now;
        let mut changes = false;
        if inputs.is_due(tick) {
            inputs.advance(tick, |new| {
                changes = true;
                take_input(rig, reference, new);
            });
        }
        *next = tick + 1;
        changes
    }

    fn words(&self) -> &dyn WordView {
        &self.now.rig
    }

    fn reference(&self) -> &[f64] {
        &self.now.reference
    }
}

#[cfg(test)]
mod tests {
    use crate::bus::Signal;
    use crate::config::SHIPPED;
    use crate::sample::{Message, RateEstimate, RateTruth};
    use crate::scenario::Scenario;

    #[test]
    fn the_metric_follows_the_set_point_in_any_order_of_ticks() {
        let tables = "[[input]]\nat_s = 1.0\nkey = \"follower.0.offset_rad_s\"\nvalue = [2.0, 0.0, 0.0]\n\
                      [[input]]\nat_s = 2.0\nkey = \"follower.0.offset_rad_s\"\nvalue = [0.0, 0.0, 0.0]\nshape = \"ramp\"\n\
                      duration_s = 1.0\n";
        let scenario = Scenario::parse(&format!("{}\n{tables}", SHIPPED[0].1), "test", &[]).unwrap();
        let truth = |rate: f64| RateTruth { omega_rad_s: [rate, 0.0, 0.0], ..RateTruth::default() };
        let (leader, follower, estimate) = (truth(1.0), truth(3.0), RateEstimate::default());
        let words = |body: usize, signal: Signal| match (body, signal) {
            (0, Signal::Truth) => Some(leader.words()),
            (1, Signal::Truth) => Some(follower.words()),
            (0, Signal::Estimate) => Some(estimate.words()),
            _ => None,
        };
        let mut view = scenario.rig.timed_view(&scenario);
        let mut at = |tick: u64| {
            let changes = view.advance(tick);
            let mut values = [f64::NAN; 2];
            view.words().score_words(&words, view.reference(), &mut values);
            (changes, values[0], view.words().bound_applies(1))
        };
        assert_eq!(at(999), (false, 2.0, true));
        assert_eq!(at(1000), (true, 0.0, false));
        assert_eq!(at(1001), (false, 0.0, false));
        assert_eq!(at(2500), (true, 1.0, false), "half of the ramp");
        assert_eq!(at(3000), (true, 2.0, true));
        assert_eq!(at(3001), (false, 2.0, true));
        assert_eq!(at(1500), (true, 0.0, false), "an earlier tick");
    }
}

//! Computes the rate of a loop whose settled state its rig does not know: it runs the loop until it is settled, disturbs its sensors
//! for one tick, and measures how the difference to the undisturbed loop falls.
//!
//! This file must not judge the rate.

use super::SCENARIO_TICKS_MAX;
use super::chain::Chain;
use super::digits::digits;
use super::exponent::{Exponent, Free, LoopPair};
use super::subject::Analysis;
use crate::rig::Rig;

/// The disturbance of a sensor, as a part of the largest magnitude that it has reported.
const DISTURBANCE: f64 = 1e-5;

impl<R: Rig> Analysis<'_, R> {
    /// Returns the rate, or the reason why it is unknown, with the floors of the settled loop.
    pub fn rate_by_running(&self) -> (Result<f64, String>, Vec<f64>) {
        match self.settled_floors() {
            Err(reason) => (Err(reason), Vec::new()),
            Ok(floors) => (self.judge(&self.exponent_of_disturbance()), floors),
        }
    }

    /// Runs the loop as it is, from the scenario's start, and returns the largest value of every metric in the last quarter; NaN for a
    /// metric without a value, whose body has no observer.
    ///
    /// # Errors
    /// The reason why the loop is not settled by then.
    fn settled_floors(&self) -> Result<Vec<f64>, String> {
        let ticks = self.scenario.last_tick.clamp(1, SCENARIO_TICKS_MAX);
        let mut chain = Chain::examine(self.rig, self.index, self.scenario);
        let mut floors = vec![0.0_f64; self.rig.metrics().len()];
        let mut values = floors.clone();
        for tick in 0..ticks {
            chain.advance();
            chain.score(&mut values);
            if let Some(loss) = chain.loss() {
                return Err(format!("the loop fails: {loss} after {} s", digits(tick as f64 * self.tick_s)));
            }
            if tick == 0 {
                floors
                    .iter_mut()
                    .zip(&values)
                    .filter(|(_, value)| value.is_nan())
                    .for_each(|(floor, _)| *floor = f64::NAN);
            }
            if values.iter().zip(&floors).any(|(value, floor)| !value.is_finite() && !floor.is_nan()) {
                return Err("from this start the loop diverges".to_owned());
            }
            if tick >= ticks - ticks.div_ceil(4) {
                let valued = floors.iter_mut().zip(&values).filter(|(floor, _)| !floor.is_nan());
                valued.for_each(|(floor, value)| *floor = value.max(*floor));
            }
        }
        let limits = &self.scenario.accept.metric_max;
        for (metric, floor) in self.rig.metrics().into_iter().zip(&floors) {
            if let Some(limit) = limits.get(metric).filter(|limit| floor > limit) {
                return Err(format!(
                    "without its changes of inputs this loop is not settled after {} s: {metric} is still {}, its limit is \
                     {limit}; lengthen the run, or correct the gains",
                    digits(ticks as f64 * self.tick_s),
                    digits(*floor)
                ));
            }
        }
        Ok(floors)
    }

    /// Computes the largest exponent of the loop's error from how a disturbance of its sensors falls.
    fn exponent_of_disturbance(&self) -> Exponent {
        let ideal = self.rig.ideal();
        let [mut calm, mut disturbed] = [(); 2].map(|()| Chain::examine(&ideal, self.index, self.scenario));
        let (mut here, mut measured) = (Vec::new(), Vec::new());
        // The largest magnitudes: of the measured numbers, and of the controlled ones.
        let (mut magnitudes, mut sizes) = (Vec::new(), Vec::new());
        // A disturbed measurement must reach observer and controller, and every sensor be disturbed.
        let pattern_ticks = self.scenario.rates.pattern_ticks();
        let settled = self.scenario.last_tick.clamp(1, SCENARIO_TICKS_MAX).next_multiple_of(pattern_ticks);
        // The next tick is then a multiple of the pattern.
        for _ in 0..settled {
            calm.advance();
            disturbed.advance();
            calm.measured(&mut measured);
            calm.output(&mut here);
            keep_largest(&mut magnitudes, &measured);
            keep_largest(&mut sizes, &here);
        }
        for _ in 0..pattern_ticks {
            calm.advance();
            disturbed.advance_disturbed(DISTURBANCE, &magnitudes);
        }
        let scales: Vec<f64> = sizes.iter().map(|size| if *size > 0.0 { *size } else { 1.0 }).collect();
        let size = (scales.len() as f64).sqrt();
        self.exponent_between(LoopPair { reference: calm, near: disturbed, free: Free::Unknown(None), scales, size })
    }
}

/// Keeps the largest magnitude of each number.
fn keep_largest(largest: &mut Vec<f64>, values: &[f64]) {
    largest.resize(values.len(), 0.0);
    largest.iter_mut().zip(values).for_each(|(largest, value)| *largest = value.abs().max(*largest));
}

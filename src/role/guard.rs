//! What the receiving end checks of a sample before anything is made of it: numbers, range, and how fast they change.
//!
//! Must not repair anything: a sample is believed whole or not at all. Must not refuse for ever what was right: the change
//! that is allowed grows with the time since the last sample that was believed.

use crate::sample::Sample;

/// Judges the samples of one signal, in the order of their ticks.
pub trait Guard<S> {
    /// Whether the sample is to be believed. One that is becomes what the next are compared with.
    fn accepts(&mut self, sample: &S) -> bool;
}

/// Believes everything: for those who watch and do not act.
#[derive(Debug, Clone, Copy, Default)]
pub struct Unguarded;

impl<S> Guard<S> for Unguarded {
    #[inline]
    fn accepts(&mut self, _sample: &S) -> bool {
        true
    }
}

/// What N components of a body can be. Units are those of the components, and ticks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds<const N: usize> {
    /// The largest magnitude.
    pub magnitude: [f64; N],
    /// The largest change per tick; +inf where nothing bounds it.
    pub slew_per_tick: [f64; N],
    /// What may be added to a change however short the time: the noise of two samples.
    pub allowance: [f64; N],
}

/// Components that are checked against their bounds and against the last ones believed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plausible<const N: usize> {
    bounds: Bounds<N>,
    generation: u64,
    /// Per component, the last value that was believed, and its tick.
    last: [Option<(f64, u64)>; N],
}

impl<const N: usize> Plausible<N> {
    /// Nothing is known yet: the first value of a component is checked for its magnitude only.
    pub fn new(bounds: Bounds<N>) -> Self {
        Self { bounds, generation: 0, last: [None; N] }
    }

    /// Whether those components of a sample that `valid` has a bit for are possible; if so they are remembered.
    ///
    /// A sender that has been started anew is a new one: nothing is concluded from what it said before.
    #[inline]
    pub fn accepts<S: Sample>(&mut self, sample: &S, values: &[f64; N], valid: u64) -> bool {
        let stamp = sample.stamp();
        if stamp.generation != self.generation {
            (self.generation, self.last) = (stamp.generation, [None; N]);
        }
        let mut components = (0..N).filter(|i| valid >> i & 1 == 1);
        if !components.all(|i| self.possible(i, values[i], stamp.tick)) {
            return false;
        }
        for i in (0..N).filter(|i| valid >> i & 1 == 1) {
            self.last[i] = Some((values[i], stamp.tick));
        }
        true
    }

    #[inline]
    fn possible(&self, i: usize, value: f64, tick: u64) -> bool {
        let Bounds { magnitude, slew_per_tick, allowance } = &self.bounds;
        // What is not a number compares as false.
        let in_range = value.abs() <= magnitude[i];
        in_range
            && self.last[i].is_none_or(|(last, last_tick)| {
                let ticks = tick.saturating_sub(last_tick) as f64;
                (value - last).abs() <= allowance[i] + slew_per_tick[i] * ticks
            })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sample::{RateMeasurement, Stamp};

    fn guard() -> Plausible<3> {
        Plausible::new(Bounds {
            magnitude: [2.0; 3],
            slew_per_tick: [0.01, 0.01, f64::INFINITY],
            allowance: [0.001; 3],
        })
    }

    fn accepts(guard: &mut Plausible<3>, tick: u64, values: [f64; 3], valid: u64) -> bool {
        let stamp = Stamp { tick, generation: 1, ..Stamp::default() };
        let sample = RateMeasurement { stamp, omega_rad_s: values, ..RateMeasurement::default() };
        guard.accepts(&sample, &values, valid)
    }

    #[test]
    fn what_is_no_number_or_out_of_range_is_not_believed() {
        for wrong in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 2.1, -2.1, f64::MAX] {
            for component in 0..3 {
                let mut values = [0.5; 3];
                values[component] = wrong;
                assert!(!accepts(&mut guard(), 0, values, 7), "{wrong}");
                assert!(accepts(&mut guard(), 0, values, 7 & !(1 << component)), "what is not valid is not looked at");
            }
        }
        assert!(accepts(&mut guard(), 0, [2.0, -2.0, 0.0], 7));
    }

    #[test]
    fn a_jump_is_refused_until_there_was_time_for_it() {
        let mut guard = guard();
        assert!(accepts(&mut guard, 0, [0.0; 3], 7));
        assert!(accepts(&mut guard, 1, [0.0109, 0.0, 1.9], 7), "slew and allowance");
        let jump = [0.5, 0.0, 0.0];
        let first = (2..100).find(|tick| accepts(&mut guard, *tick, jump, 7));
        assert_eq!(first, Some(50), "(0.5 - 0.0109 - 0.001) / 0.01 = 48.8 ticks after tick 1");
        assert!(accepts(&mut guard, 51, jump, 7), "and from then on at once");
    }

    #[test]
    fn every_flip_of_an_exponent_or_sign_is_seen_and_the_next_good_sample_is_believed() {
        let (value, mut refused) = (0.6, 0);
        for bit in 0..64 {
            let mut guard = guard();
            assert!(accepts(&mut guard, 0, [value; 3], 7));
            let wrong = f64::from_bits(f64::to_bits(value) ^ 1 << bit);
            let believed = accepts(&mut guard, 1, [wrong, value, value], 7);
            assert_eq!(believed, (wrong - value).abs() <= 0.011, "bit {bit}: {wrong}");
            refused += u32::from(!believed);
            assert!(accepts(&mut guard, 2, [value; 3], 7), "bit {bit}");
        }
        assert!(refused >= 12, "eleven bits of exponent, and the sign: {refused}");
    }

    #[test]
    fn a_new_life_of_the_sender_begins_anew() {
        let mut guard = guard();
        assert!(accepts(&mut guard, 5, [0.0; 3], 7) && !accepts(&mut guard, 6, [1.0; 3], 7));
        let stamp = Stamp { tick: 6, generation: 2, ..Stamp::default() };
        assert!(guard.accepts(&RateMeasurement { stamp, ..RateMeasurement::default() }, &[1.0, 1.0, 1.0], 7));
    }
}

//! Computes the largest exponent of a loop's error, and checks that it is a uniform rate.
//!
//! It runs two loops side by side; the logarithm of their distance gives the exponent. Must not derive it from equations by hand.

use super::chain::Chain;
use super::digits::digits;
use super::subject::{Analysis, LOST, TICKS_MAX, TICKS_MIN, exceeds, norm};
use crate::rig::{Rig, Start};
use crate::sample::status;

/// The distance of the two loops, relative to the size of their output.
const DISTANCE: f64 = 1e-5;
/// The distance is reset once it has fallen or grown by these factors. The uncontrolled coordinate does not fall, so resets must
/// be frequent: otherwise its square becomes visible beside the distance.
const FALLEN: f64 = 0.1;
const GROWN: f64 = 10.0;
/// Distances below this, relative to the size of the output, are rounding.
const ROUNDING: f64 = 1e-11;
/// Equal parts of the examined ticks must agree on the rate to within this fraction of it. There are two parts if the error fell
/// by e^-[`FALL`] in all, else four. It must fall that far unless that takes more than [`TICKS_MAX`]: a slower mode may not
/// have appeared before.
pub(super) const AGREEMENT: f64 = 0.03;
const FALL: f64 = 20.0;
/// Pairs of depth and factor: each fall by e^-depth must have that rate to within the factor. A run may reach its floor before
/// the motion repeats, or before the error has oscillated once. The depths are three and six decades.
const UNIFORM: [(f64, f64); 2] = [(6.9, 1.6), (13.8, 1.15)];

/// An exponent, and how uniform it is along the motion.
pub(super) struct Exponent {
    /// The rate at which the distance fell, 1/s, over all examined ticks but the first quarter.
    rate_per_s: f64,
    /// The rates over equal parts of these ticks, 1/s.
    parts_per_s: Vec<f64>,
    /// The slowest and the fastest of all falls by each depth of [`UNIFORM`], 1/s.
    local_per_s: [[f64; 2]; 2],
    /// The fraction of ticks without information for the observer.
    unobserved: f64,
    /// The size of the settled loop's output.
    pub size: f64,
}

impl<R: Rig> Analysis<'_, R> {
    /// Computes the largest exponent of the loop about the motion that it follows.
    pub fn exponent(&self, ideal: &R) -> Exponent {
        let begun = |start| {
            self.rig
                .isolated(self.index, start, false)
                .map(|rig| Chain::new(&rig, self.tick_s, self.scenario.actuation_delay_ticks))
        };
        let (mut here, mut there) = (Vec::new(), Vec::new());
        let mut reference = Chain::new(ideal, self.tick_s, self.scenario.actuation_delay_ticks);
        reference.advance();
        reference.output(&mut here);
        let size = norm(&here).max(f64::MIN_POSITIVE);
        let Some(mut near) = begun(Start::Off(DISTANCE * size)) else { unreachable!("as the settled one was") };
        // The uncontrolled coordinate does not decay, so it is removed at every reset.
        let mut shifted = R::FREE.and_then(|_| begun(Start::Shifted(DISTANCE)));
        near.advance();
        shifted.iter_mut().for_each(Chain::advance);
        let (mut fallen, mut reset_distance, mut unobserved) = (0.0, None, 0_u64);
        // The logarithm by which the distance has fallen, after every tick.
        let mut falls = Vec::new();
        let mut end = TICKS_MIN.max(self.scenario.last_tick.min(TICKS_MAX / 32));
        loop {
            while (falls.len() as u64) < end {
                reference.advance();
                near.advance();
                shifted.iter_mut().for_each(Chain::advance);
                reference.output(&mut here);
                if exceeds(norm(&here), LOST * size) {
                    return Exponent::GROWS;
                }
                near.output(&mut there);
                here.iter_mut().zip(&there).for_each(|(here, there)| *here -= there);
                let distance = norm(&here);
                let from = *reset_distance.get_or_insert(distance);
                falls.push(fallen + (from / distance.max(ROUNDING * size)).ln());
                unobserved += u64::from(reference.status() & (status::UNOBSERVABLE | status::UNUSABLE) != 0);
                if !(FALLEN * DISTANCE * size..GROWN * DISTANCE * size).contains(&distance) {
                    fallen = falls[falls.len() - 1];
                    let from = reference.numbers();
                    let away = shifted.as_mut().map_or(Vec::new(), |shifted| {
                        let part = (near.free() - reference.free()) / (shifted.free() - reference.free());
                        shifted.numbers().iter().zip(&from).map(|(shifted, from)| part * (shifted - from)).collect()
                    });
                    near.stretch(&from, &away, DISTANCE * size / distance.max(ROUNDING * size));
                    reset_distance = Some(DISTANCE * size);
                }
            }
            let slope = |from: usize, to: usize| slope(&falls[from..to]) / self.tick_s;
            let (begin, end_at) = (falls.len() / 4, falls.len());
            let part = |parts: usize, index: usize| {
                let length = (end_at - begin) / parts;
                slope(begin + index * length, begin + (index + 1) * length)
            };
            let rate_per_s = slope(begin, end_at);
            // While little of the fall is known, a slow oscillation may look straight in two parts.
            let parts = if rate_per_s * (end_at - begin) as f64 * self.tick_s < FALL { 4 } else { 2 };
            let exponent = Exponent {
                rate_per_s,
                parts_per_s: (0..parts).map(|index| part(parts, index)).collect(),
                local_per_s: UNIFORM
                    .map(|(depth, _)| range(&stretches(&falls[begin..], depth)).map(|per_tick| per_tick / self.tick_s)),
                unobserved: unobserved as f64 / end as f64,
                size,
            };
            let shown = rate_per_s.abs() * (end_at - begin) as f64 * self.tick_s >= FALL;
            if shown && exponent.agrees() || end >= TICKS_MAX {
                return exponent;
            }
            end *= 2;
        }
    }

    /// Returns the exponent if it is a uniform, positive rate, else the reason why not.
    pub fn judge(&self, exponent: &Exponent) -> Result<f64, String> {
        let Exponent { rate_per_s, parts_per_s, local_per_s, unobserved, .. } = exponent;
        if *unobserved > 0.5 {
            return Err(format!(
                "not observable: at {:.0} % of the ticks the measured components tell nothing of the hidden one",
                1e2 * unobserved
            ));
        }
        if *rate_per_s == f64::NEG_INFINITY {
            return Err(
                "this sampled loop diverges even from where it is settled; lower the gains or raise tick_hz".to_owned()
            );
        }
        let not_uniform = |[least, greatest]: [f64; 2]| {
            let [least, greatest] = [least, greatest].map(digits);
            Err(format!("the decay rate is not uniform along this motion: from {least} to {greatest} 1/s"))
        };
        if !exponent.agrees() {
            return not_uniform(range(parts_per_s));
        }
        if rate_per_s.is_nan() || *rate_per_s <= 0.0 {
            return Err(format!(
                "the error of this sampled loop grows, by {} 1/s; lower the gains or raise tick_hz",
                digits(-rate_per_s)
            ));
        }
        let uneven = |(range, (_, factor)): &(&[f64; 2], (f64, f64))| {
            range[0] * factor < *rate_per_s || range[1] > factor * rate_per_s
        };
        local_per_s.iter().zip(UNIFORM).find(uneven).map_or(Ok(*rate_per_s), |(range, _)| not_uniform(*range))
    }
}

impl Exponent {
    /// The exponent of a loop that diverges even from its settled state.
    const GROWS: Self = Self {
        rate_per_s: f64::NEG_INFINITY,
        parts_per_s: Vec::new(),
        local_per_s: [[f64::NEG_INFINITY; 2]; 2],
        unobserved: 0.0,
        size: 0.0,
    };

    fn agrees(&self) -> bool {
        let [least, greatest] = range(&self.parts_per_s);
        greatest - least <= AGREEMENT * self.rate_per_s.abs()
    }
}

/// Returns the least and the greatest value.
fn range(values: &[f64]) -> [f64; 2] {
    let extend = |[least, greatest]: [f64; 2], value: &f64| [value.min(least), value.max(greatest)];
    values.iter().fold([f64::INFINITY, f64::NEG_INFINITY], extend)
}

/// Returns the slope of each stretch of a fall that is at least `depth` deep, per step. A part that rises again has not fallen.
fn stretches(falls: &[f64], depth: f64) -> Vec<f64> {
    let mut falls = falls.to_vec();
    (1..falls.len()).rev().for_each(|step| falls[step - 1] = falls[step - 1].min(falls[step]));
    let mut end = 0;
    let slope_from = |begin: usize| {
        while end < falls.len() && falls[end] - falls[begin] < depth {
            end += 1;
        }
        falls.get(end).map(|fallen| (fallen - falls[begin]) / (end - begin) as f64)
    };
    (0..falls.len()).map_while(slope_from).collect()
}

/// Returns the slope of the least-squares line through evenly spaced values, per step. Oscillations about the line have little
/// effect.
pub(super) fn slope(values: &[f64]) -> f64 {
    let middle = 0.5 * (values.len() as f64 - 1.0);
    let moment = |(step, value): (usize, &f64)| (step as f64 - middle) * value;
    let count = values.len() as f64;
    values.iter().enumerate().map(moment).sum::<f64>() * 12.0 / (count * (count * count - 1.0))
}

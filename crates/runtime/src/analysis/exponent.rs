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
/// A number is free if its difference keeps this part while the distance falls by [`FALLEN`].
const STAYS: f64 = 0.5;
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

/// Two loops that are close together.
pub(super) struct LoopPair<R: Rig> {
    pub reference: Chain<R>,
    pub near: Chain<R>,
    pub free: Free<R>,
    /// The scale of each number of the output, in its unit.
    pub scales: Vec<f64>,
    /// The length of the scaled output.
    pub size: f64,
}

/// The coordinates that the loop does not control.
pub(super) enum Free<R: Rig> {
    /// The loop controls every coordinate.
    Nothing,
    /// A loop that is shifted in its one such coordinate.
    Shifted(Chain<R>),
    /// Unknown: numbers whose difference does not fall with the distance. Holds the differences after the last reset.
    Unknown(Option<Vec<f64>>),
}

impl<R: Rig> LoopPair<R> {
    fn advance(&mut self) {
        self.reference.advance();
        self.near.advance();
        if let Free::Shifted(shifted) = &mut self.free {
            shifted.advance();
        }
    }

    fn output(&self, chain: &Chain<R>, out: &mut Vec<f64>) {
        chain.output(out);
        out.iter_mut().zip(&self.scales).for_each(|(number, scale)| *number /= scale);
    }

    /// Scales the difference of the two loops, without its part in free coordinates. Returns false if that part was removed from
    /// coordinates of which it was not known that they are free: the distance then differs from the scaled one.
    fn reset(&mut self, factor: f64) -> bool {
        let from = self.reference.numbers();
        let (away, known) = match &mut self.free {
            Free::Nothing => (Vec::new(), true),
            Free::Shifted(shifted) => {
                let part = (self.near.free() - self.reference.free()) / (shifted.free() - self.reference.free());
                (shifted.numbers().iter().zip(&from).map(|(shifted, from)| part * (shifted - from)).collect(), true)
            }
            Free::Unknown(before) => {
                let apart: Vec<f64> = self.near.numbers().iter().zip(&from).map(|(near, from)| near - from).collect();
                let stays = |(apart, before): (&f64, &f64)| {
                    if factor > 1.0 && apart.abs() > STAYS * before.abs() && *before != 0.0 { *apart } else { 0.0 }
                };
                let away: Vec<f64> =
                    before.as_ref().map_or_else(Vec::new, |before| apart.iter().zip(before).map(stays).collect());
                let rest = apart.iter().enumerate().map(|(i, apart)| factor * (apart - away.get(i).unwrap_or(&0.0)));
                *before = Some(rest.collect());
                let known = away.iter().all(|away| *away == 0.0);
                (away, known)
            }
        };
        self.near.stretch(&from, &away, factor);
        known
    }
}

/// An exponent, and how uniform it is along the motion.
pub(super) struct Exponent {
    /// The rate at which the distance fell, 1/s, over all examined ticks but the first quarter.
    rate_per_s: f64,
    /// The rates over equal parts of these ticks, 1/s.
    parts_per_s: Vec<f64>,
    /// The slowest and the fastest of all falls by each depth of [`UNIFORM`], 1/s.
    local_per_s: [[f64; 2]; 2],
    /// The number of e-foldings by which the distance fell or grew over them.
    depth: f64,
    /// The fraction of ticks without information for the observer.
    unobserved: f64,
    /// The size of the settled loop's output.
    pub size: f64,
}

impl<R: Rig> Analysis<'_, R> {
    /// Computes the largest exponent of the loop about the motion that it follows.
    pub fn exponent(&self, ideal: &R) -> Exponent {
        let begun = |start| self.rig.isolated(self.index, start, false).map(|rig| Chain::new(&rig, self.scenario));
        let mut reference = Chain::new(ideal, self.scenario);
        reference.advance();
        let mut here = Vec::new();
        reference.output(&mut here);
        let size = norm(&here).max(f64::MIN_POSITIVE);
        let Some(mut near) = begun(Start::Off(DISTANCE * size)) else { unreachable!("as the settled one was") };
        // The uncontrolled coordinate does not decay, so it is removed at every reset.
        let mut shifted = R::FREE.and_then(|_| begun(Start::Shifted(DISTANCE)));
        near.advance();
        shifted.iter_mut().for_each(Chain::advance);
        let scales = vec![1.0; here.len()];
        self.exponent_between(LoopPair {
            reference,
            near,
            free: shifted.map_or(Free::Nothing, Free::Shifted),
            scales,
            size,
        })
    }

    /// Computes the exponent from the distance of two loops that are close together.
    pub fn exponent_between(&self, mut pair: LoopPair<R>) -> Exponent {
        let (mut here, mut there) = (Vec::new(), Vec::new());
        let (mut fallen, mut reset_distance, mut unobserved) = (0.0, None, 0_u64);
        // The logarithm by which the distance has fallen, after every tick.
        let mut falls = Vec::new();
        let mut end = TICKS_MIN.max(self.scenario.last_tick.min(TICKS_MAX / 32));
        let size = pair.size;
        loop {
            while (falls.len() as u64) < end {
                pair.advance();
                pair.output(&pair.reference, &mut here);
                if exceeds(norm(&here), LOST * size) {
                    return Exponent::GROWS;
                }
                pair.output(&pair.near, &mut there);
                here.iter_mut().zip(&there).for_each(|(here, there)| *here -= there);
                let distance = norm(&here);
                let from = *reset_distance.get_or_insert(distance);
                falls.push(fallen + (from / distance.max(ROUNDING * size)).ln());
                unobserved += u64::from(pair.reference.status() & (status::UNOBSERVABLE | status::UNUSABLE) != 0);
                if !(FALLEN * DISTANCE * size..GROWN * DISTANCE * size).contains(&distance) {
                    fallen = falls[falls.len() - 1];
                    let whole = pair.reset(DISTANCE * size / distance.max(ROUNDING * size));
                    reset_distance = whole.then_some(DISTANCE * size);
                }
            }
            let exponent = Exponent::of_falls(&falls, self.tick_s, (unobserved as f64 / end as f64, size));
            if exponent.fallen() && exponent.agrees() || end >= TICKS_MAX {
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
    pub const GROWS: Self = Self {
        rate_per_s: f64::NEG_INFINITY,
        parts_per_s: Vec::new(),
        local_per_s: [[f64::NEG_INFINITY; 2]; 2],
        depth: 0.0,
        unobserved: 0.0,
        size: 0.0,
    };

    /// Computes the exponent from the logarithm by which the distance of two loops has fallen after every tick. The first quarter is
    /// left out.
    pub fn of_falls(falls: &[f64], tick_s: f64, (unobserved, size): (f64, f64)) -> Self {
        let slope = |from: usize, to: usize| slope(&falls[from..to]) / tick_s;
        let (begin, end) = (falls.len() / 4, falls.len());
        let part = |parts: usize, index: usize| {
            let length = (end - begin) / parts;
            slope(begin + index * length, begin + (index + 1) * length)
        };
        let rate_per_s = slope(begin, end);
        let depth = rate_per_s * (end - begin) as f64 * tick_s;
        // While little of the fall is known, a slow oscillation may look straight in two parts.
        let parts = if depth < FALL { 4 } else { 2 };
        Self {
            rate_per_s,
            parts_per_s: (0..parts).map(|index| part(parts, index)).collect(),
            local_per_s: UNIFORM
                .map(|(depth, _)| range(&stretches(&falls[begin..], depth)).map(|per_tick| per_tick / tick_s)),
            depth,
            unobserved,
            size,
        }
    }

    /// Returns true if the distance fell or grew far enough to show a slower mode.
    fn fallen(&self) -> bool {
        self.depth.abs() >= FALL
    }

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

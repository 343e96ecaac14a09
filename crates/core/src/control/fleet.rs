//! The synchronising law for many followers at once: structures of arrays in and out, in the machine's widest
//! vectors.
//!
//! Every follower gets the bits that [`Synchronizer`] and [`limited`] compute for it alone: the same operations in
//! the same order, none of them fused, and no sum over followers. The law must not allocate, nor store anything about
//! a follower.

use super::synchronizer::{Synchronizer, limited};
use crate::model::flow_all;
use nalgebra::Vector3;

/// The number of followers computed before their commands are checked, chosen so that all data stays in the fastest
/// cache.
const BLOCK: usize = 256;

/// The synchronising law of all followers of a fleet.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FleetLaw {
    law: Synchronizer,
    acceleration_max_rad_s2: f64,
}

impl FleetLaw {
    /// Creates the law of a fleet from that of one follower. No component of a command exceeds the limit; the
    /// direction stays.
    pub fn new(law: Synchronizer, acceleration_max_rad_s2: f64) -> Self {
        Self { law, acceleration_max_rad_s2 }
    }

    /// Replaces the coefficients a of \[D\](2) by those that an observer has learned.
    pub fn learn(&mut self, coefficients: Vector3<f64>) {
        self.law.learn(coefficients);
    }

    /// Returns the law of one follower, to change its inputs.
    pub fn synchronizer_mut(&mut self) -> &mut Synchronizer {
        &mut self.law
    }

    /// Returns true if both motions are predicted before the law is applied.
    pub fn predicts(&self) -> bool {
        self.law.lead_s() > 0.0
    }

    /// Predicts all followers' rates, rad/s, in place, to the time at which the command acts, and returns the
    /// predicted reference.
    ///
    /// `applied` are the control accelerations that act on the followers until then, rad/s².
    ///
    /// # Panics
    /// If the six arrays differ in length.
    pub fn ahead(&self, reference: &Vector3<f64>, rates: [&mut [f64]; 3], applied: [&[f64]; 3]) -> Vector3<f64> {
        if self.predicts() {
            flow_all(self.law.body(), rates, applied, self.law.lead_s());
        }
        self.law.reference_ahead(*reference)
    }

    /// Computes the control accelerations, rad/s², of all followers from the reference ω or ω̂ and their rates p,
    /// rad/s.
    ///
    /// Component i of follower n is `rates[i][n]`; the commands have the same layout. One call reads 24 and writes 24
    /// bytes per follower and no other memory.
    ///
    /// # Panics
    /// If the six arrays differ in length.
    #[inline]
    pub fn command(&self, reference: &Vector3<f64>, rates: [&[f64]; 3], commands: [&mut [f64]; 3]) {
        let ([p1, p2, p3], [u1, u2, u3]) = (rates, commands);
        let count = p1.len();
        let equal = [p2.len(), p3.len(), u1.len(), u2.len(), u3.len()] == [count; 5];
        assert!(equal, "one rate and one command per follower and component");
        command(self, reference, p1, p2, p3, u1, u2, u3);
    }
}

/// The kernel, compiled for each vector instruction set and selected at its first call; without `std`, for the set
/// that the target guarantees.
#[multiversion::multiversion(targets = "simd")]
#[allow(unsafe_code, clippy::too_many_arguments, reason = "arrays that are arguments are known not to overlap")]
fn command(
    law: &FleetLaw,
    reference: &Vector3<f64>,
    p1: &[f64],
    p2: &[f64],
    p3: &[f64],
    u1: &mut [f64],
    u2: &mut [f64],
    u3: &mut [f64],
) {
    let limit = law.acceleration_max_rad_s2;
    let mut begin = 0;
    while begin < p1.len() {
        let block = begin..(begin + BLOCK).min(p1.len());
        let (p1, p2, p3) = (&p1[block.clone()], &p2[block.clone()], &p3[block.clone()]);
        let (u1, u2, u3) = (&mut u1[block.clone()], &mut u2[block.clone()], &mut u3[block.clone()]);
        begin = block.end;
        if exceeds(&law.law, reference, limit, p1, p2, p3, u1, u2, u3) {
            limit_all(limit, u1, u2, u3);
        }
    }
}

/// Writes the unlimited commands. Returns true if one of them may exceed the limit.
#[inline(always)]
#[allow(clippy::too_many_arguments, reason = "see `command`")]
fn exceeds(
    law: &Synchronizer,
    reference: &Vector3<f64>,
    limit: f64,
    p1: &[f64],
    p2: &[f64],
    p3: &[f64],
    u1: &mut [f64],
    u2: &mut [f64],
    u3: &mut [f64],
) -> bool {
    let mut beyond = 0_u64;
    let followers = p1.iter().zip(p2).zip(p3).zip(u1).zip(u2).zip(u3);
    for (((((p1, p2), p3), u1), u2), u3) in followers {
        let asked = law.command(reference, &Vector3::new(*p1, *p2, *p3));
        (*u1, *u2, *u3) = (asked.x, asked.y, asked.z);
        // A maximum would have to be computed in order; combined bits need not. NaN is not within the limit.
        let within = (asked.x.abs() <= limit) & (asked.y.abs() <= limit) & (asked.z.abs() <= limit);
        beyond |= u64::from(!within);
    }
    beyond != 0
}

/// Limits the commands that exceed the limit. Rare: a follower far from its leader, or one with NaN rates.
#[cold]
#[inline(never)]
fn limit_all(limit: f64, u1: &mut [f64], u2: &mut [f64], u3: &mut [f64]) {
    for ((u1, u2), u3) in u1.iter_mut().zip(u2).zip(u3) {
        let command = limited(Vector3::new(*u1, *u2, *u3), limit);
        (*u1, *u2, *u3) = (command.x, command.y, command.z);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{Inertia, RigidBody, uniform};

    /// Values that arithmetic treats specially.
    const SPECIAL: [f64; 12] = [
        0.0,
        -0.0,
        1.0,
        -1.0,
        f64::MIN_POSITIVE,
        5e-324,
        1e-160,
        1e155,
        f64::MAX,
        f64::INFINITY,
        f64::NEG_INFINITY,
        f64::NAN,
    ];

    fn law() -> Synchronizer {
        let body = RigidBody::new(&Inertia::new([1.0, 2.0, 2.5]).unwrap());
        Synchronizer::new(body, Vector3::new(1.0, 2.0, 3.0), 0.0)
    }

    /// Compares every follower of a fleet with the same one alone; all NaN count as equal.
    fn compare(reference: &Vector3<f64>, rates: &[Vec<f64>; 3], limit: f64) {
        let count = rates[0].len();
        let mut commands = [(); 3].map(|()| vec![9.0; count]);
        let [u1, u2, u3] = &mut commands;
        FleetLaw::new(law(), limit).command(reference, rates.each_ref().map(|rates| &**rates), [u1, u2, u3]);
        for n in 0..count {
            let alone = limited(law().command(reference, &Vector3::new(rates[0][n], rates[1][n], rates[2][n])), limit);
            for axis in 0..3 {
                let (ours, theirs) = (commands[axis][n], alone[axis]);
                let same = ours.to_bits() == theirs.to_bits() || (ours.is_nan() && theirs.is_nan());
                assert!(same, "{count} followers, limit {limit}, {n}, axis {axis}: {ours:e}, not {theirs:e}");
            }
        }
    }

    #[test]
    fn every_follower_is_bit_identical_to_one_alone() {
        for count in [0, 1, 2, 3, 7, 8, 15, 255, 256, 257, 1000, 1003] {
            for (seed, limit) in [(1, f64::INFINITY), (2, 1e3), (3, 2.0), (4, 1e-3), (5, 0.0)] {
                let mut draw = uniform(seed, count as u64);
                let mut rate = || 4.0 * draw() - 2.0;
                let reference = Vector3::from_fn(|_, _| rate());
                let mut array = || (0..count).map(|_| rate()).collect();
                compare(&reference, &[array(), array(), array()], limit);
            }
        }
    }

    #[test]
    fn special_values_are_bit_identical_too() {
        let mut draw = uniform(11, 0);
        let mut pick = || SPECIAL[(draw() * SPECIAL.len() as f64) as usize];
        for limit in [f64::INFINITY, f64::MAX, 1.0] {
            for _ in 0..50 {
                let reference = Vector3::from_fn(|_, _| pick());
                let mut array = || (0..67).map(|_| pick()).collect();
                compare(&reference, &[array(), array(), array()], limit);
            }
        }
    }

    #[test]
    #[should_panic(expected = "one rate and one command")]
    fn arrays_of_different_lengths_are_refused() {
        let (rates, mut short) = ([0.0; 5], [0.0; 4]);
        let (mut first, mut second) = ([0.0; 5], [0.0; 5]);
        FleetLaw::new(law(), 1.0).command(&Vector3::zeros(), [&rates; 3], [&mut first, &mut second, &mut short]);
    }
}

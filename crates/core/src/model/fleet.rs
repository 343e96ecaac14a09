//! The motion of many rigid bodies of equal inertia at once, as structures of arrays.
//!
//! Every body gets the bits of [`RigidBody::flow`]: the same operations in the same order, none of them fused. Bodies
//! of one block that need the same number of integration steps take them together. Must not allocate.

use super::integrate::{rk4_step, steps};
use super::rigid_body::{RigidBody, euler, fastest_rad_s, in_one_step, max_step_s};
use nalgebra::Vector3;

/// The number of bodies in a block.
const BLOCK: usize = 64;

/// Advances all bodies by `dt_s` seconds under their held torques over inertia, rad/s².
///
/// Component i of body n is `rates[i][n]`, rad/s; the torques have the same layout.
///
/// # Panics
/// If the six arrays differ in length.
pub fn flow_all(body: &RigidBody, rates: [&mut [f64]; 3], torques: [&[f64]; 3], dt_s: f64) {
    let ([r1, r2, r3], [t1, t2, t3]) = (rates, torques);
    let count = r1.len();
    let equal = [r2.len(), r3.len(), t1.len(), t2.len(), t3.len()] == [count; 5];
    assert!(equal, "one rate and one torque per body and component");
    for begin in (0..count).step_by(BLOCK) {
        let block = begin..(begin + BLOCK).min(count);
        let torques = [&t1[block.clone()], &t2[block.clone()], &t3[block.clone()]];
        flow_block(body, &mut r1[block.clone()], &mut r2[block.clone()], &mut r3[block], torques, dt_s);
    }
}

fn flow_block(body: &RigidBody, r1: &mut [f64], r2: &mut [f64], r3: &mut [f64], [t1, t2, t3]: [&[f64]; 3], dt_s: f64) {
    if all_in_one_step(r1, r2, r3, t1, t2, t3, dt_s) {
        return step_all(body, r1, r2, r3, t1, t2, t3, dt_s);
    }
    let rate = |n: usize| Vector3::new(r1[n], r2[n], r3[n]);
    let torque = |n: usize| Vector3::new(t1[n], t2[n], t3[n]);
    let needed = |n: usize| match fastest_rad_s(&rate(n), &torque(n), dt_s) {
        fastest if in_one_step(fastest, dt_s) => 1.0,
        fastest => steps(dt_s, max_step_s(fastest)),
    };
    let first = needed(0);
    if (1..r1.len()).all(|n| needed(n) == first) {
        for _ in 0..first as u64 {
            step_all(body, r1, r2, r3, t1, t2, t3, dt_s / first);
        }
        return;
    }
    for n in 0..r1.len() {
        let rate = body.flow(&Vector3::new(r1[n], r2[n], r3[n]), &Vector3::new(t1[n], t2[n], t3[n]), dt_s);
        (r1[n], r2[n], r3[n]) = (rate.x, rate.y, rate.z);
    }
}

/// Returns true if every body of a block needs only one integration step: the usual case of a fast tick.
#[multiversion::multiversion(targets = "simd")]
#[allow(unsafe_code, clippy::too_many_arguments, reason = "arrays that are arguments are known not to overlap")]
fn all_in_one_step(r1: &[f64], r2: &[f64], r3: &[f64], t1: &[f64], t2: &[f64], t3: &[f64], dt_s: f64) -> bool {
    let mut more = 0_u64;
    for (((((r1, r2), r3), t1), t2), t3) in r1.iter().zip(r2).zip(r3).zip(t1).zip(t2).zip(t3) {
        let fastest_rad_s = fastest_rad_s(&Vector3::new(*r1, *r2, *r3), &Vector3::new(*t1, *t2, *t3), dt_s);
        more |= u64::from(!in_one_step(fastest_rad_s, dt_s));
    }
    more == 0
}

/// Takes one integration step of `h` seconds for every body of a block.
#[multiversion::multiversion(targets = "simd")]
#[allow(unsafe_code, clippy::too_many_arguments, reason = "arrays that are arguments are known not to overlap")]
fn step_all(
    body: &RigidBody,
    r1: &mut [f64],
    r2: &mut [f64],
    r3: &mut [f64],
    t1: &[f64],
    t2: &[f64],
    t3: &[f64],
    h: f64,
) {
    let coefficients = *body.coefficients();
    for (((((r1, r2), r3), t1), t2), t3) in r1.iter_mut().zip(r2).zip(r3).zip(t1).zip(t2).zip(t3) {
        let torque = Vector3::new(*t1, *t2, *t3);
        let rate = rk4_step(|x| euler(&coefficients, x, &torque), &Vector3::new(*r1, *r2, *r3), h);
        (*r1, *r2, *r3) = (rate.x, rate.y, rate.z);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{Inertia, uniform};

    /// Slow and fast bodies, very different speeds within one block, and NaN.
    #[test]
    fn every_body_is_bit_identical_to_one_alone() {
        let body = RigidBody::new(&Inertia::new([1.0, 2.0, 2.5]).unwrap());
        for count in [0, 1, 3, 7, 64, 65, 1000, 1003] {
            for (scale, dt_s) in [(1.0, 1e-3), (1.0, 1e-2), (30.0, 1e-3), (1e3, 1e-4), (0.0, 1e-3)] {
                let mut draw = uniform(7, count as u64);
                let mut array = || (0..count).map(|_| scale * (draw() - 0.5)).collect::<Vec<f64>>();
                let (mut rates, mut torques) = ([array(), array(), array()], [array(), array(), array()]);
                if count > 64 {
                    (rates[1][3], rates[2][4], torques[0][5], rates[0][64]) = (f64::NAN, f64::INFINITY, 1e300, 500.0);
                }
                let at = |arrays: &[Vec<f64>; 3], n: usize| Vector3::new(arrays[0][n], arrays[1][n], arrays[2][n]);
                let alone: Vec<_> = (0..count).map(|n| body.flow(&at(&rates, n), &at(&torques, n), dt_s)).collect();
                let [r1, r2, r3] = &mut rates;
                flow_all(&body, [r1, r2, r3], torques.each_ref().map(|torques| &**torques), dt_s);
                for (n, alone) in alone.iter().enumerate() {
                    for axis in 0..3 {
                        let (ours, theirs) = (rates[axis][n], alone[axis]);
                        let same = ours.to_bits() == theirs.to_bits() || (ours.is_nan() && theirs.is_nan());
                        assert!(same, "{count} bodies, {dt_s} s, body {n}, axis {axis}: {ours:e}, not {theirs:e}");
                    }
                }
            }
        }
    }
}

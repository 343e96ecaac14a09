//! The certificate of a body held to an orbit: the exponents of the error, in continuous time and sampled.
//!
//! The certificate only reports; its reader decides which failed condition is an error.

use super::certificate::Condition;
use super::orbit_hold::{OrbitGains, OrbitHold};
use crate::model::{CentralField, OrbitFault, OrbitState};
use nalgebra::{SVector, Vector2};

/// The certificate of one driven body near one circular orbit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OrbitCertificate {
    /// The slowest exponent of the error in continuous time, 1/s, of the law and the observer.
    pub rate_per_s: f64,
    /// 1 against the modulus |z| of the slowest mode from tick to tick: of the exact motion with held, delayed
    /// thrust, linearised about the circular orbit, and of the observer.
    pub sampled: Condition,
    /// The exponent −ln|z|/h of that mode, 1/s: the rate that remains after sampling and delay.
    pub sampled_rate_per_s: f64,
}

impl OrbitCertificate {
    /// Computes the certificate at the circular orbit of radius `r` (du) for a loop with tick `tick_s` whose commands
    /// act `delay_ticks` after their measurement, 1 to 64.
    ///
    /// `decay_rate_per_s` are the observer's −L, positive, or infinite if the law does not use the estimate.
    ///
    /// # Errors
    /// [`OrbitFault`] if the model does not resolve a tick on this orbit.
    pub fn new(
        field: &CentralField,
        law: &OrbitHold,
        gains: &OrbitGains,
        decay_rate_per_s: &Vector2<f64>,
        r: f64,
        tick_s: f64,
        delay_ticks: u64,
    ) -> Result<Self, OrbitFault> {
        let (observer, mut matrix) = (decay_rate_per_s.min(), [[0.0; SIZE]; SIZE]);
        let size = linearised((field, law), r, tick_s, delay_ticks, &mut matrix)?;
        let modulus = spectral_radius(&mut matrix, size).max(libm::exp(-observer * tick_s));
        Ok(Self {
            rate_per_s: gains.rate_per_s().min(observer),
            sampled: Condition { value: 1.0, required: modulus },
            sampled_rate_per_s: -libm::log(modulus) / tick_s,
        })
    }
}

/// A square matrix whose first rows and columns are used: a matrix of variable size without an allocator.
type Square = [[f64; SIZE]; SIZE];
/// The largest number of unknowns: the state of a body, and two components of every thrust in flight.
const SIZE: usize = STATES + 2 * DELAY_MAX as usize;
const STATES: usize = 3;
/// The longest delay that the certificate covers, ticks.
const DELAY_MAX: u64 = 64;

/// Computes the matrix of one tick of the closed loop about the circular orbit of radius `r`. Its unknowns are (r,
/// Vr, Vθ) and the thrusts in flight, the next to act first; the returned number of rows and columns is used.
///
/// The unknowns are in units of the radius, the velocity and the gravity of that orbit.
fn linearised(
    (field, law): (&CentralField, &OrbitHold),
    r: f64,
    tick_s: f64,
    delay_ticks: u64,
    matrix: &mut Square,
) -> Result<usize, OrbitFault> {
    /// Half of the difference. The error of its square and the rounding divided by it are both far below the reported
    /// digits.
    const HALF: f64 = 1e-5;
    let thrusts = delay_ticks.clamp(1, DELAY_MAX) as usize;
    let size = STATES + 2 * thrusts;
    let circle = field.circular(r);
    let pull = field.mu() / (r * r);
    let unit = SVector::from([r, circle.vtheta, circle.vtheta, pull, pull]);
    // The next state and the next thrust if one unknown is off by this difference.
    let tick = |unknown: usize, off: f64| -> Result<SVector<f64, 5>, OrbitFault> {
        let at = |index: usize, unit: f64| if index == unknown { off * unit } else { 0.0 };
        let vtheta = circle.vtheta + at(2, unit[2]);
        let body = OrbitState { r: r + at(0, unit[0]), vr: at(1, unit[1]), theta: 0.0, vtheta };
        let mut acting = (0..thrusts).map(|n| STATES + 2 * n).map(|n| Vector2::new(at(n, pull), at(n + 1, pull)));
        let thrust = law.unlimited(r, &body, acting.clone());
        let next = field.flow(&body, &acting.next().unwrap_or_default(), tick_s)?;
        Ok(SVector::from([next.r, next.vr, next.vtheta, thrust.x, thrust.y]).component_div(&unit))
    };
    for unknown in 0..size {
        let change = (tick(unknown, HALF)? - tick(unknown, -HALF)?) / (2.0 * HALF);
        for (row, elements) in matrix[..size].iter_mut().enumerate() {
            elements[unknown] = match row {
                row if row < STATES => change[row],
                row if row >= size - 2 => change[STATES + row + 2 - size],
                // The next thrust moves up by one place.
                row => f64::from(u8::from(unknown == row + 2)),
            };
        }
    }
    Ok(size)
}

/// Computes the largest modulus of an eigenvalue by Gelfand's formula: the norm of the 2^n-th power, to the power
/// 2^−n.
fn spectral_radius(power: &mut Square, size: usize) -> f64 {
    let (mut log, mut share) = (0.0, 1.0);
    // 2^-40 makes the factor between the norm and the eigenvalue negligible.
    for _ in 0..40 {
        let all = power[..size].iter().flat_map(|row| &row[..size]);
        let norm = all.fold(0.0, |norm: f64, element| norm.max(element.abs()));
        if norm == 0.0 {
            return 0.0;
        }
        log += share * libm::log(norm);
        power[..size].iter_mut().flat_map(|row| &mut row[..size]).for_each(|element| *element /= norm);
        square(power, size);
        share /= 2.0;
    }
    libm::exp(log)
}

/// Multiplies a matrix by itself.
fn square(matrix: &mut Square, size: usize) {
    let factor = *matrix;
    for (row, factors) in matrix[..size].iter_mut().zip(&factor) {
        row[..size].fill(0.0);
        for (scale, factor_row) in factors[..size].iter().zip(&factor).filter(|(scale, _)| **scale != 0.0) {
            row[..size].iter_mut().zip(factor_row).for_each(|(sum, element)| *sum += scale * element);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix2, Matrix3, SMatrix};
    use std::collections::VecDeque;

    const GAINS: OrbitGains = OrbitGains { radius_per_s2: 1.0, radial_per_s: 1.8, transverse_per_s: 1.0 };

    fn certificate(gains: OrbitGains, decay: f64, tick_s: f64, (lead_s, delay_ticks): (f64, u64)) -> OrbitCertificate {
        let field = CentralField::new(1.0, 0.05, 10.0).unwrap();
        let law = OrbitHold::new(field, gains, 0.5, lead_s);
        OrbitCertificate::new(&field, &law, &gains, &Vector2::repeat(decay), 1.3, tick_s, delay_ticks).unwrap()
    }

    #[test]
    fn the_spectral_radius_is_the_largest_modulus() {
        fn radius<const N: usize>(values: SMatrix<f64, N, N>) -> f64 {
            let mut matrix = [[f64::NAN; SIZE]; SIZE];
            (0..N * N).for_each(|at| matrix[at / N][at % N] = values[(at / N, at % N)]);
            spectral_radius(&mut matrix, N)
        }
        let turning = Matrix2::new(0.6, -0.8, 0.8, 0.6) * 0.99;
        assert!((radius(turning) - 0.99).abs() < 1e-12);
        let sheared = Matrix3::new(0.5, 100.0, 3.0, 0.0, 0.9, 7.0, 0.0, 0.0, -0.95);
        assert!((radius(sheared) - 0.95).abs() < 1e-9);
        assert_eq!(radius(Matrix2::new(0.0, 1.0, 0.0, 0.0)), 0.0);
    }

    #[test]
    fn a_fine_tick_keeps_the_designed_rate() {
        let fine = certificate(GAINS, 4.0, 1e-3, (0.0, 1));
        assert_eq!(fine.rate_per_s, 0.9);
        assert!(fine.sampled.holds() && (fine.sampled_rate_per_s - 0.9).abs() < 0.01, "{fine:?}");
        let slow = certificate(GAINS, 0.25, 1e-3, (0.0, 1));
        assert!((slow.sampled_rate_per_s - 0.25).abs() < 1e-9 && slow.rate_per_s == 0.25, "{slow:?}");
    }

    /// The loop with the real law and the real motion grows exactly where the certificate predicts it.
    #[test]
    fn the_sampled_condition_predicts_the_simulated_loop() {
        let mut verdicts = [0, 0];
        for (lead_s, delay_ticks) in [0.0, 0.5].into_iter().flat_map(|lead_s| [1, 2, 5].map(|delay| (lead_s, delay))) {
            for stretch in [0.1, 0.5, 0.8, 1.2, 1.5, 2.0, 2.5] {
                let gains = OrbitGains { radius_per_s2: stretch, radial_per_s: 1.8, transverse_per_s: 1.0 };
                let sampled = certificate(gains, f64::INFINITY, 0.5, (lead_s, delay_ticks)).sampled;
                let shrinks = shrinks(gains, lead_s, delay_ticks);
                assert_eq!(sampled.holds(), shrinks, "{gains:?} {lead_s} {delay_ticks}: {sampled:?}");
                verdicts[usize::from(shrinks)] += 1;
            }
        }
        assert!(verdicts.iter().all(|count| *count > 5), "{verdicts:?}");
    }

    /// The rate with prediction does not depend on the delay.
    #[test]
    fn prediction_compensates_a_delay_of_any_number_of_ticks() {
        let rates = [1, 2, 5, 64].map(|delay| certificate(GAINS, 4.0, 0.1, (0.1, delay)).sampled_rate_per_s);
        assert!(rates.iter().all(|rate| (rate / rates[0] - 1.0).abs() < 1e-4), "{rates:?}");
        let [short, long] = [1, 5].map(|delay| certificate(GAINS, 4.0, 0.1, (0.0, delay)).sampled_rate_per_s);
        assert!(long < 0.9 * short, "without prediction the delay costs rate: {short} {long}");
    }

    fn shrinks(gains: OrbitGains, lead_s: f64, delay_ticks: u64) -> bool {
        let field = CentralField::new(1.0, 0.05, 10.0).unwrap();
        let law = OrbitHold::new(field, gains, 0.5, lead_s);
        let mut body = OrbitState { r: 1.3 + 1e-6, ..field.circular(1.3) };
        let mut acting = VecDeque::from(vec![Vector2::zeros(); delay_ticks as usize]);
        for _ in 0..400 {
            let ahead =
                acting.iter().take(delay_ticks as usize - 1).fold(body, |body, thrust| law.ahead(&body, thrust));
            let next = law.to_circle(1.3, &ahead, &acting[delay_ticks as usize - 1]);
            match acting.pop_front().map(|thrust| field.flow(&body, &thrust, 0.5)) {
                Some(Ok(moved)) => body = moved,
                _ => return false,
            }
            acting.push_back(next);
        }
        (body.r - 1.3).abs() < 1e-6
    }
}

//! What is proven of a body held to an orbit: the exponents of the error, and the loop as it is sampled.
//!
//! Must only report; whether something that fails is an error is for its reader to decide.

use super::{Condition, OrbitGains, OrbitHold};
use crate::model::{CentralField, OrbitFault, OrbitState};
use nalgebra::{SMatrix, SVector, Vector2};

/// What is proven about one driven body near one circular orbit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OrbitCertificate {
    /// The slowest exponent of the error in continuous time, 1/s: of the law and of the observer.
    pub rate_per_s: f64,
    /// 1 against the modulus |z| of the slowest mode from tick to tick: of the exact motion with held thrust and one tick
    /// of delay, linearised about the circular orbit, and of the observer.
    pub sampled: Condition,
    /// The exponent −ln|z|/h of that mode, 1/s: what sampling and delay leave of the rate.
    pub sampled_rate_per_s: f64,
}

impl OrbitCertificate {
    /// The certificate at the circular orbit of radius `r` (du) for a loop with tick `tick_s`.
    ///
    /// `decay_rate_per_s` are the observer's −L, positive, or infinite where the law does not use the estimate.
    ///
    /// # Errors
    /// [`OrbitFault`] if a tick on this orbit is more than the model resolves.
    pub fn new(
        field: &CentralField,
        law: &OrbitHold,
        gains: &OrbitGains,
        decay_rate_per_s: &Vector2<f64>,
        r: f64,
        tick_s: f64,
    ) -> Result<Self, OrbitFault> {
        let observer = decay_rate_per_s.min();
        let modulus = spectral_radius(linearised(field, law, r, tick_s)?).max(libm::exp(-observer * tick_s));
        Ok(Self {
            rate_per_s: gains.rate_per_s().min(observer),
            sampled: Condition { value: 1.0, required: modulus },
            sampled_rate_per_s: -libm::log(modulus) / tick_s,
        })
    }
}

/// One tick of the closed loop, (r, Vr, Vθ, Ur, Uθ) to the next, as a matrix about the circular orbit of radius `r`.
///
/// The unknowns are in units of the radius, the velocity and the pull of that orbit.
fn linearised(field: &CentralField, law: &OrbitHold, r: f64, tick_s: f64) -> Result<SMatrix<f64, 5, 5>, OrbitFault> {
    /// Half the difference; its square and the rounding over it are both far below what is told.
    const HALF: f64 = 1e-5;
    let circle = field.circular(r);
    let pull = field.mu() / (r * r);
    let unit = SVector::from([r, circle.vtheta, circle.vtheta, pull, pull]);
    let tick = |offset: SVector<f64, 5>| -> Result<_, OrbitFault> {
        let by = offset.component_mul(&unit);
        let body = OrbitState { r: r + by[0], vr: by[1], theta: 0.0, vtheta: circle.vtheta + by[2] };
        let applied = Vector2::new(by[3], by[4]);
        let next = field.flow(&body, &applied, tick_s)?;
        let thrust = law.unlimited(r, &body, &applied);
        Ok(SVector::from([next.r, next.vr, next.vtheta, thrust.x, thrust.y]).component_div(&unit))
    };
    let mut matrix = SMatrix::<f64, 5, 5>::zeros();
    for column in 0..5 {
        let offset = SVector::<f64, 5>::ith(column, HALF);
        matrix.set_column(column, &((tick(offset)? - tick(-offset)?) / (2.0 * HALF)));
    }
    Ok(matrix)
}

/// The largest modulus of an eigenvalue, by Gelfand's formula: the norm of the 2^n-th power, to the power 2^−n.
fn spectral_radius<const N: usize>(matrix: SMatrix<f64, N, N>) -> f64 {
    let (mut power, mut log, mut share) = (matrix, 0.0, 1.0);
    // 2^-40 leaves nothing of the factor between the norm and the eigenvalue.
    for _ in 0..40 {
        let norm = power.amax();
        if norm == 0.0 {
            return 0.0;
        }
        log += share * libm::log(norm);
        power /= norm;
        power *= power;
        share /= 2.0;
    }
    libm::exp(log)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix2, Matrix3};

    const GAINS: OrbitGains = OrbitGains { radius_per_s2: 1.0, radial_per_s: 1.8, transverse_per_s: 1.0 };

    fn certificate(gains: OrbitGains, decay: f64, tick_s: f64, lead_s: f64) -> OrbitCertificate {
        let field = CentralField::new(1.0, 0.05, 10.0).unwrap();
        let law = OrbitHold::new(field, gains, 0.5, lead_s);
        OrbitCertificate::new(&field, &law, &gains, &Vector2::repeat(decay), 1.3, tick_s).unwrap()
    }

    #[test]
    fn the_spectral_radius_is_the_largest_modulus() {
        let turning = Matrix2::new(0.6, -0.8, 0.8, 0.6) * 0.99;
        assert!((spectral_radius(turning) - 0.99).abs() < 1e-12);
        let sheared = Matrix3::new(0.5, 100.0, 3.0, 0.0, 0.9, 7.0, 0.0, 0.0, -0.95);
        assert!((spectral_radius(sheared) - 0.95).abs() < 1e-9);
        assert_eq!(spectral_radius(Matrix2::new(0.0, 1.0, 0.0, 0.0)), 0.0);
    }

    #[test]
    fn a_fine_tick_keeps_the_designed_rate() {
        let fine = certificate(GAINS, 4.0, 1e-3, 0.0);
        assert_eq!(fine.rate_per_s, 0.9);
        assert!(fine.sampled.holds() && (fine.sampled_rate_per_s - 0.9).abs() < 0.01, "{fine:?}");
        let slow = certificate(GAINS, 0.25, 1e-3, 0.0);
        assert!((slow.sampled_rate_per_s - 0.25).abs() < 1e-9 && slow.rate_per_s == 0.25, "{slow:?}");
    }

    /// The loop with the real law and the real motion grows exactly where the certificate says so.
    #[test]
    fn the_sampled_limit_is_the_real_one() {
        for lead_s in [0.0, 0.5] {
            for stretch in [0.5, 0.8, 1.2, 1.5, 2.0, 2.5] {
                let gains = OrbitGains { radius_per_s2: stretch, radial_per_s: 1.8, transverse_per_s: 1.0 };
                let told = certificate(gains, f64::INFINITY, 0.5, lead_s).sampled;
                assert_eq!(told.holds(), shrinks(gains, lead_s), "{gains:?} {lead_s}: {told:?}");
            }
        }
    }

    fn shrinks(gains: OrbitGains, lead_s: f64) -> bool {
        let field = CentralField::new(1.0, 0.05, 10.0).unwrap();
        let law = OrbitHold::new(field, gains, 0.5, lead_s);
        let mut body = OrbitState { r: 1.3 + 1e-6, ..field.circular(1.3) };
        let mut applied = Vector2::zeros();
        for _ in 0..400 {
            let next = law.to_circle(1.3, &body, &applied);
            match field.flow(&body, &applied, 0.5) {
                Ok(moved) => body = moved,
                Err(_) => return false,
            }
            applied = next;
        }
        (body.r - 1.3).abs() < 1e-6
    }
}

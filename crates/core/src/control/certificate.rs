//! The proof obligations of the synchronising law as numbers: \[D\](15)-(19), the exact condition, and the sampled
//! loop.
//!
//! The certificate only reports; its reader decides which failed condition is an error.

use crate::vector::sum;
use nalgebra::Vector3;

/// The |k|·h above which a sampled axis is visibly slower or rings; it is reported well before the axis becomes
/// unstable.
const COMFORTABLE_GAIN_STEP: f64 = 0.25;

/// One sufficient condition, with its actual and its required value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Condition {
    /// The actual value.
    pub value: f64,
    /// The value that it must exceed.
    pub required: f64,
}

impl Condition {
    /// Returns true if the value exceeds the required one.
    pub fn holds(&self) -> bool {
        self.value > self.required
    }
}

/// The certificate of one follower's synchronisation with a leader whose axis k is hidden.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Certificate {
    /// M, the bound on the leader's angular velocity, rad/s.
    pub rate_bound_rad_s: f64,
    /// \[D\](19): |k_i| > |a_i| M, |k_j| > |a_j| M, −λ > |a_i| M + |a_j| M + |k_k|/2, 1/s. Sufficient.
    pub paper: [Condition; 3],
    /// −λ > M²/4·max(a_i²/|k_i|, a_j²/|k_j|) + |k_k|/4, 1/s: necessary and sufficient for V̇ < 0 wherever |ω| ≤ M, where
    /// V = ½(|e|² + ε²) of \[D\](15). The Schur complement of the error system (14).
    pub exact: Condition,
    /// The slowest exponent of the error, 1/s: min(|k_1|, |k_2|, |k_3|, −λ). It holds unconditionally, because the
    /// observer's error does not depend on the others.
    pub rate_per_s: f64,
    /// The largest |k|·h. With d unpredicted ticks of delay an axis obeys z^(d+1) − z^d + |k|h = 0 and is stable
    /// below 2 sin(π/(4d + 2)): 1 for one tick, 2 for none.
    pub gain_step: Condition,
    /// The factors of −e_i² and −ε² in the bound on V̇ of \[D\](18), 1/s.
    slopes: Vector3<f64>,
    hidden_slope: f64,
    arguments: Arguments,
}

/// The arguments of [`Certificate::new`].
#[derive(Debug, Clone, Copy, PartialEq)]
struct Arguments {
    coefficients: Vector3<f64>,
    hidden_axis: usize,
    gain_per_s: Vector3<f64>,
    decay_rate_per_s: f64,
    tick_s: f64,
    unpredicted_ticks: u64,
}

impl Certificate {
    /// Computes the certificate of a loop with tick `tick_s`.
    ///
    /// `coefficients` are the a of \[D\](2), `hidden_axis` is 1 to 3, `gain_per_s` = −k and `decay_rate_per_s` = −λ
    /// are positive, `rate_bound_rad_s` is M, `unpredicted_ticks` is the delay, or 0 if the law predicts over it.
    pub fn new(
        coefficients: &Vector3<f64>,
        hidden_axis: usize,
        gain_per_s: &Vector3<f64>,
        decay_rate_per_s: f64,
        rate_bound_rad_s: f64,
        tick_s: f64,
        unpredicted_ticks: u64,
    ) -> Self {
        let [i, j, k] = [hidden_axis % 3, (hidden_axis + 1) % 3, (hidden_axis - 1) % 3];
        let m = rate_bound_rad_s;
        let pull = [i, j].map(|axis| coefficients[axis].abs() * m);
        let mut slopes = Vector3::zeros();
        (slopes[i], slopes[j]) = (gain_per_s[i] - pull[0], gain_per_s[j] - pull[1]);
        slopes[k] = gain_per_s[k] / 2.0;
        let schur = [i, j].map(|axis| coefficients[axis] * coefficients[axis] / gain_per_s[axis]);
        Self {
            rate_bound_rad_s: m,
            paper: [
                Condition { value: gain_per_s[i], required: pull[0] },
                Condition { value: gain_per_s[j], required: pull[1] },
                Condition { value: decay_rate_per_s, required: pull[0] + pull[1] + gain_per_s[k] / 2.0 },
            ],
            exact: Condition {
                value: decay_rate_per_s,
                required: m * m / 4.0 * schur[0].max(schur[1]) + gain_per_s[k] / 4.0,
            },
            rate_per_s: gain_per_s.min().min(decay_rate_per_s),
            gain_step: Self::gain_step(gain_per_s, tick_s, unpredicted_ticks),
            slopes,
            hidden_slope: decay_rate_per_s - pull[0] - pull[1] - gain_per_s[k] / 2.0,
            arguments: Arguments {
                coefficients: *coefficients,
                hidden_axis,
                gain_per_s: *gain_per_s,
                decay_rate_per_s,
                tick_s,
                unpredicted_ticks,
            },
        }
    }

    /// Returns the certificate of the same loop with other gains or another decay rate, 1/s.
    #[must_use]
    pub fn with_rates(&self, gain_per_s: Option<Vector3<f64>>, decay_rate_per_s: Option<f64>) -> Self {
        let arguments = &self.arguments;
        Self::new(
            &arguments.coefficients,
            arguments.hidden_axis,
            &gain_per_s.unwrap_or(arguments.gain_per_s),
            decay_rate_per_s.unwrap_or(arguments.decay_rate_per_s),
            self.rate_bound_rad_s,
            arguments.tick_s,
            arguments.unpredicted_ticks,
        )
    }

    /// Computes V = ½(|e|² + ε²) of \[D\](15), rad²/s², and the bound on V̇ of \[D\](18), rad²/s³, for the errors e =
    /// p − ω and ε = ω_k − ω̂_k, rad/s.
    #[inline]
    pub fn lyapunov(&self, error: &Vector3<f64>, hidden_error: f64) -> (f64, f64) {
        let square = error.component_mul(error);
        let hidden = hidden_error * hidden_error;
        (0.5 * (sum(&square) + hidden), -self.slopes.dot(&square) - self.hidden_slope * hidden)
    }

    /// Computes the condition of the sampled loop, which needs no observer: see the field of this name.
    pub fn gain_step(gain_per_s: &Vector3<f64>, tick_s: f64, unpredicted_ticks: u64) -> Condition {
        let value = match unpredicted_ticks {
            0 => 2.0,
            1 => 1.0,
            ticks => 2.0 * libm::sin(core::f64::consts::PI / (4 * ticks + 2) as f64),
        };
        Condition { value, required: gain_per_s.max() * tick_s }
    }

    /// Returns true if the tick is so coarse that the sampled loop visibly differs from the continuous one.
    pub fn coarse_tick(&self) -> bool {
        self.gain_step.required > COMFORTABLE_GAIN_STEP
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Matrix4;

    /// Returns V̇ as a quadratic form in (e1, e2, e3, ε) at a given ω, from the error system (14) with the hidden
    /// axis 3.
    fn form(a: &Vector3<f64>, gain: &Vector3<f64>, decay: f64, w1: f64, w2: f64) -> Matrix4<f64> {
        let mut q = Matrix4::from_diagonal(&nalgebra::Vector4::new(-gain.x, -gain.y, -gain.z, -decay));
        for (row, half) in [(0, -a.x * w2 / 2.0), (1, -a.y * w1 / 2.0), (2, -gain.z / 2.0)] {
            q[(row, 3)] = half;
            q[(3, row)] = half;
        }
        q
    }

    fn worst_eigenvalue(a: &Vector3<f64>, gain: &Vector3<f64>, decay: f64, m: f64) -> f64 {
        (0..=90)
            .map(|step| f64::from(step).to_radians())
            .map(|angle| form(a, gain, decay, m * angle.cos(), m * angle.sin()).symmetric_eigenvalues().max())
            .fold(f64::NEG_INFINITY, f64::max)
    }

    #[test]
    fn the_exact_condition_is_where_the_largest_eigenvalue_changes_its_sign() {
        let (a, gain, m) = (Vector3::new(-0.5, 0.75, -0.4), Vector3::new(2.0, 3.0, 4.0), 1.5);
        let needed = Certificate::new(&a, 3, &gain, 1.0, m, 1e-3, 1).exact.required;
        assert!(worst_eigenvalue(&a, &gain, needed * 1.001, m) < 0.0);
        assert!(worst_eigenvalue(&a, &gain, needed * 0.999, m) > 0.0);
    }

    /// The paper's bound is at least the V̇ of the error system, at every angle of ω and for random errors.
    #[test]
    fn the_bound_on_the_rate_of_v_holds() {
        let (a, gain, m) = (Vector3::new(-0.5, 0.75, -0.4), Vector3::new(2.0, 3.0, 4.0), 1.5);
        let certificate = Certificate::new(&a, 3, &gain, 5.0, m, 1e-3, 1);
        for step in 0..360 {
            let angle = f64::from(step).to_radians();
            let q = form(&a, &gain, 5.0, m * angle.cos(), m * angle.sin());
            let x = nalgebra::Vector4::new(
                (7.0 * angle).sin(),
                (5.0 * angle).cos(),
                (3.0 * angle).sin(),
                (11.0 * angle).cos(),
            );
            let (v, bound) = certificate.lyapunov(&x.xyz(), x.w);
            assert!((v - 0.5 * x.norm_squared()).abs() < 1e-15);
            assert!((x.transpose() * q * x).x <= bound, "angle {step}");
        }
    }

    #[test]
    fn the_paper_s_condition_implies_the_exact_one() {
        let (a, gain) = (Vector3::new(-0.5, 0.75, -0.4), Vector3::new(2.0, 3.0, 4.0));
        let loose = Certificate::new(&a, 3, &gain, 1.0, 1.5, 1e-3, 1);
        let certificate = Certificate::new(&a, 3, &gain, loose.paper[2].required * 1.01, 1.5, 1e-3, 1);
        assert!(certificate.paper.iter().all(Condition::holds) && certificate.exact.holds());
        assert!(!loose.paper[2].holds());
    }

    #[test]
    fn relabelled_axes_have_relabelled_conditions() {
        let (a, gain) = (Vector3::new(-0.5, 0.75, -0.4), Vector3::new(2.0, 3.0, 4.0));
        let turned = |v: &Vector3<f64>| Vector3::new(v.z, v.x, v.y);
        let third = Certificate::new(&a, 3, &gain, 5.0, 1.5, 1e-3, 1);
        let first = Certificate::new(&turned(&a), 1, &turned(&gain), 5.0, 1.5, 1e-3, 1);
        assert_eq!(third.exact, first.exact);
        assert_eq!(third.paper, first.paper);
    }

    /// The sampled axis e(n+1) = e(n) − g h e(n−d) is stable up to the limit and not beyond.
    #[test]
    fn the_sampled_axis_is_stable_up_to_the_limit() {
        for delay in [0, 1, 2, 5, 64] {
            let grows = |gain_step: f64| {
                let mut e = vec![1.0_f64; delay + 1];
                for _ in 0..200_000 {
                    e.push(e[e.len() - 1] - gain_step * e[e.len() - 1 - delay]);
                }
                e.iter().rev().take(200).any(|e| e.is_nan() || e.abs() > 1.0)
            };
            let gain = Vector3::repeat(1.0);
            let limit = Certificate::new(&Vector3::zeros(), 3, &gain, 1.0, 1.0, 1.0, delay as u64).gain_step.value;
            assert!(!grows(limit * 0.99) && grows(limit * 1.01), "{delay}: {limit}");
        }
    }
}

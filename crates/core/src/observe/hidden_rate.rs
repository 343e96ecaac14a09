//! The invariant relation for a component of a rigid body's angular velocity that no sensor measures, \[D\] section 3.
//!
//! For the hidden axis k and the measured axes i, j (cyclic) there is a function φ(ω_i, ω_j) with φ̇ = ω_k along the
//! free motion. The signs of a_i and a_j determine its level curves: three conics, three functions. Only the
//! increment of φ between two samples is computed. The relation must not choose a branch, unwrap an angle, or divide
//! by a value that may vanish without a check.

use super::filter::{Increment, Span, StepAgain};
use super::series;
use crate::state::{Persist, Words, persist_fields};
use nalgebra::{Vector1, Vector2, Vector3};

/// The conic on which the measured components move, which determines φ.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Conic {
    /// a_i·a_j < 0, the hidden axis has the largest or the smallest moment: φ = atan2(Ω ω_i, a_i ω_j)/Ω, \[D\](11).
    Elliptic {
        /// Ω = √(−a_i a_j), dimensionless.
        omega: f64,
    },
    /// a_i·a_j > 0, the hidden axis has the intermediate moment: φ = ±ln|Ω ω_i ± a_i ω_j|/Ω, \[D\](12).
    Hyperbolic {
        /// Ω = √(a_i a_j), dimensionless.
        omega: f64,
    },
    /// a_j = 0 ≠ a_i, an axisymmetric body with a hidden transverse axis: φ = ω_i/(a_i ω_j). Not in the paper.
    ParabolicFirst,
    /// a_i = 0 ≠ a_j, the same with the measured axes exchanged: φ = ω_j/(a_j ω_i). Not in the paper.
    ParabolicSecond,
}

/// The reason why a component of the angular velocity cannot be observed from the other two.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum HiddenRateError {
    /// The axis number is invalid.
    #[error("axis {axis} does not exist; the axes are 1, 2 and 3")]
    NoSuchAxis {
        /// The axis as given.
        axis: usize,
    },
    /// The measured components do not depend on the hidden one.
    #[error(
        "axis {axis} cannot be observed: the body turns like a sphere (a1 = a2 = a3 = 0), so the measured components do \
         not depend on the hidden one; give moments of inertia that differ"
    )]
    Sphere {
        /// The hidden axis, 1 to 3.
        axis: usize,
    },
}

impl From<&HiddenRateError> for &'static str {
    /// Returns the stable name of the error.
    fn from(error: &HiddenRateError) -> Self {
        match error {
            HiddenRateError::NoSuchAxis { .. } => "no-such-axis",
            HiddenRateError::Sphere { .. } => "spherical-body",
        }
    }
}

/// The relative size below which a coefficient of a measured axis counts as zero (a parabola): it changes φ by less
/// than rounding does. If both are below the rounding of the moments from which they are computed, the body is a
/// sphere.
const ROUNDING: f64 = f64::EPSILON;

/// The largest rotation of (Ω ω_i, a_i ω_j) in one step, rad, that is distinguished from its complement (π is
/// ambiguous).
const MAX_TURN_RAD: f64 = 3.0;

/// The smallest ratio of the hyperbola's branches at which the smaller one contributes to φ.
const WEAKEST_BRANCH: f64 = 1.0 / 16.0;

/// The torque share of an undriven body. Adding −0 changes no number, so that the addition can be left out.
const NO_PUSH: [f64; 2] = [-0.0; 2];

/// The inputs of the relation at one instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RateSample {
    /// Angular velocity, rad/s; the hidden component is not used.
    pub rate_rad_s: Vector3<f64>,
    /// Known torque over inertia, held from this instant to the next, rad/s².
    pub torque_rad_s2: Vector3<f64>,
}

persist_fields!(RateSample, rate_rad_s, torque_rad_s2);

/// The terms of the relation at one sample. Computed once and used by two steps: the one that ends at the sample and
/// the next.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Regressor {
    /// The measured components ω_i and ω_j, rad/s.
    i: f64,
    j: f64,
    /// Ω ω_i and a_i ω_j: the plane of the conic.
    x: f64,
    y: f64,
    /// x² + y².
    square: f64,
    /// a_k ω_i ω_j: ω̇_k of the free motion, rad/s².
    drift: f64,
    /// a_k (a_i ω_j² + a_j ω_i²): the derivative of `drift` per unit of ω_k.
    bend: f64,
    /// The torque over inertia held from here on, on the axes i, j and k, rad/s².
    torque: [f64; 3],
}

impl Regressor {
    /// Returns a_k ω_i ω_j, rad/s².
    #[inline]
    pub fn drift(&self) -> f64 {
        self.drift
    }
}

/// The length of a step with the weights of Hermite's rule, computed once for equal steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Interval {
    span: Span,
    /// h/6, h/2 and h²/12.
    sixth: f64,
    half: f64,
    twelfth: f64,
    /// The weights of the values and slopes at both ends in ∫∫.
    moment: [f64; 4],
}

impl Interval {
    /// Returns the length, s.
    #[inline]
    pub fn length(&self) -> f64 {
        self.span.length()
    }
}

impl From<f64> for Interval {
    fn from(h: f64) -> Self {
        let square = h * h;
        Self {
            span: h.into(),
            sixth: h / 6.0,
            half: h / 2.0,
            twelfth: square / 12.0,
            moment: [square * 0.35, square * 0.15, square * h / 20.0, square * h / 30.0],
        }
    }
}

/// The result of one step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Observation {
    /// The relation held over the step.
    Seen(Increment<1>),
    /// The measured components are too small to carry information: the estimate moves by this drift (rad/s) alone.
    Unobservable {
        /// ∫g dt by the model, rad/s.
        drift: Vector1<f64>,
    },
}

/// The relation for one hidden axis of one body.
///
/// The third component of a tumbling body's angular velocity from the other two:
///
/// ```
/// # extern crate corotate_core as corotate;
/// use corotate::model::{Inertia, RigidBody};
/// use corotate::nalgebra::{Vector1, Vector3};
/// use corotate::observe::{HiddenRate, InvariantFilter, Observation, RateSample};
///
/// let inertia = Inertia::new([1.0, 2.0, 2.5]).unwrap();
/// let (body, h) = (RigidBody::new(&inertia), 1e-3);
/// let relation = HiddenRate::new(&inertia.coefficients(), 3, 1e-6).unwrap();
/// let mut filter = InvariantFilter::new(Vector1::new(6.0), Vector1::new(0.0));
/// let mut rate = Vector3::new(0.6, -0.4, 0.8);
/// let regressor = |rate: Vector3<f64>| {
///     relation.regressor(&RateSample { rate_rad_s: rate, torque_rad_s2: Vector3::zeros() })
/// };
/// for _ in 0..5000 {
///     let next = body.flow(&rate, &Vector3::zeros(), h);
///     match relation.observe(&regressor(rate), &regressor(next), h, filter.estimate().x) {
///         Observation::Seen(increment) => filter.step(&increment),
///         Observation::Unobservable { drift } => filter.predict(&drift),
///     }
///     rate = next;
/// }
/// assert!((filter.estimate().x - rate.z).abs() < 1e-9);
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HiddenRate {
    /// Index of the hidden component.
    hidden: usize,
    /// a_i, a_j, a_k.
    a: [f64; 3],
    conic: Conic,
    floor_rad_s: f64,
    /// The variances of the two measured components, (rad/s)², if they are known.
    variance: Option<[f64; 2]>,
    constants: Constants,
}

/// The constants of all steps.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Constants {
    /// Ω, or 1 on a parabola.
    omega: f64,
    inverse_omega: f64,
    /// a_k a_i and a_k a_j.
    bend: [f64; 2],
    /// a_i/a_j.
    ratio: f64,
    /// The smallest x² + y² that carries information, and the smallest |x ± y|.
    floor: f64,
    floor_z: f64,
}

impl Constants {
    fn new(omega: f64, [ai, aj, ak]: [f64; 3], floor_rad_s: f64) -> Self {
        let floor_z = floor_rad_s * omega.max(ai.abs());
        let (inverse_omega, floor) = (1.0 / omega, floor_z * floor_z);
        Self { omega, inverse_omega, bend: [ak * ai, ak * aj], ratio: ai / aj, floor, floor_z }
    }
}

/// Returns the lesser of two finite numbers; `f64::min` also handles NaN and costs more.
#[inline(always)]
fn lesser(x: f64, y: f64) -> f64 {
    if x < y { x } else { y }
}

/// Returns the components i, j and k of a vector in the body's order; `hidden` is the index of k.
#[inline(always)]
fn cyclic(vector: &Vector3<f64>, hidden: usize) -> [f64; 3] {
    match hidden {
        0 => [vector.y, vector.z, vector.x],
        1 => [vector.z, vector.x, vector.y],
        _ => [vector.x, vector.y, vector.z],
    }
}

impl HiddenRate {
    /// Creates the relation for the hidden axis `axis` (1 to 3) of a body with the coefficients a of \[D\](2).
    ///
    /// Measured components below `floor_rad_s` count as carrying no information.
    ///
    /// # Errors
    /// [`HiddenRateError`] if there is no such axis or the body is a sphere.
    pub fn new(coefficients: &Vector3<f64>, axis: usize, floor_rad_s: f64) -> Result<Self, HiddenRateError> {
        if !(1..=3).contains(&axis) {
            return Err(HiddenRateError::NoSuchAxis { axis });
        }
        let a = cyclic(coefficients, axis - 1);
        let largest = a[0].abs().max(a[1].abs());
        let negligible = |a: f64| largest < ROUNDING || a.abs() < ROUNDING * largest;
        let conic = match (negligible(a[0]), negligible(a[1])) {
            (true, true) => return Err(HiddenRateError::Sphere { axis }),
            (false, true) => Conic::ParabolicFirst,
            (true, false) => Conic::ParabolicSecond,
            (false, false) if a[0] * a[1] < 0.0 => Conic::Elliptic { omega: libm::sqrt(-a[0] * a[1]) },
            (false, false) => Conic::Hyperbolic { omega: libm::sqrt(a[0] * a[1]) },
        };
        let omega = match conic {
            Conic::Elliptic { omega } | Conic::Hyperbolic { omega } => omega,
            Conic::ParabolicFirst | Conic::ParabolicSecond => 1.0,
        };
        let constants = Constants::new(omega, a, floor_rad_s);
        Ok(Self { hidden: axis - 1, a, conic, floor_rad_s, variance: None, constants })
    }

    /// Returns the relation with increments that include the variances of white measurement noise.
    ///
    /// `sensor_deviation_rad_s` are the standard deviations of one sample's components; the hidden one is not used.
    /// The bits of an increment's potential and drift do not change.
    #[must_use]
    pub fn with_noise(mut self, sensor_deviation_rad_s: &Vector3<f64>) -> Self {
        let [i, j, _] = cyclic(sensor_deviation_rad_s, self.hidden);
        self.variance = Some([i * i, j * j]);
        self
    }

    /// Returns the index of the hidden component, 0 to 2.
    #[inline]
    pub fn hidden(&self) -> usize {
        self.hidden
    }

    /// Returns the level, rad/s, below which the measured components carry no information.
    pub fn floor_rad_s(&self) -> f64 {
        self.floor_rad_s
    }

    /// Returns the possible effect of the samples' rounding on the estimate of the hidden component at `rate_rad_s`
    /// and steps of `dt_s`, rad/s.
    ///
    /// By \[D\](2), ω̇_i = a_i ω_j ω_k. In one step an error δ of ω_k changes ω_i by a_i ω_j δ dt, which is lost if
    /// it is below the last bit of ω_i; the same holds for ω_j. The axis with the larger change sets the limit.
    /// Rounding may have the same sign at every step, so that no filter removes it.
    pub fn rounding_rad_s(&self, rate_rad_s: &Vector3<f64>, dt_s: f64) -> f64 {
        let ([ai, aj, _], [i, j, _]) = (self.a, cyclic(rate_rad_s, self.hidden));
        ROUNDING / ((ai * j / i).abs().max((aj * i / j).abs()) * dt_s)
    }

    /// Returns the conic on which the measured components move.
    pub fn conic(&self) -> Conic {
        self.conic
    }

    /// Returns the longest step, s, over which a hidden component of at most `rate_bound_rad_s` can be followed.
    ///
    /// On an ellipse the phase rotates by Ω ω_k dt and is known only up to full turns; the other conics have no such
    /// limit.
    pub fn longest_step_s(&self, rate_bound_rad_s: f64) -> f64 {
        match self.conic {
            Conic::Elliptic { omega } => MAX_TURN_RAD / (omega * rate_bound_rad_s),
            _ => f64::INFINITY,
        }
    }

    /// Computes the terms of the relation at a sample whose components are finite.
    #[inline(always)]
    pub fn regressor(&self, sample: &RateSample) -> Regressor {
        let [i, j, _] = cyclic(&sample.rate_rad_s, self.hidden);
        self.at([i, j], cyclic(&sample.torque_rad_s2, self.hidden))
    }

    #[inline(always)]
    fn at(&self, [i, j]: [f64; 2], torque: [f64; 3]) -> Regressor {
        let Constants { omega, bend, .. } = self.constants;
        let (x, y) = (omega * i, self.a[0] * j);
        let bend = bend[0] * (j * j) + bend[1] * (i * i);
        Regressor { i, j, x, y, square: x * x + y * y, drift: self.a[2] * i * j, bend, torque }
    }

    /// Persists the terms at a sample, see [`Persist`]. Only the measured values are stored.
    pub fn persist_regressor<W: Words>(&self, regressor: &mut Regressor, words: &mut W) {
        let Regressor { mut i, mut j, mut torque, .. } = *regressor;
        i.persist(words);
        j.persist(words);
        torque.persist(words);
        *regressor = self.at([i, j], torque);
    }

    /// Returns a measured angular velocity with `estimate` in place of the hidden component, rad/s.
    #[inline(always)]
    pub fn complete(&self, measured: &Vector3<f64>, estimate: f64) -> Vector3<f64> {
        match self.hidden {
            0 => Vector3::new(estimate, measured.y, measured.z),
            1 => Vector3::new(measured.x, estimate, measured.z),
            _ => Vector3::new(measured.x, measured.y, estimate),
        }
    }

    /// Returns the torque over inertia of a sample, rad/s².
    pub fn torque(&self, regressor: &Regressor) -> Vector3<f64> {
        let [i, j, k] = regressor.torque;
        match self.hidden {
            0 => Vector3::new(k, i, j),
            1 => Vector3::new(j, k, i),
            _ => Vector3::new(i, j, k),
        }
    }

    /// Computes the increment over the interval (s, positive) from `from` to `to`. `estimate` (rad/s) is the estimate
    /// at its start.
    pub fn observe(
        &self,
        from: &Regressor,
        to: &Regressor,
        interval: impl Into<Interval>,
        estimate: f64,
    ) -> Observation {
        let interval = interval.into();
        let exact = (|y, x| Some(series::atan2(y, x)), |x| Some(series::ln_1p(x)));
        let Some((growth, share)) = self.growth(from, to, interval.length(), estimate, exact) else {
            return self.unobservable(from, to, &interval, estimate);
        };
        let (potential, push) =
            if driven(from) { self.undriven([from, to], share, &interval, growth) } else { (growth, NO_PUSH) };
        let exact = increment(from, to, push, &interval, potential);
        Observation::Seen(match self.variance {
            None => exact,
            Some(variance) => self.noisy(exact, to, share, variance),
        })
    }

    /// The fast path: advances `filter`, which is at `estimate`, over a step that is short, undriven, observable, without
    /// noise and as long as the filter's last one. Returns the new estimate and the excess of the step's own
    /// reconstruction over it, both in rad/s. Returns `None` and changes nothing for any other step.
    ///
    /// The result is bit-identical to that of [`HiddenRate::observe`] and the filter's step. It calls no function, so
    /// that all values stay in registers.
    #[inline(always)]
    pub fn fast_step(
        &self,
        [from, to]: [&Regressor; 2],
        interval: &Interval,
        estimate: f64,
        filter: &mut impl StepAgain<1>,
    ) -> Option<(f64, f64)> {
        if driven(from) || self.variance.is_some() {
            return None;
        }
        let short = (|y, x| series::short_atan2(y, x), |x| series::short_ln_1p(x));
        let (growth, _) = self.growth(from, to, interval.length(), estimate, short)?;
        let increment = increment(from, to, NO_PUSH, interval, growth);
        let estimate = filter.step_again(&increment)?.x;
        Some((estimate, increment.reconstruction().x - estimate))
    }

    /// Returns true if both ends of a step carry information, but its turn is ambiguous: more than half a turn, or through both
    /// branches of a hyperbola.
    pub fn is_too_long(&self, from: &Regressor, to: &Regressor) -> bool {
        let floor = self.constants.floor_z;
        let seen = |at: &Regressor| match self.conic {
            Conic::Elliptic { .. } => at.square > self.constants.floor,
            Conic::Hyperbolic { .. } => (at.x + at.y).abs() > floor || (at.x - at.y).abs() > floor,
            // A zero of the measured rate is passed in steps of any length.
            Conic::ParabolicFirst | Conic::ParabolicSecond => false,
        };
        seen(from) && seen(to)
    }

    fn unobservable(&self, from: &Regressor, to: &Regressor, interval: &Interval, estimate: f64) -> Observation {
        let push = [self.push(from, &from.torque), self.push(to, &from.torque)];
        Observation::Unobservable { drift: Vector1::new(drift(from, to, push, interval, estimate).0) }
    }

    /// Computes Δφ between the ends and the share of the hyperbola's branch z₊ in it. Returns `None` where the
    /// relation does not hold, or where `atan2` or `ln_1p` returns `None`.
    #[inline(always)]
    fn growth(
        &self,
        from: &Regressor,
        to: &Regressor,
        dt_s: f64,
        estimate: f64,
        (atan2, ln_1p): (impl Fn(f64, f64) -> Option<f64>, impl Fn(f64) -> Option<f64> + Copy),
    ) -> Option<(f64, f64)> {
        match self.conic {
            Conic::Elliptic { omega } => {
                if lesser(from.square, to.square) <= self.constants.floor
                    || omega * estimate.abs() * dt_s > MAX_TURN_RAD
                {
                    return None;
                }
                let (cross, dot) = (from.y * to.x - from.x * to.y, from.x * to.x + from.y * to.y);
                Some((atan2(cross, dot)? * self.constants.inverse_omega, 1.0))
            }
            Conic::Hyperbolic { .. } => self.logarithmic_growth(from, to, ln_1p),
            Conic::ParabolicFirst => self.quotient_growth(from.j, to.j, from.i, to.i, self.a[0]),
            Conic::ParabolicSecond => self.quotient_growth(from.i, to.i, from.j, to.j, self.a[1]),
        }
    }

    /// Computes Δφ and the share on a hyperbola.
    #[inline(always)]
    fn logarithmic_growth(
        &self,
        from: &Regressor,
        to: &Regressor,
        ln_1p: impl Fn(f64) -> Option<f64> + Copy,
    ) -> Option<(f64, f64)> {
        let (plus, minus) = (from.x + from.y, from.x - from.y);
        let least = (lesser(plus.abs(), (to.x + to.y).abs()), lesser(minus.abs(), (to.x - to.y).abs()));
        if !(least.0 > self.constants.floor_z || least.1 > self.constants.floor_z) {
            return None;
        }
        // A branch that the torque takes through zero must not be integrated over: it gets no share.
        let share = if least.1 < least.0 * WEAKEST_BRANCH {
            1.0
        } else if least.0 < least.1 * WEAKEST_BRANCH {
            0.0
        } else {
            branch_share(from, to, self.constants.ratio)
        };
        // Computed from the differences, not as z'/z: the small change carries the information.
        let (dx, dy) = (to.x - from.x, to.y - from.y);
        let growth = branch_growth(share, dx + dy, plus, ln_1p)? - branch_growth(1.0 - share, dx - dy, minus, ln_1p)?;
        Some((growth * self.constants.inverse_omega, share))
    }

    /// Computes the growth of top/(a·bottom), for the parabola.
    #[inline(always)]
    fn quotient_growth(&self, bottom: f64, bottom_to: f64, top: f64, top_to: f64, a: f64) -> Option<(f64, f64)> {
        let seen = lesser(bottom.abs(), bottom_to.abs()) > self.floor_rad_s && bottom * bottom_to > 0.0;
        seen.then(|| ((top_to * bottom - top * bottom_to) / (a * bottom * bottom_to), 1.0))
    }

    /// Returns Δφ less the torque's contribution, and the torque's contribution to the slopes of the drift at the
    /// ends.
    fn undriven(&self, ends: [&Regressor; 2], share: f64, interval: &Interval, growth: f64) -> (f64, [f64; 2]) {
        let torque = &ends[0].torque;
        let gradients = ends.map(|end| self.gradient(end, share));
        let rough = growth - interval.length() * torque_share(gradients, torque);
        (growth - self.torque_growth(ends, share, interval, rough), ends.map(|end| self.push(end, torque)))
    }

    /// Computes a_k (u_i ω_j + u_j ω_i), rad/s³.
    #[inline]
    fn push(&self, end: &Regressor, torque: &[f64; 3]) -> f64 {
        self.a[2] * (torque[0] * end.j + torque[1] * end.i)
    }

    /// Computes (∂φ/∂ω_i, ∂φ/∂ω_j) at one instant, s.
    #[inline]
    fn gradient(&self, p: &Regressor, share: f64) -> [f64; 2] {
        let [ai, aj, _] = self.a;
        match self.conic {
            Conic::Elliptic { .. } => [p.y / p.square, -ai * p.i / p.square],
            Conic::Hyperbolic { omega } => {
                // A branch without a share may be zero.
                let over = |share: f64, z: f64| if share == 0.0 { 0.0 } else { share / z };
                let (plus, minus) = (over(share, p.x + p.y), over(1.0 - share, p.x - p.y));
                [plus - minus, (plus + minus) * ai / omega]
            }
            Conic::ParabolicFirst => [1.0 / (ai * p.j), -p.i / (ai * p.j * p.j)],
            Conic::ParabolicSecond => [-p.j / (aj * p.i * p.i), 1.0 / (aj * p.i)],
        }
    }

    /// Computes ∫(φ_i u_i + φ_j u_j) dt by Simpson's rule, with the middle of the path from its cubic Hermite
    /// interpolation.
    #[inline]
    fn torque_growth(&self, [from, to]: [&Regressor; 2], share: f64, interval: &Interval, rough: f64) -> f64 {
        let (dt_s, torque) = (interval.length(), from.torque);
        let hidden = hidden_at_ends(known_drift(from, to), interval, rough * interval.span.inverse());
        let velocity = |p: &Regressor, hidden: f64| {
            Vector2::new(self.a[0] * p.j * hidden + torque[0], self.a[1] * hidden * p.i + torque[1])
        };
        let turned = velocity(from, hidden[0]) - velocity(to, hidden[1]);
        let middle = 0.5 * Vector2::new(from.i + to.i, from.j + to.j) + dt_s / 8.0 * turned;
        let middle = self.gradient(&self.at(middle.into(), torque), share);
        let ends_mean = torque_share([self.gradient(from, share), self.gradient(to, share)], &torque);
        dt_s * (ends_mean + 2.0 * torque_share([middle; 2], &torque)) * (1.0 / 3.0)
    }

    /// Returns the increment with the covariance of its potential φ and its drift, from that of the measured pair.
    ///
    /// A sample enters the drift as the end of one step and as the start of the next, with half a step's weight each.
    fn noisy(&self, exact: Increment<1>, to: &Regressor, share: f64, variance: [f64; 2]) -> Increment<1> {
        let step = self.a[2] * exact.weight;
        let (phi, drift) = (self.gradient(to, share), [step * to.j, step * to.i]);
        let covariance = |x: [f64; 2], y: [f64; 2]| Vector1::new(x[0] * y[0] * variance[0] + x[1] * y[1] * variance[1]);
        Increment {
            variance: covariance(phi, phi),
            drift_variance: covariance(drift, drift),
            drift_covariance: covariance(phi, drift),
            ..exact
        }
    }
}

/// Returns true if a torque acts on the measured axes.
#[inline(always)]
fn driven(from: &Regressor) -> bool {
    // Compares all bits but the signs.
    (from.torque[0].to_bits() | from.torque[1].to_bits()) << 1 != 0
}

/// Creates the increment whose potential grew by `potential`.
#[inline(always)]
fn increment(from: &Regressor, to: &Regressor, push: [f64; 2], interval: &Interval, potential: f64) -> Increment<1> {
    let span = interval.span;
    let (drift, moment) = drift(from, to, push, interval, potential * span.inverse());
    Increment::exact(Vector1::new(potential), span, Vector1::new(drift), Vector1::new(moment))
}

/// Computes the mean over two instants of φ_i u_i + φ_j u_j, the rate at which the torque changes the potential.
#[inline]
fn torque_share(gradients: [[f64; 2]; 2], torque: &[f64; 3]) -> f64 {
    let rate = |g: [f64; 2]| g[0] * torque[0] + g[1] * torque[1];
    0.5 * (rate(gradients[0]) + rate(gradients[1]))
}

/// Computes g = a_k ω_i ω_j + u_k at the two ends of a step, rad/s².
#[inline(always)]
fn known_drift(from: &Regressor, to: &Regressor) -> [f64; 2] {
    [from.drift + from.torque[2], to.drift + from.torque[2]]
}

/// Computes the hidden component at the two ends from its mean over the step, for a linear drift g.
#[inline(always)]
fn hidden_at_ends(g: [f64; 2], interval: &Interval, mean: f64) -> [f64; 2] {
    let sixth = interval.sixth;
    [mean - sixth * (2.0 * g[0] + g[1]), mean + sixth * (g[0] + 2.0 * g[1])]
}

/// Computes ∫g and ∫∫g over a step. g is the cubic Hermite polynomial through both ends with the slopes ω_k · bend +
/// `push`; `mean` is the mean of ω_k.
#[inline(always)]
fn drift(from: &Regressor, to: &Regressor, push: [f64; 2], interval: &Interval, mean: f64) -> (f64, f64) {
    let [g0, g1] = known_drift(from, to);
    let hidden = hidden_at_ends([g0, g1], interval, mean);
    let (s0, s1) = (from.bend * hidden[0] + push[0], to.bend * hidden[1] + push[1]);
    let drift = interval.half * (g0 + g1) + interval.twelfth * (s0 - s1);
    let moment = &interval.moment;
    (drift, (moment[0] * g0 + moment[1] * g1) + (moment[2] * s0 - moment[3] * s1))
}

/// Computes the contribution of one branch of a hyperbola to Ω Δφ: `share` times the growth of ln z, where z at the
/// start of the step grows by `change`.
#[inline(always)]
fn branch_growth(share: f64, change: f64, z: f64, ln_1p: impl Fn(f64) -> Option<f64>) -> Option<f64> {
    if share == 0.0 {
        return Some(0.0);
    }
    let change = change / z;
    // z never changes its sign along a free motion; if noise changes it, the logarithm does not exist.
    if change > -1.0 { Some(share * ln_1p(change)?) } else { None }
}

/// Computes the share of the branch z₊ in φ for which a disturbed measurement changes φ least; the branch z₋ has the
/// rest. `ratio` is a_i/a_j.
///
/// As Ω vanishes, either branch alone loses all its digits, but their best mean loses none.
#[inline(always)]
fn branch_share(from: &Regressor, to: &Regressor, ratio: f64) -> f64 {
    let (x, y) = (from.x + to.x, from.y + to.y);
    (x + y) * (x + ratio * y) / (2.0 * (x * x + ratio * y * y))
}

#[cfg(test)]
mod tests {
    use super::super::InvariantFilter;
    use super::*;
    use crate::model::{Inertia, RigidBody};

    const RATE: f64 = 5.0;

    struct Run {
        body: RigidBody,
        relation: HiddenRate,
        filter: InvariantFilter<1>,
        axis: usize,
        rate: Vector3<f64>,
        torque: Vector3<f64>,
        unseen: usize,
    }

    impl Run {
        fn new(moments: [f64; 3], axis: usize, rate: [f64; 3]) -> Self {
            let body = RigidBody::new(&Inertia::new(moments).unwrap());
            let relation = HiddenRate::new(body.coefficients(), axis, 1e-6).unwrap();
            let filter = InvariantFilter::new(Vector1::new(RATE), Vector1::zeros());
            Self { body, relation, filter, axis, rate: rate.into(), torque: Vector3::zeros(), unseen: 0 }
        }

        fn error(&self) -> f64 {
            self.rate[self.axis - 1] - self.filter.estimate().x
        }

        fn sample(&self) -> RateSample {
            RateSample { rate_rad_s: self.rate, torque_rad_s2: self.torque }
        }

        fn step(&mut self, h: f64) {
            let from = self.relation.regressor(&self.sample());
            self.rate = self.body.flow(&self.rate, &self.torque, h);
            let to = self.relation.regressor(&self.sample());
            match self.relation.observe(&from, &to, h, self.filter.estimate().x) {
                Observation::Seen(increment) => self.filter.step(&increment),
                Observation::Unobservable { drift } => {
                    self.unseen += 1;
                    self.filter.predict(&drift);
                }
            }
        }

        fn floor(&mut self, h: f64, settle_s: f64, run_s: f64) -> f64 {
            let mut worst = 0.0_f64;
            for tick in 0..(run_s / h).round() as u64 {
                self.step(h);
                if tick as f64 * h > settle_s {
                    worst = worst.max(self.error().abs());
                }
            }
            worst
        }
    }

    #[test]
    fn every_axis_has_its_conic() {
        let conic = |moments, axis| {
            HiddenRate::new(&Inertia::new(moments).unwrap().coefficients(), axis, 1e-6).map(|relation| relation.conic())
        };
        assert!(matches!(conic([1.0, 2.0, 2.5], 3), Ok(Conic::Elliptic { .. })));
        assert!(matches!(conic([1.0, 2.0, 2.5], 1), Ok(Conic::Elliptic { .. })));
        assert!(matches!(conic([1.0, 2.0, 2.5], 2), Ok(Conic::Hyperbolic { .. })));
        assert_eq!(conic([2.0, 1.5, 2.0], 3), Ok(Conic::ParabolicFirst));
        assert_eq!(conic([1.5, 2.0, 2.0], 3), Ok(Conic::ParabolicFirst).and(conic([1.5, 2.0, 2.0], 3)));
        assert!(matches!(conic([1.0, 1.0, 1.6], 3), Ok(Conic::Elliptic { .. })), "hidden symmetry axis");
        assert_eq!(conic([1.0; 3], 3), Err(HiddenRateError::Sphere { axis: 3 }));
        assert_eq!(conic([1.0, 2.0, 2.5], 0), Err(HiddenRateError::NoSuchAxis { axis: 0 }));
        assert_eq!(conic([1.0, 2.0, 2.5], 4), Err(HiddenRateError::NoSuchAxis { axis: 4 }));
    }

    #[test]
    fn a_known_torque_does_not_raise_the_error_floor() {
        for (moments, axis) in [([1.0, 2.0, 2.5], 3), ([1.0, 2.5, 2.0], 3), ([2.0, 1.5, 2.0], 3), ([2.0, 2.0, 1.5], 1)]
        {
            let mut run = Run::new(moments, axis, [0.9, 0.7, 0.8]);
            run.torque = Vector3::new(0.02, 0.05, -0.03);
            let floor = run.floor(1e-3, 8.0, 10.0);
            assert!(floor < 1e-11, "{moments:?} axis {axis}: {floor:e}");
        }
    }

    #[test]
    fn nearly_equal_moments_lose_only_the_digits_that_rounding_explains() {
        let start = [0.6, -0.4, 0.8];
        for exponent in [4, 6, 8, 10, 12] {
            let d = 10.0_f64.powi(-exponent);
            for (moments, axis) in
                [([1.0, 1.0 + d, 1.0 + 2.0 * d], 1), ([1.0, 1.0, 1.0 + d], 2), ([1.0, 1.0 + d, 1.6], 3)]
            {
                let mut run = Run::new(moments, axis, start);
                let (floor, bound) = (run.floor(1e-3, 8.0, 9.0), run.relation.rounding_rad_s(&start.into(), 1e-3));
                assert!(floor < 10.0 * bound + 1e-11, "{moments:?} axis {axis}: {floor:e}, explained {bound:e}");
                assert!(axis == 3 || floor > 1e-3 * bound, "{moments:?} axis {axis}: {floor:e}, explained {bound:e}");
            }
        }
        let symmetric = |moments, axis| HiddenRate::new(&Inertia::new(moments).unwrap().coefficients(), axis, 1e-6);
        assert!(symmetric([1.0, 1.0, 1.6], 1).unwrap().rounding_rad_s(&start.into(), 1e-3) < 1e-12, "axisymmetric");
    }

    #[test]
    fn the_fast_path_is_bit_identical() {
        for (moments, axis) in [([1.0, 2.0, 2.5], 3), ([1.0, 2.5, 2.0], 3), ([2.0, 1.5, 2.0], 3), ([2.0, 2.0, 1.5], 1)]
        {
            let mut run = Run::new(moments, axis, [0.9, 0.7, 0.8]);
            let (mut short, mut usual) = (run.filter, 0);
            let interval = Interval::from(1e-3);
            for _ in 0..3000 {
                let from = run.relation.regressor(&run.sample());
                run.step(1e-3);
                let to = run.relation.regressor(&run.sample());
                let estimate = short.estimate().x;
                match run.relation.fast_step([&from, &to], &interval, estimate, &mut short) {
                    Some((estimate, _)) => {
                        usual += 1;
                        assert_eq!(estimate.to_bits(), run.filter.estimate().x.to_bits(), "{moments:?} {axis}");
                    }
                    None => short = run.filter,
                }
            }
            assert!(usual > 2990, "{moments:?} {axis}: {usual}");
        }
    }

    #[test]
    fn an_unobservable_motion_is_held_and_flagged() {
        let mut run = Run::new([1.0, 2.0, 2.5], 3, [0.0, 0.0, 0.8]);
        run.filter = InvariantFilter::new(Vector1::new(RATE), Vector1::new(0.3));
        run.step(1e-3);
        assert_eq!((run.unseen, run.filter.estimate().x), (1, 0.3));
    }

    #[test]
    fn a_step_too_long_for_the_phase_is_unobservable() {
        let mut run = Run::new([1.0, 2.0, 2.5], 3, [0.6, -0.4, 0.8]);
        run.filter = InvariantFilter::new(Vector1::new(RATE), Vector1::new(0.8));
        let limit = run.relation.longest_step_s(0.8);
        run.step(limit * 1.01);
        assert_eq!(run.unseen, 1);
        assert!(run.error().is_finite());
    }
}

//! The physical limits of this rig's bodies, and the guards that check samples against them.
//!
//! Limits do not depend on unknowns: those of an observer that learns the inertia hold for every inertia.

use crate::config::Checks;
use crate::model::RigidBody;
use crate::rate::ALL;
use crate::rig::contract::Figure;
use crate::rig::filter::SURE_DEVIATIONS;
use crate::role::{Bounds, Guard, MotionCheck, PlausibilityCheck, Refusal};
use crate::sample::{RateCommand, RateEstimate, RateMeasurement, Sample, status};
use crate::state::persist_fields;
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

/// The largest turn of a body in one tick, rad. A half turn is indistinguishable from the opposite one.
pub(super) const MAX_TURN_RAD: f64 = 3.0;
/// The factor from what the initial rates permit to the default rate limit.
const RATE_MARGIN: f64 = 2.0;

/// The table `[limits]` as typed.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct RawLimits {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rate_rad_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub acceleration_rad_s2: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub repeats: Option<u64>,
}

impl RawLimits {
    pub fn is_default(&self) -> bool {
        self.rate_rad_s.is_none() && self.acceleration_rad_s2.is_none() && self.repeats.is_none()
    }
}

/// The quantities that determine the default limits.
#[derive(Debug, Clone, Copy)]
pub(super) struct Circumstances {
    /// The bound M on the leader's rate, rad/s.
    pub leader_rad_s: f64,
    /// The fastest initial rate of a follower, rad/s.
    pub follower_rad_s: f64,
    /// The error of the first guess of the hidden rate, rad/s. The law first drives a follower off by this much.
    pub guess_error_rad_s: f64,
    /// The largest error of an estimate before it settles, rad/s.
    pub transient_rad_s: f64,
    /// The rate at which the observer corrects an estimate, 1/s; +inf if it is not bounded.
    pub correction_per_s: f64,
    /// The largest gain of the law, 1/s.
    pub gain_per_s: f64,
}

/// The limits as resolved. They hold for each component.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Limits {
    pub rate_rad_s: f64,
    pub estimate_rad_s: f64,
    pub acceleration_rad_s2: f64,
    correction_per_s: f64,
    repeats: u64,
}

impl Limits {
    /// Returns the given limits, or defaults.
    ///
    /// The default acceleration is the largest that the law can command for inputs within the other limits; the coefficients of a
    /// body are at most 1.
    pub fn resolve(raw: &RawLimits, about: &Circumstances, checks: &mut Checks<'_>) -> Self {
        for (key, value) in
            [("limits.rate_rad_s", raw.rate_rad_s), ("limits.acceleration_rad_s2", raw.acceleration_rad_s2)]
        {
            value.iter().for_each(|value| checks.positive(key, *value));
        }
        let fastest_rad_s = about.leader_rad_s.max(about.follower_rad_s);
        if let Some(rate_rad_s) = raw.rate_rad_s {
            checks.require(rate_rad_s > fastest_rad_s, "limits.rate_rad_s", "limit-too-low", || {
                format!("{rate_rad_s} is not above the {fastest_rad_s:.3} rad/s that a body may turn at; raise it")
            });
        }
        let default_rad_s = RATE_MARGIN * (about.leader_rad_s + about.follower_rad_s + about.guess_error_rad_s);
        let rate_rad_s = raw.rate_rad_s.unwrap_or(default_rad_s.max(f64::MIN_POSITIVE));
        let estimate_rad_s = rate_rad_s + about.transient_rad_s;
        let demand = about.gain_per_s * (estimate_rad_s + rate_rad_s)
            + estimate_rad_s * estimate_rad_s
            + rate_rad_s * rate_rad_s;
        Self {
            rate_rad_s,
            estimate_rad_s,
            acceleration_rad_s2: raw.acceleration_rad_s2.unwrap_or(demand),
            correction_per_s: about.correction_per_s,
            repeats: raw.repeats.unwrap_or(u64::MAX),
        }
    }

    /// Returns the limits as figures for reports.
    pub fn figures(&self) -> Vec<Figure> {
        let figure = |name: &str, value| Figure { name: name.to_owned(), value };
        vec![
            figure("largest |rate| of a component, rad/s", self.rate_rad_s),
            figure("largest |estimate| of a component, rad/s", self.estimate_rad_s),
            figure("largest |acceleration| of a component that is asked for, rad/s^2", self.acceleration_rad_s2),
        ]
    }

    /// Creates a guard for a body's measurements. A measurement without all components in `needed` is rejected.
    pub fn measurement(&self, body: &Sensed, tick_s: f64, needed: u64) -> MeasurementGuard {
        MeasurementGuard {
            rate: PlausibilityCheck::new(self.bounds(body, tick_s)),
            pursuit: MotionCheck::default(),
            motion: body.motion(tick_s),
            acceleration_rad_s2: self.acceleration_rad_s2,
            needed,
        }
    }

    /// Returns the bounds of a body's measured rates.
    pub fn bounds(&self, body: &Sensed, tick_s: f64) -> Bounds<3> {
        let free = body.recorded_rad_s2.unwrap_or(body.coefficients * (self.rate_rad_s * self.rate_rad_s));
        let driven = if body.driven.is_some() {
            body.factor.map(|factor| self.acceleration_rad_s2 / factor)
        } else {
            Vector3::zeros()
        };
        let spread = body.deviation * SURE_DEVIATIONS;
        let rounding = Vector3::repeat(8.0 * f64::EPSILON * self.rate_rad_s);
        Bounds {
            magnitude: (Vector3::repeat(self.rate_rad_s) + body.bias.abs() + spread).into(),
            slew_per_tick: ((free + driven) * tick_s).into(),
            allowance: (spread * 2.0 + rounding).into(),
            repeats: self.repeats,
        }
    }

    /// Creates a guard for estimates of a body whose |a| are at most `coefficients`, computed at every n-th tick.
    pub fn estimate(&self, coefficients: &Vector3<f64>, tick_s: f64, every_ticks: u64) -> EstimateGuard {
        let free = coefficients * (self.estimate_rad_s * self.estimate_rad_s);
        let corrected = Vector3::repeat(self.correction_per_s * 2.0 * self.estimate_rad_s);
        let bounds = Bounds {
            magnitude: [self.estimate_rad_s; 3],
            slew_per_tick: ((free + corrected) * (tick_s * every_ticks as f64)).into(),
            allowance: [0.0; 3],
            repeats: self.repeats.saturating_mul(every_ticks),
        };
        EstimateGuard { rate: PlausibilityCheck::new(bounds) }
    }

    /// Creates a guard for commands.
    pub fn command(&self) -> CommandGuard {
        CommandGuard { acceleration_rad_s2: self.acceleration_rad_s2 }
    }
}

/// The properties of a body that its measurements show.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sensed {
    /// The bounds on |a| of \[D\](2).
    pub coefficients: Vector3<f64>,
    /// The inertia over the nominal one.
    pub factor: Vector3<f64>,
    /// The dynamics of a driven body; `None` if the body is free, since its energy then bounds its rate.
    pub driven: Option<RigidBody>,
    /// The standard deviation and bias of its sensors, rad/s.
    pub deviation: Vector3<f64>,
    pub bias: Vector3<f64>,
    /// Bounds on the angular acceleration of a motion that is played back, rad/s².
    pub recorded_rad_s2: Option<Vector3<f64>>,
}

impl Sensed {
    pub fn motion(&self, tick_s: f64) -> Option<Motion> {
        self.driven.map(|body| Motion { body, factor: self.factor, tick_s })
    }
}

/// The motion of a driven body over one tick.
#[derive(Debug, Clone, Copy)]
pub(super) struct Motion {
    body: RigidBody,
    factor: Vector3<f64>,
    tick_s: f64,
}

impl Motion {
    /// Returns true if a sample beyond the range, or after such a sample, is accepted: the body moves by Euler's equations under the
    /// applied input. A body that turns too far in a tick to be distinguished from its mirror image is never accepted.
    pub fn follows(
        &self,
        pursuit: &mut MotionCheck<3>,
        tick: u64,
        rate: &[f64; 3],
        applied: &[f64; 3],
        bounds: &Bounds<3>,
    ) -> bool {
        if !within(rate, MAX_TURN_RAD / self.tick_s) {
            pursuit.stop();
            return false;
        }
        pursuit.is_consistent(tick, rate, &bounds.allowance, |from| self.flow(from, applied))
    }

    fn flow(&self, from: &[f64; 3], applied: &[f64; 3]) -> [f64; 3] {
        let applied = Vector3::from(*applied).component_div(&self.factor);
        self.body.flow(&Vector3::from(*from), &applied, self.tick_s).into()
    }
}

/// A guard of measurements: range, and the rates of change that Euler's equations and the actuators permit. A driven body
/// beyond its range is accepted after some samples of motion by its equations.
#[derive(Debug)]
pub struct MeasurementGuard {
    rate: PlausibilityCheck<3>,
    pursuit: MotionCheck<3>,
    motion: Option<Motion>,
    acceleration_rad_s2: f64,
    needed: u64,
}

persist_fields!(MeasurementGuard, rate, pursuit);

impl MeasurementGuard {
    /// Checks the rates of a sample in which a field repeats an earlier value.
    #[cold]
    fn accepts_held(&mut self, sample: &RateMeasurement) -> bool {
        if !sample.holds("omega_rad_s") {
            return self.accepts_new(sample);
        }
        if let (true, Some(motion)) = (self.pursuit.active(), self.motion) {
            return self.pursuit.coast(sample.stamp.tick, |from| motion.flow(from, &sample.applied_rad_s2));
        }
        let change = |bounds: &Bounds<3>, i: usize, _: &[f64; 3], ticks: f64| bounds.slew_per_tick[i] * ticks;
        self.rate.accepts_held(&sample.stamp, &sample.omega_rad_s, (sample.valid, ALL), change)
    }

    #[inline]
    fn accepts_new(&mut self, sample: &RateMeasurement) -> bool {
        if self.rate.accepts(&sample.stamp, &sample.omega_rad_s, sample.valid) {
            self.pursuit.stop();
            true
        } else {
            (self.pursuit.active() || !self.rate.contains(&sample.omega_rad_s)) && self.follows(sample)
        }
    }

    /// Checks a sample that is out of range, or follows such a sample.
    #[cold]
    fn follows(&mut self, sample: &RateMeasurement) -> bool {
        let (Some(motion), ALL) = (self.motion, sample.valid) else { return false };
        let (rate, tick) = (&sample.omega_rad_s, sample.stamp.tick);
        let follows = motion.follows(&mut self.pursuit, tick, rate, &sample.applied_rad_s2, self.rate.bounds());
        if follows {
            self.rate.record_accepted(&sample.stamp, rate, ALL);
        }
        follows
    }
}

impl Guard<RateMeasurement> for MeasurementGuard {
    #[inline]
    fn accepts(&mut self, sample: &RateMeasurement) -> bool {
        sample.valid & self.needed == self.needed
            && within(&sample.applied_rad_s2, self.acceleration_rad_s2)
            && if sample.is_held() { self.accepts_held(sample) } else { self.accepts_new(sample) }
    }

    fn refusal(&self, sample: &RateMeasurement) -> Refusal {
        if sample.valid & self.needed != self.needed {
            Refusal::Incomplete
        } else if !within(&sample.applied_rad_s2, self.acceleration_rad_s2) {
            Refusal::of_values(&sample.applied_rad_s2)
        } else {
            self.rate.refusal()
        }
    }
}

/// A guard of estimates: range, the rates of change that the body and the observer's correction permit, and that an invalid
/// component is marked as a guess. The rate of change is bounded only for a first-order filter on noise-free sensors.
#[derive(Debug)]
pub struct EstimateGuard {
    rate: PlausibilityCheck<3>,
}

persist_fields!(EstimateGuard, rate);

impl Guard<RateEstimate> for EstimateGuard {
    #[inline]
    fn accepts(&mut self, sample: &RateEstimate) -> bool {
        let complete = sample.valid & ALL == ALL || sample.status & (status::INITIAL | status::DEGRADED) != 0;
        complete
            && within(&sample.coefficients, f64::MAX)
            && sample.innovation_rad_s.is_finite()
            && self.rate.accepts(&sample.stamp, &sample.omega_rad_s, ALL)
    }

    fn refusal(&self, sample: &RateEstimate) -> Refusal {
        if sample.valid & ALL != ALL && sample.status & (status::INITIAL | status::DEGRADED) == 0 {
            Refusal::Incomplete
        } else if !(within(&sample.coefficients, f64::MAX) && sample.innovation_rad_s.is_finite()) {
            Refusal::NotFinite
        } else {
            self.rate.refusal()
        }
    }
}

/// A guard of commands: the actuators can apply what is commanded.
#[derive(Debug)]
pub struct CommandGuard {
    acceleration_rad_s2: f64,
}

persist_fields!(CommandGuard,);

impl Guard<RateCommand> for CommandGuard {
    #[inline]
    fn accepts(&mut self, sample: &RateCommand) -> bool {
        within(&sample.acceleration_rad_s2, self.acceleration_rad_s2)
    }

    fn refusal(&self, sample: &RateCommand) -> Refusal {
        Refusal::of_values(&sample.acceleration_rad_s2)
    }
}

/// Returns true if all components are at most `limit` in magnitude. NaN is not.
#[inline]
fn within(values: &[f64; 3], limit: f64) -> bool {
    values.iter().all(|value| value.abs() <= limit)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::role::SUSPECT_SAMPLES;
    use crate::sample::Stamp;

    const LIMITS: Limits = Limits {
        rate_rad_s: 2.0,
        estimate_rad_s: 3.0,
        acceleration_rad_s2: 8.0,
        correction_per_s: f64::INFINITY,
        repeats: u64::MAX,
    };

    fn sensed(driven: bool) -> Sensed {
        let zero = Vector3::zeros();
        let driven = driven.then(|| RigidBody::with_coefficients(Vector3::new(-0.5, 0.5, 0.2)));
        Sensed {
            coefficients: Vector3::repeat(0.5),
            factor: Vector3::repeat(2.0),
            driven,
            deviation: zero,
            bias: zero,
            recorded_rad_s2: None,
        }
    }

    fn measurement(tick: u64, rate: f64) -> RateMeasurement {
        let stamp = Stamp { tick, generation: 1, ..Stamp::default() };
        RateMeasurement { stamp, omega_rad_s: [rate; 3], valid: ALL, ..RateMeasurement::default() }
    }

    #[test]
    fn dynamics_and_actuators_bound_the_rate_of_change() {
        for (driven, slew) in [(false, 0.5 * 4.0), (true, 0.5 * 4.0 + 8.0 / 2.0)] {
            let mut guard = LIMITS.measurement(&sensed(driven), 1e-3, ALL);
            assert!(guard.accepts(&measurement(0, 1.0)));
            assert!(!guard.accepts(&measurement(1, 1.0 + 1.01e-3 * slew)));
            assert!(guard.accepts(&measurement(1, 1.0 + 0.99e-3 * slew)));
        }
    }

    /// Returns the accepted ticks of a body that a constant command drives beyond its range, as seen by its sensor `seen`.
    fn accepted(seen: impl Fn(u64, Vector3<f64>) -> Vector3<f64>) -> Vec<u64> {
        let (sensed, applied) = (sensed(true), Vector3::new(4.0, -2.0, 1.0));
        let (body, mut rate) = (sensed.driven.unwrap(), Vector3::new(2.5, -1.0, 1.5));
        let mut guard = LIMITS.measurement(&sensed, 1e-3, ALL);
        assert!(guard.accepts(&measurement(0, 1.0)));
        let accepts = |tick: &u64| {
            let mut sample = measurement(*tick, 0.0);
            (sample.omega_rad_s, sample.applied_rad_s2) = (seen(*tick, rate).into(), applied.into());
            rate = body.flow(&rate, &applied.component_div(&sensed.factor), 1e-3);
            guard.accepts(&sample)
        };
        (1..100).filter(accepts).collect()
    }

    #[test]
    fn a_body_that_moves_beyond_its_range_by_its_equations_is_accepted_after_a_few_samples() {
        assert_eq!(accepted(|_, rate| rate), (1 + SUSPECT_SAMPLES..100).collect::<Vec<_>>());
    }

    #[test]
    fn a_faulty_sensor_beyond_the_range_is_rejected() {
        const NEVER: [u64; 0] = [];
        let stuck = Vector3::new(2.5, -1.0, 1.5);
        assert_eq!(accepted(|_, _| stuck), NEVER);
        assert_eq!(accepted(|_, rate| 1.5 * rate), NEVER);
        assert_eq!(accepted(|_, rate| rate + Vector3::new(50.0, 0.0, 0.0)), NEVER);
        assert_eq!(accepted(|tick, rate| if tick % 5 == 0 { 3.0 * rate } else { rate }), NEVER);
        assert_eq!(accepted(|_, _| Vector3::repeat(f64::MAX)), NEVER);
        let then_stuck = accepted(|tick, rate| if tick < 30 { rate } else { stuck });
        assert_eq!(then_stuck, (1 + SUSPECT_SAMPLES..30).collect::<Vec<_>>());
    }

    #[test]
    fn a_measurement_without_a_needed_component_is_rejected() {
        let incomplete = RateMeasurement { valid: 0b011, ..measurement(0, 1.0) };
        assert!(LIMITS.measurement(&sensed(false), 1e-3, 0b011).accepts(&incomplete));
        assert!(!LIMITS.measurement(&sensed(false), 1e-3, ALL).accepts(&incomplete));
    }

    #[test]
    fn an_incomplete_estimate_is_accepted_only_with_its_reason() {
        let estimate = |valid, status| RateEstimate { valid, status, ..RateEstimate::default() };
        let mut guard = LIMITS.estimate(&Vector3::repeat(1.0), 1e-3, 1);
        assert!(guard.accepts(&estimate(ALL, 0)) && guard.accepts(&estimate(0b011, status::INITIAL)));
        assert!(!guard.accepts(&estimate(0b011, 0)));
        assert!(!guard.accepts(&RateEstimate { omega_rad_s: [0.0, 3.1, 0.0], ..estimate(ALL, 0) }));
        assert!(!guard.accepts(&RateEstimate { coefficients: [0.0, f64::NAN, 0.0], ..estimate(ALL, 0) }));
    }

    #[test]
    fn body_and_correction_bound_the_rate_of_change_of_a_noise_free_estimate() {
        let limits = Limits { correction_per_s: 6.0, ..LIMITS };
        let slew = 0.5 * 9.0 + 6.0 * 6.0;
        let estimate = |tick, rate| {
            let stamp = Stamp { tick, generation: 1, ..Stamp::default() };
            RateEstimate { stamp, omega_rad_s: [rate; 3], valid: ALL, ..RateEstimate::default() }
        };
        let mut guard = limits.estimate(&Vector3::repeat(0.5), 1e-3, 1);
        assert!(guard.accepts(&estimate(0, 0.0)) && !guard.accepts(&estimate(1, 1.01e-3 * slew)));
        assert!(guard.accepts(&estimate(1, 0.99e-3 * slew)));
        let mut loose = LIMITS.estimate(&Vector3::repeat(0.5), 1e-3, 1);
        assert!(loose.accepts(&estimate(0, 0.0)) && loose.accepts(&estimate(1, 3.0)));
    }

    #[test]
    fn a_command_beyond_the_actuators_is_rejected() {
        let command = |value| RateCommand { acceleration_rad_s2: [0.0, value, 0.0], ..RateCommand::default() };
        let mut guard = LIMITS.command();
        assert!(guard.accepts(&command(-8.0)));
        assert!(!guard.accepts(&command(8.1)) && !guard.accepts(&command(f64::NAN)));
    }
}

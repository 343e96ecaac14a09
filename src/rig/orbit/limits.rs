//! What bodies of the orbit rigs can do at the most, and the guards that hold samples against it.
//!
//! Must not refuse what the model itself holds possible: the region between central body and escape.

use super::roles::{POSITION, VELOCITY};
use crate::config::{Checks, finite_positive};
use crate::model::{CentralField, OrbitState};
use crate::rig::{Figure, rigid_body::SURE_DEVIATIONS};
use crate::role::Guard;
use crate::sample::{OrbitCommand, OrbitEstimate, OrbitMeasurement, status};
use nalgebra::Vector4;
use serde::{Deserialize, Serialize};

/// A default speed limit lies so far above what the initial orbits reach.
const SPEED_MARGIN: f64 = 3.0;
/// Rounding of a limit that is itself a permitted value.
const ROUNDING: f64 = 1e-12;

/// The table `[limits]` as typed.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct RawLimits {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub speed_du_s: Option<f64>,
}

impl RawLimits {
    pub fn is_default(&self) -> bool {
        self.speed_du_s.is_none()
    }
}

/// The limits as resolved.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Limits {
    field: CentralField,
    pub speed_du_s: f64,
    /// How far a velocity estimate may err before it settles, du/s.
    pub transient_du_s: f64,
    pub thrust_du_s2: f64,
    tick_s: f64,
}

impl Limits {
    /// The speed given, or well above that of the initial orbits where they are fastest and of the target circle.
    pub fn resolve(
        raw: &RawLimits,
        field: CentralField,
        states: &[OrbitState],
        target: Option<f64>,
        checks: &mut Checks<'_>,
    ) -> f64 {
        let speed = |state: &OrbitState| state.vr.hypot(state.vtheta);
        let pericentre = |state: &OrbitState| {
            let r = field.pericentre(state);
            let r = if field.holds(r) { r } else { state.r };
            (2.0 * (field.energy(state) + field.mu() / r)).max(0.0).sqrt()
        };
        let circle = target.map_or(0.0, |radius| field.circular_velocity(radius));
        let initial = states.iter().map(speed).fold(0.0, f64::max);
        if let Some(limit) = raw.speed_du_s {
            finite_positive(checks, "limits.speed_du_s", limit);
            checks.require(limit > initial.max(circle), "limits.speed_du_s", || {
                format!(
                    "{limit} is not above the {:.3} du/s that a body has or is to have; raise it",
                    initial.max(circle)
                )
            });
        }
        let fastest = states.iter().map(pericentre).fold(initial.max(circle), f64::max);
        raw.speed_du_s.unwrap_or(SPEED_MARGIN * fastest)
    }

    pub fn new(field: CentralField, speed_du_s: f64, transient_du_s: f64, thrust_du_s2: f64, tick_s: f64) -> Self {
        Self { field, speed_du_s, transient_du_s, thrust_du_s2, tick_s }
    }

    /// For people.
    pub fn figures(&self) -> Vec<Figure> {
        let figure = |name: &str, value| Figure { name: name.to_owned(), value };
        vec![
            figure("largest |component| of a velocity, du/s", self.speed_du_s),
            figure("largest |component| of a velocity estimate, du/s", self.speed_du_s + self.transient_du_s),
            figure("largest |component| of a thrust, du/s^2", self.thrust_du_s2),
        ]
    }

    /// A guard for measurements with sensors of these standard deviations and biases of (r, θ, Vr, Vθ).
    pub fn measurement(&self, deviation: [f64; 4], bias: [f64; 4], needed: u64) -> MeasurementGuard {
        let spread = Vector4::from(deviation) * SURE_DEVIATIONS;
        MeasurementGuard {
            limits: *self,
            spread,
            offset: Vector4::from(bias).abs() + spread,
            needed,
            generation: 0,
            last: None,
        }
    }

    /// A guard for estimates, whose radius is as measured with this standard deviation and bias.
    pub fn estimate(&self, deviation: [f64; 4], bias: [f64; 4]) -> EstimateGuard {
        EstimateGuard { limits: *self, radius_offset: bias[0].abs() + SURE_DEVIATIONS * deviation[0] }
    }

    /// A guard for commands.
    pub fn command(&self) -> CommandGuard {
        CommandGuard { thrust_du_s2: self.thrust_du_s2 * (1.0 + ROUNDING) }
    }

    fn radius_possible(&self, r: f64, offset: f64) -> bool {
        let slack = offset + ROUNDING * r;
        self.field.holds(r + slack) || self.field.holds(r - slack) || self.field.holds(r)
    }
}

/// Guards measurements: the region, the speed, and how fast gravity and thrust let them change from where the body was.
#[derive(Debug)]
pub struct MeasurementGuard {
    limits: Limits,
    spread: Vector4<f64>,
    offset: Vector4<f64>,
    needed: u64,
    generation: u64,
    /// The last measurement that was believed, its tick, and whether it has a velocity.
    last: Option<(Vector4<f64>, u64, bool)>,
}

impl MeasurementGuard {
    #[inline]
    fn in_range(&self, x: &Vector4<f64>, moving: bool) -> bool {
        let speed = self.limits.speed_du_s;
        let velocity = |i: usize| !moving || x[i].abs() <= speed + self.offset[i];
        self.limits.radius_possible(x[0], self.offset[0]) && x[1].is_finite() && velocity(2) && velocity(3)
    }

    /// Whether a body that was at `from` can be at `to` after `ticks` ticks.
    #[inline]
    fn reachable(&self, from: &Vector4<f64>, to: &Vector4<f64>, ticks: u64, moving: bool) -> bool {
        let Limits { field, speed_du_s: speed, thrust_du_s2: thrust, tick_s, .. } = &self.limits;
        let time = ticks as f64 * tick_s;
        // The nearest that it can have come to the centre meanwhile.
        let r = (from[0] - self.offset[0] - speed * time).max(field.inner());
        let acceleration = field.mu() / (r * r) + 2.0 * speed * speed / r + thrust;
        let change = [speed * time, speed * time / r, acceleration * time, acceleration * time];
        let allowed = |i: usize| {
            let slack = 2.0 * self.spread[i] + ROUNDING * (1.0 + to[i].abs());
            (to[i] - from[i]).abs() <= change[i] + slack
        };
        (0..if moving { 4 } else { 2 }).all(allowed)
    }
}

impl Guard<OrbitMeasurement> for MeasurementGuard {
    #[inline]
    fn accepts(&mut self, sample: &OrbitMeasurement) -> bool {
        if sample.stamp.generation != self.generation {
            (self.generation, self.last) = (sample.stamp.generation, None);
        }
        let [vr, vtheta] = sample.velocity_du_s;
        let (x, moving) =
            (Vector4::new(sample.radius_du, sample.angle_rad, vr, vtheta), sample.valid & VELOCITY == VELOCITY);
        let complete = sample.valid & self.needed == self.needed;
        // Without a position there is nothing to check: the observer says itself that it cannot use it.
        if complete && sample.valid & POSITION != POSITION {
            return true;
        }
        let believed = complete
            && sample.applied_du_s2.iter().all(|thrust| thrust.abs() <= self.limits.thrust_du_s2 * (1.0 + ROUNDING))
            && self.in_range(&x, moving)
            && self.last.is_none_or(|(last, tick, moved)| {
                self.reachable(&last, &x, sample.stamp.tick.saturating_sub(tick), moving && moved)
            });
        if believed {
            self.last = Some((x, sample.stamp.tick, moving));
        }
        believed
    }
}

/// Guards estimates: the region, the speed, and that components which are not valid are said to be guesses.
#[derive(Debug)]
pub struct EstimateGuard {
    limits: Limits,
    radius_offset: f64,
}

impl Guard<OrbitEstimate> for EstimateGuard {
    #[inline]
    fn accepts(&mut self, sample: &OrbitEstimate) -> bool {
        let speed = self.limits.speed_du_s + self.limits.transient_du_s;
        let all = POSITION | VELOCITY;
        let told = sample.valid & all == all || sample.status & status::INITIAL != 0;
        let placed =
            sample.valid & POSITION != POSITION || self.limits.radius_possible(sample.radius_du, self.radius_offset);
        let [vr, vtheta] = sample.velocity_du_s;
        told && placed && sample.angle_rad.is_finite() && vr.abs() <= speed && vtheta.abs() <= speed
    }
}

/// Guards commands: the thrusters can do what is asked.
#[derive(Debug)]
pub struct CommandGuard {
    thrust_du_s2: f64,
}

impl Guard<OrbitCommand> for CommandGuard {
    #[inline]
    fn accepts(&mut self, sample: &OrbitCommand) -> bool {
        sample.thrust_du_s2.iter().all(|thrust| thrust.abs() <= self.thrust_du_s2)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sample::Stamp;

    fn limits() -> Limits {
        Limits::new(CentralField::new(1.0, 0.05, 10.0).unwrap(), 2.0, 1.0, 0.5, 1e-3)
    }

    fn at(tick: u64, radius_du: f64, angle_rad: f64, velocity: f64) -> OrbitMeasurement {
        let stamp = Stamp { tick, generation: 1, ..Stamp::default() };
        let valid = POSITION | VELOCITY;
        OrbitMeasurement {
            stamp,
            radius_du,
            angle_rad,
            velocity_du_s: [velocity; 2],
            valid,
            ..OrbitMeasurement::default()
        }
    }

    fn guard() -> MeasurementGuard {
        limits().measurement([0.0; 4], [0.0; 4], POSITION)
    }

    #[test]
    fn outside_the_region_nobody_is() {
        for r in [f64::NAN, 0.0, -1.0, 0.04, 10.1, f64::INFINITY] {
            assert!(!guard().accepts(&at(0, r, 0.0, 0.9)), "{r}");
        }
        for sample in [at(0, 1.0, f64::NAN, 0.9), at(0, 1.0, 0.0, 2.1), at(0, 1.0, 0.0, f64::NAN)] {
            assert!(!guard().accepts(&sample), "{sample:?}");
        }
        assert!(guard().accepts(&at(0, 1.0, 1e9, 0.9)), "an angle may be any");
    }

    #[test]
    fn nobody_jumps_and_everybody_gets_there_in_time() {
        for (jump, first) in [((1.5, 0.0, 0.9), 250), ((1.0, 0.5, 0.9), 200), ((1.0, 0.0, 1.8), 60)] {
            let (mut guard, (r, angle, velocity)) = (guard(), jump);
            assert!(guard.accepts(&at(0, 1.0, 0.0, 0.9)));
            let seen = (1..1000).find(|tick| guard.accepts(&at(*tick, r, angle, velocity))).unwrap();
            assert!((first - 60..=first + 60).contains(&seen), "{jump:?} at {seen}");
        }
        let mut calm = guard();
        assert!((0..100).all(|tick| calm.accepts(&at(tick, 1.0 + 0.9e-3 * tick as f64, 1e-3 * tick as f64, 0.9))));
    }

    #[test]
    fn what_the_thrusters_cannot_do_is_neither_applied_nor_reported() {
        let command = |thrust| OrbitCommand { thrust_du_s2: [0.0, thrust], ..OrbitCommand::default() };
        assert!(limits().command().accepts(&command(-0.5)) && !limits().command().accepts(&command(0.51)));
        assert!(!guard().accepts(&OrbitMeasurement { applied_du_s2: [0.0, 0.51], ..at(0, 1.0, 0.0, 0.9) }));
    }

    #[test]
    fn an_estimate_that_lacks_a_component_says_why_or_is_not_believed() {
        let estimate = |valid, status| OrbitEstimate { radius_du: 1.0, valid, status, ..OrbitEstimate::default() };
        let mut guard = limits().estimate([0.0; 4], [0.0; 4]);
        assert!(
            guard.accepts(&estimate(POSITION | VELOCITY, 0)) && guard.accepts(&estimate(POSITION, status::INITIAL))
        );
        assert!(guard.accepts(&OrbitEstimate { status: status::INITIAL, ..OrbitEstimate::default() }));
        assert!(!guard.accepts(&estimate(POSITION, 0)) && !guard.accepts(&estimate(VELOCITY | 1, 0)));
    }
}

//! What bodies of the orbit rigs can do at the most, and the guards that hold samples against it.
//!
//! Must not refuse what the model itself holds possible: the region between central body and escape.

use super::roles::{POSITION, VELOCITY};
use crate::config::Checks;
use crate::model::{CentralField, OrbitState};
use crate::rig::Figure;
use crate::rig::filter::SURE_DEVIATIONS;
use crate::role::{Bounds, Guard, PlausibilityCheck, Refusal};
use crate::sample::{OrbitCommand, OrbitEstimate, OrbitMeasurement, status};
use crate::state::persist_fields;
use nalgebra::Vector4;
use serde::{Deserialize, Serialize};

/// A default speed limit lies so far above what the initial orbits reach.
const SPEED_MARGIN: f64 = 3.0;
/// And above the speed of a fall to the central body.
const FALL_MARGIN: f64 = 1.5;
/// Rounding of a limit that is itself a permitted value.
const ROUNDING: f64 = 1e-12;

/// The table `[limits]` as typed.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct RawLimits {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub speed_du_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub repeats: Option<u64>,
}

impl RawLimits {
    pub fn is_default(&self) -> bool {
        self.speed_du_s.is_none() && self.repeats.is_none()
    }
}

/// The limits as resolved.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Limits {
    pub field: CentralField,
    pub speed_du_s: f64,
    /// How far a velocity estimate may err before it settles, du/s.
    pub transient_du_s: f64,
    pub thrust_du_s2: f64,
    pub tick_s: f64,
    /// So often a measurement may repeat the one before to the last bit.
    pub repeats: u64,
}

impl Limits {
    /// The speed given, or well above that of the initial orbits where they are fastest, of the target circle, and of a fall
    /// to the central body.
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
            checks.positive("limits.speed_du_s", limit);
            checks.require(limit > initial.max(circle), "limits.speed_du_s", "limit-too-low", || {
                format!(
                    "{limit} is not above the {:.3} du/s that a body has or is to have; raise it",
                    initial.max(circle)
                )
            });
        }
        let fastest = states.iter().map(pericentre).fold(initial.max(circle), f64::max);
        // A body that is thrust off its orbit falls to the centre at the worst.
        let energy = states.iter().map(|state| field.energy(state)).fold(0.0, f64::max);
        let falling = (2.0 * (energy + field.mu() / field.inner())).sqrt();
        raw.speed_du_s.unwrap_or((SPEED_MARGIN * fastest).max(FALL_MARGIN * falling))
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
        let offset = Vector4::from(bias).abs() + spread;
        let (far, fast) = (f64::MAX, self.speed_du_s);
        let bounds = Bounds {
            magnitude: [far, far, fast + offset[2], fast + offset[3]],
            slew_per_tick: [f64::INFINITY; 4],
            // A noisy radius also blurs what follows from it.
            allowance: (spread * 2.0 + Vector4::repeat(ROUNDING)).into(),
            repeats: self.repeats,
        };
        MeasurementGuard { limits: *self, radius_offset: offset[0], state: PlausibilityCheck::new(bounds), needed }
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
    radius_offset: f64,
    state: PlausibilityCheck<4>,
    needed: u64,
}

impl Limits {
    /// How far a component of (r, θ, Vr, Vθ) can have changed after so many ticks from `from`.
    #[inline]
    fn change(&self, i: usize, from: &[f64; 4], ticks: f64) -> f64 {
        let (time, speed) = (ticks * self.tick_s, self.speed_du_s);
        // The nearest that it can have come to the centre meanwhile.
        let r = (from[0] - speed * time).max(self.field.inner());
        match i {
            0 => speed * time,
            1 => speed * time / r,
            _ => (self.field.mu() / (r * r) + 2.0 * speed * speed / r + self.thrust_du_s2) * time,
        }
    }
}

persist_fields!(MeasurementGuard, state);

impl Guard<OrbitMeasurement> for MeasurementGuard {
    #[inline]
    fn accepts(&mut self, sample: &OrbitMeasurement) -> bool {
        let ([vr, vtheta], limits) = (sample.velocity_du_s, self.limits);
        let state = [sample.radius_du, sample.angle_rad, vr, vtheta];
        let placed = sample.valid & 1 == 0 || limits.radius_possible(sample.radius_du, self.radius_offset);
        sample.valid & self.needed == self.needed
            && sample.applied_du_s2.iter().all(|thrust| thrust.abs() <= limits.thrust_du_s2 * (1.0 + ROUNDING))
            && placed
            && self
                .state
                .accepts_within(&sample.stamp, &state, sample.valid, |_, i, from, ticks| limits.change(i, from, ticks))
    }

    fn refusal(&self, sample: &OrbitMeasurement) -> Refusal {
        let ([a, b], radius) = (sample.applied_du_s2, sample.radius_du);
        let largest = self.limits.thrust_du_s2 * (1.0 + ROUNDING);
        if sample.valid & self.needed != self.needed {
            Refusal::Incomplete
        } else if !(a.abs() <= largest && b.abs() <= largest) {
            Refusal::of_values(&[a, b])
        } else if sample.valid & 1 == 1 && !self.limits.radius_possible(radius, self.radius_offset) {
            Refusal::of_values(&[radius])
        } else {
            self.state.refusal()
        }
    }
}

/// Guards estimates: the region, the speed, and that components which are not valid are said to be guesses.
#[derive(Debug)]
pub struct EstimateGuard {
    limits: Limits,
    radius_offset: f64,
}

persist_fields!(EstimateGuard,);

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

    fn refusal(&self, sample: &OrbitEstimate) -> Refusal {
        let (all, [vr, vtheta]) = (POSITION | VELOCITY, sample.velocity_du_s);
        if sample.valid & all != all && sample.status & status::INITIAL == 0 {
            return Refusal::Incomplete;
        }
        Refusal::of_values(&[sample.radius_du, sample.angle_rad, vr, vtheta])
    }
}

/// Guards commands: the thrusters can do what is asked.
#[derive(Debug)]
pub struct CommandGuard {
    thrust_du_s2: f64,
}

persist_fields!(CommandGuard,);

impl Guard<OrbitCommand> for CommandGuard {
    #[inline]
    fn accepts(&mut self, sample: &OrbitCommand) -> bool {
        sample.thrust_du_s2.iter().all(|thrust| thrust.abs() <= self.thrust_du_s2)
    }

    fn refusal(&self, sample: &OrbitCommand) -> Refusal {
        Refusal::of_values(&sample.thrust_du_s2)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sample::Stamp;

    fn limits() -> Limits {
        Limits {
            field: CentralField::new(1.0, 0.05, 10.0).unwrap(),
            speed_du_s: 2.0,
            transient_du_s: 1.0,
            thrust_du_s2: 0.5,
            tick_s: 1e-3,
            repeats: u64::MAX,
        }
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

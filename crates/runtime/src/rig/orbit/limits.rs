//! The physical limits of the orbit rigs' bodies, and the guards that check samples against them.
//!
//! A guard accepts everything that the model permits: the region between central body and escape radius.

use super::roles::{POSITION, VELOCITY};
use crate::config::Checks;
use crate::model::{CentralField, OrbitState};
use crate::rig::contract::Figure;
use crate::rig::filter::SURE_DEVIATIONS;
use crate::role::{Bounds, Guard, PlausibilityCheck, Refusal};
use crate::sample::{OrbitCommand, OrbitEstimate, OrbitMeasurement, Sample, status};
use crate::state::persist_fields;
use nalgebra::Vector4;
use serde::{Deserialize, Serialize};

/// The factor from the fastest speed of the initial orbits to the default speed limit.
const SPEED_MARGIN: f64 = 3.0;
/// The factor from the speed of a fall to the central body to the default speed limit.
const FALL_MARGIN: f64 = 1.5;
/// The relative rounding error that a permitted limit value may have.
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
    /// The largest error of a velocity estimate before it settles, du/s.
    pub transient_du_s: f64,
    pub thrust_du_s2: f64,
    pub tick_s: f64,
    /// The number of consecutive bit-identical measurements that are accepted.
    pub repeats: u64,
}

impl Limits {
    /// Returns the given speed limit, or a default well above the speeds of the initial orbits, of the target circle, and of a fall
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
                    "{limit} is not above the {:.3} du/s of the initial states and the target; raise it",
                    initial.max(circle)
                )
            });
        }
        let fastest = states.iter().map(pericentre).fold(initial.max(circle), f64::max);
        // A body that is thrust off its orbit at worst falls to the centre.
        let energy = states.iter().map(|state| field.energy(state)).fold(0.0, f64::max);
        let falling = (2.0 * (energy + field.mu() / field.inner())).sqrt();
        raw.speed_du_s.unwrap_or((SPEED_MARGIN * fastest).max(FALL_MARGIN * falling))
    }

    /// Returns the limits as figures for reports.
    pub fn figures(&self) -> Vec<Figure> {
        let figure = |name: &str, value| Figure { name: name.to_owned(), value };
        vec![
            figure("largest |component| of a velocity, du/s", self.speed_du_s),
            figure("largest |component| of a velocity estimate, du/s", self.speed_du_s + self.transient_du_s),
            figure("largest |component| of a thrust, du/s^2", self.thrust_du_s2),
        ]
    }

    /// Creates a guard for measurements of sensors with these standard deviations and biases of (r, θ, Vr, Vθ).
    pub fn measurement(&self, deviation: [f64; 4], bias: [f64; 4], needed: u64) -> MeasurementGuard {
        let spread = Vector4::from(deviation) * SURE_DEVIATIONS;
        let offset = Vector4::from(bias).abs() + spread;
        let (far, fast) = (f64::MAX, self.speed_du_s);
        let bounds = Bounds {
            magnitude: [far, far, fast + offset[2], fast + offset[3]],
            slew_per_tick: [f64::INFINITY; 4],
            // A noisy radius also blurs the quantities computed from it.
            allowance: (spread * 2.0 + Vector4::repeat(ROUNDING)).into(),
            repeats: self.repeats,
        };
        MeasurementGuard { limits: *self, radius_offset: offset[0], state: PlausibilityCheck::new(bounds), needed }
    }

    /// Creates a guard for estimates, whose radius is measured with this standard deviation and bias.
    pub fn estimate(&self, deviation: [f64; 4], bias: [f64; 4]) -> EstimateGuard {
        EstimateGuard { limits: *self, radius_offset: bias[0].abs() + SURE_DEVIATIONS * deviation[0] }
    }

    /// Creates a guard for commands.
    pub fn command(&self) -> CommandGuard {
        CommandGuard { thrust_du_s2: self.thrust_du_s2 * (1.0 + ROUNDING) }
    }

    fn radius_possible(&self, r: f64, offset: f64) -> bool {
        let slack = offset + ROUNDING * r;
        self.field.holds(r + slack) || self.field.holds(r - slack) || self.field.holds(r)
    }
}

/// A guard of measurements: region, speed, and the rates of change that gravity and thrust permit.
#[derive(Debug)]
pub struct MeasurementGuard {
    limits: Limits,
    radius_offset: f64,
    state: PlausibilityCheck<4>,
    needed: u64,
}

impl Limits {
    /// Returns the largest possible change of a component of (r, θ, Vr, Vθ) within `ticks` ticks from the state `from`.
    #[inline]
    fn change(&self, i: usize, from: &[f64; 4], ticks: f64) -> f64 {
        let (time, speed) = (ticks * self.tick_s, self.speed_du_s);
        // The smallest possible distance from the centre in this time.
        let r = (from[0] - speed * time).max(self.field.inner());
        match i {
            0 => speed * time,
            1 => speed * time / r,
            _ => (self.field.mu() / (r * r) + 2.0 * speed * speed / r + self.thrust_du_s2) * time,
        }
    }
}

persist_fields!(MeasurementGuard, state);

impl MeasurementGuard {
    /// Checks the motion of a sample in which a field repeats an earlier value.
    #[cold]
    fn accepts_held(&mut self, sample: &OrbitMeasurement, state: &[f64; 4]) -> bool {
        let fields = [("radius_du", 0b1), ("angle_rad", 0b10), ("velocity_du_s", 0b1100)];
        let held = fields.into_iter().filter(|(name, _)| sample.holds(name)).map(|(_, bits)| bits).sum();
        let (limits, valid) = (self.limits, sample.valid);
        self.state.accepts_held(&sample.stamp, state, (valid, held), |_, i, from, ticks| limits.change(i, from, ticks))
    }
}

impl Guard<OrbitMeasurement> for MeasurementGuard {
    #[inline]
    fn accepts(&mut self, sample: &OrbitMeasurement) -> bool {
        let ([vr, vtheta], limits) = (sample.velocity_du_s, self.limits);
        let state = [sample.radius_du, sample.angle_rad, vr, vtheta];
        let placed = sample.valid & 1 == 0 || limits.radius_possible(sample.radius_du, self.radius_offset);
        sample.valid & self.needed == self.needed
            && sample.applied_du_s2.iter().all(|thrust| thrust.abs() <= limits.thrust_du_s2 * (1.0 + ROUNDING))
            && placed
            && if sample.is_held() {
                self.accepts_held(sample, &state)
            } else {
                let change = |_: &Bounds<4>, i: usize, from: &[f64; 4], ticks: f64| limits.change(i, from, ticks);
                self.state.accepts_within(&sample.stamp, &state, sample.valid, change)
            }
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

/// A guard of estimates: region, speed, and that invalid components are marked as guesses.
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
        let complete = sample.valid & all == all || sample.status & status::INITIAL != 0;
        let placed =
            sample.valid & POSITION != POSITION || self.limits.radius_possible(sample.radius_du, self.radius_offset);
        let [vr, vtheta] = sample.velocity_du_s;
        complete && placed && sample.angle_rad.is_finite() && vr.abs() <= speed && vtheta.abs() <= speed
    }

    fn refusal(&self, sample: &OrbitEstimate) -> Refusal {
        let (all, [vr, vtheta]) = (POSITION | VELOCITY, sample.velocity_du_s);
        if sample.valid & all != all && sample.status & status::INITIAL == 0 {
            return Refusal::Incomplete;
        }
        Refusal::of_values(&[sample.radius_du, sample.angle_rad, vr, vtheta])
    }
}

/// A guard of commands: the thrusters can apply what is commanded.
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
    fn samples_outside_the_region_are_rejected() {
        for r in [f64::NAN, 0.0, -1.0, 0.04, 10.1, f64::INFINITY] {
            assert!(!guard().accepts(&at(0, r, 0.0, 0.9)), "{r}");
        }
        for sample in [at(0, 1.0, f64::NAN, 0.9), at(0, 1.0, 0.0, 2.1), at(0, 1.0, 0.0, f64::NAN)] {
            assert!(!guard().accepts(&sample), "{sample:?}");
        }
        assert!(guard().accepts(&at(0, 1.0, 1e9, 0.9)), "any angle is valid");
    }

    #[test]
    fn a_jump_is_rejected_until_enough_time_has_passed() {
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
    fn thrust_beyond_the_limit_is_rejected_in_commands_and_measurements() {
        let command = |thrust| OrbitCommand { thrust_du_s2: [0.0, thrust], ..OrbitCommand::default() };
        assert!(limits().command().accepts(&command(-0.5)) && !limits().command().accepts(&command(0.51)));
        assert!(!guard().accepts(&OrbitMeasurement { applied_du_s2: [0.0, 0.51], ..at(0, 1.0, 0.0, 0.9) }));
    }

    #[test]
    fn an_incomplete_estimate_is_accepted_only_with_its_reason() {
        let estimate = |valid, status| OrbitEstimate { radius_du: 1.0, valid, status, ..OrbitEstimate::default() };
        let mut guard = limits().estimate([0.0; 4], [0.0; 4]);
        assert!(
            guard.accepts(&estimate(POSITION | VELOCITY, 0)) && guard.accepts(&estimate(POSITION, status::INITIAL))
        );
        assert!(guard.accepts(&OrbitEstimate { status: status::INITIAL, ..OrbitEstimate::default() }));
        assert!(!guard.accepts(&estimate(POSITION, 0)) && !guard.accepts(&estimate(VELOCITY | 1, 0)));
    }
}

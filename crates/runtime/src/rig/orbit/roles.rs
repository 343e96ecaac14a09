//! Body, observer and law of the orbit rigs: the conversion between samples and vectors.
//!
//! The computations themselves are in `model`, `observe` and `control`.

use crate::control::{InFlightCommands, OrbitHold};
use crate::model::{CentralField, Noise, OrbitState};
use crate::observe::{Filter, OrbitSample, OrbitVelocity, to_inertial, to_polar};
use crate::rig::filter::FilterDesign;
use crate::role::{Body, Estimator, Law, LawInputs};
use crate::sample::{OrbitCommand, OrbitEstimate, OrbitMeasurement, OrbitTruth, status};
use crate::state::persist_fields;
use crate::vector::zeros;
use nalgebra::Vector2;

/// The bits of r and θ in a sample's `valid`.
pub(super) const POSITION: u64 = 0b0011;
/// The bits of Vr and Vθ.
pub(super) const VELOCITY: u64 = 0b1100;

/// The numbers of the inputs that bodies, observers and laws of these rigs take.
pub(super) mod port {
    /// k_r, 1/s².
    pub const RADIUS_GAIN: usize = 0;
    /// k_v, 1/s.
    pub const RADIAL_GAIN: usize = 1;
    /// k_θ, 1/s.
    pub const TRANSVERSE_GAIN: usize = 2;
    /// The radius of the orbit to hold, du.
    pub const TARGET: usize = 3;
    /// The decay rates of the observer's errors, 1/s.
    pub const DECAY: usize = 4;
    /// The disturbance of a body, du/s².
    pub const DISTURBANCE: usize = 5;
}

/// A body in a central field, with its sensors and thrusters.
#[derive(Debug)]
pub struct OrbitPlant {
    field: CentralField,
    state: OrbitState,
    applied: Vector2<f64>,
    /// The errors that its sensors add to (r, θ, Vr, Vθ).
    noise: Noise<4>,
    /// The bits of the measured components.
    measured: u64,
    /// [`status::FAULT`] once the body's motion has ended in the model, or 0.
    fault: u64,
    /// The disturbance with the opposite sign, du/s²: subtracting zero leaves every bit of a number as it is.
    resistance: Vector2<f64>,
}

impl OrbitPlant {
    /// Creates a body whose sensors measure its position, and its velocity if `velocity_measured`.
    pub(super) fn new(field: CentralField, state: OrbitState, velocity_measured: bool, noise: Noise<4>) -> Self {
        let measured = if velocity_measured { POSITION | VELOCITY } else { POSITION };
        Self { field, state, applied: Vector2::zeros(), noise, measured, fault: 0, resistance: Vector2::zeros() }
    }

    /// Lets a disturbance act on the body, du/s².
    #[must_use]
    pub(super) fn disturbed(self, disturbance: &Vector2<f64>) -> Self {
        Self { resistance: disturbance.map(|component| 0.0 - component), ..self }
    }
}

persist_fields!(OrbitPlant, state, applied, noise, fault);

impl Body for OrbitPlant {
    type Truth = OrbitTruth;
    type Measurement = OrbitMeasurement;
    type Command = OrbitCommand;

    #[inline]
    fn apply(&mut self, command: &OrbitCommand) -> bool {
        let usable = command.thrust_du_s2.iter().all(|value| value.is_finite());
        if usable {
            self.applied = command.thrust_du_s2.into();
        }
        usable
    }

    fn apply_safe(&mut self) {
        self.applied = Vector2::zeros();
    }

    #[inline]
    fn truth(&self, status: u64, out: &mut OrbitTruth) {
        out.radius_du = self.state.r;
        out.angle_rad = self.state.theta;
        out.velocity_du_s = [self.state.vr, self.state.vtheta];
        out.applied_du_s2 = self.applied.into();
        out.status = status | self.fault;
    }

    #[inline]
    fn measure(&mut self, _tick: u64, status: u64, out: &mut OrbitMeasurement) {
        let noise = self.noise.sample();
        out.radius_du = self.state.r + noise[0];
        out.angle_rad = self.state.theta + noise[1];
        let velocity = [self.state.vr + noise[2], self.state.vtheta + noise[3]];
        out.velocity_du_s = if self.measured & VELOCITY == VELOCITY { velocity } else { [0.0; 2] };
        out.applied_du_s2 = self.applied.into();
        out.valid = self.measured;
        out.status = status | self.fault;
    }

    /// Moves the body. If the model ends, the body freezes at its last valid state for the rest of the run.
    #[inline]
    fn flow(&mut self, dt_s: f64) {
        if self.fault != 0 {
            return;
        }
        match self.field.flow(&self.state, &(self.applied - self.resistance), dt_s) {
            Ok(state) => self.state = state,
            Err(fault) => (self.state, self.fault) = (fault.last(), status::FAULT),
        }
    }

    fn set_input(&mut self, port: usize, values: &[f64]) {
        if let (port::DISTURBANCE, &[radial, transverse]) = (port, values) {
            self.resistance = Vector2::new(0.0 - radial, 0.0 - transverse);
        }
    }
}

/// The observer of the first body's velocity.
#[derive(Debug)]
pub struct OrbitObserver {
    relation: OrbitVelocity,
    field: CentralField,
    design: FilterDesign<2>,
    /// (Vr, Vθ) before anything is known, du/s.
    guess: Vector2<f64>,
    filter: Filter<2>,
    last: Option<OrbitSample>,
    /// The state to which the model has advanced the body since the last usable measurement.
    coasted: Option<OrbitState>,
    status: u64,
}

impl OrbitObserver {
    /// Creates an observer of the two inertial velocity components, with a guess of (Vr, Vθ) in du/s.
    pub(super) fn new(
        relation: OrbitVelocity,
        field: CentralField,
        design: FilterDesign<2>,
        guess: Vector2<f64>,
    ) -> Self {
        let filter = design.filter(guess);
        Self { relation, field, design, guess, filter, last: None, coasted: None, status: status::INITIAL }
    }

    /// Returns the estimated motion; before the first measurement at rest in the centre.
    #[inline]
    fn estimate(&self) -> OrbitState {
        self.coasted.unwrap_or_else(|| {
            let at = self.last.unwrap_or(OrbitSample { r: 0.0, theta: 0.0, thrust: zeros() });
            let velocity = to_polar(at.theta, self.filter.estimate());
            OrbitState { r: at.r, vr: velocity.x, theta: at.theta, vtheta: velocity.y }
        })
    }

    #[inline]
    fn seen(measurement: &OrbitMeasurement) -> OrbitSample {
        OrbitSample { r: measurement.radius_du, theta: measurement.angle_rad, thrust: measurement.applied_du_s2.into() }
    }
}

persist_fields!(OrbitObserver, filter, last, coasted, status);

impl Estimator for OrbitObserver {
    type Measurement = OrbitMeasurement;
    type Estimate = OrbitEstimate;

    /// A frozen body's measurements carry no motion to learn from.
    #[inline]
    fn usable(&self, measurement: &OrbitMeasurement) -> bool {
        let OrbitSample { r, theta, thrust } = Self::seen(measurement);
        measurement.valid & POSITION == POSITION
            && measurement.status & status::FAULT == 0
            && r > 0.0
            && [r, theta, thrust.x, thrust.y].iter().all(|value| value.is_finite())
    }

    fn start(&mut self, measurement: &OrbitMeasurement) {
        let guess = to_inertial(measurement.angle_rad, &self.guess);
        self.filter = self.design.filter(guess);
        self.last = Some(Self::seen(measurement));
        self.coasted = None;
        self.status = status::INITIAL;
    }

    #[inline]
    fn update(&mut self, measurement: &OrbitMeasurement, dt_s: f64) {
        let seen = Self::seen(measurement);
        if let Some(last) = &self.last {
            self.filter.step(&self.relation.observe(last, &seen, dt_s));
            self.status = 0;
        }
        self.last = Some(seen);
        self.coasted = None;
    }

    /// Advances under the last reported thrust. Where the model ends, the estimate stays.
    fn coast(&mut self, dt_s: f64) {
        if let Some(OrbitSample { thrust, .. }) = &self.last {
            let from = self.estimate();
            self.coasted = Some(self.field.flow(&from, thrust, dt_s).unwrap_or(from));
        }
    }

    fn set_input(&mut self, port: usize, values: &[f64]) {
        if let (port::DECAY, &[first, second]) = (port, values) {
            self.design = FilterDesign::First([first, second]);
            self.filter = self.design.filter(*self.filter.estimate());
        }
    }

    #[inline]
    fn write(&self, status: u64, out: &mut OrbitEstimate) {
        // Before the first measurement the content is meaningless, and `valid` is 0.
        let OrbitState { r, vr, theta, vtheta } = self.estimate();
        out.radius_du = r;
        out.angle_rad = theta;
        out.velocity_du_s = [vr, vtheta];
        out.status = self.status | status;
        out.valid = match self.last {
            None => 0,
            Some(_) if out.status & status::INITIAL != 0 => POSITION,
            Some(_) => POSITION | VELOCITY,
        };
    }
}

/// The target of a law, and the sources of its inputs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Aim {
    /// A circular orbit of this radius, du, for the observed body. Its velocity comes from the estimate, or from its own sensors
    /// if `full_state`.
    Circle { radius: f64, full_state: bool },
    /// The leader's motion, with estimated velocity. The driven body measures its own velocity.
    Leader,
}

/// The law of one driven body.
#[derive(Debug)]
pub struct OrbitLaw {
    law: OrbitHold,
    aim: Aim,
    /// The commands that a predicting law has sent and that do not act yet, du/s².
    in_flight: InFlightCommands<[f64; 2]>,
}

impl OrbitLaw {
    /// Creates the law of one body. A predicting law predicts its motion over `predicted_ticks`.
    pub(super) fn new(law: OrbitHold, aim: Aim, predicted_ticks: u64) -> Self {
        Self { law, aim, in_flight: InFlightCommands::new(predicted_ticks, || [0.0; 2]) }
    }

    /// Returns the thrust. `None` asks for no thrust: the body is lost, or the leader is still unknown.
    #[inline]
    fn thrust(&self, estimate: &OrbitEstimate, measurement: &OrbitMeasurement) -> Option<Vector2<f64>> {
        let sound = measurement.status & status::FAULT == 0 && estimate.valid & POSITION == POSITION;
        let body = state(measurement.radius_du, measurement.angle_rad, &measurement.velocity_du_s);
        let tick = measurement.stamp.tick;
        let applied = measurement.applied_du_s2;
        sound.then(|| match self.aim {
            Aim::Circle { radius, full_state: true } => {
                let (body, applied) = self.ahead(tick, body, applied);
                self.law.to_circle(radius, &body, &applied)
            }
            Aim::Circle { radius, full_state: false } => {
                let [vr, vtheta] = estimate.velocity_du_s;
                let (body, applied) = self.ahead(tick, OrbitState { vr, vtheta, ..body }, applied);
                self.law.to_circle(radius, &body, &applied)
            }
            Aim::Leader => {
                let leader = state(estimate.radius_du, estimate.angle_rad, &estimate.velocity_du_s);
                let coasting = |leader, _| self.law.ahead(&leader, &Vector2::zeros());
                let leader = self.in_flight.after(tick).fold(leader, coasting);
                let (body, applied) = self.ahead(tick, body, applied);
                self.law.to_leader(&leader, &body, &applied)
            }
        })
    }

    /// Returns a body one tick before a new command acts, and the input of that tick: the law itself predicts the last tick.
    #[inline]
    fn ahead(&self, tick: u64, body: OrbitState, applied: [f64; 2]) -> (OrbitState, Vector2<f64>) {
        let (mut body, mut acts) = (body, Vector2::from(applied));
        for input in self.in_flight.after(tick) {
            body = self.law.ahead(&body, &acts);
            acts = input.map_or(acts, |input| (*input).into());
        }
        (body, acts)
    }
}

#[inline]
fn state(r: f64, theta: f64, velocity: &[f64; 2]) -> OrbitState {
    OrbitState { r, vr: velocity[0], theta, vtheta: velocity[1] }
}

persist_fields!(OrbitLaw, in_flight);

impl Law for OrbitLaw {
    type Estimate = OrbitEstimate;
    type Measurement = OrbitMeasurement;
    type Command = OrbitCommand;

    #[inline]
    fn command(&mut self, inputs: &LawInputs<'_, Self>, out: &mut OrbitCommand) {
        let LawInputs { estimate, measurement, .. } = inputs;
        out.thrust_du_s2 = self.thrust(estimate, measurement).unwrap_or_default().into();
        if let Some(sent) = self.in_flight.sent(measurement.stamp.tick) {
            *sent = out.thrust_du_s2;
        }
    }

    fn set_input(&mut self, port: usize, values: &[f64]) {
        let &[value] = values else { return };
        let gains = self.law.gains_mut();
        match port {
            port::RADIUS_GAIN => gains.radius_per_s2 = value,
            port::RADIAL_GAIN => gains.radial_per_s = value,
            port::TRANSVERSE_GAIN => gains.transverse_per_s = value,
            port::TARGET => {
                if let Aim::Circle { radius, .. } = &mut self.aim {
                    *radius = value;
                }
            }
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn quiet() -> Noise<4> {
        Noise::new(1, 0, [0.0; 4], [0.0; 4])
    }

    fn plant(state: OrbitState) -> OrbitPlant {
        OrbitPlant::new(CentralField::new(1.0, 0.05, 10.0).unwrap(), state, false, quiet())
    }

    fn measured(plant: &mut OrbitPlant) -> OrbitMeasurement {
        let mut measurement = OrbitMeasurement::default();
        plant.measure(0, 0, &mut measurement);
        measurement
    }

    fn observer() -> OrbitObserver {
        let field = CentralField::new(1.0, 0.05, 10.0).unwrap();
        OrbitObserver::new(OrbitVelocity::new(1.0), field, FilterDesign::First([4.0; 2]), Vector2::new(0.0, 0.9))
    }

    #[test]
    fn a_lost_body_freezes_reports_a_fault_and_gets_no_thrust() {
        for start in [
            OrbitState { r: 0.06, vr: -2.0, ..OrbitState::default() },
            OrbitState { r: 9.9, vr: 3.0, ..OrbitState::default() },
        ] {
            let mut plant = plant(start);
            (0..100).for_each(|_| plant.flow(1e-2));
            let frozen = measured(&mut plant);
            plant.flow(1.0);
            assert_eq!(measured(&mut plant), frozen);
            assert_eq!(frozen.status, status::FAULT);
            assert!(frozen.radius_du > 0.05 && frozen.radius_du < 10.0, "{frozen:?}");
            assert!(!observer().usable(&frozen));
            let estimate = OrbitEstimate { valid: POSITION, radius_du: 1.0, ..OrbitEstimate::default() };
            let law = OrbitHold::new(
                plant.field,
                crate::control::OrbitGains { radius_per_s2: 1.0, radial_per_s: 1.0, transverse_per_s: 1.0 },
                0.5,
                0.0,
            );
            for aim in [Aim::Leader, Aim::Circle { radius: 1.3, full_state: true }] {
                assert_eq!(OrbitLaw::new(law, aim, 1).thrust(&estimate, &frozen), None);
            }
        }
    }

    #[test]
    fn a_velocity_that_is_not_measured_is_not_published() {
        let state = OrbitState { r: 1.0, vr: 0.1, theta: 0.3, vtheta: 0.9 };
        let hidden = measured(&mut plant(state));
        assert_eq!((hidden.velocity_du_s, hidden.valid), ([0.0; 2], POSITION));
        let open = measured(&mut OrbitPlant::new(plant(state).field, state, true, quiet()));
        assert_eq!((open.velocity_du_s, open.valid), ([0.1, 0.9], POSITION | VELOCITY));
    }

    #[test]
    fn an_unusable_command_changes_nothing() {
        let mut plant = plant(OrbitState { r: 1.0, ..OrbitState::default() });
        let command = |x| OrbitCommand { thrust_du_s2: [x, 0.1], ..OrbitCommand::default() };
        assert!(plant.apply(&command(0.2)) && !plant.apply(&command(f64::NAN)));
        assert_eq!(measured(&mut plant).applied_du_s2, [0.2, 0.1]);
        plant.apply_safe();
        assert_eq!(measured(&mut plant).applied_du_s2, [0.0; 2]);
    }

    #[test]
    fn the_guess_is_polar_and_invalid_before_the_first_measurement() {
        let (mut observer, mut estimate) = (observer(), OrbitEstimate::default());
        observer.write(status::UNUSABLE, &mut estimate);
        assert_eq!((estimate.valid, estimate.radius_du), (0, 0.0));
        let start = OrbitState { r: 1.0, vr: 0.1, theta: 2.0, vtheta: 0.95 };
        observer.start(&measured(&mut plant(start)));
        observer.write(0, &mut estimate);
        assert_eq!((estimate.valid, estimate.status), (POSITION, status::INITIAL));
        assert!((estimate.velocity_du_s[1] - 0.9).abs() < 1e-15 && estimate.velocity_du_s[0].abs() < 1e-15);
    }
}

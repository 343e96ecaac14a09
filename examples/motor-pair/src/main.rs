//! Two DC motors: the follower tracks the leader's speed, although the leader's load torque is not measured.

use corotate::observe::Increment;
use corotate::prelude::*;
use nalgebra::Vector1;
use serde::{Deserialize, Serialize};
use std::process::ExitCode;

sample! { MotorTruth = "motor-pair/Truth/v1" { speed_rad_s: f64, load_n_m: f64, current_a: f64, status: u64, } }
sample! { MotorMeasurement = "motor-pair/Measurement/v1" { speed_rad_s: f64, current_a: f64, status: u64, } }
sample! { MotorEstimate = "motor-pair/Estimate/v1" { speed_rad_s: f64, load_n_m: f64, rise_rad_s2: f64, status: u64, } }
sample! { MotorCommand = "motor-pair/Command/v1" { current_a: f64, } }

/// The scenario's table `[motor]`: J dω/dt = k i − b ω − τ, and how the leader's load τ is found and its speed followed.
#[derive(Clone, Copy, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Motor {
    inertia_kg_m2: f64,
    friction_n_m_s: f64,
    torque_n_m_per_a: f64,
    leader_load_n_m: f64,
    leader_current_a: f64,
    decay_rate_per_s: f64,
    gain_per_s: f64,
}

#[derive(Clone, Serialize, Deserialize)]
struct MotorPair {
    motor: Motor,
}
struct MotorBody {
    motor: Motor,
    state: MotorTruth,
}
persist_fields!(MotorBody, state);

impl Body for MotorBody {
    type Truth = MotorTruth;
    type Measurement = MotorMeasurement;
    type Command = MotorCommand;
    fn apply(&mut self, command: &MotorCommand) -> bool {
        self.state.current_a = command.current_a;
        true
    }
    fn apply_safe(&mut self) {
        self.state.current_a = 0.0;
    }
    fn truth(&self, status: u64, out: &mut MotorTruth) {
        sample::copy_fields(&MotorTruth { status, ..self.state }, out);
    }
    fn measure(&mut self, _tick: u64, status: u64, out: &mut MotorMeasurement) {
        sample::copy_fields(&MotorTruth { status, ..self.state }, out);
    }
    fn flow(&mut self, dt_s: f64) {
        let (state, motor) = (&mut self.state, &self.motor);
        let end = (motor.torque_n_m_per_a * state.current_a - state.load_n_m) / motor.friction_n_m_s;
        let rate = motor.friction_n_m_s / motor.inertia_kg_m2;
        state.speed_rad_s = end + (state.speed_rad_s - end) * (-rate * dt_s).exp();
    }
    fn set_input(&mut self, _port: usize, values: &[f64]) {
        self.state.load_n_m = values[0];
    }
}

/// ∫τ dt = ∫(k i − b ω) dt − J Δω: the load is the unknown.
impl InvariantRelation<1> for Motor {
    type Measurement = MotorMeasurement;
    type Estimate = MotorEstimate;
    fn increment(&self, last: &MotorMeasurement, now: &MotorMeasurement, dt_s: f64) -> Increment<1> {
        let mean = (last.speed_rad_s + now.speed_rad_s) / 2.0;
        let torque = self.torque_n_m_per_a * last.current_a - self.friction_n_m_s * mean;
        let potential = torque * dt_s - self.inertia_kg_m2 * (now.speed_rad_s - last.speed_rad_s);
        Increment::exact(Vector1::new(potential), dt_s, Vector1::zeros(), Vector1::zeros())
    }
    fn write(&self, last: &MotorMeasurement, load: &Vector1<f64>, status: u64, out: &mut MotorEstimate) {
        let torque = self.torque_n_m_per_a * last.current_a - self.friction_n_m_s * last.speed_rad_s - load.x;
        (out.speed_rad_s, out.load_n_m, out.status) = (last.speed_rad_s, load.x, status);
        out.rise_rad_s2 = torque / self.inertia_kg_m2;
    }
}

/// The follower accelerates as the leader does, and against its own error.
impl Law for Motor {
    type Estimate = MotorEstimate;
    type Measurement = MotorMeasurement;
    type Command = MotorCommand;
    fn command(&mut self, inputs: &LawInputs<'_, Self>, out: &mut MotorCommand) {
        let (leader, own) = (inputs.estimate, inputs.measurement);
        let rise = leader.rise_rad_s2 - self.gain_per_s * (own.speed_rad_s - leader.speed_rad_s);
        out.current_a = (self.inertia_kg_m2 * rise + self.friction_n_m_s * own.speed_rad_s) / self.torque_n_m_per_a;
    }
    fn set_input(&mut self, _port: usize, values: &[f64]) {
        self.gain_per_s = values[0];
    }
}
persist_fields!(Motor,);

impl SimpleRig for MotorPair {
    type Body = MotorBody;
    type Estimator = RelationObserver<Motor, 1>;
    type Law = Motor;
    const NAME: &'static str = "motor-pair";
    const METRICS: &'static [Difference] = &[
        Difference::following("speed_error_rad_s", "speed_rad_s"),
        Difference::estimating("load_error_n_m", "load_n_m"),
    ];
    fn check(&mut self, _context: Context, checks: &mut Checks<'_>) {
        checks.positive("motor.inertia_kg_m2", self.motor.inertia_kg_m2);
        checks.positive("motor.friction_n_m_s", self.motor.friction_n_m_s);
        checks.positive("motor.torque_n_m_per_a", self.motor.torque_n_m_per_a);
    }
    fn body(&self, index: usize) -> MotorBody {
        let Motor { leader_load_n_m: load, leader_current_a: current, .. } = self.motor;
        let (load_n_m, current_a) = if index == 0 { (load, current) } else { (0.0, 0.0) };
        MotorBody { motor: self.motor, state: MotorTruth { load_n_m, current_a, ..MotorTruth::default() } }
    }
    fn estimator(&self) -> RelationObserver<Motor, 1> {
        RelationObserver::new(self.motor, [self.motor.decay_rate_per_s], [0.0])
    }
    fn law(&self, _index: usize) -> Motor {
        self.motor
    }
    fn inputs(&self) -> Vec<InputInfo> {
        let Motor { gain_per_s, leader_load_n_m, .. } = self.motor;
        let gain = InputInfo::new("motor.gain_per_s", Variability::Tunable, "gain of the law, 1/s", &[gain_per_s]);
        let load =
            InputInfo::new("motor.leader_load_n_m", Variability::Input, "the leader's load, N m", &[leader_load_n_m]);
        vec![gain.within(0.0, 100.0).used_by([InputUser::Law(1)], 0), load.used_by([InputUser::Body(0)], 0)]
    }
}

fn main() -> ExitCode {
    Program::new().rig::<MotorPair>().scenario("motor-pair", include_str!("../motor-pair.toml")).main()
}

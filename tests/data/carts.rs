//! Carts on a rail whose positions are measured with noise, and whose speeds are not. The followers are pushed to the leader.
//!
//! A test program, built like an example. The follower has an observer; without one a law knows no speed.

use corotate::prelude::*;
use serde::{Deserialize, Serialize};
use std::process::ExitCode;

sample! { State = "carts/State/v1" { position_m: f64, speed_m_s: f64, status: u64, } }
sample! { Sensors = "carts/Sensors/v1" { position_m: f64, status: u64, } }
sample! { Push = "carts/Push/v1" { rise_m_s2: f64, } }

/// The scenario's table `[cart]`.
#[derive(Clone, Copy, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Cart {
    leader_speed_m_s: f64,
    initial_m: f64,
    noise_m: f64,
    correction: [f64; 2],
    gain: [f64; 2],
}

struct Plant {
    position_m: f64,
    speed_m_s: f64,
    noise: Noise<1>,
}
persist_fields!(Plant, position_m, speed_m_s, noise);

impl Dynamics for Plant {
    type Truth = State;
    type Measurement = Sensors;
    type Command = Push;
    fn truth(&self, status: u64, out: &mut State) {
        (out.position_m, out.speed_m_s, out.status) = (self.position_m, self.speed_m_s, status);
    }
    fn measure(&mut self, status: u64, out: &mut Sensors) {
        (out.position_m, out.status) = (self.position_m + self.noise.sample()[0], status);
    }
    fn advance(&mut self, command: &Push, dt_s: f64) {
        self.position_m += (self.speed_m_s + 0.5 * command.rise_m_s2 * dt_s) * dt_s;
        self.speed_m_s += command.rise_m_s2 * dt_s;
    }
}

/// The motion under the push that acted, corrected by the measured position.
struct Observer {
    correction: [f64; 2],
    position_m: f64,
    speed_m_s: f64,
    rise_m_s2: f64,
}
persist_fields!(Observer, correction, position_m, speed_m_s, rise_m_s2);

impl Estimator for Observer {
    type Measurement = Applied<Sensors, Push>;
    type Estimate = State;
    fn update(&mut self, measured: &Self::Measurement, dt_s: f64) {
        let ahead_m = self.position_m + (self.speed_m_s + 0.5 * self.rise_m_s2 * dt_s) * dt_s;
        let error_m = measured.position_m - ahead_m;
        self.position_m = ahead_m + self.correction[0] * error_m;
        self.speed_m_s += self.rise_m_s2 * dt_s + self.correction[1] * error_m;
        self.rise_m_s2 = measured.applied.rise_m_s2;
    }
    fn write(&self, status: u64, out: &mut State) {
        (out.position_m, out.speed_m_s, out.status) = (self.position_m, self.speed_m_s, status);
    }
    fn set_input(&mut self, _port: usize, values: &[f64]) {
        self.correction = [values[0], values[1]];
    }
}

impl Law for Cart {
    type Estimate = State;
    type Measurement = Applied<Sensors, Push>;
    type Command = Push;
    fn command(&mut self, inputs: &LawInputs<'_, Self>, out: &mut Push) {
        let leader = inputs.estimate;
        // Without an observer of its own a cart is taken to be as fast as the leader.
        let (position_m, speed_m_s) = match inputs.own_estimate {
            Some(own) => (own.position_m, own.speed_m_s),
            None => (inputs.measurement.position_m, leader.speed_m_s),
        };
        let (near, fast) = (leader.position_m - position_m, leader.speed_m_s - speed_m_s);
        out.rise_m_s2 = self.gain[0] * near + self.gain[1] * fast;
    }
}
persist_fields!(Cart,);

#[derive(Clone, Serialize, Deserialize)]
struct Carts {
    cart: Cart,
}

impl SimpleRig for Carts {
    type Body = Actuated<Plant>;
    type Estimator = Observer;
    type Law = Cart;
    const NAME: &'static str = "carts";
    const BODIES: &'static [BodyInfo] =
        &[BodyInfo::free("leader"), BodyInfo::driven("follower"), BodyInfo::driven("other")];
    const METRICS: &'static [Difference] = &[
        Difference::following("position_error_m", "position_m").for_body("follower"),
        Difference::estimating("estimate_error_m", "position_m"),
        Difference::estimating("own_estimate_error_m", "position_m").for_body("follower"),
    ];
    fn body(&self, index: usize) -> Actuated<Plant> {
        let noise = Noise::new(1, index as u64, [self.cart.noise_m], [0.0]);
        let (position_m, speed_m_s) =
            if index == 0 { (0.0, self.cart.leader_speed_m_s) } else { (self.cart.initial_m, 0.0) };
        Actuated::new(Plant { position_m, speed_m_s, noise })
    }
    fn estimator(&self) -> Observer {
        Observer { correction: self.cart.correction, position_m: 0.0, speed_m_s: 0.0, rise_m_s2: 0.0 }
    }
    fn estimator_of(&self, index: usize) -> Observer {
        let position_m = if index == 0 { 0.0 } else { self.cart.initial_m };
        Observer { position_m, ..self.estimator() }
    }
    fn law(&self, _index: usize) -> Cart {
        self.cart
    }
    fn bounds(&self) -> Vec<(&'static str, f64)> {
        vec![("position_m", 1e3)]
    }
    fn ideal(&self) -> Self {
        Self { cart: Cart { noise_m: 0.0, ..self.cart } }
    }
    fn inputs(&self) -> Vec<InputInfo> {
        let correction = &self.cart.correction;
        let correction = InputInfo::new("cart.correction", Variability::Tunable, "gains of the observers", correction);
        vec![correction.used_by([InputUser::Observer], 0)]
    }
}

fn main() -> ExitCode {
    Program::new().rig::<Carts>().scenario("carts", include_str!("../carts.toml")).main()
}

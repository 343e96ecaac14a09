//! A cart with a pole: a state feedback follows a reference position. Speeds are observed with the plant's model.

use corotate::prelude::*;
use nalgebra::Vector4;
use serde::{Deserialize, Serialize};
use std::process::ExitCode;

sample! { State = "cart-pole/State/v1" { position_m: f64, speed_m_s: f64, angle_rad: f64, rate_rad_s: f64, status: u64, } }
sample! { Sensors = "cart-pole/Sensors/v1" { position_m: f64, angle_rad: f64, } }
sample! { Force = "cart-pole/Force/v1" { force_n: f64, } }

/// The scenario's table `[cart]`. A state is position, speed, angle and rate; the angle is 0 if the pole stands upright.
#[derive(Clone, Copy, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Cart {
    cart_kg: f64,
    pole_kg: f64,
    length_m: f64,
    force_max_n: f64,
    initial: [f64; 4],
    push_n: f64,
    noise: [f64; 2],
    encoder_step_rad: f64,
    correction: [f64; 4],
    gain: [f64; 4],
}

/// Returns the state after `dt_s` under a force, within the limit of the motor.
fn after(cart: &Cart, state: &Vector4<f64>, force_n: f64, dt_s: f64) -> Vector4<f64> {
    let force_n = force_n.clamp(-cart.force_max_n, cart.force_max_n) + cart.push_n;
    let derivative = |x: &Vector4<f64>| {
        let (sine, cosine) = libm::sincos(x[2]);
        let sum_n = force_n + cart.pole_kg * sine * (cart.length_m * x[3] * x[3] - 9.81 * cosine);
        let rise = sum_n / (cart.cart_kg + cart.pole_kg * sine * sine);
        Vector4::new(x[1], rise, x[3], (9.81 * sine - rise * cosine) / cart.length_m)
    };
    rk4_step(derivative, state, dt_s)
}

struct Plant {
    cart: Cart,
    state: Vector4<f64>,
    noise: Noise<2>,
}
persist_fields!(Plant, state, noise);

impl Dynamics for Plant {
    type Truth = State;
    type Measurement = Sensors;
    type Command = Force;
    fn truth(&self, status: u64, out: &mut State) {
        [out.position_m, out.speed_m_s, out.angle_rad, out.rate_rad_s] = self.state.into();
        out.status = status;
    }
    fn measure(&mut self, _status: u64, out: &mut Sensors) {
        let noise = self.noise.sample();
        out.position_m = self.state[0] + noise[0];
        out.angle_rad = quantize(self.state[2] + noise[1], self.cart.encoder_step_rad);
    }
    fn advance(&mut self, command: &Force, dt_s: f64) {
        self.state = after(&self.cart, &self.state, command.force_n, dt_s);
    }
    fn set_input(&mut self, _port: usize, values: &[f64]) {
        self.cart.push_n = values[0];
    }
}

/// A Luenberger observer: the model under the force that acted, corrected by what was measured.
struct Observer {
    cart: Cart,
    state: Vector4<f64>,
    force_n: f64,
}
persist_fields!(Observer, state, force_n);

impl Estimator for Observer {
    type Measurement = Applied<Sensors, Force>;
    type Estimate = State;
    fn update(&mut self, measured: &Self::Measurement, dt_s: f64) {
        let ahead = after(&self.cart, &self.state, self.force_n, dt_s);
        let (x, a) = (measured.position_m - ahead[0], measured.angle_rad - ahead[2]);
        self.state = ahead + Vector4::from(self.cart.correction).component_mul(&Vector4::new(x, x, a, a));
        self.force_n = measured.applied.force_n;
    }
    fn write(&self, status: u64, out: &mut State) {
        [out.position_m, out.speed_m_s, out.angle_rad, out.rate_rad_s] = self.state.into();
        out.status = status;
    }
}

impl Law for Cart {
    type Estimate = State;
    type Measurement = Applied<Sensors, Force>;
    type Command = Force;
    fn command(&mut self, inputs: &LawInputs<'_, Self>, out: &mut Force) {
        let &State { position_m, speed_m_s, angle_rad, rate_rad_s, .. } = inputs.estimate;
        let error = Vector4::new(position_m - inputs.reference[0], speed_m_s, angle_rad, rate_rad_s);
        out.force_n = -Vector4::from(self.gain).dot(&error);
    }
}
persist_fields!(Cart,);

#[derive(Clone, Serialize, Deserialize)]
struct CartPole {
    cart: Cart,
}

impl SimpleRig for CartPole {
    type Body = Actuated<Plant>;
    type Estimator = Observer;
    type Law = Cart;
    const NAME: &'static str = "cart-pole";
    const BODIES: &'static [BodyInfo] = &[BodyInfo::driven("cart")];
    const REFERENCE: &'static [&'static str] = &["position_m"];
    const METRICS: &'static [Difference] = &[
        Difference::from_reference("position_error_m", "position_m"),
        Difference::from_zero("angle_rad", "angle_rad"),
    ];
    fn body(&self, _index: usize) -> Actuated<Plant> {
        let noise = Noise::new(1, 0, self.cart.noise, [0.0; 2]);
        Actuated::new(Plant { cart: self.cart, state: self.cart.initial.into(), noise })
    }
    fn estimator(&self) -> Observer {
        Observer { cart: self.cart, state: Vector4::zeros(), force_n: 0.0 }
    }
    fn law(&self, _index: usize) -> Cart {
        self.cart
    }
    fn ideal(&self) -> Self {
        Self { cart: Cart { noise: [0.0; 2], encoder_step_rad: 0.0, ..self.cart } }
    }
    fn inputs(&self) -> Vec<InputInfo> {
        let push = InputInfo::new("cart.push_n", Variability::Input, "force on the cart, N", &[self.cart.push_n]);
        vec![push.used_by([InputUser::Body(0)], 0)]
    }
}

fn main() -> ExitCode {
    Program::new().rig::<CartPole>().scenario("cart-pole", include_str!("../cart-pole.toml")).main()
}

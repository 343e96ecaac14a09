//! A body whose value the law drives to its reference: the least that a rig needs. Replace every part by your own.

use corotate::prelude::*;
use serde::{Deserialize, Serialize};
use std::process::ExitCode;

// The samples. A field's name ends with its unit.
sample! { State = "empty/State/v1" { value_m: f64, status: u64, } }
sample! { Sensors = "empty/Sensors/v1" { value_m: f64, } }
sample! { Input = "empty/Input/v1" { speed_m_s: f64, } }

/// The scenario's table `[body]`.
#[derive(Clone, Copy, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Parameters {
    initial_m: f64,
    gain_per_s: f64,
}

/// The body: its motion and its sensors.
struct Plant {
    value_m: f64,
}
persist_fields!(Plant, value_m);

impl Dynamics for Plant {
    type Truth = State;
    type Measurement = Sensors;
    type Command = Input;
    fn truth(&self, status: u64, out: &mut State) {
        (out.value_m, out.status) = (self.value_m, status);
    }
    fn measure(&mut self, _status: u64, out: &mut Sensors) {
        out.value_m = self.value_m;
    }
    fn advance(&mut self, command: &Input, dt_s: f64) {
        self.value_m += command.speed_m_s * dt_s;
    }
}

/// The observer: here the last measurement.
struct Observer {
    value_m: f64,
}
persist_fields!(Observer, value_m);

impl Estimator for Observer {
    type Measurement = Applied<Sensors, Input>;
    type Estimate = State;
    fn update(&mut self, measured: &Self::Measurement, _dt_s: f64) {
        self.value_m = measured.value_m;
    }
    fn write(&self, status: u64, out: &mut State) {
        (out.value_m, out.status) = (self.value_m, status);
    }
}

/// The law: a command from reference, estimate and measurement.
impl Law for Parameters {
    type Estimate = State;
    type Measurement = Applied<Sensors, Input>;
    type Command = Input;
    fn command(&mut self, inputs: &LawInputs<'_, Self>, out: &mut Input) {
        out.speed_m_s = self.gain_per_s * (inputs.reference[0] - inputs.estimate.value_m);
    }
}
persist_fields!(Parameters,);

#[derive(Clone, Serialize, Deserialize)]
struct Empty {
    body: Parameters,
}

impl SimpleRig for Empty {
    type Body = Actuated<Plant>;
    type Estimator = Observer;
    type Law = Parameters;
    const NAME: &'static str = "empty";
    const BODIES: &'static [BodyInfo] = &[BodyInfo::driven("body")];
    const REFERENCE: &'static [&'static str] = &["value_m"];
    const METRICS: &'static [Difference] = &[Difference::from_reference("error_m", "value_m")];
    fn body(&self, _index: usize) -> Actuated<Plant> {
        Actuated::new(Plant { value_m: self.body.initial_m })
    }
    fn estimator(&self) -> Observer {
        Observer { value_m: 0.0 }
    }
    fn law(&self, _index: usize) -> Parameters {
        self.body
    }
}

fn main() -> ExitCode {
    Program::new().rig::<Empty>().scenario("empty", include_str!("../empty.toml")).main()
}

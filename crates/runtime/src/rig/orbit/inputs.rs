//! The inputs of the orbit rigs: gains, the observer's decay rates, the orbit to hold, and disturbances.

use super::OrbitRig;
use super::roles::{Aim, port};
use crate::config::{InputInfo, InputUser, ResponseField, Variability};
use crate::rig::filter::FilterDesign;

/// Returns the inputs of a rig.
pub(super) fn inputs(rig: &OrbitRig) -> Vec<InputInfo> {
    let laws = || rig.driven().map(InputUser::Law);
    let mut inputs = Vec::new();
    if let Some(controller) = &rig.controller {
        let gains = &controller.gains;
        for (name, description, value, port) in [
            ("radius_per_s2", "gain on the radius, 1/s²", gains.radius_per_s2, port::RADIUS_GAIN),
            ("radial_per_s", "gain on the radial velocity, 1/s", gains.radial_per_s, port::RADIAL_GAIN),
            ("transverse_per_s", "gain on the transverse velocity, 1/s", gains.transverse_per_s, port::TRANSVERSE_GAIN),
        ] {
            let input = InputInfo::new(format!("controller.gain.{name}"), Variability::Tunable, description, &[value]);
            inputs.push(input.within(0.0, f64::INFINITY).used_by(laws(), port));
        }
    }
    if let Aim::Circle { radius, .. } = rig.aim {
        let (key, description) = ("controller.target_radius_du", "set point: radius of the circular orbit, du");
        let input = InputInfo::new(key, Variability::Input, description, &[radius]).within(0.0, f64::INFINITY);
        let input = input.used_by(laws().chain([InputUser::Score]), port::TARGET);
        inputs.push(input.seen_in(response(rig, 0, false)));
    }
    if let FilterDesign::First(rates) = &rig.filter {
        let description = "rates at which the errors of the estimated velocity decay, per inertial axis, 1/s";
        let input = InputInfo::new("observer.decay_rate_per_s", Variability::Tunable, description, rates);
        inputs.push(input.within(0.0, f64::INFINITY).used_by([InputUser::Observer], port::DECAY));
    }
    for (index, body) in rig.bodies.iter().enumerate() {
        let table = if index == 0 { body.name.to_string() } else { format!("follower.{}", index - 1) };
        let (key, disturbance) = (format!("{table}.disturbance_du_s2"), rig.disturbances_du_s2[index].as_slice());
        let description = "disturbance per mass, radial and transverse, du/s²";
        let input = InputInfo::new(key, Variability::Input, description, disturbance);
        inputs.push(input.used_by([InputUser::Body(index)], port::DISTURBANCE).seen_in(response(rig, index, true)));
    }
    inputs
}

/// Returns the response of a driven body: its radius, in a rendezvous relative to the leader's.
fn response(rig: &OrbitRig, index: usize, disturbs: bool) -> Option<ResponseField> {
    let (field, command, relative) = ("radius_du", Some("applied_du_s2"), rig.aim == Aim::Leader);
    let response = ResponseField { body: index, field, element: Some(0), relative, command, disturbs };
    rig.bodies[index].driven.then_some(response)
}

/// Takes new values for the score.
pub(super) fn set(rig: &mut OrbitRig, port: usize, values: &[f64]) {
    if let (port::TARGET, &[target], Aim::Circle { radius, .. }) = (port, values, &mut rig.aim) {
        *radius = target;
    }
}

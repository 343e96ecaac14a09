//! The inputs of this rig: gains, the observer's decay rate, rates relative to the leader, and disturbances.

use super::RigidBodyRig;
use super::design::ObserverDesign;
use crate::config::{InputInfo, InputUser, ResponseField, Variability};
use crate::rate::port;
use crate::rig::filter::FilterDesign;
use nalgebra::Vector3;

/// Returns the port of a body's input for the score: the ports of all bodies in turn.
fn score_port(index: usize, port: usize) -> usize {
    index * port::COUNT + port
}

/// Returns the inputs of a rig.
pub(super) fn inputs(rig: &RigidBodyRig) -> Vec<InputInfo> {
    let laws = || (1..rig.bodies.len()).filter(|index| rig.bodies[*index].driven).map(InputUser::Law);
    let score = |input: InputInfo, index: usize, port| input.used_by([InputUser::Score], score_port(index, port));
    let mut inputs = Vec::new();
    if let Some(controller) = &rig.controller {
        let gains = controller.gain_per_s.as_slice();
        let description = "gains of the law about the three axes, 1/s";
        let input = InputInfo::new("controller.gain_per_s", Variability::Tunable, description, gains);
        inputs.push(score(input.within(0.0, f64::INFINITY).used_by(laws(), port::GAIN), 0, port::GAIN));
    }
    if let ObserverDesign::Hidden { filter: FilterDesign::First(rate), .. } = &rig.observer {
        let description = "rate at which the error of the estimate decays, 1/s";
        let input = InputInfo::new("observer.decay_rate_per_s", Variability::Tunable, description, rate);
        let users = std::iter::once(InputUser::Observer).chain(laws());
        inputs.push(score(input.within(0.0, f64::INFINITY).used_by(users, port::DECAY), 0, port::DECAY));
    }
    for (index, body) in rig.bodies.iter().enumerate() {
        let table = if index == 0 { "leader".to_owned() } else { format!("follower.{}", index - 1) };
        if body.driven {
            let (key, offset) = (format!("{table}.offset_rad_s"), rig.offsets_rad_s[index].as_slice());
            let description = "set point: rate relative to the leader, in the body's axes, rad/s";
            let largest = (rig.limits.rate_rad_s - rig.rate_bound_rad_s()).max(0.0);
            let input = InputInfo::new(key, Variability::Input, description, offset).within(-largest, largest);
            let input = input.used_by([InputUser::Law(index)], port::OFFSET).seen_in(response(rig, index, false));
            inputs.push(score(input, index, port::OFFSET));
        }
        let played = index == 0 && rig.playback.is_some();
        if body.fleet.is_none() && !played {
            let (key, disturbance) = (format!("{table}.disturbance_rad_s2"), rig.disturbances_rad_s2[index].as_slice());
            let description = "disturbance torque over inertia, in the body's axes, rad/s²";
            let largest = rig.limits.acceleration_rad_s2;
            let input = InputInfo::new(key, Variability::Input, description, disturbance).within(-largest, largest);
            let input = input.used_by([InputUser::Body(index)], port::DISTURBANCE).seen_in(response(rig, index, true));
            inputs.push(score(input, index, port::DISTURBANCE));
        }
    }
    inputs
}

/// Returns the response of a driven single body: its rate relative to the leader.
fn response(rig: &RigidBodyRig, index: usize, disturbs: bool) -> Option<ResponseField> {
    let (field, command) = ("omega_rad_s", Some("applied_rad_s2"));
    let single = rig.bodies[index].driven && rig.bodies[index].fleet.is_none();
    single.then_some(ResponseField { body: index, field, element: None, relative: true, command, disturbs })
}

/// Takes new values for the score.
pub(super) fn set(rig: &mut RigidBodyRig, score_port: usize, values: &[f64]) {
    let (index, port) = (score_port / port::COUNT, score_port % port::COUNT);
    match (port, values) {
        (port::GAIN, &[x, y, z]) => {
            rig.certificate =
                rig.certificate.map(|certificate| certificate.with_rates(Some(Vector3::new(x, y, z)), None));
        }
        (port::DECAY, &[rate]) => {
            rig.certificate = rig.certificate.map(|certificate| certificate.with_rates(None, Some(rate)))
        }
        (port::OFFSET, &[x, y, z]) => rig.offsets_rad_s[index] = Vector3::new(x, y, z),
        (port::DISTURBANCE, &[x, y, z]) => rig.disturbances_rad_s2[index] = Vector3::new(x, y, z),
        _ => {}
    }
}

//! The inputs of this rig: gains, the observer's decay rate, rates relative to the leader, and disturbances.

use super::RigidBodyRig;
use super::design::ObserverDesign;
use crate::config::{InputInfo, InputUse, InputUser, ResponseField, Variability};
use crate::rate::port;
use crate::rig::filter::FilterDesign;
use nalgebra::Vector3;

/// Returns the port of a body's input for the score: the ports of all bodies in turn.
fn score_port(index: usize, port: usize) -> usize {
    index * port::COUNT + port
}

/// Returns the inputs of a rig.
pub(super) fn inputs(rig: &RigidBodyRig) -> Vec<InputInfo> {
    let driven = || (1..rig.bodies.len()).filter(|index| rig.bodies[*index].driven);
    let laws = |port: usize| driven().map(move |index| InputUse { user: InputUser::Law(index), port });
    let score = |index: usize, port: usize| InputUse { user: InputUser::Score, port: score_port(index, port) };
    let mut inputs = Vec::new();
    if let Some(controller) = &rig.controller {
        inputs.push(InputInfo {
            key: "controller.gain_per_s".to_owned(),
            description: "gains of the law about the three axes, 1/s".into(),
            variability: Variability::Tunable,
            initial: controller.gain_per_s.as_slice().to_vec(),
            range: (0.0, f64::INFINITY),
            uses: laws(port::GAIN).chain([score(0, port::GAIN)]).collect(),
            response: None,
        });
    }
    if let ObserverDesign::Hidden { filter: FilterDesign::First([rate]), .. } = &rig.observer {
        let observer = InputUse { user: InputUser::Observer, port: port::DECAY };
        inputs.push(InputInfo {
            key: "observer.decay_rate_per_s".to_owned(),
            description: "rate at which the error of the estimate decays, 1/s".into(),
            variability: Variability::Tunable,
            initial: vec![*rate],
            range: (0.0, f64::INFINITY),
            uses: std::iter::once(observer).chain(laws(port::DECAY)).chain([score(0, port::DECAY)]).collect(),
            response: None,
        });
    }
    for index in 0..rig.bodies.len() {
        let body = if index == 0 { "leader".to_owned() } else { format!("follower.{}", index - 1) };
        if rig.bodies[index].driven {
            let largest = (rig.limits.rate_rad_s - rig.rate_bound_rad_s()).max(0.0);
            let law = InputUse { user: InputUser::Law(index), port: port::OFFSET };
            inputs.push(InputInfo {
                key: format!("{body}.offset_rad_s"),
                description: "set point: rate relative to the leader, in the body's axes, rad/s".into(),
                variability: Variability::Input,
                initial: rig.offsets_rad_s[index].as_slice().to_vec(),
                range: (-largest, largest),
                uses: vec![law, score(index, port::OFFSET)],
                response: response(rig, index, false),
            });
        }
        let played = index == 0 && rig.playback.is_some();
        if rig.bodies[index].fleet.is_none() && !played {
            let largest = rig.limits.acceleration_rad_s2;
            let plant = InputUse { user: InputUser::Body(index), port: port::DISTURBANCE };
            inputs.push(InputInfo {
                key: format!("{body}.disturbance_rad_s2"),
                description: "disturbance torque over inertia, in the body's axes, rad/s²".into(),
                variability: Variability::Input,
                initial: rig.disturbances_rad_s2[index].as_slice().to_vec(),
                range: (-largest, largest),
                uses: vec![plant, score(index, port::DISTURBANCE)],
                response: response(rig, index, true),
            });
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

//! The inputs of the orbit rigs: gains, the observer's decay rates, the orbit to hold, and disturbances.

use super::OrbitRig;
use super::roles::{Aim, port};
use crate::config::{InputInfo, InputUse, InputUser, ResponseField, Variability};
use crate::rig::filter::FilterDesign;

/// Returns the inputs of a rig.
pub(super) fn inputs(rig: &OrbitRig) -> Vec<InputInfo> {
    let laws = |port| rig.driven().map(move |index| InputUse { user: InputUser::Law(index), port }).collect();
    let mut inputs = Vec::new();
    if let Some(controller) = &rig.controller {
        let gains = &controller.gains;
        for (name, description, value, port) in [
            ("radius_per_s2", "gain on the radius, 1/s²", gains.radius_per_s2, port::RADIUS_GAIN),
            ("radial_per_s", "gain on the radial velocity, 1/s", gains.radial_per_s, port::RADIAL_GAIN),
            ("transverse_per_s", "gain on the transverse velocity, 1/s", gains.transverse_per_s, port::TRANSVERSE_GAIN),
        ] {
            inputs.push(InputInfo {
                key: format!("controller.gain.{name}"),
                description: description.into(),
                variability: Variability::Tunable,
                initial: vec![value],
                range: (0.0, f64::INFINITY),
                uses: laws(port),
                response: None,
            });
        }
    }
    if let Aim::Circle { radius, .. } = rig.aim {
        let uses: Vec<InputUse> = laws(port::TARGET);
        inputs.push(InputInfo {
            key: "controller.target_radius_du".to_owned(),
            description: "set point: radius of the circular orbit, du".into(),
            variability: Variability::Input,
            initial: vec![radius],
            range: (0.0, f64::INFINITY),
            uses: uses.into_iter().chain([InputUse { user: InputUser::Score, port: port::TARGET }]).collect(),
            response: response(rig, 0, false),
        });
    }
    if let FilterDesign::First(rates) = rig.filter {
        inputs.push(InputInfo {
            key: "observer.decay_rate_per_s".to_owned(),
            description: "rates at which the errors of the estimated velocity decay, per inertial axis, 1/s".into(),
            variability: Variability::Tunable,
            initial: rates.to_vec(),
            range: (0.0, f64::INFINITY),
            uses: vec![InputUse { user: InputUser::Observer, port: port::DECAY }],
            response: None,
        });
    }
    for (index, body) in rig.bodies.iter().enumerate() {
        let table = if index == 0 { body.name.to_string() } else { format!("follower.{}", index - 1) };
        inputs.push(InputInfo {
            key: format!("{table}.disturbance_du_s2"),
            description: "disturbance per mass, radial and transverse, du/s²".into(),
            variability: Variability::Input,
            initial: rig.disturbances_du_s2[index].as_slice().to_vec(),
            range: (f64::NEG_INFINITY, f64::INFINITY),
            uses: vec![InputUse { user: InputUser::Body(index), port: port::DISTURBANCE }],
            response: response(rig, index, true),
        });
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

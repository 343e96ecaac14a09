//! Reads and checks the sections of the orbit rigs.
//!
//! Every refusal names the key and the remedy, and all refusals are reported at once.

use super::design::{ControllerDesign, OrbitRig, Sensors};
use super::limits::{Limits, RawLimits};
use super::roles::Aim;
use crate::config::{BodyInfo, Checks, ConfigError, Document};
use crate::control::{OrbitGains, OrbitHold};
use crate::model::{CentralField, CentralFieldError, Noise, OrbitState};
use crate::rig::contract::Context;
use crate::rig::contract::check_name;
use crate::rig::filter::{FilterDesign, SURE_DEVIATIONS, UNKNOWN_DEVIATION};
use nalgebra::Vector2;
use serde::{Deserialize, Serialize};

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawHold {
    central_body: RawCentralBody,
    spacecraft: RawBody,
    observer: RawObserver,
    controller: RawHoldController,
    #[serde(default, skip_serializing_if = "RawLimits::is_default")]
    limits: RawLimits,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawRendezvous {
    central_body: RawCentralBody,
    leader: RawBody,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    follower: Vec<RawFollower>,
    observer: RawObserver,
    #[serde(skip_serializing_if = "Option::is_none")]
    controller: Option<RawController>,
    #[serde(default, skip_serializing_if = "RawLimits::is_default")]
    limits: RawLimits,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawCentralBody {
    gravitational_parameter_du3_s2: f64,
    radius_du: f64,
    escape_radius_du: f64,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawBody {
    initial_radius_du: f64,
    #[serde(default)]
    initial_angle_rad: f64,
    initial_velocity_du_s: [f64; 2],
    #[serde(default)]
    noise: RawSensor,
    #[serde(default)]
    bias: RawSensor,
    #[serde(default, skip_serializing_if = "is_zero")]
    disturbance_du_s2: [f64; 2],
}

fn is_zero(vector: &[f64; 2]) -> bool {
    *vector == [0.0; 2]
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawFollower {
    name: String,
    initial_radius_du: f64,
    #[serde(default)]
    initial_angle_rad: f64,
    initial_velocity_du_s: [f64; 2],
    #[serde(default)]
    noise: RawSensor,
    #[serde(default)]
    bias: RawSensor,
    #[serde(default, skip_serializing_if = "is_zero")]
    disturbance_du_s2: [f64; 2],
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawObserver {
    #[serde(skip_serializing_if = "Option::is_none")]
    decay_rate_per_s: Option<[f64; 2]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    bandwidth_rad_s: Option<[f64; 2]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    process_noise_du2_s3: Option<f64>,
    #[serde(default)]
    initial_guess_du_s: [f64; 2],
}

/// The errors that a body's sensors add to the truth: standard deviations of white noise, or constant biases.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct RawSensor {
    radius_du: f64,
    angle_rad: f64,
    velocity_du_s: [f64; 2],
}

impl RawSensor {
    fn components(&self) -> [f64; 4] {
        [self.radius_du, self.angle_rad, self.velocity_du_s[0], self.velocity_du_s[1]]
    }
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawHoldController {
    target_radius_du: f64,
    #[serde(default)]
    feedback: Feedback,
    gain: RawGain,
    thrust_max_du_s2: f64,
    #[serde(default)]
    predict: bool,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawController {
    gain: RawGain,
    thrust_max_du_s2: f64,
    #[serde(default)]
    predict: bool,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawGain {
    radius_per_s2: f64,
    radial_per_s: f64,
    transverse_per_s: f64,
}

/// The source of the velocity in the law of `orbit-hold`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Feedback {
    #[default]
    Estimate,
    FullState,
}

impl From<&RawBody> for OrbitState {
    fn from(raw: &RawBody) -> Self {
        let [vr, vtheta] = raw.initial_velocity_du_s;
        Self { r: raw.initial_radius_du, vr, theta: raw.initial_angle_rad, vtheta }
    }
}

impl From<&RawFollower> for OrbitState {
    fn from(raw: &RawFollower) -> Self {
        let [vr, vtheta] = raw.initial_velocity_du_s;
        Self { r: raw.initial_radius_du, vr, theta: raw.initial_angle_rad, vtheta }
    }
}

/// Reads and checks a scenario of the rig `orbit-hold`.
pub(super) fn hold(
    sections: &Document,
    context: Context,
    checks: &mut Checks<'_>,
) -> Result<(Option<OrbitRig>, toml::Table), ConfigError> {
    let raw: RawHold = sections.read_into()?;
    let RawHoldController { target_radius_du: radius, feedback, gain, thrust_max_du_s2, predict } = &raw.controller;
    let parts = Parts {
        central_body: &raw.central_body,
        name: "spacecraft",
        observed: &raw.spacecraft,
        followers: &[],
        observer: &raw.observer,
        controller: Some((gain, *thrust_max_du_s2, *predict)),
        aim: Aim::Circle { radius: *radius, full_state: *feedback == Feedback::FullState },
        limits: &raw.limits,
    };
    let table = toml::Table::try_from(&raw).expect("a scenario of plain values is TOML");
    Ok((parts.build(context, checks), table))
}

/// Reads and checks a scenario of the rig `orbit-rendezvous`.
pub(super) fn rendezvous(
    sections: &Document,
    context: Context,
    checks: &mut Checks<'_>,
) -> Result<(Option<OrbitRig>, toml::Table), ConfigError> {
    let raw: RawRendezvous = sections.read_into()?;
    let parts = Parts {
        central_body: &raw.central_body,
        name: "leader",
        observed: &raw.leader,
        followers: &raw.follower,
        observer: &raw.observer,
        controller: raw.controller.as_ref().map(|raw| (&raw.gain, raw.thrust_max_du_s2, raw.predict)),
        aim: Aim::Leader,
        limits: &raw.limits,
    };
    let table = toml::Table::try_from(&raw).expect("a scenario of plain values is TOML");
    Ok((parts.build(context, checks), table))
}

/// The tables of both rigs in common form.
struct Parts<'a> {
    central_body: &'a RawCentralBody,
    /// The name of the observed body and of its table.
    name: &'static str,
    observed: &'a RawBody,
    followers: &'a [RawFollower],
    observer: &'a RawObserver,
    /// Gains, largest thrust, and true if the law predicts.
    controller: Option<(&'a RawGain, f64, bool)>,
    aim: Aim,
    limits: &'a RawLimits,
}

impl Parts<'_> {
    fn build(&self, context: Context, checks: &mut Checks<'_>) -> Option<OrbitRig> {
        let mut sound = true;
        let mut review = Review { checks, sound: &mut sound };
        let field = review.field(self.central_body);
        review.place(&format!("{}.initial_radius_du", self.name), self.observed.initial_radius_du, field.as_ref());
        // The body that holds an orbit is itself driven.
        let (driven, target) = match self.aim {
            Aim::Circle { radius, .. } => (true, Some(radius)),
            Aim::Leader => (false, None),
        };
        if let Some(radius) = target {
            review.place("controller.target_radius_du", radius, field.as_ref());
        }
        review.followers(self.followers, field.as_ref());
        review.controller(self.controller, !driven && self.followers.is_empty());
        review.sensor(self.name, &self.observed.noise);
        let (Some(field), Some(filter)) = (field, review.filter(self.observer)) else { return None };
        let initial: Vec<OrbitState> =
            [self.observed.into()].into_iter().chain(self.followers.iter().map(OrbitState::from)).collect();
        let sensed = [(&self.observed.noise, &self.observed.bias)]
            .into_iter()
            .chain(self.followers.iter().map(|follower| (&follower.noise, &follower.bias)));
        let sensors: Vec<Sensors> =
            sensed.zip(0..).map(|((noise, bias), stream)| sensor(context, stream, noise, bias)).collect();
        let body = |name: &str, driven| BodyInfo { name: name.to_owned().into(), driven, fleet: None, observer: None };
        let bodies = [body(self.name, driven)];
        let thrust_max = self.controller.map_or(0.0, |(_, thrust_max, _)| thrust_max);
        let speed = Limits::resolve(self.limits, field, &initial, target, review.checks);
        let rig = OrbitRig {
            bodies: bodies
                .into_iter()
                .chain(self.followers.iter().map(|follower| body(&follower.name, true)))
                .collect(),
            field,
            initial,
            limits: limits(field, speed, self.observer, &sensors[0], thrust_max, self.limits, context),
            sensors,
            filter,
            initial_guess: self.observer.initial_guess_du_s.into(),
            controller: self
                .controller
                .map(|(gain, thrust_max, predict)| gain.controller(field, thrust_max, predict, context)),
            aim: self.aim,
            disturbances_du_s2: [self.observed.disturbance_du_s2]
                .into_iter()
                .chain(self.followers.iter().map(|follower| follower.disturbance_du_s2))
                .map(Vector2::from)
                .collect(),
            tick_s: context.tick_s,
            rates: context.rates,
        };
        if sound {
            check_loop(&rig, checks);
        }
        Some(rig)
    }
}

fn sensor(context: Context, stream: u64, noise: &RawSensor, bias: &RawSensor) -> Sensors {
    Sensors {
        noise: Noise::new(context.seed, stream, noise.components(), bias.components()),
        deviation: noise.components(),
        bias: bias.components(),
    }
}

/// Returns the limits. Until it settles, an estimate errs by its guess; a filter that weighs noise may err by more.
fn limits(
    field: CentralField,
    speed_du_s: f64,
    observer: &RawObserver,
    sensors: &Sensors,
    thrust_du_s2: f64,
    raw: &RawLimits,
    context: Context,
) -> Limits {
    let guess = observer.initial_guess_du_s.iter().fold(0.0, |largest: f64, guess| largest.max(guess.abs()));
    let noisy = sensors.deviation != [0.0; 4] || observer.decay_rate_per_s.is_none();
    Limits {
        field,
        speed_du_s,
        transient_du_s: speed_du_s + guess + if noisy { SURE_DEVIATIONS * UNKNOWN_DEVIATION } else { 0.0 },
        thrust_du_s2,
        tick_s: context.tick_s,
        repeats: raw.repeats.unwrap_or(u64::MAX),
    }
}

impl RawGain {
    fn controller(&self, field: CentralField, thrust_max: f64, predict: bool, context: Context) -> ControllerDesign {
        let gains = OrbitGains {
            radius_per_s2: self.radius_per_s2,
            radial_per_s: self.radial_per_s,
            transverse_per_s: self.transverse_per_s,
        };
        let lead_s = if predict { context.tick_s } else { 0.0 };
        let (law, delay_ticks) = (OrbitHold::new(field, gains, thrust_max, lead_s), context.actuation_delay_ticks);
        ControllerDesign { gains, law, delay_ticks, predict }
    }
}

/// Checks that record whether one of them failed.
struct Review<'a, 'd> {
    checks: &'a mut Checks<'d>,
    sound: &'a mut bool,
}

impl Review<'_, '_> {
    fn require(&mut self, holds: bool, key: &str, code: &'static str, reason: impl FnOnce() -> String) {
        *self.sound &= holds;
        self.checks.require(holds, key, code, reason);
    }

    fn positive(&mut self, key: &str, value: f64) {
        self.require(value > 0.0, key, "not-positive", || format!("{value} is not above zero; give a positive number"));
    }

    fn field(&mut self, raw: &RawCentralBody) -> Option<CentralField> {
        match CentralField::new(raw.gravitational_parameter_du3_s2, raw.radius_du, raw.escape_radius_du) {
            Ok(field) => Some(field),
            Err(error) => {
                let key = match error {
                    CentralFieldError::NotAttracting { .. } => "central_body.gravitational_parameter_du3_s2",
                    CentralFieldError::EmptyRegion { inner, .. } if inner <= 0.0 => "central_body.radius_du",
                    CentralFieldError::EmptyRegion { .. } => "central_body.escape_radius_du",
                };
                self.require(false, key, (&error).into(), || error.to_string());
                None
            }
        }
    }

    /// Checks a radius at which a body starts or ends.
    fn place(&mut self, key: &str, r: f64, field: Option<&CentralField>) {
        match field {
            Some(field) => self.require(field.holds(r), key, "out-of-range", || {
                format!(
                    "{r} du is not between the central body's radius and the escape radius; move it, or change \
                     central_body.radius_du or central_body.escape_radius_du"
                )
            }),
            None => self.positive(key, r),
        }
    }

    fn followers(&mut self, followers: &[RawFollower], field: Option<&CentralField>) {
        for (index, follower) in followers.iter().enumerate() {
            let taken = followers[..index].iter().map(|follower| follower.name.as_str());
            check_name(self.checks, &format!("follower[{index}].name"), &follower.name, taken);
            self.place(&format!("follower[{index}].initial_radius_du"), follower.initial_radius_du, field);
            self.sensor(&format!("follower[{index}]"), &follower.noise);
        }
    }

    fn sensor(&mut self, body: &str, noise: &RawSensor) {
        let real = noise.components().iter().all(|deviation| *deviation >= 0.0);
        self.require(real, &format!("{body}.noise"), "negative", || {
            "a standard deviation is below zero; give 0 or more".to_owned()
        });
    }

    fn filter(&mut self, observer: &RawObserver) -> Option<FilterDesign<2>> {
        let density = ("process_noise_du2_s3", observer.process_noise_du2_s3);
        let design = FilterDesign::resolve(self.checks, observer.decay_rate_per_s, observer.bandwidth_rad_s, density);
        *self.sound &= design.is_some();
        design
    }

    /// Checks that there is a controller exactly if there are followers.
    fn controller(&mut self, controller: Option<(&RawGain, f64, bool)>, alone: bool) {
        match controller {
            Some((gain, thrust_max, _)) => self.loops(gain, thrust_max),
            None => self.require(alone, "controller", "missing-key", || {
                "is missing; followers need a [controller] with gain and thrust_max_du_s2".to_owned()
            }),
        }
        self.require(controller.is_none() || !alone, "controller", "unused-key", || {
            "has no follower to drive; add a [[follower]] or remove it".to_owned()
        });
    }

    fn loops(&mut self, gain: &RawGain, thrust_max: f64) {
        self.positive("controller.gain.radius_per_s2", gain.radius_per_s2);
        self.positive("controller.gain.radial_per_s", gain.radial_per_s);
        self.positive("controller.gain.transverse_per_s", gain.transverse_per_s);
        self.positive("controller.thrust_max_du_s2", thrust_max);
    }
}

fn check_loop(rig: &OrbitRig, checks: &mut Checks<'_>) {
    let circle = rig.field.circular(rig.certified_radius());
    // Without a loop, check the free motion. A slower loop is judged by running it.
    let sampled = match rig.controller.as_ref().filter(|_| rig.rates.pattern_ticks() == 1) {
        Some(controller) => rig.certificate(controller).map(|certificate| Some(certificate.sampled)),
        None => rig.field.flow(&circle, &Vector2::zeros(), rig.tick_s).map(|_| None),
    };
    match sampled {
        Ok(None) => {}
        Ok(Some(sampled)) => checks.require(sampled.holds(), "controller.gain", "unstable-loop", || {
            format!(
                "the sampled loop is unstable: its slowest mode is multiplied by {:.4} from tick to tick; lower the gains \
                 or raise tick_hz",
                sampled.required
            )
        }),
        Err(_) => checks.refuse(
            "tick_hz", "tick-too-long",
            format!("in a tick of {} s a body moves further than can be resolved; raise tick_hz", rig.tick_s),
        ),
    }
}

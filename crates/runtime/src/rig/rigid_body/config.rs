//! The sections of a scenario that belong to this rig: as typed, with their checks.

use super::limits::RawLimits;
use super::playback::RawPlayback;
use crate::config::Checks;
use crate::rig::contract::check_name;
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

/// The most followers: each is a process, and the transport holds 128 of them.
const MAX_FOLLOWERS: usize = 100;
/// The most bodies of a fleet: one sample of them is 48 MB.
const MAX_BODIES: i64 = 1_000_000;

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Raw {
    pub leader: RawLeader,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub follower: Vec<RawFollower>,
    pub observer: RawObserver,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub controller: Option<RawController>,
    #[serde(default, skip_serializing_if = "RawLimits::is_default")]
    pub limits: RawLimits,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawLeader {
    pub inertia_kg_m2: [f64; 3],
    #[serde(skip_serializing_if = "Option::is_none")]
    pub initial_rate_rad_s: Option<[f64; 3]>,
    /// A log whose motion it repeats.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub data: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub playback: Option<RawPlayback>,
    pub measured_axes: Vec<usize>,
    #[serde(default)]
    pub noise_rad_s: [f64; 3],
    #[serde(default)]
    pub bias_rad_s: [f64; 3],
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub outage: Vec<RawOutage>,
}

impl RawLeader {
    /// Where it begins, rad/s.
    pub fn initial(&self) -> Vector3<f64> {
        self.initial_rate_rad_s.unwrap_or_default().into()
    }
}

/// A gyro that is dead from one tick to another.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawOutage {
    pub axis: usize,
    pub from_s: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub until_s: Option<f64>,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawFollower {
    pub name: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub count: Option<i64>,
    pub initial_rate_rad_s: [f64; 3],
    #[serde(skip_serializing_if = "Option::is_none")]
    pub initial_rate_spread_rad_s: Option<[f64; 3]>,
    #[serde(default = "identical")]
    pub inertia_factor: [f64; 3],
    #[serde(default)]
    pub noise_rad_s: [f64; 3],
    #[serde(default)]
    pub bias_rad_s: [f64; 3],
}

fn identical() -> [f64; 3] {
    [1.0; 3]
}

impl RawFollower {
    /// How many bodies it is, if it is a fleet.
    pub fn fleet(&self) -> Option<usize> {
        self.count.and_then(|count| usize::try_from(count).ok())
    }

    /// How far the initial rates of a fleet's bodies are from the one given, at the most.
    pub fn spread_rad_s(&self) -> [f64; 3] {
        self.initial_rate_spread_rad_s.unwrap_or_default()
    }

    /// The fastest initial rate of a body, rad/s.
    pub fn fastest(&self) -> Vector3<f64> {
        Vector3::from(self.initial_rate_rad_s).abs() + Vector3::from(self.spread_rad_s())
    }
}

/// What the observer is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Kind {
    /// Supplies one component that is never measured.
    #[default]
    HiddenRate,
    /// Learns the inertia while all components are measured, and supplies one that is lost.
    Inertia,
    /// The same for a body that is known to be axisymmetric.
    AxisymmetricInertia,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawObserver {
    #[serde(default)]
    pub kind: Kind,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub decay_rate_per_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bandwidth_rad_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub process_noise_rad2_s3: Option<f64>,
    #[serde(default)]
    pub initial_guess_rad_s: f64,
    #[serde(default = "default_floor")]
    pub observability_floor_rad_s: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub identifier_decay: Option<IdentifierDecay>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub identifier_bandwidth: Option<[f64; 3]>,
    #[serde(default)]
    pub initial_coefficients: [f64; 3],
    #[serde(skip_serializing_if = "Option::is_none")]
    pub symmetry_axis: Option<usize>,
}

/// How fast the identifier's error decays, per unit of excitation: rates per component, or minus a matrix.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "there is no such choice; give three decay rates, as [5.0, 5.0, 5.0], or a 3 by 3 Hurwitz matrix"
)]
pub(super) enum IdentifierDecay {
    /// One positive rate per component.
    Rates([f64; 3]),
    /// The matrix of \[SZ\](8), all eigenvalues left of the imaginary axis.
    Matrix([[f64; 3]; 3]),
}

fn default_floor() -> f64 {
    1e-6
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawController {
    pub gain_per_s: [f64; 3],
    #[serde(default)]
    pub predict: bool,
    #[serde(default)]
    pub coefficients: Coefficients,
    #[serde(default)]
    pub adaptation_gain: f64,
}

/// Which mass distribution the law works with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Coefficients {
    /// The configured one.
    #[default]
    Known,
    /// The one that the observer has learned.
    Learned,
}

/// Checks what can be told from the text alone, whatever the observer is for.
pub(super) fn check(raw: &Raw, checks: &mut Checks<'_>) {
    check_followers(&raw.follower, checks);
    check_noise(checks, "leader", &raw.leader.noise_rad_s);
    check_motion(&raw.leader, checks);
    check_observer(&raw.observer, checks);
    check_fleets(raw, checks);
    match (&raw.controller, raw.follower.is_empty()) {
        (None, false) => {
            checks.refuse("controller", "missing-key", "is missing; followers need a [controller] with gain_per_s")
        }
        (Some(_), true) => {
            checks.refuse("controller", "unused-key", "has no follower to drive; add a [[follower]] or remove it")
        }
        (Some(controller), false) => {
            for (axis, gain) in controller.gain_per_s.into_iter().enumerate() {
                checks.positive(&format!("controller.gain_per_s[{axis}]"), gain);
            }
            checks.require(controller.adaptation_gain >= 0.0, "controller.adaptation_gain", "negative", || {
                format!("{} is below zero and would unlearn; give 0 or more", controller.adaptation_gain)
            });
        }
        (None, true) => {}
    }
}

/// The leader moves by its own dynamics or by a log.
fn check_motion(leader: &RawLeader, checks: &mut Checks<'_>) {
    match (leader.initial_rate_rad_s, &leader.data) {
        (None, None) => {
            checks.refuse("leader.initial_rate_rad_s", "missing-key", "is missing; add it, or leader.data with a log")
        }
        (Some(_), Some(_)) => checks.refuse(
            "leader.initial_rate_rad_s",
            "conflicting-keys",
            "has no meaning where leader.data tells the motion; remove one of them",
        ),
        _ => {}
    }
    checks.require(leader.playback.is_none() || leader.data.is_some(), "leader.playback", "unused-key", || {
        "says how a log is read, and there is none; add leader.data".to_owned()
    });
}

fn check_observer(observer: &RawObserver, checks: &mut Checks<'_>) {
    checks.positive("observer.observability_floor_rad_s", observer.observability_floor_rad_s);
    let (learns, symmetric) = (observer.kind != Kind::HiddenRate, observer.kind == Kind::AxisymmetricInertia);
    let identifier = observer.identifier_decay.is_some() || observer.identifier_bandwidth.is_some();
    for (key, given, needed) in [
        ("observer.identifier_decay", identifier, learns),
        ("observer.symmetry_axis", observer.symmetry_axis.is_some(), symmetric),
    ] {
        match (given, needed) {
            (false, true) => checks.refuse(key, "missing-key", "is missing for this observer.kind; add it"),
            (true, false) => checks.refuse(key, "unused-key", "has no meaning for this observer.kind; remove it"),
            _ => {}
        }
    }
    if let Some(IdentifierDecay::Rates(rates)) = &observer.identifier_decay {
        rates.iter().for_each(|rate| checks.positive("observer.identifier_decay", *rate));
    }
    if let Some(bandwidth) = &observer.identifier_bandwidth {
        bandwidth.iter().for_each(|value| checks.positive("observer.identifier_bandwidth", *value));
        checks.require(
            observer.identifier_decay.is_none(),
            "observer.identifier_bandwidth",
            "conflicting-keys",
            || "is of second order, and observer.identifier_decay of first; give one of them".to_owned(),
        );
    }
}

fn check_noise(checks: &mut Checks<'_>, body: &str, deviation: &[f64; 3]) {
    let real = deviation.iter().all(|deviation| *deviation >= 0.0);
    checks.require(real, &format!("{body}.noise_rad_s"), "negative", || {
        format!("{deviation:?} has a standard deviation below zero; give 0 or more")
    });
}

fn check_followers(followers: &[RawFollower], checks: &mut Checks<'_>) {
    checks.require(followers.len() <= MAX_FOLLOWERS, "follower", "too-many", || {
        format!("{} are more than a run holds; give at most {MAX_FOLLOWERS}", followers.len())
    });
    for (index, follower) in followers.iter().enumerate() {
        let (key, name) = (format!("follower[{index}].name"), &follower.name);
        check_name(checks, &key, name, followers[..index].iter().map(|other| other.name.as_str()));
        check_noise(checks, &format!("follower[{index}]"), &follower.noise_rad_s);
        for factor in follower.inertia_factor {
            checks.positive(&format!("follower[{index}].inertia_factor"), factor);
        }
    }
}

/// What fleets are, and what they do without.
fn check_fleets(raw: &Raw, checks: &mut Checks<'_>) {
    for (index, follower) in raw.follower.iter().enumerate() {
        let key = |name: &str| format!("follower[{index}].{name}");
        let spread = follower.initial_rate_spread_rad_s;
        let Some(count) = follower.count else {
            checks.require(spread.is_none(), &key("initial_rate_spread_rad_s"), "unused-key", || {
                "is for many bodies, and this follower is one; give count, or remove it".to_owned()
            });
            continue;
        };
        checks.require((1..=MAX_BODIES).contains(&count), &key("count"), "out-of-range", || {
            format!("{count} is no number of bodies that one process hosts; give 1 to {MAX_BODIES}")
        });
        checks.require(
            spread.iter().flatten().all(|spread| *spread >= 0.0),
            &key("initial_rate_spread_rad_s"),
            "negative",
            || "is a distance to either side and below zero; give 0 or more".to_owned(),
        );
        for (name, plain) in [
            ("inertia_factor", follower.inertia_factor == identical()),
            ("noise_rad_s", follower.noise_rad_s == [0.0; 3]),
            ("bias_rad_s", follower.bias_rad_s == [0.0; 3]),
        ] {
            checks.require(plain, &key(name), "fleet-key", || {
                "has no meaning for a fleet, whose bodies are like the leader and perfectly measured; remove it or count"
                    .to_owned()
            });
        }
    }
    if raw.follower.iter().any(|follower| follower.count.is_some()) {
        let adapts = raw.controller.as_ref().is_some_and(|controller| controller.adaptation_gain > 0.0);
        checks.require(!adapts, "controller.adaptation_gain", "fleet-key", || {
            "learns the inertia of single followers, and a fleet's is the leader's; give 0 or leave the fleet out"
                .to_owned()
        });
        checks.require(raw.limits.repeats.is_none(), "limits.repeats", "fleet-key", || {
            "is not counted for the bodies of a fleet; remove it or the fleet".to_owned()
        });
    }
}

/// The component that the observer supplies, 1 to 3: the one that is not measured, or the one that fails.
///
/// An observer that learns needs all three to begin with.
pub(super) fn hidden_axis(raw: &Raw, checks: &mut Checks<'_>) -> Option<usize> {
    let measured = &raw.leader.measured_axes;
    let hidden: Vec<usize> = (1..=3).filter(|axis| !measured.contains(axis)).collect();
    let expected = if raw.observer.kind == Kind::HiddenRate { 2 } else { 3 };
    if measured.len() != expected || hidden.len() != 3 - expected {
        let remedy = match expected {
            2 => "does not leave exactly one axis hidden; name two different axes of 1, 2 and 3",
            _ => "is not all axes, which learning needs; give [1, 2, 3] and let one fail with [[leader.outage]]",
        };
        checks.refuse("leader.measured_axes", "bad-axes", format!("{measured:?} {remedy}"));
        return None;
    }
    let supplied = hidden.first().or(raw.leader.outage.first().map(|outage| &outage.axis));
    // An outage of an axis that no body has is refused elsewhere.
    supplied.copied().filter(|axis| (1..=3).contains(axis))
}

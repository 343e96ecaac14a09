//! The tables of a scenario that belong to this rig, as typed, with their checks.

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
    /// A log whose motion the leader plays back.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub data: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub playback: Option<RawPlayback>,
    pub measured_axes: Vec<usize>,
    #[serde(default)]
    pub noise_rad_s: [f64; 3],
    #[serde(default)]
    pub bias_rad_s: [f64; 3],
    #[serde(default, skip_serializing_if = "is_zero")]
    pub disturbance_rad_s2: [f64; 3],
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub outage: Vec<RawOutage>,
}

impl RawLeader {
    /// Returns the initial rate, rad/s.
    pub fn initial(&self) -> Vector3<f64> {
        self.initial_rate_rad_s.unwrap_or_default().into()
    }
}

/// A gyro that is dead from one time to another.
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
    #[serde(default, skip_serializing_if = "is_zero")]
    pub offset_rad_s: [f64; 3],
    #[serde(default, skip_serializing_if = "is_zero")]
    pub disturbance_rad_s2: [f64; 3],
}

fn is_zero(vector: &[f64; 3]) -> bool {
    *vector == [0.0; 3]
}

fn identical() -> [f64; 3] {
    [1.0; 3]
}

impl RawFollower {
    /// Returns the number of bodies if this follower is a fleet.
    pub fn fleet(&self) -> Option<usize> {
        self.count.and_then(|count| usize::try_from(count).ok())
    }

    /// Returns the largest distance of a body's initial rate from the given one, rad/s.
    pub fn spread_rad_s(&self) -> [f64; 3] {
        self.initial_rate_spread_rad_s.unwrap_or_default()
    }

    /// Returns a bound on the initial rates of all bodies and on their rates relative to the leader, rad/s.
    pub fn fastest(&self) -> Vector3<f64> {
        let initial = Vector3::from(self.initial_rate_rad_s).abs() + Vector3::from(self.spread_rad_s());
        initial.sup(&Vector3::from(self.offset_rad_s).abs())
    }
}

/// The purpose of the observer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Kind {
    /// Supplies one component that is never measured.
    #[default]
    HiddenRate,
    /// Learns the inertia while all components are measured, and supplies one that is lost.
    Inertia,
    /// As `Inertia`, for a body known to be axisymmetric.
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

/// The decay of the identifier's error per unit of excitation: one rate per component, or minus a matrix.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "unknown choice; give three decay rates, as [5.0, 5.0, 5.0], or a 3 by 3 Hurwitz matrix")]
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

/// The mass distribution that the law uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Coefficients {
    /// The configured one.
    #[default]
    Known,
    /// The one that the observer has learned.
    Learned,
}

/// Checks the text alone, independently of the observer's kind.
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

/// Checks that the leader moves either by its own dynamics or by a log.
fn check_motion(leader: &RawLeader, checks: &mut Checks<'_>) {
    match (leader.initial_rate_rad_s, &leader.data) {
        (None, None) => {
            checks.refuse("leader.initial_rate_rad_s", "missing-key", "is missing; add it, or leader.data with a log")
        }
        (Some(_), Some(_)) => checks.refuse(
            "leader.initial_rate_rad_s",
            "conflicting-keys",
            "conflicts with leader.data, which gives the motion; remove one of them",
        ),
        _ => {}
    }
    checks.require(leader.playback.is_none() || leader.data.is_some(), "leader.playback", "unused-key", || {
        "describes how to read a log, and no log is given; add leader.data".to_owned()
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
            (true, false) => checks.refuse(key, "unused-key", "is unused with this observer.kind; remove it"),
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
            || {
                "is for a second-order filter and observer.identifier_decay for a first-order one; give one of them"
                    .to_owned()
            },
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
        check_name(checks, &key, name, followers[..index].iter().map(|follower| follower.name.as_str()));
        check_noise(checks, &format!("follower[{index}]"), &follower.noise_rad_s);
        for factor in follower.inertia_factor {
            checks.positive(&format!("follower[{index}].inertia_factor"), factor);
        }
    }
}

/// Checks the keys of fleets, including keys that a fleet does not support.
fn check_fleets(raw: &Raw, checks: &mut Checks<'_>) {
    for (index, follower) in raw.follower.iter().enumerate() {
        let key = |name: &str| format!("follower[{index}].{name}");
        let spread = follower.initial_rate_spread_rad_s;
        let Some(count) = follower.count else {
            checks.require(spread.is_none(), &key("initial_rate_spread_rad_s"), "unused-key", || {
                "is for a fleet, and this follower is a single body; give count, or remove it".to_owned()
            });
            continue;
        };
        checks.require((1..=MAX_BODIES).contains(&count), &key("count"), "out-of-range", || {
            format!("one process cannot host {count} bodies; give 1 to {MAX_BODIES}")
        });
        checks.require(
            spread.iter().flatten().all(|spread| *spread >= 0.0),
            &key("initial_rate_spread_rad_s"),
            "negative",
            || "is a half-width and must not be negative; give 0 or more".to_owned(),
        );
        for (name, plain) in [
            ("inertia_factor", follower.inertia_factor == identical()),
            ("noise_rad_s", follower.noise_rad_s == [0.0; 3]),
            ("bias_rad_s", follower.bias_rad_s == [0.0; 3]),
            ("disturbance_rad_s2", follower.disturbance_rad_s2 == [0.0; 3]),
        ] {
            checks.require(plain, &key(name), "fleet-key", || {
                "is not supported for a fleet, whose bodies equal the leader and are measured without error; remove it or count"
                    .to_owned()
            });
        }
    }
    if raw.follower.iter().any(|follower| follower.count.is_some()) {
        let adapts = raw.controller.as_ref().is_some_and(|controller| controller.adaptation_gain > 0.0);
        checks.require(!adapts, "controller.adaptation_gain", "fleet-key", || {
            "adapts to the inertia of single followers, and a fleet has the leader's; give 0 or remove the fleet"
                .to_owned()
        });
        checks.require(raw.limits.repeats.is_none(), "limits.repeats", "fleet-key", || {
            "is not supported for a fleet; remove it or the fleet".to_owned()
        });
    }
}

/// Returns the component that the observer supplies, 1 to 3: the unmeasured one, or the one that fails. An observer that learns
/// needs all three components at first.
pub(super) fn hidden_axis(raw: &Raw, checks: &mut Checks<'_>) -> Option<usize> {
    let measured = &raw.leader.measured_axes;
    let hidden: Vec<usize> = (1..=3).filter(|axis| !measured.contains(axis)).collect();
    let expected = if raw.observer.kind == Kind::HiddenRate { 2 } else { 3 };
    if measured.len() != expected || hidden.len() != 3 - expected {
        let remedy = match expected {
            2 => "must leave exactly one axis hidden; name two different axes of 1, 2 and 3",
            _ => {
                "must name all axes, because the observer learns; give [1, 2, 3] and let one fail with [[leader.outage]]"
            }
        };
        checks.refuse("leader.measured_axes", "bad-axes", format!("{measured:?} {remedy}"));
        return None;
    }
    let supplied = hidden.first().or(raw.leader.outage.first().map(|outage| &outage.axis));
    // An outage of a nonexistent axis is refused elsewhere.
    supplied.copied().filter(|axis| (1..=3).contains(axis))
}

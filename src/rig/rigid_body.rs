//! The rig `rigid-body`: a leader with one unmeasured component of its angular velocity, and followers that turn as it does.
//!
//! Parameters, and the glue between samples and vectors; the mathematics is in `model`, `observe` and `control`.

use super::{BodyInfo, CertificateReport, ConditionReport, Figure, Rig};
use crate::config::{Checks, ConfigError, Document, finite_positive};
use crate::control::{Certificate, Synchronizer};
use crate::model::{Inertia, RigidBody};
use crate::observe::{HiddenRate, InvariantFilter, Observation, RateSample};
use crate::role::{Body, Estimator, Law};
use crate::sample::{RateCommand, RateEstimate, RateMeasurement, RateTruth, status};
use nalgebra::{Vector1, Vector3};
use serde::{Deserialize, Serialize};

/// All components of a vector.
const ALL: u64 = 0b111;

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Raw {
    leader: RawLeader,
    follower: Vec<RawFollower>,
    observer: RawObserver,
    controller: RawController,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawLeader {
    inertia_kg_m2: [f64; 3],
    initial_rate_rad_s: [f64; 3],
    measured_axes: Vec<usize>,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawFollower {
    name: String,
    initial_rate_rad_s: [f64; 3],
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawObserver {
    decay_rate_per_s: f64,
    #[serde(default)]
    initial_guess_rad_s: f64,
    #[serde(default = "default_floor")]
    observability_floor_rad_s: f64,
}

fn default_floor() -> f64 {
    1e-6
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawController {
    gain_per_s: [f64; 3],
    #[serde(default)]
    predict: bool,
}

/// A leader, its observer, and the followers with their laws.
#[derive(Debug, Clone)]
pub struct RigidBodyRig {
    bodies: Vec<BodyInfo>,
    inertia: Inertia,
    initial_rates: Vec<Vector3<f64>>,
    hidden_axis: usize,
    relation: HiddenRate,
    decay_rate_per_s: f64,
    initial_guess_rad_s: f64,
    gain_per_s: Vector3<f64>,
    predict: bool,
    tick_s: f64,
}

/// Reads and checks the sections of this rig.
pub(super) fn resolve(
    sections: &Document,
    tick_s: f64,
    checks: &mut Checks<'_>,
) -> Result<(Option<RigidBodyRig>, toml::Table), ConfigError> {
    let raw: Raw = sections.read_into()?;
    let table = toml::Table::try_from(&raw).expect("a scenario of plain values is TOML");
    check_followers(&raw.follower, checks);
    finite_positive(checks, "observer.decay_rate_per_s", raw.observer.decay_rate_per_s);
    finite_positive(checks, "observer.observability_floor_rad_s", raw.observer.observability_floor_rad_s);
    for gain in raw.controller.gain_per_s {
        finite_positive(checks, "controller.gain_per_s", gain);
    }
    let hidden_axis = hidden_axis(&raw.leader.measured_axes, checks);
    let inertia = checks.accept("leader.inertia_kg_m2", Inertia::new(raw.leader.inertia_kg_m2));
    let (Some(hidden_axis), Some(inertia)) = (hidden_axis, inertia) else { return Ok((None, table)) };
    let relation = HiddenRate::new(&inertia.coefficients(), hidden_axis, raw.observer.observability_floor_rad_s);
    let Some(relation) = checks.accept("leader.inertia_kg_m2", relation) else { return Ok((None, table)) };

    let mut rig = RigidBodyRig {
        bodies: vec![BodyInfo { name: "leader".to_owned(), driven: false }],
        inertia,
        initial_rates: vec![raw.leader.initial_rate_rad_s.into()],
        hidden_axis,
        relation,
        decay_rate_per_s: raw.observer.decay_rate_per_s,
        initial_guess_rad_s: raw.observer.initial_guess_rad_s,
        gain_per_s: raw.controller.gain_per_s.into(),
        predict: raw.controller.predict,
        tick_s,
    };
    for follower in raw.follower {
        rig.bodies.push(BodyInfo { name: follower.name, driven: true });
        rig.initial_rates.push(follower.initial_rate_rad_s.into());
    }
    rig.check_tick(checks);
    Ok((Some(rig), table))
}

fn check_followers(followers: &[RawFollower], checks: &mut Checks<'_>) {
    checks.require(!followers.is_empty(), "follower", || "there is none; add a [[follower]]".to_owned());
    for (index, follower) in followers.iter().enumerate() {
        let (key, name) = (format!("follower[{index}].name"), &follower.name);
        let plain = (1..=32).contains(&name.len())
            && name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-');
        checks.require(plain, &key, || format!("`{name}` cannot name a process; use 1 to 32 of a-z, 0-9 and -"));
        let reserved = ["leader", "observer", "controller", "run"].contains(&name.as_str());
        let taken = followers[..index].iter().any(|other| other.name == *name);
        checks.require(!reserved && !taken, &key, || format!("`{name}` is taken already; choose another name"));
    }
}

fn hidden_axis(measured: &[usize], checks: &mut Checks<'_>) -> Option<usize> {
    let hidden: Vec<usize> = (1..=3).filter(|axis| !measured.contains(axis)).collect();
    match (measured, hidden.as_slice()) {
        ([_, _], [hidden]) => Some(*hidden),
        _ => {
            checks.refuse(
                "leader.measured_axes",
                format!("{measured:?} does not leave exactly one axis hidden; name two different axes of 1, 2 and 3"),
            );
            None
        }
    }
}

impl RigidBodyRig {
    fn check_tick(&self, checks: &mut Checks<'_>) {
        let m = self.inertia.rate_bound_rad_s(&self.initial_rates[0]);
        let longest_s = self.relation.longest_step_s(m);
        let tick_s = self.tick_s;
        checks.require(tick_s < longest_s, "tick_hz", || {
            format!(
                "the leader may turn at {m:.3} rad/s, so its phase is ambiguous from one tick of {tick_s} s to the next; \
                 raise tick_hz above {:.3}",
                1.0 / longest_s
            )
        });
        let guess_limit = self.relation.longest_step_s(self.initial_guess_rad_s.abs());
        checks.require(tick_s < guess_limit, "observer.initial_guess_rad_s", || {
            format!(
                "at {} rad/s the phase would be ambiguous from tick to tick; guess nearer to 0",
                self.initial_guess_rad_s
            )
        });
        let certificate = self.certificate();
        checks.require(certificate.stable_when_sampled(), "controller.gain_per_s", || {
            format!(
                "the largest gain times the tick is {:.3}, and the sampled loop is unstable from {} on; lower the gain or \
                 raise tick_hz",
                certificate.gain_step.required, certificate.gain_step.value
            )
        });
    }

    fn certificate(&self) -> Certificate {
        Certificate::new(
            &self.inertia.coefficients(),
            self.hidden_axis,
            &self.gain_per_s,
            self.decay_rate_per_s,
            self.inertia.rate_bound_rad_s(&self.initial_rates[0]),
            self.tick_s,
            self.predict,
        )
    }
}

impl Rig for RigidBodyRig {
    type Body = RatePlant;
    type Estimator = RateObserver;
    type Law = RateLaw;

    fn bodies(&self) -> &[BodyInfo] {
        &self.bodies
    }

    fn body(&self, index: usize) -> RatePlant {
        RatePlant {
            body: RigidBody::new(&self.inertia),
            rate: self.initial_rates[index],
            applied: Vector3::zeros(),
            measured: if index == 0 { ALL & !(1 << (self.hidden_axis - 1)) } else { ALL },
        }
    }

    fn estimator(&self) -> RateObserver {
        RateObserver {
            relation: self.relation,
            filter: self.filter(),
            start: self.filter(),
            hidden: self.hidden_axis - 1,
            last: RateSample { rate_rad_s: Vector3::zeros(), torque_rad_s2: Vector3::zeros() },
            status: status::INITIAL,
        }
    }

    fn law(&self, _index: usize) -> RateLaw {
        let lead_s = if self.predict { self.tick_s } else { 0.0 };
        RateLaw { law: Synchronizer::new(RigidBody::new(&self.inertia), self.gain_per_s, lead_s) }
    }

    fn metrics(&self) -> &'static [&'static str] {
        &["sync_error_rad_s", "estimate_error_rad_s"]
    }

    /// |p − ω| of the worst follower, and |ω̂ − ω|.
    fn score<'a>(
        &self,
        truth: impl Fn(usize) -> Option<&'a RateTruth>,
        estimate: Option<&RateEstimate>,
        out: &mut [f64],
    ) {
        let rate = |index| truth(index).map(|truth| Vector3::from(truth.omega_rad_s));
        let distance = |from: Option<Vector3<f64>>, to: Option<Vector3<f64>>| match (from, to) {
            (Some(from), Some(to)) => (from - to).norm(),
            _ => f64::NAN,
        };
        let leader = rate(0);
        let followers = (1..self.bodies.len()).map(|index| distance(rate(index), leader));
        out[0] = followers.fold(0.0, |worst: f64, error| if error > worst || error.is_nan() { error } else { worst });
        out[1] = distance(estimate.map(|estimate| estimate.omega_rad_s.into()), leader);
    }

    fn certificates(&self) -> Vec<CertificateReport> {
        let certificate = self.certificate();
        let condition = |name: &str, condition: crate::control::Condition| ConditionReport {
            name: name.to_owned(),
            value: condition.value,
            required: condition.required,
            holds: condition.holds(),
        };
        let [i, j, _] = [self.hidden_axis % 3 + 1, (self.hidden_axis + 1) % 3 + 1, self.hidden_axis];
        let conditions = vec![
            condition(&format!("[D](19) |k{i}| > |a{i}| M, 1/s"), certificate.paper[0]),
            condition(&format!("[D](19) |k{j}| > |a{j}| M, 1/s"), certificate.paper[1]),
            condition("[D](19) decay rate > |ai| M + |aj| M + |kk|/2, 1/s", certificate.paper[2]),
            condition("exact (Schur) decay rate, 1/s", certificate.exact),
            condition("sampled: limit > |k| h", certificate.gain_step),
        ];
        let mut warnings = Vec::new();
        if certificate.coarse_tick() {
            warnings.push(format!(
                "|k| h = {:.3} is above 0.25: the sampled loop will be visibly slower than designed; raise tick_hz",
                certificate.gain_step.required
            ));
        }
        if !certificate.exact.holds() {
            warnings.push(
                "V is not proven to fall everywhere (the error still converges, at the rate below); raise \
                 observer.decay_rate_per_s or the gains"
                    .to_owned(),
            );
        }
        let report = |body: &BodyInfo| CertificateReport {
            body: body.name.clone(),
            conditions: conditions.clone(),
            rate_per_s: certificate.rate_per_s,
            bounds: vec![Figure { name: "M >= |omega|, rad/s".to_owned(), value: certificate.rate_bound_rad_s }],
            warnings: warnings.clone(),
        };
        self.bodies.iter().filter(|body| body.driven).map(report).collect()
    }
}

impl RigidBodyRig {
    fn filter(&self) -> InvariantFilter<1> {
        InvariantFilter::new(Vector1::new(self.decay_rate_per_s), Vector1::new(self.initial_guess_rad_s))
    }
}

/// A rigid body with its rate gyros and torquers.
#[derive(Debug)]
pub struct RatePlant {
    body: RigidBody,
    rate: Vector3<f64>,
    applied: Vector3<f64>,
    measured: u64,
}

impl Body for RatePlant {
    type Truth = RateTruth;
    type Measurement = RateMeasurement;
    type Command = RateCommand;

    fn apply(&mut self, command: &RateCommand) -> bool {
        let acceleration = Vector3::from(command.acceleration_rad_s2);
        let usable = acceleration.iter().all(|value| value.is_finite());
        if usable {
            self.applied = acceleration;
        }
        usable
    }

    fn apply_safe(&mut self) {
        self.applied = Vector3::zeros();
    }

    fn truth(&self, status: u64, out: &mut RateTruth) {
        out.omega_rad_s = self.rate.into();
        out.applied_rad_s2 = self.applied.into();
        out.status = status;
    }

    fn measure(&self, status: u64, out: &mut RateMeasurement) {
        for axis in 0..3 {
            out.omega_rad_s[axis] = if self.measured >> axis & 1 == 1 { self.rate[axis] } else { 0.0 };
        }
        out.applied_rad_s2 = self.applied.into();
        out.valid = self.measured;
        out.status = status;
    }

    fn flow(&mut self, dt_s: f64) {
        self.rate = self.body.flow(&self.rate, &self.applied, dt_s);
    }
}

/// The observer of the leader's hidden component.
#[derive(Debug)]
pub struct RateObserver {
    relation: HiddenRate,
    filter: InvariantFilter<1>,
    start: InvariantFilter<1>,
    hidden: usize,
    last: RateSample,
    status: u64,
}

impl RateObserver {
    fn seen(measurement: &RateMeasurement) -> RateSample {
        RateSample { rate_rad_s: measurement.omega_rad_s.into(), torque_rad_s2: measurement.applied_rad_s2.into() }
    }
}

impl Estimator for RateObserver {
    type Measurement = RateMeasurement;
    type Estimate = RateEstimate;

    fn usable(&self, measurement: &RateMeasurement) -> bool {
        let needed = ALL & !(1 << self.hidden);
        let finite = |values: &[f64; 3]| values.iter().all(|value| value.is_finite());
        measurement.valid & needed == needed && finite(&measurement.omega_rad_s) && finite(&measurement.applied_rad_s2)
    }

    fn start(&mut self, measurement: &RateMeasurement) {
        self.filter = self.start;
        self.last = Self::seen(measurement);
        self.status = status::INITIAL;
    }

    fn update(&mut self, measurement: &RateMeasurement, dt_s: f64) {
        let seen = Self::seen(measurement);
        match self.relation.observe(&self.last, &seen, dt_s, self.filter.estimate().x) {
            Observation::Seen(increment) => {
                self.filter.step(&increment);
                self.status = 0;
            }
            Observation::Unobservable { drift } => {
                self.filter.predict(&drift);
                self.status |= status::UNOBSERVABLE;
            }
        }
        self.last = seen;
    }

    fn write(&self, status: u64, out: &mut RateEstimate) {
        let mut rate = self.last.rate_rad_s;
        rate[self.hidden] = self.filter.estimate().x;
        out.omega_rad_s = rate.into();
        out.status = self.status | status;
        out.valid = if out.status & status::INITIAL == 0 { ALL } else { ALL & !(1 << self.hidden) };
    }
}

/// The synchronising law of one follower.
#[derive(Debug)]
pub struct RateLaw {
    law: Synchronizer,
}

impl Law for RateLaw {
    type Estimate = RateEstimate;
    type Measurement = RateMeasurement;
    type Command = RateCommand;

    fn command(&mut self, estimate: &RateEstimate, measurement: &RateMeasurement, out: &mut RateCommand) {
        let command = self.law.command(
            &estimate.omega_rad_s.into(),
            &measurement.omega_rad_s.into(),
            &measurement.applied_rad_s2.into(),
        );
        out.acceleration_rad_s2 = command.into();
    }
}

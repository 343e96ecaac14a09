//! What a rig is: the trait, its samples, and what it tells of itself.
//!
//! Must not know any rig.

use super::fleet::Fleet;
use super::pictures::{Picture, graphs};
use crate::config::{BodyInfo, Checks, ConfigError, Document};
use crate::role::{Body, Estimator, Guard, Law, SingleBody};
use crate::sample::FleetSample;
use crate::state::Persist;
use serde::{Deserialize, Serialize};

/// The samples of a rig, by signal.
pub type Truth<R> = <<R as Rig>::Body as Body>::Truth;
/// The samples of a rig, by signal.
pub type Measurement<R> = <<R as Rig>::Body as Body>::Measurement;
/// The samples of a rig, by signal.
pub type Estimate<R> = <<R as Rig>::Estimator as Estimator>::Estimate;
/// The samples of a rig, by signal.
pub type Command<R> = <<R as Rig>::Body as Body>::Command;

/// The samples of a rig's fleets, by signal.
pub type FleetTruth<R> = FleetSample<<<R as Rig>::Fleet as Fleet<Estimate<R>>>::Truth>;
/// The samples of a rig's fleets, by signal.
pub type FleetMeasurement<R> = FleetSample<<<R as Rig>::Fleet as Fleet<Estimate<R>>>::Measurement>;
/// The samples of a rig's fleets, by signal.
pub type FleetCommand<R> = FleetSample<<<R as Rig>::Fleet as Fleet<Estimate<R>>>::Command>;

/// Where a loop begins that is analysed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Start {
    /// As the scenario has it.
    Given,
    /// Where it is to get: the driven body at what it follows, the observer at the truth.
    Settled,
    /// Off that by about so much in every component that the loop controls, in their units: by other parts of it in each, and
    /// the guess by others than the body, so that every mode of the error is excited.
    Off(f64),
    /// Off that by so much in the one that it does not control ([`Rig::FREE`]).
    Shifted(f64),
}

/// A plant, an observer and a control law that belong together.
pub trait Rig: Clone + Send + Sync + 'static {
    /// The kind of body.
    type Body: SingleBody + Persist;
    /// What observes the first body.
    type Estimator: Estimator<Measurement = Measurement<Self>> + Persist;
    /// What drives a driven body.
    type Law: Law<Estimate = Estimate<Self>, Measurement = Measurement<Self>, Command = Command<Self>> + Persist;
    /// What keeps measurements that cannot be from observer and law.
    type MeasurementGuard: Guard<Measurement<Self>> + Persist;
    /// What keeps estimates that cannot be from the law.
    type EstimateGuard: Guard<Estimate<Self>> + Persist;
    /// What keeps commands that cannot be from the actuators.
    type CommandGuard: Guard<Command<Self>> + Persist;
    /// Many bodies in one process; [`NoFleet`](super::NoFleet) where the rig has none.
    type Fleet: Fleet<Estimate<Self>>;
    /// By which a scenario's key `rig` names it.
    const NAMES: &'static [&'static str];
    /// The keys of a scenario that are its own, each of a list of tables.
    const LISTS: &'static [&'static str] = &[];
    /// Of how many components, counted from the first, the `valid` word of measurements and estimates tells.
    const AXES: usize = 0;
    /// The fields of truths and estimates that the loop controls: their errors are to vanish.
    const CONTROLLED: &'static [&'static str] = &[];
    /// The field of truths that the loop does not control, if there is one: a motion that is shifted in it is as good.
    const FREE: Option<&'static str> = None;

    /// The keys of a scenario that are its own, each of one table.
    fn tables() -> Vec<&'static str>;
    /// The rig of this name as its tables describe it, or none if `checks` noted a problem with it; and the tables with every
    /// default filled in.
    ///
    /// # Errors
    /// [`ConfigError`] for keys that are unknown, missing or of the wrong type.
    fn resolve(
        name: &str,
        sections: &Document,
        context: Context,
        checks: &mut Checks<'_>,
    ) -> Result<(Option<Self>, toml::Table), ConfigError>;
    /// The bodies; the first is the observed one.
    fn bodies(&self) -> &[BodyInfo];
    /// A body at its initial state.
    fn body(&self, index: usize) -> Self::Body;
    /// The observer at its initial guess.
    fn estimator(&self) -> Self::Estimator;
    /// The law of a driven body.
    fn law(&self, index: usize) -> Self::Law;
    /// A guard for a body's measurements at a new reader, which `acts` on them or only observes.
    fn measurement_guard(&self, index: usize, acts: bool) -> Self::MeasurementGuard;
    /// A guard for estimates at a new reader.
    fn estimate_guard(&self) -> Self::EstimateGuard;
    /// A guard for a body's commands.
    fn command_guard(&self, index: usize) -> Self::CommandGuard;
    /// The fleet in the place of the body with this index, if there is one.
    fn fleet(&self, _index: usize) -> Option<Self::Fleet> {
        None
    }
    /// The physical bounds that the guards work with.
    fn limits(&self) -> Vec<Figure> {
        Vec::new()
    }
    /// What the controller can hold against a bound of the scenario's `[watchdog]`; at most [`WATCHED_MAX`](crate::control::WATCHED_MAX).
    fn monitors() -> &'static [Monitor<Self>] {
        &[]
    }
    /// What a run is scored by; the unit is the last part of each name.
    fn metrics(&self) -> Vec<&'static str>;
    /// Writes one tick's value of every metric; NaN for what cannot be told without a missing sample, +inf once a body is
    /// lost. `truth` gives the truth of a body by its index, `fleet` that of a fleet.
    fn score<'a>(
        &self,
        truth: impl Fn(usize) -> Option<&'a Truth<Self>>,
        fleet: impl Fn(usize) -> Option<&'a FleetTruth<Self>>,
        estimate: Option<&Estimate<Self>>,
        out: &mut [f64],
    );
    /// How a body's motion has ended, as a verb with its object, if it has.
    fn loss(&self, _truth: &Truth<Self>) -> Option<&'static str> {
        None
    }
    /// This rig with no other driven body than the one with this index, and that a single one, begun there, with or without
    /// noise: for the analysis of its loop. None if the rig cannot tell where that is settled.
    fn isolated(&self, _index: usize, _start: Start, _noisy: bool) -> Option<Self> {
        None
    }
    /// What is proven of the closed loop, one entry per driven body.
    fn certificates(&self) -> Vec<CertificateReport> {
        Vec::new()
    }
    /// Whether a body applied what it was told to at this tick.
    fn undisturbed(_truth: &Truth<Self>) -> bool {
        true
    }
    /// V and the bound on V̇ of a driven body, of the true errors, if the rig has such a function: from the truths of the
    /// observed body and of the driven one, and from the estimate.
    fn true_lyapunov(
        &self,
        _observed: &Truth<Self>,
        _driven: &Truth<Self>,
        _estimate: &Estimate<Self>,
    ) -> Option<(f64, f64)> {
        None
    }
    /// V and the bound on V̇ that a controller published with a command, if the rig has such a function: as it sees them.
    fn lyapunov(_command: &Command<Self>) -> Option<(f64, f64)> {
        None
    }
    /// What a report draws of the motion; every number of the truth over time unless the rig knows better.
    fn pictures() -> Vec<Picture> {
        graphs::<Truth<Self>>()
    }
    /// Overrides that make of this scenario one whose motion a report draws beside that of the run, if there is such a one.
    fn counterpart(&self) -> &'static [&'static str] {
        &[]
    }
    /// What a reader of the results must know of the scenario, such as a declared exception to a rule.
    fn notes(&self) -> Vec<String> {
        Vec::new()
    }
}

/// A quantity that the controller can watch.
pub struct Monitor<R: Rig> {
    /// Its name, with its unit as the last part; the key of its bound is `<name>_max`.
    pub name: &'static str,
    /// How it is told.
    pub watched: Watched<R>,
    /// Why it cannot be watched in this scenario, if so.
    pub absent: fn(&R) -> Option<&'static str>,
}

/// Of what a quantity that is watched is told, and how it is judged.
pub enum Watched<R: Rig> {
    /// Of what the law works on, and not of the truth: constant in a sound loop. Its drift relative to its first values is
    /// judged.
    Constant(fn(&R, &Estimate<R>) -> f64),
    /// Of what the law works on: small in a sound loop.
    Small(fn(&R, &Estimate<R>) -> f64),
    /// Of a command, if that tells it: small in a sound loop.
    Commanded(fn(&Command<R>) -> Option<f64>),
}

/// The observed body's entry of a list, and another one's unless that is the same.
pub(super) fn pair<T: Clone>(of: &[T], other: usize) -> Vec<T> {
    let others = (other > 0).then(|| of[other].clone());
    core::iter::once(of[0].clone()).chain(others).collect()
}

/// What is proven of one driven body's law in continuous time, and the conditions of stability when it is sampled.
#[derive(Debug, Clone, Serialize)]
pub struct CertificateReport {
    /// The driven body.
    pub body: String,
    /// One entry per condition.
    pub conditions: Vec<ConditionReport>,
    /// The slowest exponent of the continuous law's error, 1/s; none where the observer's is not constant.
    pub continuous_rate_per_s: Option<f64>,
    /// What the conditions rest on.
    pub bounds: Vec<Figure>,
    /// What a careful engineer would change.
    pub warnings: Vec<String>,
}

/// A number that a certificate rests on.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Figure {
    /// What it is, with its unit.
    pub name: String,
    /// Its value.
    #[serde(deserialize_with = "crate::telemetry::number_or_nan")]
    pub value: f64,
}

/// One condition of a certificate.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ConditionReport {
    /// Which one, with its source.
    pub name: String,
    /// What is there.
    #[serde(deserialize_with = "crate::telemetry::number_or_nan")]
    pub value: f64,
    /// What it must exceed.
    #[serde(deserialize_with = "crate::telemetry::number_or_nan")]
    pub required: f64,
    /// Whether it does.
    pub holds: bool,
}

/// Checks that a body's name can name a process and is not `taken` by a role or another body.
pub(super) fn check_name<'a>(checks: &mut Checks<'_>, key: &str, name: &str, mut taken: impl Iterator<Item = &'a str>) {
    let plain = (1..=32).contains(&name.len())
        && name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-');
    checks.require(plain, key, "bad-name", || format!("`{name}` cannot name a process; use 1 to 32 of a-z, 0-9 and -"));
    let free =
        !["leader", "observer", "controller", "recorder", "run"].contains(&name) && taken.all(|other| other != name);
    checks.require(free, key, "taken-name", || format!("`{name}` is taken already; choose another name"));
}

/// What a rig must know of the scenario around it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Context {
    /// The period h, s.
    pub tick_s: f64,
    /// How long a run is, s.
    pub duration_s: f64,
    /// The seed of all randomness.
    pub seed: u64,
    /// From so many ticks after its measurement on a command acts.
    pub actuation_delay_ticks: u64,
}

//! The contract of a rig: the trait [`Rig`], its samples, and the figures that it reports.
//!
//! This file does not know any particular rig.

use super::fleet::Fleet;
use super::pictures::{Picture, graphs};
use super::sensors::SensedBody;
use crate::config::{BodyInfo, Checks, ConfigError, Document, InputInfo, Rates, Settings};
use crate::role::{
    Actuation, Body, Controller, Estimator, Guard, Law, LoopBody, LoopControl, Observer, Plant, SingleBody,
};
use crate::sample::FleetSample;
use crate::state::Persist;
use serde::{Deserialize, Serialize};

/// The full state of a rig's body, for recording and scoring.
pub type Truth<R> = <<R as Rig>::Body as Body>::Truth;
/// The sensor readings of a rig's body.
pub type Measurement<R> = <<R as Rig>::Body as Body>::Measurement;
/// The estimate of a rig's observer.
pub type Estimate<R> = <<R as Rig>::Estimator as Estimator>::Estimate;
/// The input of a rig's actuators.
pub type Command<R> = <<R as Rig>::Body as Body>::Command;

/// A body of a rig's loop in one thread.
pub type RigLoopBody<R> =
    LoopBody<SensedBody<<R as Rig>::Body>, <R as Rig>::Estimator, <R as Rig>::Law, Vec<Command<R>>>;

/// Creates a body of a loop in one thread, at its initial state; `controlled` adds its controller.
pub fn loop_body<R: Rig>(
    rig: &R,
    index: usize,
    controlled: bool,
    actuation: Actuation,
    settings: &Settings,
) -> RigLoopBody<R> {
    let control = controlled.then(|| LoopControl {
        controller: controller(rig.law(index), settings),
        commands: vec![Command::<R>::default(); actuation.delay_ticks as usize],
    });
    let plant = plant(sensed_body(rig, index, settings), actuation, settings);
    LoopBody::new(plant, control).observed(further_observer(rig, index, settings))
}

/// Creates a single body with its sensors, at its initial state.
pub fn sensed_body<R: Rig>(rig: &R, index: usize, settings: &Settings) -> SensedBody<R::Body> {
    SensedBody::new(rig.body(index), settings, &rig.bodies()[index].name)
}

/// Creates the plant of a body.
pub fn plant<B: Body>(body: B, actuation: Actuation, settings: &Settings) -> Plant<B> {
    Plant::new(body, actuation, settings.tick_s()).with_substeps(settings.rates.substeps)
}

/// Creates the observer of a rig's first body at its initial guess.
pub fn observer<R: Rig>(rig: &R, settings: &Settings) -> Observer<R::Estimator> {
    observing(rig.estimator(), settings)
}

/// Creates the observer of the body with this index, which is not the first, at its initial guess. Returns `None` if the scenario has
/// none.
pub fn further_observer<R: Rig>(rig: &R, index: usize, settings: &Settings) -> Option<Observer<R::Estimator>> {
    let name = &rig.bodies()[index].name;
    // An isolated rig has fewer bodies than the scenario.
    let observed = settings.bodies.iter().any(|body| body.name == *name && body.observer.is_some());
    let estimator = rig.estimator_of(index).filter(|_| index > 0 && observed);
    estimator.map(|estimator| observing(estimator, settings))
}

fn observing<E: Estimator>(estimator: E, settings: &Settings) -> Observer<E> {
    Observer::new(estimator, settings.tick_s()).every(settings.rates.observer_ticks)
}

/// Creates the controller of a law with the scenario's reference at tick 0.
pub fn controller<L: Law>(law: L, settings: &Settings) -> Controller<L> {
    let controller = Controller::new(law, settings.tick_s()).every(settings.rates.controller_ticks);
    controller.with_reference(&settings.reference)
}

/// The full state of a rig's fleet.
pub type FleetTruth<R> = FleetSample<<<R as Rig>::Fleet as Fleet<Estimate<R>>>::Truth>;
/// The sensor readings of a rig's fleet.
pub type FleetMeasurement<R> = FleetSample<<<R as Rig>::Fleet as Fleet<Estimate<R>>>::Measurement>;
/// The input of the actuators of a rig's fleet.
pub type FleetCommand<R> = FleetSample<<<R as Rig>::Fleet as Fleet<Estimate<R>>>::Command>;

/// The initial state of a loop for its analysis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Start {
    /// As the scenario defines it.
    Given,
    /// The target: the driven body at its reference, the observer at the truth.
    Settled,
    /// Displaced from the target by about this amount in every controlled component, in its unit. The factors differ between
    /// components, and between body and guess, so that every mode of the error is excited.
    Off(f64),
    /// Displaced from the target by this amount in the uncontrolled component ([`Rig::FREE`]).
    Shifted(f64),
}

/// A plant, an observer and a control law that belong together.
///
/// Body 0 is always observed, usually it is the leader; the driven bodies follow it. Most rigs need only
/// [`SimpleRig`](super::SimpleRig), which implements this trait. Implement `Rig` itself for fleets, guards of your own, several
/// rig names, certificates or Lyapunov functions.
///
/// Every associated type that keeps state implements [`Persist`], so that a restarted role can continue.
pub trait Rig: Clone + Send + Sync + 'static {
    /// The plant: a body with its sensors and actuators.
    type Body: SingleBody + Persist;
    /// The observer of a body.
    type Estimator: Estimator<Measurement = Measurement<Self>> + Persist;
    /// The control law of a driven body.
    type Law: Law<Estimate = Estimate<Self>, Measurement = Measurement<Self>, Command = Command<Self>> + Persist;
    /// The guard that rejects impossible measurements before observer and law use them.
    type MeasurementGuard: Guard<Measurement<Self>> + Persist;
    /// The guard that rejects impossible estimates before the law uses them.
    type EstimateGuard: Guard<Estimate<Self>> + Persist;
    /// The guard that rejects impossible commands before the actuators apply them.
    type CommandGuard: Guard<Command<Self>> + Persist;
    /// Many bodies in one process; [`NoFleet`](super::NoFleet) if the rig has none.
    type Fleet: Fleet<Estimate<Self>>;
    /// The values of the scenario key `rig` that select this rig.
    const NAMES: &'static [&'static str];
    /// The scenario keys that belong to this rig and hold a list of tables, such as `follower`.
    const LISTS: &'static [&'static str] = &[];
    /// The number of leading components covered by the `valid` word of measurements and estimates.
    const AXES: usize = 0;
    /// The field of truths that the loop does not control, if there is one, such as an orbit's phase. A motion shifted in this
    /// field is equally good.
    const FREE: Option<&'static str> = None;

    /// Returns the fields of truths and estimates that the loop controls: their errors must vanish.
    fn controlled() -> Vec<&'static str> {
        Vec::new()
    }
    /// Returns the scenario keys that belong to this rig and hold one table, such as `leader`.
    fn tables() -> Vec<&'static str>;
    /// Reads the rig of the given name from its tables. Returns it with the same tables in which every default is filled in. The
    /// rig is `None` if `checks` recorded a problem with it.
    ///
    /// # Errors
    /// [`ConfigError`] for keys that are unknown, missing or of the wrong type.
    fn resolve(
        name: &str,
        sections: &Document,
        context: Context,
        checks: &mut Checks<'_>,
    ) -> Result<(Option<Self>, toml::Table), ConfigError>;
    /// Returns the bodies; the first is always observed.
    fn bodies(&self) -> &[BodyInfo];
    /// Creates a body at its initial state.
    fn body(&self, index: usize) -> Self::Body;
    /// Creates the observer of the first body at its initial guess.
    fn estimator(&self) -> Self::Estimator;
    /// Creates the observer of the body with this index at its initial guess; `None` if a scenario cannot let this body be observed. By
    /// default only the first body can.
    fn estimator_of(&self, index: usize) -> Option<Self::Estimator> {
        (index == 0).then(|| self.estimator())
    }
    /// Creates the law of a driven body.
    fn law(&self, index: usize) -> Self::Law;
    /// Creates a reader's guard for a body's measurements. `acts` is true for a reader that controls with them.
    fn measurement_guard(&self, index: usize, acts: bool) -> Self::MeasurementGuard;
    /// Creates a reader's guard for the estimates of any body.
    fn estimate_guard(&self) -> Self::EstimateGuard;
    /// Creates a guard for a body's commands.
    fn command_guard(&self, index: usize) -> Self::CommandGuard;
    /// Returns the fleet that takes the place of the body with this index, if it is one.
    fn fleet(&self, _index: usize) -> Option<Self::Fleet> {
        None
    }
    /// Returns the physical bounds that the guards use.
    fn limits(&self) -> Vec<Figure> {
        Vec::new()
    }
    /// Returns the quantities that `[watchdog]` can bound; at most [`WATCHED_MAX`](crate::control::WATCHED_MAX).
    fn monitors() -> &'static [Monitor<Self>] {
        &[]
    }
    /// Returns the names of the metrics; the last part of each name is its unit.
    fn metrics(&self) -> Vec<&'static str>;
    /// Returns the fields of the scenario's `[reference]` with the number of elements of each; at most
    /// [`REFERENCE_MAX`](crate::role::REFERENCE_MAX) elements in all, and 6 of one field.
    fn reference() -> Vec<(&'static str, usize)> {
        Vec::new()
    }
    /// Writes one tick's value of every metric: NaN if a sample that it needs is missing, +inf once a body is lost. `truth` returns
    /// the truth of the body with an index, `fleet` that of a fleet, `estimate` the estimate of a body. `reference` has the numbers of the reference at that tick.
    fn score<'a>(
        &self,
        truth: impl Fn(usize) -> Option<&'a Truth<Self>>,
        fleet: impl Fn(usize) -> Option<&'a FleetTruth<Self>>,
        estimate: impl Fn(usize) -> Option<&'a Estimate<Self>>,
        reference: &[f64],
        out: &mut [f64],
    );
    /// Returns how a body's motion has ended, as a verb with its object, such as `leaves the region`.
    fn loss(&self, _truth: &Truth<Self>) -> Option<&'static str> {
        None
    }
    /// Returns this rig reduced to body 0 and the given driven body, which is made a single one, for the analysis of its loop.
    /// The loop starts as `start` says, with sensor noise if `noisy`. Returns `None` if the target state is unknown.
    fn isolated(&self, _index: usize, _start: Start, _noisy: bool) -> Option<Self> {
        None
    }
    /// Returns the rig without noise and rounding of its sensors, for the analysis of a loop that [`isolated`](Self::isolated) does
    /// not know, and for its linearisation.
    #[must_use]
    fn ideal(&self) -> Self {
        self.clone()
    }
    /// Returns the scenario keys that may change while the loop runs.
    fn inputs(&self) -> Vec<InputInfo> {
        Vec::new()
    }
    /// Takes new values of an input that the score uses, from this tick on. `port` is the number in [`inputs`](Rig::inputs).
    fn set_input(&mut self, _port: usize, _values: &[f64]) {}
    /// Returns the proofs about the closed loop, one per driven body.
    fn certificates(&self) -> Vec<CertificateReport> {
        Vec::new()
    }
    /// Returns true if a body's input at this tick was neither a held command nor the safe one.
    fn undisturbed(_truth: &Truth<Self>) -> bool {
        true
    }
    /// Returns V and the bound on V̇ for the driven body with an index, from the truths of the observed and the driven body and from the
    /// estimate. Called only while [`bound_applies`](Rig::bound_applies). Returns `None` if the rig has no Lyapunov function.
    fn true_lyapunov(
        &self,
        _index: usize,
        _observed: &Truth<Self>,
        _driven: &Truth<Self>,
        _estimate: &Estimate<Self>,
    ) -> Option<(f64, f64)> {
        None
    }
    /// Returns true if the bound on V̇ applies to the driven body with an index at the present inputs, such as disturbances. Called
    /// again only after a change of an input.
    fn bound_applies(&self, _index: usize) -> bool {
        true
    }
    /// Returns V and the bound on V̇ that the controller published with a command, computed from its inputs.
    fn lyapunov(_command: &Command<Self>) -> Option<(f64, f64)> {
        None
    }
    /// Returns the pictures of the motion in a report; by default every number of the truth over time, and the commands.
    fn pictures() -> Vec<Picture> {
        graphs::<Truth<Self>, Measurement<Self>, Command<Self>>()
    }
    /// Returns overrides that turn this scenario into a reference run, whose motion a report draws beside this one; empty for
    /// none.
    fn counterpart(&self) -> &'static [&'static str] {
        &[]
    }
    /// Returns notes for readers of the results, such as a declared exception to a rule.
    fn notes(&self) -> Vec<String> {
        Vec::new()
    }
}

/// A quantity that the controller can watch and the scenario's `[watchdog]` can bound.
pub struct Monitor<R: Rig> {
    /// The name, with the unit as the last part. The key of its bound is `<name>_max`.
    pub name: &'static str,
    /// The value, and the way to judge it.
    pub watched: Watched<R>,
    /// Returns the reason why the quantity cannot be watched in a scenario, if there is one.
    pub absent: fn(&R) -> Option<&'static str>,
}

/// The source of a watched quantity, and the way to judge it.
pub enum Watched<R: Rig> {
    /// A function of the law's inputs that is constant in a sound loop. Its drift relative to its first values is judged.
    Constant(fn(&R, &Estimate<R>) -> f64),
    /// A function of the law's inputs that is small in a sound loop.
    Small(fn(&R, &Estimate<R>) -> f64),
    /// A function of a command that is small in a sound loop. `None`: this command does not carry it.
    Commanded(fn(&Command<R>) -> Option<f64>),
}

/// Returns the list reduced to the entry of body 0 and that of body `index`, if that is another one.
pub(super) fn pair<T: Clone>(list: &[T], index: usize) -> Vec<T> {
    let driven = (index > 0).then(|| list[index].clone());
    core::iter::once(list[0].clone()).chain(driven).collect()
}

/// The proofs about one driven body's law in continuous time, and the stability conditions of the sampled law.
#[derive(Debug, Clone, Serialize)]
pub struct CertificateReport {
    /// The name of the driven body.
    pub body: String,
    /// One entry per condition.
    pub conditions: Vec<ConditionReport>,
    /// The slowest exponent of the error under the continuous law, 1/s; `None` if the observer's gain varies.
    pub continuous_rate_per_s: Option<f64>,
    /// The bounds that the conditions assume.
    pub bounds: Vec<Figure>,
    /// Advice on scenario keys to change.
    pub warnings: Vec<String>,
}

/// A number with its name.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Figure {
    /// The name, with the unit.
    pub name: String,
    /// Its value.
    #[serde(deserialize_with = "crate::telemetry::number_or_nan")]
    pub value: f64,
}

/// One condition of a certificate.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ConditionReport {
    /// The condition and its source.
    pub name: String,
    /// The actual value.
    #[serde(deserialize_with = "crate::telemetry::number_or_nan")]
    pub value: f64,
    /// The value that the actual one must exceed.
    #[serde(deserialize_with = "crate::telemetry::number_or_nan")]
    pub required: f64,
    /// True if it does.
    pub holds: bool,
}

/// Checks that a body's name can name a process and is not `taken` by a role or another body.
pub(super) fn check_name<'a>(checks: &mut Checks<'_>, key: &str, name: &str, mut taken: impl Iterator<Item = &'a str>) {
    let plain = (1..=32).contains(&name.len())
        && name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-');
    checks.require(plain, key, "bad-name", || format!("`{name}` cannot name a process; use 1 to 32 of a-z, 0-9 and -"));
    let free =
        !["leader", "observer", "controller", "recorder", "run"].contains(&name) && taken.all(|used| used != name);
    checks.require(free, key, "taken-name", || format!("`{name}` is taken already; choose another name"));
}

/// The settings of a scenario that a rig depends on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Context {
    /// The period h, s.
    pub tick_s: f64,
    /// The length of a run, s.
    pub duration_s: f64,
    /// The seed of all random numbers.
    pub seed: u64,
    /// The number of ticks from a measurement to the tick at which its command acts.
    pub actuation_delay_ticks: u64,
    /// The rates of the roles: the controller's period is `controller_ticks` times h.
    pub rates: Rates,
}

impl Context {
    /// Returns the context of a run of 1 s with period `tick_s`, in which every role computes at every tick.
    pub(crate) fn every_tick(tick_s: f64) -> Self {
        Self { tick_s, duration_s: 1.0, seed: 1, actuation_delay_ticks: 1, rates: Rates::ALL }
    }
}

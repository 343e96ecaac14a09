//! Scores a run from the truth and the estimates. No role in the loop reads both.
//!
//! Must not delay the loop, except through the ticks that it permits in lockstep.

mod response;
mod timed;

pub use response::StepResponse;
pub use timed::TimedView;
pub(crate) use timed::timed_view;

use crate::bus::{Bus, BusError, Carried, Reader, Signal, Topic};
use crate::clock::Grid;
use crate::config::{Accept, ChangeLists, InputInfo, InputUser, Settings, set_point_of};
use crate::input::Shape;
use crate::rig::{BodyInfo, Estimate, FleetTruth, Rig, Truth};
use crate::role::Guard;
use crate::runtime::{AcceptedTicks, Input, LateSamples, NewValue, RoleInputs, Seek, topic};
use crate::sample::{Message, Sample, Stamp, status};
use response::Responses;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The score of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// Ticks at which every sample was present.
    pub scored_ticks: u64,
    /// Ticks at which some sample was missing.
    pub unscored_ticks: u64,
    /// Ticks at which some body was lost. The metrics are infinite then, which JSON writes as null.
    pub faulted_ticks: u64,
    /// One entry per metric of the rig.
    pub metrics: Vec<MetricScore>,
    /// The result of the live certificate, if the rig has one.
    pub certificate: Option<CertificateScore>,
    /// Samples received per scored signal, by service.
    #[serde(skip)]
    pub received: Vec<(String, u64)>,
    /// Per signal and status bit, the number of ticks with this bit set; zero counts are left out.
    pub statuses: BTreeMap<String, BTreeMap<String, u64>>,
    /// The responses to steps of set points and disturbances.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub responses: Vec<StepResponse>,
    /// Recovery time per incident number, s: from the incident's tick until every metric with a limit stays within it, to the end or
    /// to the next incident.
    #[serde(skip)]
    pub recoveries_s: BTreeMap<u64, f64>,
}

/// The number of steps for which the bound on V̇ held for the true errors: V(k+1) ≤ V(k) + h·bound(k). A step is one tick of
/// one driven body; the three counts add up to all steps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct CertificateScore {
    /// Steps for which the bound held, or V was at the rounding floor.
    pub held: u64,
    /// Steps for which the bound did not hold.
    pub broken: u64,
    /// Steps without a verdict: before the first command acts, around missed ticks, and while the motion was unobservable.
    pub unjudged: u64,
}

/// Status bits of an estimate that rests on no information about the hidden component.
const BLIND: u64 = status::UNOBSERVABLE | status::UNUSABLE | status::INITIAL;

/// Returns the V above which its change over one tick exceeds rounding, for rates of the order of 1 rad/s.
///
/// The reconstruction of ε divides the rounding of a measured increment by h, and the change of V over a tick is a part h
/// of V. Errors are therefore significant from rounding/h² on.
pub fn lyapunov_floor(tick_s: f64) -> f64 {
    let error = 64.0 * f64::EPSILON / (tick_s * tick_s);
    error * error
}

/// The score of one metric.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MetricScore {
    /// The metric's name; the unit is the last part.
    pub name: String,
    /// The value at the last scored tick; NaN if no tick was scored.
    #[serde(deserialize_with = "crate::telemetry::number_or_nan")]
    pub last: f64,
    /// The largest value from `accept.settled_by_s` on; `None` if no tick was scored from there on.
    pub settled_max: Option<f64>,
    /// The largest value from `accept.peak_from_s` on, settled or not; `None` if no tick was scored from there on.
    pub peak: Option<f64>,
    /// The tick of the peak.
    pub peak_tick: Option<u64>,
    /// The time from which the value stayed within its limit, s; `None` without a limit, or if it did not stay there.
    pub settled_at_s: Option<f64>,
    /// The integral of the squared value over the run, (unit)² s; unscored ticks add nothing.
    #[serde(deserialize_with = "crate::telemetry::number_or_nan")]
    pub ise: f64,
    /// Ticks without a value from `accept.settled_by_s` on.
    #[serde(skip)]
    pub settled_blank: u64,
    /// Ticks without a value from `accept.peak_from_s` on.
    #[serde(skip)]
    pub peak_blank: u64,
    /// The largest accepted value; infinite without a limit.
    #[serde(skip)]
    limit: f64,
    #[serde(skip)]
    last_above: Option<u64>,
}

/// A scorer that follows a run.
pub trait Scorer {
    /// Scores up to `budget` ticks whose samples have arrived. Returns the number of ticks scored.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    fn poll(&mut self, budget: u64) -> Result<u64, BusError>;
    /// Returns the next tick to score; every tick before it has been consumed.
    fn next_tick(&self) -> u64;
    /// Returns the latest value of the first metric.
    fn latest(&self) -> f64;
    /// Sets the time grid once the epoch is known. Samples of ticks that are not yet due are refused from then on.
    fn start(&mut self, grid: Grid);
    /// Records that a role failed at a tick; `id` is the incident number in [`Score::recoveries_s`].
    fn incident(&mut self, id: u64, tick: u64);
    /// Scores the remaining samples, complete or not, and returns the score.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    fn finish(&mut self) -> Result<Score, BusError>;
}

/// Passes a new value of an input to the score of a rig, or to its reference.
fn take_input<R: Rig>(rig: &mut R, reference: &mut [f64], new: NewValue<'_>) {
    match new.by.user {
        InputUser::Score => rig.set_input(new.by.port, new.values),
        InputUser::Reference => {
            let numbers = reference.iter_mut().skip(new.by.port);
            numbers.zip(new.values).for_each(|(number, value)| *number = *value);
        }
        _ => {}
    }
}

/// Returns the observed bodies but the first, with their indices.
fn further_observed(scenario: &Settings) -> impl Iterator<Item = (usize, &BodyInfo)> {
    scenario.bodies.iter().enumerate().skip(1).filter(|(_, body)| body.observer.is_some())
}

/// Opens the scorer of a rig.
pub(crate) fn score_rig<R: Rig, B: Bus + 'static>(
    rig: &R,
    scenario: &Settings,
    bus: &B,
) -> Result<Box<dyn Scorer>, BusError> {
    Ok(Box::new(RigScorer::open(rig, scenario, bus)?))
}

/// A driven body, for the live certificate.
struct DrivenBody {
    body: usize,
    /// True while the bound on V̇ applies at the present inputs.
    bounded: bool,
    /// The previous tick with its V and its bound on V̇.
    before: Option<(u64, f64, f64)>,
}

/// Returns an element of a numeric field of a sample.
fn number<S: Sample>(sample: &S, name: &str, element: usize) -> Option<f64> {
    let field = S::FIELDS.iter().find(|field| field.name == name && element < field.count)?;
    sample.words().get(field.offset / size_of::<u64>() + element).map(|bits| f64::from_bits(*bits))
}

/// The number of a signal's samples with each status bit set.
struct Statuses {
    signal: String,
    counts: [u64; status::NAMES.len()],
}

impl Statuses {
    fn new(body: &str, signal: Signal) -> Self {
        Self { signal: format!("{body}/{}", signal.name()), counts: [0; status::NAMES.len()] }
    }

    /// Counts the status bits of a sample. Most samples have none.
    #[inline]
    fn take<S: Sample>(&mut self, sample: &S) {
        let bits = sample.status();
        if bits != 0 {
            let counts = self.counts.iter_mut().zip(status::NAMES);
            counts.for_each(|(count, (_, bit))| *count += u64::from(bits & bit != 0));
        }
    }

    /// Returns the counts above zero by name, without `INITIAL`: every estimate begins with its guess.
    fn named(&self) -> impl Iterator<Item = (&'static str, u64)> {
        let counts = status::NAMES.into_iter().zip(self.counts);
        let nonzero = counts.filter(|((_, bit), count)| *count > 0 && *bit != status::INITIAL);
        nonzero.map(|((name, _), count)| (name, count))
    }
}

/// The truth signal of a body or a fleet.
enum TruthInput<R: Rig, B: Bus> {
    One(Input<B, Truth<R>>),
    Fleet(Input<B, FleetTruth<R>>),
}

impl<R: Rig, B: Bus> TruthInput<R, B> {
    fn open(bus: &B, topic: &Topic, fleet: Option<usize>) -> Result<Self, BusError> {
        Ok(match fleet {
            None => Self::One(Input::open(bus, topic, Reader::Scorer)?),
            Some(bodies) => Self::Fleet(Input::open_many(bus, topic, bodies, Reader::Scorer)?),
        })
    }

    fn expect(&mut self, accepted_ticks: AcceptedTicks) {
        match self {
            Self::One(input) => input.expect(accepted_ticks),
            Self::Fleet(input) => input.expect(accepted_ticks),
        }
    }

    fn seek(&mut self, tick: u64) -> Result<Seek, BusError> {
        match self {
            Self::One(input) => input.seek(tick),
            Self::Fleet(input) => input.seek(tick),
        }
    }

    fn last_tick(&self) -> Option<u64> {
        match self {
            Self::One(input) => input.last_tick(),
            Self::Fleet(input) => input.last_tick(),
        }
    }

    fn refresh(&mut self) {
        match self {
            Self::One(input) => input.refresh(),
            Self::Fleet(input) => input.refresh(),
        }
    }

    /// Returns the number of samples received.
    fn samples(&mut self) -> u64 {
        match self {
            Self::One(input) => input.counters().samples(),
            Self::Fleet(input) => input.counters().samples(),
        }
    }

    /// Returns the stamp of the current sample.
    fn stamp(&self) -> Option<&Stamp> {
        match self {
            Self::One(input) => input.sample().map(Message::stamp),
            Self::Fleet(input) => input.sample().map(Message::stamp),
        }
    }

    /// Returns the current sample if it belongs to that tick and to a single body.
    fn body_sample(&self, tick: u64) -> Option<&Truth<R>> {
        if let Self::One(input) = self { at(input, tick) } else { None }
    }

    /// Returns the current sample if it belongs to that tick and to a fleet.
    fn fleet_sample(&self, tick: u64) -> Option<&FleetTruth<R>> {
        if let Self::Fleet(input) = self { at(input, tick) } else { None }
    }
}

/// The estimate signal of a body.
type EstimateInput<R, B> = Input<B, Estimate<R>, <R as Rig>::EstimateGuard>;

struct RigScorer<R: Rig, B: Bus> {
    truths: Vec<TruthInput<R, B>>,
    estimate: EstimateInput<R, B>,
    /// The estimates of other bodies than the first, with the indices of these.
    further_estimates: Vec<(usize, EstimateInput<R, B>)>,
    last_tick: u64,
    scoring: Scoring<R>,
}

/// The score as it grows tick by tick, independent of how the samples arrive.
pub(crate) struct Scoring<R: Rig> {
    rig: R,
    reference: Vec<f64>,
    inputs: RoleInputs,
    infos: Vec<InputInfo>,
    changes: ChangeLists,
    responses: Responses,
    accept: Accept,
    tick_s: f64,
    delay_ticks: u64,
    driven: Vec<DrivenBody>,
    /// The status counts of the first body's estimate, then of every body's truth.
    statuses: Vec<Statuses>,
    /// The status counts of the other estimates, with the indices of their bodies.
    further_statuses: Vec<(usize, Statuses)>,
    services: Vec<String>,
    next_tick: u64,
    /// Per incident: its number, its tick, and the last tick since at which some metric was not known to be within its limit.
    incidents: Vec<(u64, u64, u64)>,
    values: Vec<f64>,
    score: Score,
}

impl<R: Rig> Scoring<R> {
    /// Begins the score of a run; without `follows_inputs` no input changes during it.
    pub fn new(rig: &R, scenario: &Settings, follows_inputs: bool) -> Self {
        let bodies = rig.bodies().iter();
        // The certificate covers single bodies only.
        let driven = bodies.clone().enumerate().filter(|(_, body)| body.driven && body.fleet.is_none());
        let estimates = Statuses::new(&rig.bodies()[0].name, Signal::Estimate);
        let truths = bodies.clone().map(|body| Statuses::new(&body.name, Signal::Truth));
        let further = || further_observed(scenario).map(|(index, body)| (index, &body.name));
        let names = bodies.clone().map(|body| (&body.name, Signal::Truth));
        let signals = core::iter::once((&rig.bodies()[0].name, Signal::Estimate)).chain(names);
        let signals = signals.chain(further().map(|(_, name)| (name, Signal::Estimate)));
        let metric = |name: &&str| MetricScore {
            name: (*name).to_owned(),
            last: f64::NAN,
            settled_max: None,
            peak: None,
            peak_tick: None,
            settled_at_s: None,
            ise: 0.0,
            settled_blank: 0,
            peak_blank: 0,
            limit: scenario.accept.metric_max.get(*name).copied().unwrap_or(f64::INFINITY),
            last_above: None,
        };
        Self {
            rig: rig.clone(),
            reference: scenario.reference.clone(),
            inputs: RoleInputs::new(&scenario.inputs, |_| follows_inputs),
            infos: scenario.inputs.infos.clone(),
            changes: scenario.inputs.lists(),
            responses: Responses::new(scenario.tick_s()),
            accept: scenario.accept.clone(),
            tick_s: scenario.tick_s(),
            delay_ticks: scenario.actuation_delay_ticks,
            driven: driven
                .map(|(body, _)| DrivenBody { body, bounded: rig.bound_applies(body), before: None })
                .collect(),
            statuses: core::iter::once(estimates).chain(truths).collect(),
            further_statuses: further().map(|(index, name)| (index, Statuses::new(name, Signal::Estimate))).collect(),
            services: signals.map(|(body, signal)| topic(scenario, body, signal).to_string()).collect(),
            next_tick: 0,
            incidents: Vec::new(),
            values: vec![f64::NAN; rig.metrics().len()],
            score: Score {
                scored_ticks: 0,
                unscored_ticks: 0,
                faulted_ticks: 0,
                metrics: rig.metrics().iter().map(metric).collect(),
                certificate: None,
                received: Vec::new(),
                statuses: BTreeMap::new(),
                responses: Vec::new(),
                recoveries_s: BTreeMap::new(),
            },
        }
    }

    /// Returns the latest value of the first metric.
    pub fn latest(&self) -> f64 {
        self.score.metrics.first().map_or(f64::NAN, |metric| metric.last)
    }

    /// Scores the next tick from its available samples; `complete` is true if none is missing.
    #[inline]
    pub fn take<'a>(
        &mut self,
        truth: impl Fn(usize) -> Option<&'a Truth<R>> + Copy,
        fleet: impl Fn(usize) -> Option<&'a FleetTruth<R>>,
        estimate: impl Fn(usize) -> Option<&'a Estimate<R>> + Copy,
        complete: bool,
    ) {
        let tick = self.next_tick;
        if self.inputs.is_due(tick) {
            self.apply_inputs(tick);
        }
        *(if complete { &mut self.score.scored_ticks } else { &mut self.score.unscored_ticks }) += 1;
        self.rig.score(truth, fleet, estimate, &self.reference, &mut self.values);
        if self.responses.are_observed() {
            self.responses.take(|body, field, element| number(truth(body)?, field, element));
        }
        let (mut faulted, time_s) = (false, tick as f64 * self.tick_s);
        for (metric, &value) in self.score.metrics.iter_mut().zip(&self.values) {
            faulted |= value == f64::INFINITY;
            metric.take(tick, value, &self.accept, time_s);
            if !value.is_nan() {
                metric.ise += value * value * self.tick_s;
            }
        }
        self.score.faulted_ticks += u64::from(faulted);
        if !self.incidents.is_empty()
            && !self.within()
            && let Some((_, _, last)) = self.incidents.iter_mut().rfind(|(_, from, _)| *from <= tick)
        {
            *last = tick;
        }
        for (body, statuses) in &mut self.further_statuses {
            estimate(*body).into_iter().for_each(|estimate| statuses.take(estimate));
        }
        let (estimate, (estimates, truths)) = (estimate(0), self.statuses.split_at_mut(1));
        estimate.iter().for_each(|estimate| estimates[0].take(*estimate));
        let per_body = truths.iter_mut().enumerate();
        per_body.for_each(|(body, statuses)| truth(body).iter().for_each(|truth| statuses.take(*truth)));
        // The certificate cannot be judged from an estimate without information.
        let seen = estimate.filter(|estimate| estimate.status() & BLIND == 0);
        for driven in &mut self.driven {
            let (observed, own) = (truth(0), truth(driven.body));
            let now = match (observed, own, seen) {
                (Some(observed), Some(own), Some(estimate)) if driven.bounded => {
                    self.rig.true_lyapunov(driven.body, observed, own, estimate)
                }
                _ => None,
            };
            // A follower in hold or in safe state did not apply the command that the certificate assumes.
            let undisturbed = own.is_some_and(|truth| R::undisturbed(truth));
            driven.judge(tick, (self.tick_s, self.delay_ticks), now, undisturbed, &mut self.score.certificate);
        }
        self.next_tick += 1;
    }

    #[cold]
    fn apply_inputs(&mut self, tick: u64) {
        let (rig, reference) = (&mut self.rig, &mut self.reference);
        let begins = self.inputs.advance(tick, |new| take_input(rig, reference, new));
        // V jumps with a set point.
        for driven in &mut self.driven {
            (driven.before, driven.bounded) = (None, self.rig.bound_applies(driven.body));
        }
        // Within a ramp or an excitation there is nothing to look up.
        if !begins {
            return;
        }
        let changes = self.changes.at(tick);
        self.responses.end();
        if changes.iter().all(|change| matches!(change.shape, Shape::Row { .. })) {
            return;
        }
        let before = self.changes.values_at(&self.infos, tick.saturating_sub(1));
        let now = self.changes.values_at(&self.infos, tick);
        for change in changes {
            let Some(info) = self.infos.get(change.input) else { continue };
            // After a pulse only a disturbance has a set point to return to.
            let disturbs = info.response.is_some_and(|field| field.disturbs);
            match change.shape {
                Shape::Step => {}
                Shape::Pulse { .. } if disturbs => {}
                _ => continue,
            }
            let set_point = set_point_of(&self.infos, info).map_or(&[][..], |number| &now[number]);
            self.responses.begin(info, tick, (&before[change.input], &now[change.input]), set_point);
        }
    }

    /// Returns true if every metric with a limit is known and within it.
    fn within(&self) -> bool {
        self.score.metrics.iter().zip(&self.values).all(|(metric, value)| *value <= metric.limit)
    }

    /// Returns the recovery times; empty if no metric has a limit.
    fn recoveries_s(&self) -> BTreeMap<u64, f64> {
        let recovery = |&(id, from, last_outside): &(u64, u64, u64)| {
            let back = last_outside + 1;
            let judged = !self.accept.metric_max.is_empty() && back < self.next_tick;
            judged.then(|| (id, back.saturating_sub(from) as f64 * self.tick_s))
        };
        self.incidents.iter().filter_map(recovery).collect()
    }

    /// Completes the score. `received` yields the sample counts of the first estimate, then of every body's truth, then of the other
    /// estimates.
    pub fn finish(&mut self, received: impl Iterator<Item = u64>) -> Score {
        let services = self.services.iter().cloned();
        self.score.received = services.zip(received).collect();
        self.score.responses = self.responses.finish();
        self.score.recoveries_s = self.recoveries_s();
        if let Some(certificate) = &mut self.score.certificate {
            let steps = self.next_tick * self.driven.len() as u64;
            certificate.unjudged = steps - certificate.held - certificate.broken;
        }
        let named = |statuses: &Statuses| {
            (
                statuses.signal.clone(),
                statuses.named().map(|(name, ticks)| (name.to_owned(), ticks)).collect::<BTreeMap<_, _>>(),
            )
        };
        let statuses = self.statuses.iter().chain(self.further_statuses.iter().map(|(_, statuses)| statuses));
        self.score.statuses = statuses.map(named).filter(|(_, counts)| !counts.is_empty()).collect();
        let (tick_s, ticks) = (self.tick_s, self.next_tick);
        for metric in &mut self.score.metrics {
            let first_within = metric.last_above.map_or(0, |tick| tick + 1);
            let limited = self.accept.metric_max.contains_key(&metric.name);
            metric.settled_at_s = (limited && first_within < ticks).then_some(first_within as f64 * tick_s);
        }
        self.score.clone()
    }
}

impl<R: Rig, B: Bus> RigScorer<R, B> {
    fn open(rig: &R, scenario: &Settings, bus: &B) -> Result<Self, BusError> {
        // Guard and lateness are those of the roles: a sample that they refuse is not scored.
        let estimate = |body: &BodyInfo| {
            let topic = topic(scenario, &body.name, Signal::Estimate);
            let late = LateSamples::for_signal(scenario, Signal::Estimate, &body.name);
            let input = Input::open(bus, &topic, Reader::Scorer)?.with_late(late);
            let mut input = input.with_guard(rig.estimate_guard());
            input.expect(crate::runtime::accepted_ticks(scenario, None));
            Ok(input)
        };
        let further = further_observed(scenario).map(|(index, body)| Ok((index, estimate(body)?)));
        let truth = |body: &BodyInfo| TruthInput::open(bus, &topic(scenario, &body.name, Signal::Truth), body.fleet);
        Ok(Self {
            truths: rig.bodies().iter().map(truth).collect::<Result<_, _>>()?,
            estimate: estimate(&scenario.bodies[0])?,
            further_estimates: further.collect::<Result<_, BusError>>()?,
            last_tick: scenario.last_tick,
            scoring: Scoring::new(rig, scenario, true),
        })
    }

    /// Returns true if no sample of the next tick can still arrive.
    fn settled(&mut self) -> Result<bool, BusError> {
        let next = self.scoring.next_tick;
        let mut waiting = self.estimate.seek(next)? == Seek::NotYet;
        for (_, estimate) in &mut self.further_estimates {
            waiting = waiting || estimate.seek(next)? == Seek::NotYet;
        }
        for truth in &mut self.truths {
            waiting = waiting || truth.seek(next)? == Seek::NotYet;
        }
        Ok(!waiting)
    }

    fn estimates(&mut self) -> impl Iterator<Item = &mut EstimateInput<R, B>> {
        std::iter::once(&mut self.estimate).chain(self.further_estimates.iter_mut().map(|(_, estimate)| estimate))
    }

    /// Connects every input to its current writer: a writer that ends unconnected takes its samples with it.
    fn connect(&mut self) {
        self.estimates().for_each(Input::refresh);
        self.truths.iter_mut().for_each(TruthInput::refresh);
    }

    fn score_tick(&mut self) {
        let tick = self.scoring.next_tick;
        let (truths, first, further) = (&self.truths, at(&self.estimate, tick), &self.further_estimates);
        let arrived = |(_, estimate): &(usize, EstimateInput<R, B>)| at(estimate, tick).is_some();
        let complete = first.is_some()
            && further.iter().all(arrived)
            && truths.iter().all(|truth| truth.stamp().is_some_and(|stamp| stamp.tick == tick));
        let estimate = |body: usize| match body {
            0 => first,
            _ => further.iter().find(|(index, _)| *index == body).and_then(|(_, estimate)| at(estimate, tick)),
        };
        self.scoring.take(
            |body| truths[body].body_sample(tick),
            |body| truths[body].fleet_sample(tick),
            estimate,
            complete,
        );
    }
}

impl DrivenBody {
    /// Judges the step from the previous tick to this one; `now` holds V and the bound on V̇, if known.
    #[inline]
    fn judge(
        &mut self,
        tick: u64,
        (tick_s, delay_ticks): (f64, u64),
        now: Option<(f64, f64)>,
        undisturbed: bool,
        score: &mut Option<CertificateScore>,
    ) {
        let now = now.filter(|(v, bound)| v.is_finite() && bound.is_finite());
        if let Some((v, _)) = now {
            let score = score.get_or_insert_default();
            // V is controlled only once the first command acts.
            if let Some((before, v_before, bound)) = self.before
                && before + 1 == tick
                && before >= delay_ticks
                && undisturbed
            {
                let holds = v <= v_before + tick_s * bound || v <= lyapunov_floor(tick_s);
                *(if holds { &mut score.held } else { &mut score.broken }) += 1;
            }
        }
        self.before = now.filter(|_| undisturbed).map(|(v, bound)| (tick, v, bound));
    }
}

/// Returns the current sample if it belongs to that tick.
fn at<B: Bus, S: Carried + ?Sized, G: Guard<S>>(input: &Input<B, S, G>, tick: u64) -> Option<&S> {
    input.sample().filter(|sample| sample.stamp().tick == tick)
}

impl MetricScore {
    #[inline]
    fn take(&mut self, tick: u64, value: f64, accept: &Accept, time_s: f64) {
        if value.is_nan() {
            self.settled_blank += u64::from(time_s >= accept.settled_by_s);
            self.peak_blank += u64::from(time_s >= accept.peak_from_s);
            return;
        }
        self.last = value;
        if time_s >= accept.settled_by_s {
            // No value here is NaN, for which `f64::max` would pay.
            self.settled_max = Some(self.settled_max.map_or(value, |worst| if value > worst { value } else { worst }));
        }
        if time_s >= accept.peak_from_s && self.peak.is_none_or(|peak| value > peak) {
            (self.peak, self.peak_tick) = (Some(value), Some(tick));
        }
        if value > self.limit {
            self.last_above = Some(tick);
        }
    }
}

impl<R: Rig, B: Bus> Scorer for RigScorer<R, B> {
    fn poll(&mut self, budget: u64) -> Result<u64, BusError> {
        let before = self.next_tick();
        while self.next_tick() <= self.last_tick
            && self.next_tick() < before.saturating_add(budget)
            && self.settled()?
        {
            self.score_tick();
        }
        let scored = self.next_tick() - before;
        if scored == 0 {
            self.connect();
        }
        Ok(scored)
    }

    fn next_tick(&self) -> u64 {
        self.scoring.next_tick
    }

    fn latest(&self) -> f64 {
        self.scoring.latest()
    }

    fn start(&mut self, grid: Grid) {
        let accepted_ticks = AcceptedTicks::Due(grid);
        self.truths.iter_mut().for_each(|truth| truth.expect(accepted_ticks));
        self.estimates().for_each(|estimate| estimate.expect(accepted_ticks));
    }

    fn incident(&mut self, id: u64, tick: u64) {
        self.scoring.incidents.push((id, tick, tick));
    }

    fn finish(&mut self) -> Result<Score, BusError> {
        // A sample that has not arrived by now is lost: continue while any input holds a newer one.
        loop {
            self.poll(u64::MAX)?;
            let newest = |tick: Option<u64>| tick.is_some_and(|tick| tick >= self.scoring.next_tick);
            let more = newest(self.estimate.last_tick())
                || self.further_estimates.iter().any(|(_, estimate)| newest(estimate.last_tick()))
                || self.truths.iter().any(|truth| newest(truth.last_tick()));
            if !more || self.next_tick() > self.last_tick {
                break;
            }
            self.score_tick();
        }
        let estimates = self.estimate.counters().samples();
        let truths = self.truths.iter_mut().map(TruthInput::samples);
        let further = self.further_estimates.iter_mut().map(|(_, estimate)| estimate.counters().samples());
        Ok(self.scoring.finish(core::iter::once(estimates).chain(truths).chain(further)))
    }
}

#[cfg(test)]
mod tests {
    use crate::bus::domain::OwnedDomain;
    use crate::bus::iox::IoxBus;
    use crate::config::SHIPPED;
    use crate::runtime::{Poll, RoleId, RunCondition, depths, private_ledger};
    use crate::scenario::{Scenario, build, scorer};

    /// A follower sends the first truth and ends before any estimate has arrived.
    #[test]
    fn a_truth_whose_writer_has_ended_is_scored() {
        let (name, text) = SHIPPED[0];
        let overrides = ["clock=lockstep", "duration_s=0.002", "accept={}"].map(str::to_owned);
        let scenario = &Scenario::parse(text, name, &overrides).unwrap();
        let domain = OwnedDomain::create(0).unwrap();
        let bus = IoxBus::enter(domain.domain(), "test", depths(scenario)).unwrap();
        let mut scorer = scorer(scenario, &bus).unwrap();
        let roles = RoleId::all(scenario);
        let ledgers: Vec<_> = roles.iter().map(|role| private_ledger(scenario, *role)).collect();
        let nodes = roles.iter().zip(&ledgers).map(|(role, ledger)| build(scenario, *role, &bus, ledger).unwrap());
        let mut nodes: Vec<_> = nodes.collect();
        assert_eq!(scorer.poll(u64::MAX).unwrap(), 0);
        let follower = roles.iter().position(|role| *role == RoleId::Plant(1)).unwrap();
        let mut follower = nodes.remove(follower);
        for node in std::iter::once(&mut follower).chain(&mut nodes) {
            assert_eq!(node.poll(RunCondition::Inputs { up_to: 0 }).unwrap(), Poll::Executed);
            node.finish_tick().unwrap();
        }
        drop(follower);
        assert_eq!(scorer.poll(u64::MAX).unwrap(), 1);
        assert_eq!(scorer.finish().unwrap().unscored_ticks, 0);
    }
}

//! The score as it grows tick by tick, independent of how the samples arrive.

use super::response::Responses;
use super::result::{CertificateScore, MetricScore, Score};
use crate::bus::Signal;
use crate::config::{Accept, ChangeLists, InputInfo, InputUser, Settings, set_point_of};
use crate::input::Shape;
use crate::rig::{BodyInfo, Estimate, FleetTruth, Rig, Truth};
use crate::runtime::{NewValue, RoleInputs, topic};
use crate::sample::{Sample, status};
use std::collections::BTreeMap;

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

/// The score up to a tick.
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
    pub(super) next_tick: u64,
    /// Per incident: its number, its tick, and the last tick since at which some metric was not known to be within its limit.
    pub(super) incidents: Vec<(u64, u64, u64)>,
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

/// A driven body, for the live certificate.
struct DrivenBody {
    body: usize,
    /// True while the bound on V̇ applies at the present inputs.
    bounded: bool,
    /// The previous tick with its V and its bound on V̇.
    before: Option<(u64, f64, f64)>,
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

/// Returns an element of a numeric field of a sample.
fn number<S: Sample>(sample: &S, name: &str, element: usize) -> Option<f64> {
    let field = S::FIELDS.iter().find(|field| field.name == name && element < field.count)?;
    sample.words().get(field.offset / size_of::<u64>() + element).map(|bits| f64::from_bits(*bits))
}

/// Passes a new value of an input to the score of a rig, or to its reference.
pub(super) fn take_input<R: Rig>(rig: &mut R, reference: &mut [f64], new: NewValue<'_>) {
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
pub(super) fn further_observed(scenario: &Settings) -> impl Iterator<Item = (usize, &BodyInfo)> {
    scenario.bodies.iter().enumerate().skip(1).filter(|(_, body)| body.observer.is_some())
}

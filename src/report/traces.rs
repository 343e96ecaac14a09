//! Reads a recording once: the signals of all charts in columns, and the metrics as the launcher scores them.
//!
//! Memory does not grow with the length of the run. Ignores the samples that roles ignore: late, repeated and broken ones,
//! and those that a guard rejects. Must not know charts.

use super::columns::{Columns, Corners, Count, Extremes};
use super::windows::{WindowTrace, windows};
use crate::bus::Signal;
use crate::record::{RecordError, Recording, SignalInfo};
use crate::rig::{Picture, Plane, WordGuard};
use crate::sample::{Column, FieldKind, Order, Place, Stamp, status};
use crate::scenario::AnyRig;
use crate::scenario::Scenario;
use crate::score::{StepResponse, TimedView, lyapunov_floor};
use std::collections::BTreeMap;
use std::sync::Arc;

/// The number of ticks behind the newest after which a tick is scored with the samples that it has.
const WINDOW_TICKS: u64 = 2048;
/// The largest number of driven bodies with traces; all bodies are scored.
pub const BODIES_SHOWN: usize = 4;

/// The traces of a recording.
#[derive(Debug, Default)]
pub struct Traces {
    /// The first and last tick with a sample.
    pub ticks: Option<(u64, u64)>,
    /// The names of the bodies.
    pub bodies: Vec<String>,
    /// Values by body, signal, field and element. The bodies of a fleet share a trace.
    pub values: BTreeMap<Key, Columns<Extremes>>,
    /// Paths by body and by the title of the plane.
    pub paths: BTreeMap<(String, &'static str), Columns<Corners>>,
    /// The metrics over time.
    pub metrics: Vec<MetricTrace>,
    /// The measured decay rate of V and its bound, by body, while V exceeds rounding errors.
    pub falls: BTreeMap<String, [Columns<Extremes>; 2]>,
    /// The samples and lateness of the roles, in the order of a tick.
    pub roles: Vec<RoleTrace>,
    /// The number of ticks with all samples that the metrics need.
    pub scored_ticks: u64,
    /// The number of ticks at which the first body's estimate reported a degraded status, by status.
    pub unseen: BTreeMap<&'static str, Columns<Count>>,
    /// The responses to the given steps.
    pub windows: Vec<WindowTrace>,
}

/// Returns the name under which the estimate of a body is drawn: that of its observer.
pub fn observer_name(index: usize, body: &str) -> String {
    if index == 0 { "observer".to_owned() } else { format!("observer-{body}") }
}

/// The status bits of a degraded estimate.
const UNSEEN: u64 = status::UNOBSERVABLE | status::UNUSABLE | status::AXIS_LOST | status::DEGRADED;

/// Body, signal, field, element.
pub type Key = (String, &'static str, String, usize);

/// The samples of a role.
#[derive(Debug, Default)]
pub struct RoleTrace {
    pub role: String,
    service: String,
    pub samples: Columns<Count>,
    pub lateness_us: Columns<Extremes>,
    /// The number of samples with stamps before their due time, and the largest difference, µs.
    pub early: (u64, f64),
}

/// A metric over time.
#[derive(Debug)]
pub struct MetricTrace {
    pub name: &'static str,
    pub values: Columns<Extremes>,
    pub last: f64,
    last_tick: u64,
    /// The largest value from `accept.settled_by_s` on.
    pub settled_max: Option<f64>,
}

/// Reads the traces of a recording, with the responses to `steps`. The scenario has the changes that the run received.
///
/// # Errors
/// [`RecordError`], also if the layouts of its samples differ from the scenario's.
pub fn trace(recording: &Recording, scenario: &Scenario, steps: &[StepResponse]) -> Result<Traces, RecordError> {
    recording.check_layouts(scenario)?;
    let mut tracer = Tracer::new(scenario, recording);
    tracer.traces.windows = windows(steps, scenario, recording);
    tracer.run(recording)
}

/// A recorded signal while its samples are read.
struct SignalTrace {
    /// The signal; `None` if the scenario has no signal of this name and length.
    kind: Option<Signal>,
    guard: Option<Box<dyn WordGuard>>,
    body: usize,
    role: Option<usize>,
    order: Order,
    /// The index of the status word, if the samples have one.
    status: Option<usize>,
    /// The traced fields.
    fields: Vec<Field>,
}

struct Field {
    offset: usize,
    count: usize,
    /// The elements per component: one for each body of a fleet.
    bodies: usize,
    /// The offset of the word whose bits mark the measured elements, if elements can be missing.
    valid: Option<usize>,
    traces: Vec<(Key, Columns<Extremes>)>,
}

/// The truths of all bodies and the estimates of a tick that is still incomplete, by body.
struct Pending {
    truths: Vec<Option<Vec<u64>>>,
    estimates: Vec<Option<Vec<u64>>>,
}

/// Views of samples with the inputs of their tick. Each of them sees its ticks in order.
struct Views {
    complete: Box<dyn TimedView>,
    incomplete: Box<dyn TimedView>,
    /// One per body.
    commands: Vec<Box<dyn TimedView>>,
}

impl Views {
    fn new(scenario: &Scenario) -> Self {
        let view = || scenario.rig.timed_view(scenario);
        let commands = scenario.rig.bodies().iter().map(|_| view()).collect();
        Self { complete: view(), incomplete: view(), commands }
    }
}

struct Tracer {
    rig: Arc<dyn AnyRig>,
    /// True for each body with an observer.
    observed: Vec<bool>,
    views: Views,
    tick_s: f64,
    settled_by_s: f64,
    epoch_ns: u64,
    period_ns: u64,
    last_tick: u64,
    signals: Vec<SignalTrace>,
    pending: BTreeMap<u64, Pending>,
    newest: u64,
    /// The tick, V and the bound on its rate at the last command, by body.
    before: BTreeMap<usize, (u64, f64, f64)>,
    metrics: Vec<f64>,
    planes: Vec<Plane>,
    traces: Traces,
}

fn plane(picture: Picture) -> Option<Plane> {
    if let Picture::Plane(plane) = picture { Some(plane) } else { None }
}

impl Tracer {
    fn new(scenario: &Scenario, recording: &Recording) -> Self {
        let (rig, info) = (&scenario.rig, recording.info());
        let metric = |name: &&'static str| MetricTrace {
            name,
            values: Columns::default(),
            last: f64::NAN,
            last_tick: 0,
            settled_max: None,
        };
        let bodies = rig.bodies().iter().map(|body| body.name.to_string()).collect();
        let mut traces = Traces { bodies, metrics: rig.metrics().iter().map(metric).collect(), ..Traces::default() };
        let signals = recording.signals().iter().map(|signal| SignalTrace::new(&**rig, signal, &mut traces)).collect();
        Self {
            rig: rig.clone(),
            observed: scenario.bodies.iter().map(|body| body.observer.is_some()).collect(),
            views: Views::new(scenario),
            tick_s: info.period_ns as f64 / 1e9,
            settled_by_s: scenario.accept.settled_by_s,
            epoch_ns: info.epoch_ns,
            period_ns: info.period_ns.max(1),
            last_tick: info.last_tick,
            signals,
            pending: BTreeMap::new(),
            newest: 0,
            before: BTreeMap::new(),
            metrics: vec![f64::NAN; rig.metrics().len()],
            planes: rig.pictures().into_iter().filter_map(plane).collect(),
            traces,
        }
    }

    fn run(mut self, recording: &Recording) -> Result<Traces, RecordError> {
        recording.visit(|signal, received_ns, sample| self.take(signal, received_ns, sample))?;
        while let Some((tick, pending)) = self.pending.pop_first() {
            self.score(tick, &pending, false);
        }
        let mut traces = self.traces;
        for field in self.signals.into_iter().flat_map(|signal| signal.fields) {
            traces.values.extend(field.traces);
        }
        traces.roles.retain(|role| role.samples.iter().next().is_some());
        Ok(traces)
    }

    fn take(&mut self, index: usize, received_ns: u64, sample: &[u8]) {
        let stamp: Stamp = bytemuck::pod_read_unaligned(&sample[..size_of::<Stamp>()]);
        let (tick, signal) = (stamp.tick, &mut self.signals[index]);
        // A recorder may read its clock just before a tick.
        let due_tick = received_ns.saturating_sub(self.epoch_ns) / self.period_ns + 1;
        let max_tick = signal.order.max_tick((self.epoch_ns > 0).then_some(due_tick), self.last_tick);
        let place = signal.order.place(&stamp, max_tick);
        if !matches!(place, Place::NoSample | Place::Sample) {
            return;
        }
        let (first, last) = self.traces.ticks.unwrap_or((tick, tick));
        self.traces.ticks = Some((first.min(tick), last.max(tick)));
        if place == Place::NoSample {
            return;
        }
        if let Some(role) = signal.role {
            let role = &mut self.traces.roles[role];
            role.samples.at(tick).0 += 1;
            if self.epoch_ns > 0 {
                let due_ns = self.epoch_ns as f64 + tick as f64 * self.period_ns as f64;
                let late_us = (stamp.sent_ns as f64 - due_ns) / 1e3;
                if late_us >= 0.0 {
                    role.lateness_us.at(tick).take(late_us);
                } else if stamp.sent_ns > 0 {
                    role.early = (role.early.0 + 1, role.early.1.max(-late_us));
                }
            }
        }
        if self.accepted(index, tick, sample) {
            self.signals[index].fields.iter_mut().for_each(|field| field.take(tick, sample));
        }
    }

    /// Stores the sample if a metric needs it; returns true if its guard accepts it.
    fn accepted(&mut self, index: usize, tick: u64, sample: &[u8]) -> bool {
        let signal = &mut self.signals[index];
        let (body, kind) = (signal.body, signal.kind);
        self.newest = tick.max(self.newest);
        let words: Vec<u64> = sample.chunks_exact(8).map(bytemuck::pod_read_unaligned).collect();
        if signal.guard.as_mut().is_some_and(|guard| !guard.accepts(&words)) {
            return false;
        }
        match kind {
            Some(Signal::Truth) => {
                if self.rig.bodies()[body].fleet.is_none() {
                    self.path(body, tick, sample, index);
                }
                self.keep(tick, |pending| pending.truths[body] = Some(words));
            }
            Some(Signal::Estimate) => {
                self.path(body, tick, sample, index);
                if body == 0 {
                    self.unseen(tick, self.signals[index].status.map_or(0, |word| words[word]));
                }
                self.keep(tick, |pending| pending.estimates[body] = Some(words));
            }
            Some(Signal::Command) => self.fall(body, tick, &words),
            _ => {}
        }
        true
    }

    /// Counts the degraded status bits of the first body's estimate.
    fn unseen(&mut self, tick: u64, status: u64) {
        for (name, _) in status::NAMES.into_iter().filter(|(_, bit)| status & UNSEEN & bit != 0) {
            self.traces.unseen.entry(name).or_default().at(tick).0 += 1;
        }
    }

    fn keep(&mut self, tick: u64, put: impl FnOnce(&mut Pending)) {
        let bodies = self.observed.len();
        let blank = || Pending { truths: vec![None; bodies], estimates: vec![None; bodies] };
        let pending = self.pending.entry(tick).or_insert_with(blank);
        put(pending);
        let mut estimates = pending.estimates.iter().zip(&self.observed);
        if estimates.all(|(estimate, observed)| estimate.is_some() || !observed)
            && pending.truths.iter().all(Option::is_some)
        {
            if let Some(whole) = self.pending.remove(&tick) {
                self.traces.scored_ticks += 1;
                self.score(tick, &whole, true);
            }
        } else if let Some(first) = self.pending.first_entry()
            && first.key().saturating_add(WINDOW_TICKS) < self.newest
        {
            let (tick, part) = first.remove_entry();
            self.score(tick, &part, false);
        }
    }

    fn score(&mut self, tick: u64, pending: &Pending, complete: bool) {
        let words = |body: usize, signal| match signal {
            Signal::Truth => pending.truths[body].as_deref(),
            Signal::Estimate => pending.estimates[body].as_deref(),
            _ => None,
        };
        let view = if complete { &mut self.views.complete } else { &mut self.views.incomplete };
        view.advance(tick);
        view.words().score_words(&words, view.reference(), &mut self.metrics);
        self.traces.windows.iter_mut().for_each(|window| window.take(tick, |body| words(body, Signal::Truth)));
        let settled = tick as f64 * self.tick_s >= self.settled_by_s;
        for (metric, &value) in self.traces.metrics.iter_mut().zip(&self.metrics).filter(|(_, value)| !value.is_nan()) {
            metric.values.at(tick).take(value);
            // An incomplete tick may be scored after later ones.
            if tick >= metric.last_tick {
                (metric.last, metric.last_tick) = (value, tick);
            }
            if settled {
                metric.settled_max = Some(metric.settled_max.map_or(value, |worst| worst.max(value)));
            }
        }
    }

    /// Adds the decay rate of V from the last command to this one, and its bound, where the bound applies.
    fn fall(&mut self, body: usize, tick: u64, command: &[u64]) {
        let view = &mut self.views.commands[body];
        if view.advance(tick) {
            // V jumps with an input.
            self.before.remove(&body);
        }
        let lyapunov = view.words().lyapunov_words(command).filter(|_| view.words().bound_applies(body));
        let Some((v, bound)) = lyapunov else { return };
        let name = &self.traces.bodies[body];
        if let Some((before, v_before, bound)) = self.before.insert(body, (tick, v, bound))
            && before + 1 == tick
            && v > lyapunov_floor(self.tick_s)
        {
            let falls = self.traces.falls.entry(name.clone()).or_default();
            falls[0].at(before).take((v_before - v) / self.tick_s);
            falls[1].at(before).take(-bound);
        }
    }

    /// Adds a point to the paths of a body or an estimate in all planes.
    fn path(&mut self, body: usize, tick: u64, sample: &[u8], index: usize) {
        let owner = match self.signals[index].kind {
            Some(Signal::Estimate) => observer_name(body, &self.traces.bodies[body]),
            _ => self.traces.bodies[body].clone(),
        };
        let fields = &self.signals[index].fields;
        let element = |name: &str, element| {
            let field = fields.iter().find(|field| field.is(name))?;
            (element < field.count).then(|| field.value(sample, element))
        };
        for plane in &self.planes {
            if let Some([x, y]) = (plane.point)(&element) {
                self.traces.paths.entry((owner.clone(), plane.title)).or_default().at(tick).take(tick, x, y);
            }
        }
    }
}

impl SignalTrace {
    fn new(rig: &dyn AnyRig, info: &SignalInfo, traces: &mut Traces) -> Self {
        let body = rig.bodies().iter().position(|body| body.name == info.body);
        let fleet = body.and_then(|body| rig.bodies()[body].fleet);
        let signals = [Signal::Truth, Signal::Measurement, Signal::Estimate, Signal::Command];
        // A signal that the scenario does not have, or that has another length, is not traced.
        let fits = |signal: &Signal| {
            let length = body.and_then(|body| rig.length(body, *signal));
            info.signal == signal.name() && length.is_some_and(|words| 8 * words == info.layout.size())
        };
        let kind = signals.into_iter().find(fits);
        let guard = kind.zip(body).and_then(|(signal, body)| rig.guard(body, signal));
        let body = body.unwrap_or(0);
        let shown = kind.is_some() && body <= BODIES_SHOWN;
        let columns = info.layout.columns.iter().skip(Stamp::FIELDS.len());
        let columns = columns.filter(|column| shown && column.kind == FieldKind::F64);
        // Only elements of the first field can be missing in a measurement.
        let named = |name: &str| info.layout.columns.iter().find(|column| column.name == name);
        let valid = named("valid").filter(|_| kind == Some(Signal::Measurement));
        let name = kind.map_or("", Signal::name);
        let field = |(place, column): (usize, &Column)| {
            let valid = valid.filter(|_| place == 0 && column.count == rig.axes()).map(|valid| valid.offset);
            Field { valid, ..Field::new(column, info, name, fleet.unwrap_or(1)) }
        };
        let fields = columns.enumerate().map(field).collect();
        let status = named("status").map(|status| status.offset / size_of::<u64>());
        Self { kind, guard, body, role: role(info, traces), order: Order::default(), status, fields }
    }
}

/// Returns the index of the role that sends a signal; `None` for the truth, and for all but the first signal of a role.
fn role(info: &SignalInfo, traces: &mut Traces) -> Option<usize> {
    if info.signal == "truth" || info.role.is_empty() {
        return None;
    }
    if let Some(place) = traces.roles.iter().position(|trace| trace.role == info.role) {
        return (traces.roles[place].service == info.service).then_some(place);
    }
    let (role, service) = (info.role.clone(), info.service.clone());
    traces.roles.push(RoleTrace { role, service, ..RoleTrace::default() });
    Some(traces.roles.len() - 1)
}

impl Field {
    fn new(column: &Column, info: &SignalInfo, signal: &'static str, bodies: usize) -> Self {
        let bodies = bodies.max(1);
        let key = |element| (info.body.clone(), signal, column.name.clone(), element);
        let traces = (0..column.count / bodies).map(|element| (key(element), Columns::default())).collect();
        Self { offset: column.offset, count: column.count, bodies, valid: None, traces }
    }

    fn is(&self, name: &str) -> bool {
        self.traces.first().is_some_and(|(key, _)| key.2 == name)
    }

    fn value(&self, sample: &[u8], element: usize) -> f64 {
        bytemuck::pod_read_unaligned(&sample[self.offset + 8 * element..][..8])
    }

    fn take(&mut self, tick: u64, sample: &[u8]) {
        let bodies = self.bodies;
        let valid = self.valid.map_or(u64::MAX, |offset| bytemuck::pod_read_unaligned(&sample[offset..][..8]));
        for component in 0..self.traces.len() {
            for body in (0..bodies).filter(|_| valid >> component.min(63) & 1 == 1) {
                let value = self.value(sample, component * bodies + body);
                self.traces[component].1.at(tick).take(value);
            }
        }
    }
}

fn whole_name((body, signal, field, _): &Key) -> String {
    format!("{body}/{signal}.{field}")
}

impl Traces {
    /// Returns the trace of an element of a field.
    pub fn get(&self, body: &str, signal: &'static str, field: &str, element: usize) -> Option<&Columns<Extremes>> {
        self.values.get(&(body.to_owned(), signal, field.to_owned(), element))
    }

    /// Returns the elements of a field, such as `leader/estimate.omega_rad_s`, or one element, such as
    /// `leader/estimate.omega_rad_s[2]`.
    pub fn named<'a>(&'a self, name: &'a str) -> impl Iterator<Item = (&'a Key, &'a Columns<Extremes>)> {
        let matches = move |key: &Key| whole_name(key) == name || format!("{}[{}]", whole_name(key), key.3) == name;
        self.values.iter().filter(move |(key, _)| matches(key))
    }

    /// Returns the names of all fields.
    pub fn names(&self) -> String {
        let mut names: Vec<String> = self.values.keys().map(whole_name).collect();
        names.dedup();
        names.join(", ")
    }

    /// Returns the intervals of a degraded status, in ticks, and the number of ticks in them.
    pub fn unseen_spans(&self, name: &str) -> (Vec<(u64, u64)>, u64) {
        let (mut spans, mut total) = (Vec::<(u64, u64)>::new(), 0);
        let columns =
            self.unseen.get(name).into_iter().flat_map(|columns| columns.iter().map(|c| (columns.stride(), c)));
        for (stride, (from, count)) in columns.filter(|(_, (_, count))| count.0 > 0) {
            total += count.0;
            match spans.last_mut().filter(|(_, end)| *end == from) {
                Some((_, end)) => *end = from + stride,
                None => spans.push((from, from + stride)),
            }
        }
        (spans, total)
    }

    /// Returns the intervals in which a role has fewer samples than ticks, and the number of missing samples of all roles.
    pub fn missing(&self) -> (Vec<(u64, u64)>, u64) {
        let Some((first, last)) = self.ticks else { return (Vec::new(), 0) };
        let (mut spans, mut total) = (Vec::new(), 0);
        for role in &self.roles {
            let (stride, mut next) = (role.samples.stride(), first);
            let counted = role.samples.iter().map(|(tick, count)| (tick, count.0));
            // After the last sample of a role there are no columns.
            let empty = |tick: u64| (tick, 0);
            let beyond = role.samples.iter().last().map_or(first, |(tick, _)| tick + stride);
            let beyond = (beyond..=last).step_by(stride.max(last / 512).max(1) as usize).map(empty);
            let all: Vec<(u64, u64)> = counted.chain(beyond).collect();
            for (index, (tick, count)) in all.iter().enumerate() {
                let end = all.get(index + 1).map_or(last + 1, |(tick, _)| *tick).min(last + 1);
                let ticks = end.saturating_sub(next.max(*tick));
                let missing = ticks.saturating_sub(*count);
                if missing > 0 {
                    spans.push((*tick, end));
                    total += missing;
                }
                next = end.max(next);
            }
        }
        spans.sort_unstable();
        spans.dedup();
        (spans, total)
    }
}

//! Reads every signal of a running loop and updates the model from it.
//!
//! Values and send times come from the samples; the roles do no work for it. Must not hold a sample of the bus: it copies
//! what it shows.

use super::model::{Model, RoleLine, Series, SignalLine};
use crate::bus::Port;
use crate::bus::iox::IoxBus;
use crate::bus::{Bus, BusError, Read, Reader, Signal, Topic, WordReader};
use crate::clock::{Grid, monotonic_ns};
use crate::config::ClockKind;
use crate::fault::{Action, Fault, Interruption, Transport};
use crate::runtime::{RoleId, ports, topic, window_ticks};
use crate::sample::{Field, FieldKind, Health, NO_SAMPLE, RoleState, Stamp, status};
use crate::scenario::AnyRig;
use crate::scenario::Scenario;
use crate::score::TimedView;
use std::collections::VecDeque;
use std::sync::Arc;

/// The time between two polls, ns: long enough to stay out of the 99 % latencies of a loop at 1 kHz, and short enough
/// that no queue overflows.
pub(super) const POLL_NS: u64 = 100_000_000;
/// The largest number of samples of one signal per poll, so that a loop faster than this process cannot block it.
const TAKEN_MAX: usize = 8192;
/// The words of a stamp.
const STAMP: usize = size_of::<Stamp>() / size_of::<u64>();
/// The number of ticks whose send times are kept.
const SENT: usize = 8192;
/// The number of samples that are kept per signal: in real time, and in lockstep in addition to its window.
const KEPT: usize = 8;
/// The largest number of array elements that are shown.
const SHOWN: usize = 4;
/// The shortest time between two events about the same thing, s.
const QUIET_S: f64 = 1.0;
/// The status bits that cause an event.
const EVENTFUL: u64 = status::HOLDING
    | status::SAFE
    | status::UNUSABLE
    | status::AXIS_LOST
    | status::DEGRADED
    | status::FAULT
    | status::REJECTED;

/// A reader of one signal with its recent samples.
struct Tap {
    topic: Topic,
    fields: Vec<Field>,
    /// The index of the status word, if the signal has one.
    status: Option<usize>,
    link: WordReader,
    /// Copies of samples at ticks that the stride divides, the newest last.
    kept: VecDeque<Vec<u64>>,
    /// The stamps of the samples from the last poll.
    news: Vec<Stamp>,
    /// The status bits of these samples.
    bits: u64,
    /// The tick and send time, ns, at the index tick modulo [`SENT`].
    sent: Vec<(u64, u64)>,
}

impl Tap {
    fn open(bus: &IoxBus, port: Port) -> Result<Self, BusError> {
        let link = port.reader(bus, Reader::Scorer)?;
        let Port { topic, fields, .. } = port;
        let status = fields.iter().find(|field| field.name == "status").map(|field| field.offset / size_of::<u64>());
        let (kept, news, sent) = (VecDeque::new(), Vec::new(), vec![(u64::MAX, 0); SENT]);
        Ok(Self { topic, fields, status, link, kept, news, bits: 0, sent })
    }

    /// Reads all available samples; keeps copies of at most `keep` samples at ticks that `stride` divides.
    fn drain(&mut self, stride: u64, keep: usize) -> Result<(), BusError> {
        let Self { status, link, kept, news, bits, sent, .. } = self;
        news.clear();
        *bits = 0;
        while news.len() < TAKEN_MAX
            && let Some(words) = link.next()?
        {
            let stamp: Stamp = bytemuck::pod_read_unaligned(bytemuck::cast_slice(&words[..STAMP]));
            // Skips warm-up samples and no-sample markers.
            if stamp.generation == 0 || stamp.generation & NO_SAMPLE != 0 {
                continue;
            }
            news.push(stamp);
            sent[stamp.tick as usize % SENT] = (stamp.tick, stamp.sent_ns);
            *bits |= status.map_or(0, |status| words[status]);
            if stamp.tick.is_multiple_of(stride) {
                let mut copy = if kept.len() >= keep { kept.pop_front().unwrap_or_default() } else { Vec::new() };
                copy.clear();
                copy.extend_from_slice(words);
                kept.push_back(copy);
            }
        }
        Ok(())
    }

    /// Returns the copied sample of a tick, if it is kept.
    fn at(&self, tick: u64) -> Option<&[u64]> {
        self.kept.iter().rev().find(|words| words[0] == tick).map(Vec::as_slice)
    }

    fn sent_ns(&self, tick: u64) -> Option<u64> {
        let (kept_tick, sent_ns) = self.sent[tick as usize % SENT];
        (kept_tick == tick).then_some(sent_ns)
    }

    fn name(&self) -> String {
        format!("{}/{}", self.topic.body, self.topic.signal.name())
    }

    fn line(&self) -> SignalLine {
        let fields = |words: &Vec<u64>| {
            let stamp = bytemuck::pod_read_unaligned(bytemuck::cast_slice(&words[..STAMP]));
            std::iter::once(stamp_text(&stamp))
                .chain(self.fields.iter().map(|field| field_text(field, words)))
                .collect()
        };
        SignalLine { name: self.name(), fields: self.kept.back().map(fields).unwrap_or_default() }
    }
}

/// Formats a stamp on one line.
fn stamp_text(stamp: &Stamp) -> (String, String) {
    let Stamp { tick, generation, origin_ns, sent_ns } = *stamp;
    let sent = match sent_ns {
        // A clock without due times.
        0 => String::new(),
        _ => format!("  sent {:.1} us after due", sent_ns as f64 / 1e3 - origin_ns as f64 / 1e3),
    };
    ("tick".to_owned(), format!("{tick}  life {generation}{sent}"))
}

/// Formats the name and value of a field.
fn field_text(field: &Field, words: &[u64]) -> (String, String) {
    let first = field.offset / size_of::<u64>();
    let values = words.get(first..first + field.count).unwrap_or_default();
    let number = |word: &u64| match field.kind {
        FieldKind::U64 => word.to_string(),
        FieldKind::F64 => format!("{:+.4e}", f64::from_bits(*word)),
    };
    let text = match (field.name, values) {
        ("status", [0]) => "-".to_owned(),
        ("status", [bits]) => bit_names(*bits).join(" "),
        ("valid", [bits]) => format!("{bits:#b}"),
        (_, [value]) => number(value),
        _ => values.iter().take(SHOWN).map(number).collect::<Vec<_>>().join(" "),
    };
    let more = if values.len() > SHOWN { format!(" ... of {}", values.len()) } else { String::new() };
    (field.name.to_owned(), text + &more)
}

fn bit_names(bits: u64) -> Vec<&'static str> {
    status::NAMES.into_iter().filter(|(_, bit)| bits & bit != 0).map(|(name, _)| name).collect()
}

/// The inputs of a role's line.
struct RoleFeed {
    health: <IoxBus as Bus>::Reader<Health>,
    /// The index of the tap of its first signal.
    output: usize,
    /// The index of the tap of the input that its tick waits for.
    input: Option<usize>,
    /// The missed ticks at the last event about them.
    reported_missed: u64,
    /// The time of that event, s.
    reported_s: f64,
}

/// The readers of all signals of a run.
pub(super) struct Feed {
    taps: Vec<Tap>,
    roles: Vec<RoleFeed>,
    rig: Arc<dyn AnyRig>,
    /// The rig with the inputs of the scored tick.
    view: Box<dyn TimedView>,
    faults: Vec<(u64, String)>,
    realtime: bool,
    stride: u64,
    keep: usize,
    scored: Option<u64>,
    /// The status bits of each tap that already caused an event, and the time at which one was last set, s.
    reported: Vec<(u64, f64)>,
}

impl Feed {
    /// Opens every signal of a scenario, and initialises the lines of the model.
    pub fn open(scenario: &Scenario, bus: &IoxBus, model: &mut Model) -> Result<Self, BusError> {
        let (mut taps, mut roles, mut outputs) = (Vec::new(), Vec::new(), Vec::new());
        for role in RoleId::all(scenario) {
            outputs.push(taps.len());
            for port in ports(scenario, role).writes {
                taps.push(Tap::open(bus, port)?);
            }
        }
        let bodies = &scenario.bodies;
        let find = |signal, body: usize| {
            let sought = |tap: &Tap| tap.topic.signal == signal && tap.topic.body == bodies[body].name;
            taps.iter().position(sought)
        };
        for (role, output) in RoleId::all(scenario).into_iter().zip(outputs) {
            let input = match role {
                RoleId::Plant(_) => None,
                RoleId::Observer(body) => find(Signal::Measurement, body),
                RoleId::Controller => find(Signal::Estimate, 0),
            };
            let health = bus.reader(&topic(scenario, role.name(scenario), Signal::Health), Reader::Role)?;
            roles.push(RoleFeed { health, output, input, reported_missed: 0, reported_s: f64::NEG_INFINITY });
        }
        model.roles = RoleId::all(scenario).into_iter().map(|role| RoleLine::new(role.name(scenario))).collect();
        model.series = scenario.rig.metrics().iter().map(|name| Series::new(name)).collect();
        model.signals = taps.iter().map(Tap::line).collect();
        model.scripted = scenario.faults.len();
        let realtime = scenario.clock == ClockKind::Realtime;
        let mut faults: Vec<(u64, String)> = scenario
            .faults
            .iter()
            .map(|scripted| {
                (scripted.fault.from_tick, format!("injected: {} of {}", fault_name(&scripted.fault), scripted.role))
            })
            .collect();
        faults.sort();
        Ok(Self {
            reported: vec![(0, f64::NEG_INFINITY); taps.len()],
            taps,
            roles,
            rig: scenario.rig.clone(),
            view: scenario.rig.timed_view(scenario),
            faults,
            realtime,
            stride: if realtime { (POLL_NS / 2 / scenario.period_ns).max(1) } else { 1 },
            keep: if realtime { KEPT } else { KEPT + 2 * window_ticks(scenario) as usize },
            scored: None,
        })
    }

    /// Reads the samples since the last poll and updates the model.
    pub fn poll(&mut self, grid: Option<Grid>, model: &mut Model) -> Result<(), BusError> {
        // Outputs before inputs: the input of every output that was read is already sent, and is read afterwards.
        for tap in self.taps.iter_mut().rev() {
            tap.drain(self.stride, self.keep)?;
        }
        let newest = self.taps.iter().flat_map(|tap| &tap.news).map(|stamp| stamp.tick);
        let newest = newest.filter(|tick| *tick <= model.last_tick).max().unwrap_or(0);
        let first_poll = model.tick == 0;
        model.tick = model.tick.max(newest);
        self.report_faults(first_poll, model);
        let now_s = monotonic_ns() as f64 / 1e9;
        for index in 0..self.roles.len() {
            self.update_role(index, now_s, model)?;
            if let Some(grid) = grid.filter(|_| self.realtime) {
                self.update_latencies(index, grid, model);
            }
        }
        self.report_status(now_s, model);
        self.score(model);
        Ok(())
    }

    /// Copies the fields of every signal into the model.
    pub fn refresh(&self, model: &mut Model) {
        model.signals = self.taps.iter().map(Tap::line).collect();
    }

    /// Adds an event for each injected fault that has begun, except at the first poll.
    fn report_faults(&mut self, first_poll: bool, model: &mut Model) {
        let due = self.faults.partition_point(|(tick, _)| *tick <= model.tick);
        for (tick, text) in self.faults.drain(..due) {
            if !first_poll {
                model.add_event(tick, text);
            }
        }
    }

    /// Updates the line of a role from its heartbeats, or from its samples if it sends no heartbeats.
    fn update_role(&mut self, index: usize, now_s: f64, model: &mut Model) -> Result<(), BusError> {
        let feed = &mut self.roles[index];
        let mut newest = None;
        while feed.health.advance()? {
            newest = feed.health.current().copied().or(newest);
        }
        let news = self.taps[feed.output].news.last();
        let Model { roles, tick: now, .. } = model;
        let (role, now) = (&mut roles[index], *now);
        let mut events = Vec::new();
        if let Some(health) = newest {
            let generation = health.stamp.generation;
            if role.generation > 0 && generation > role.generation {
                events.push(format!("{} restarted: life {generation}", role.name));
            }
            if health.denied > role.denied {
                events.push(format!("{} was denied {} privileges", role.name, health.denied));
            }
            role.rate.push(now_s, health.executed);
            (role.state, role.generation) = (RoleState::from_number(health.state), generation);
            (role.tick, role.missed, role.denied) = (health.stamp.tick, health.missed, health.denied);
        } else if let (0, Some(stamp)) = (role.generation, news) {
            // A foreign program may send no heartbeats.
            role.rate.push(now_s, stamp.tick);
            (role.state, role.tick) = (RoleState::Running, stamp.tick + 1);
        }
        if role.missed > feed.reported_missed && now_s - feed.reported_s > QUIET_S {
            events.push(format!("{} missed {} ticks", role.name, role.missed - feed.reported_missed));
            (feed.reported_missed, feed.reported_s) = (role.missed, now_s);
        }
        events.into_iter().for_each(|text| model.add_event(now, text));
        Ok(())
    }

    /// Adds the lateness of a role's samples, and the time from its input to its output.
    fn update_latencies(&self, index: usize, grid: Grid, model: &mut Model) {
        let (feed, role) = (&self.roles[index], &mut model.roles[index]);
        let stamped = |stamp: &&Stamp| stamp.tick <= model.last_tick && stamp.sent_ns > 0;
        for stamp in self.taps[feed.output].news.iter().filter(stamped) {
            role.lateness.push(grid.due_ns(stamp.tick), stamp.sent_ns);
            let input_ns = feed.input.and_then(|input| self.taps[input].sent_ns(stamp.tick));
            if let Some(input_ns) = input_ns.filter(|ns| *ns > 0) {
                role.step.push(input_ns, stamp.sent_ns);
            }
        }
    }

    /// Adds an event for status bits that were set.
    fn report_status(&mut self, now_s: f64, model: &mut Model) {
        for (tap, (reported, set_s)) in self.taps.iter().zip(&mut self.reported) {
            // The truth has the same status as the measurement.
            let bits = if tap.topic.signal == Signal::Truth { 0 } else { tap.bits & EVENTFUL };
            if bits & !*reported != 0 {
                let text = format!("{}: {}", tap.name(), bit_names(bits & !*reported).join(", "));
                model.add_event(model.tick, text);
            }
            if bits != 0 {
                (*reported, *set_s) = (*reported | bits, now_s);
            } else if now_s - *set_s > QUIET_S {
                *reported = 0;
            }
        }
    }

    /// Scores the newest tick with all truths and estimates.
    fn score(&mut self, model: &mut Model) {
        let taps = &self.taps;
        let with_signal = |signal| taps.iter().filter(move |tap| tap.topic.signal == signal);
        let needed = || with_signal(Signal::Truth).chain(with_signal(Signal::Estimate));
        let complete = |tick: &u64| needed().all(|tap| tap.at(*tick).is_some());
        let ticks = with_signal(Signal::Estimate).flat_map(|tap| tap.kept.iter().rev()).map(|words| words[0]);
        let Some(tick) = ticks.filter(|tick| self.scored.is_none_or(|scored| *tick > scored)).find(complete) else {
            return;
        };
        let bodies = self.rig.bodies();
        let words = |body: usize, signal| with_signal(signal).find(|tap| tap.topic.body == bodies[body].name)?.at(tick);
        let mut values = vec![f64::NAN; model.series.len()];
        let metrics = values.len() - usize::from(model.series.last().is_some_and(|series| series.name == LYAPUNOV));
        self.view.advance(tick);
        self.view.words().score_words(&words, self.view.reference(), &mut values[..metrics]);
        model.series.iter_mut().zip(values).for_each(|(series, value)| series.push(value));
        let commands = (0..bodies.len()).filter_map(|body| words(body, Signal::Command));
        let functions = commands.filter_map(|command| self.rig.lyapunov_words(command));
        let v = functions.map(|(v, _)| v).fold(f64::NAN, f64::max);
        if !v.is_nan() {
            if metrics == model.series.len() {
                model.series.push(Series::new(LYAPUNOV));
            }
            model.series[metrics].push(v);
        }
        self.scored = Some(tick);
    }
}

/// The name of V among the series.
const LYAPUNOV: &str = "V (largest)";

/// Returns a short name of an injected fault.
fn fault_name(fault: &Fault) -> &'static str {
    match fault.action {
        Action::Content(_) => "wrong sample",
        Action::Transport(Transport::Drop) => "dropped sample",
        Action::Transport(Transport::Duplicate) => "duplicate sample",
        Action::Transport(Transport::Delay(_)) => "late sample",
        Action::Role(Interruption::Stall { .. }) => "stall",
        Action::Role(Interruption::Kill) => "kill",
        Action::Role(Interruption::Miss) => "missed ticks",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sample::{FleetSample, RateEstimate, Sample};

    #[test]
    fn fields_and_stamps_are_formatted() {
        let estimate = RateEstimate {
            omega_rad_s: [0.5, -1.0, 2e-9],
            valid: 0b111,
            status: status::AXIS_LOST | status::DEGRADED,
            ..RateEstimate::default()
        };
        let text = |name: &str| {
            let field = RateEstimate::FIELDS.iter().find(|field| field.name == name).unwrap();
            field_text(field, crate::sample::Message::words(&estimate)).1
        };
        assert_eq!(text("omega_rad_s"), "+5.0000e-1 -1.0000e0 +2.0000e-9");
        assert_eq!((text("valid"), text("status")), ("0b111".to_owned(), "axis_lost degraded".to_owned()));
        let stamp = Stamp { tick: 7, generation: 2, origin_ns: 1_000_000, sent_ns: 1_002_500 };
        assert_eq!(stamp_text(&stamp).1, "7  life 2  sent 2.5 us after due");
        assert_eq!(stamp_text(&Stamp { sent_ns: 0, ..stamp }).1, "7  life 2");
        let many: Vec<Field> = FleetSample::<crate::sample::TruthLayout>::fields(100).collect();
        assert!(field_text(&many[2], &vec![0; 1000]).1.ends_with("... of 300"));
        assert_eq!(field_text(&many[2], &[]).1, "", "a sample that is too short");
    }
}

//! Takes every signal of a running loop off its bus and makes of it what there is to see.
//!
//! What roles compute and when they send it is all in their samples; nothing is asked of them. Must not keep a sample: what
//! is shown is copied.

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
use std::collections::VecDeque;
use std::sync::Arc;

/// Between two looks, ns: seldom enough that their traces are not in the 99 % of a loop at 1 kHz, and less than what waits.
pub(super) const LOOK_NS: u64 = 100_000_000;
/// Samples that one look takes of one signal at the most: a loop that is faster than this process must not hold it up.
const TAKEN_MAX: usize = 8192;
/// Words of a stamp.
const STAMP: usize = size_of::<Stamp>() / size_of::<u64>();
/// Ticks of which the time of sending is kept.
const SENT: usize = 8192;
/// Samples of a signal that are kept in real time, and in lockstep beyond its window.
const KEPT: usize = 8;
/// Elements of an array that are shown.
const SHOWN: usize = 4;
/// The same thing is not told again within so long, s.
const QUIET_S: f64 = 1.0;
/// Bits of a status word that are worth an event.
const EVENTFUL: u64 = status::HOLDING
    | status::SAFE
    | status::UNUSABLE
    | status::AXIS_LOST
    | status::DEGRADED
    | status::FAULT
    | status::REJECTED;

/// One signal.
struct Tap {
    topic: Topic,
    fields: Vec<Field>,
    /// The word of the status, if it has one.
    status: Option<usize>,
    link: WordReader,
    /// Samples of every so-many-th tick, the newest last.
    kept: VecDeque<Vec<u64>>,
    /// The stamps that the last look took.
    news: Vec<Stamp>,
    /// Status bits that they had.
    bits: u64,
    /// Tick and time of sending, by the tick's remainder.
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

    /// Takes whatever has come; keeps copies of ticks that `stride` divides, so many at the most.
    fn drain(&mut self, stride: u64, keep: usize) -> Result<(), BusError> {
        let Self { status, link, kept, news, bits, sent, .. } = self;
        news.clear();
        *bits = 0;
        while news.len() < TAKEN_MAX
            && let Some(words) = link.next()?
        {
            let stamp: Stamp = bytemuck::pod_read_unaligned(bytemuck::cast_slice(&words[..STAMP]));
            // Warm-up, and voids.
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

    /// The copy of a tick's sample, if there is one.
    fn at(&self, tick: u64) -> Option<&[u64]> {
        self.kept.iter().rev().find(|words| words[0] == tick).map(Vec::as_slice)
    }

    fn sent_ns(&self, tick: u64) -> Option<u64> {
        let (of, sent_ns) = self.sent[tick as usize % SENT];
        (of == tick).then_some(sent_ns)
    }

    fn name(&self) -> String {
        format!("{}/{}", self.topic.body, self.topic.signal.name())
    }

    fn line(&self) -> SignalLine {
        let fields = |words: &Vec<u64>| {
            let stamp = bytemuck::pod_read_unaligned(bytemuck::cast_slice(&words[..STAMP]));
            std::iter::once(stamped(&stamp)).chain(self.fields.iter().map(|field| told(field, words))).collect()
        };
        SignalLine { name: self.name(), fields: self.kept.back().map(fields).unwrap_or_default() }
    }
}

/// A stamp as text, on one line.
fn stamped(stamp: &Stamp) -> (String, String) {
    let Stamp { tick, generation, origin_ns, sent_ns } = *stamp;
    let sent = match sent_ns {
        // Where nobody looks at the time.
        0 => String::new(),
        _ => format!("  sent {:.1} us after due", sent_ns as f64 / 1e3 - origin_ns as f64 / 1e3),
    };
    ("tick".to_owned(), format!("{tick}  life {generation}{sent}"))
}

/// A field's name and value as text.
fn told(field: &Field, words: &[u64]) -> (String, String) {
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
        (_, [one]) => number(one),
        _ => values.iter().take(SHOWN).map(number).collect::<Vec<_>>().join(" "),
    };
    let more = if values.len() > SHOWN { format!(" ... of {}", values.len()) } else { String::new() };
    (field.name.to_owned(), text + &more)
}

fn bit_names(bits: u64) -> Vec<&'static str> {
    status::NAMES.into_iter().filter(|(_, bit)| bits & bit != 0).map(|(name, _)| name).collect()
}

/// What is known of a role besides what its line shows.
struct RoleFeed {
    health: <IoxBus as Bus>::Reader<Health>,
    /// The tap of its first signal, and of the sample that its tick waits for.
    output: usize,
    input: Option<usize>,
    missed_told: u64,
    told_s: f64,
}

/// All signals of a run.
pub(super) struct Feed {
    taps: Vec<Tap>,
    roles: Vec<RoleFeed>,
    rig: Arc<dyn AnyRig>,
    faults: Vec<(u64, String)>,
    realtime: bool,
    stride: u64,
    keep: usize,
    scored: Option<u64>,
    /// Per tap: the bits that were told, and when, s.
    told: Vec<(u64, f64)>,
}

impl Feed {
    /// Opens every signal of a scenario, and makes the model's lines.
    pub fn open(scenario: &Scenario, bus: &IoxBus, model: &mut Model) -> Result<Self, BusError> {
        let (mut taps, mut roles, mut outputs) = (Vec::new(), Vec::new(), Vec::new());
        for role in RoleId::all(scenario) {
            outputs.push(taps.len());
            for port in ports(scenario, role).writes {
                taps.push(Tap::open(bus, port)?);
            }
        }
        let find = |signal| taps.iter().position(|tap: &Tap| tap.topic.signal == signal);
        for (role, output) in RoleId::all(scenario).into_iter().zip(outputs) {
            let input = match role {
                RoleId::Plant(_) => None,
                RoleId::Observer => find(Signal::Measurement),
                RoleId::Controller => find(Signal::Estimate),
            };
            let health = bus.reader(&topic(scenario, role.name(scenario), Signal::Health), Reader::Role)?;
            roles.push(RoleFeed { health, output, input, missed_told: 0, told_s: f64::NEG_INFINITY });
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
                (scripted.fault.from_tick, format!("scripted: {} of {}", word(&scripted.fault), scripted.role))
            })
            .collect();
        faults.sort();
        Ok(Self {
            told: vec![(0, f64::NEG_INFINITY); taps.len()],
            taps,
            roles,
            rig: scenario.rig.clone(),
            faults,
            realtime,
            stride: if realtime { (LOOK_NS / 2 / scenario.period_ns).max(1) } else { 1 },
            keep: if realtime { KEPT } else { KEPT + 2 * window_ticks(scenario) as usize },
            scored: None,
        })
    }

    /// Takes what has come since the last look.
    pub fn look(&mut self, grid: Option<Grid>, model: &mut Model) -> Result<(), BusError> {
        // Outputs before inputs: of whatever output was seen, the input has been sent and is seen too.
        for tap in self.taps.iter_mut().rev() {
            tap.drain(self.stride, self.keep)?;
        }
        let newest = self.taps.iter().flat_map(|tap| &tap.news).map(|stamp| stamp.tick);
        let newest = newest.filter(|tick| *tick <= model.last_tick).max().unwrap_or(0);
        let came = model.tick == 0;
        model.tick = model.tick.max(newest);
        self.scripted(came, model);
        let now_s = monotonic_ns() as f64 / 1e9;
        for index in 0..self.roles.len() {
            self.hear(index, now_s, model)?;
            if let Some(grid) = grid.filter(|_| self.realtime) {
                self.time(index, grid, model);
            }
        }
        self.notice(now_s, model);
        self.score(model);
        Ok(())
    }

    /// Writes the fields of every signal.
    pub fn tell(&self, model: &mut Model) {
        model.signals = self.taps.iter().map(Tap::line).collect();
    }

    /// Tells of scripted faults that have begun, but not of those before this process came.
    fn scripted(&mut self, came: bool, model: &mut Model) {
        let due = self.faults.partition_point(|(tick, _)| *tick <= model.tick);
        for (tick, text) in self.faults.drain(..due) {
            if !came {
                model.happened(tick, text);
            }
        }
    }

    /// Hears how a role is.
    fn hear(&mut self, index: usize, now_s: f64, model: &mut Model) -> Result<(), BusError> {
        let feed = &mut self.roles[index];
        let mut heard = None;
        while feed.health.advance()? {
            heard = feed.health.current().copied().or(heard);
        }
        let news = self.taps[feed.output].news.last();
        let Model { roles, tick: now, .. } = model;
        let (role, now) = (&mut roles[index], *now);
        let mut events = Vec::new();
        if let Some(health) = heard {
            let generation = health.stamp.generation;
            if role.generation > 0 && generation > role.generation {
                events.push(format!("{} is back, in its life {generation}", role.name));
            }
            if health.denied > role.denied {
                events.push(format!("{} runs without {} privileges it asked for", role.name, health.denied));
            }
            role.rate.push(now_s, health.executed);
            (role.state, role.generation) = (RoleState::from_number(health.state), generation);
            (role.tick, role.missed, role.denied) = (health.stamp.tick, health.missed, health.denied);
        } else if let (0, Some(stamp)) = (role.generation, news) {
            // A program that is not ours may say nothing of itself.
            role.rate.push(now_s, stamp.tick);
            (role.state, role.tick) = (RoleState::Running, stamp.tick + 1);
        }
        if role.missed > feed.missed_told && now_s - feed.told_s > QUIET_S {
            events.push(format!("{} missed {} ticks", role.name, role.missed - feed.missed_told));
            (feed.missed_told, feed.told_s) = (role.missed, now_s);
        }
        events.into_iter().for_each(|text| model.happened(now, text));
        Ok(())
    }

    /// Enters how late a role sent, and how long after its input.
    fn time(&self, index: usize, grid: Grid, model: &mut Model) {
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

    /// Tells of status bits that came up.
    fn notice(&mut self, now_s: f64, model: &mut Model) {
        for (tap, (told, told_s)) in self.taps.iter().zip(&mut self.told) {
            // The truth says what the measurement says.
            let bits = if tap.topic.signal == Signal::Truth { 0 } else { tap.bits & EVENTFUL };
            if bits & !*told != 0 {
                let text = format!("{}: {}", tap.name(), bit_names(bits & !*told).join(", "));
                model.happened(model.tick, text);
            }
            if bits != 0 {
                (*told, *told_s) = (*told | bits, now_s);
            } else if now_s - *told_s > QUIET_S {
                *told = 0;
            }
        }
    }

    /// Scores the newest tick of which everything is here.
    fn score(&mut self, model: &mut Model) {
        let taps = &self.taps;
        let of = |signal| taps.iter().filter(move |tap| tap.topic.signal == signal);
        let whole = |tick: &u64| of(Signal::Truth).chain(of(Signal::Estimate)).all(|tap| tap.at(*tick).is_some());
        let ticks = of(Signal::Estimate).flat_map(|tap| tap.kept.iter().rev()).map(|words| words[0]);
        let Some(tick) = ticks.filter(|tick| self.scored.is_none_or(|scored| *tick > scored)).find(whole) else {
            return;
        };
        let bodies = self.rig.bodies();
        let words = |body: usize, signal| of(signal).find(|tap| tap.topic.body == bodies[body].name)?.at(tick);
        let mut values = vec![f64::NAN; model.series.len()];
        let metrics = values.len() - usize::from(model.series.last().is_some_and(|series| series.name == LYAPUNOV));
        self.rig.score_words(&words, &mut values[..metrics]);
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

/// What a scripted fault does, in a word.
fn word(fault: &Fault) -> &'static str {
    match fault.action {
        Action::Content(_) => "a wrong sample",
        Action::Transport(Transport::Drop) => "a dropped sample",
        Action::Transport(Transport::Duplicate) => "a sample sent twice",
        Action::Transport(Transport::Delay(_)) => "a late sample",
        Action::Role(Interruption::Stall { .. }) => "a stall",
        Action::Role(Interruption::Kill) => "a kill",
        Action::Role(Interruption::Miss) => "missed ticks",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sample::{FleetSample, RateEstimate, Sample};

    #[test]
    fn fields_are_told_as_people_read_them() {
        let estimate = RateEstimate {
            omega_rad_s: [0.5, -1.0, 2e-9],
            valid: 0b111,
            status: status::AXIS_LOST | status::DEGRADED,
            ..RateEstimate::default()
        };
        let text = |name: &str| {
            let field = RateEstimate::FIELDS.iter().find(|field| field.name == name).unwrap();
            told(field, crate::sample::Message::words(&estimate)).1
        };
        assert_eq!(text("omega_rad_s"), "+5.0000e-1 -1.0000e0 +2.0000e-9");
        assert_eq!((text("valid"), text("status")), ("0b111".to_owned(), "axis_lost degraded".to_owned()));
        let stamp = Stamp { tick: 7, generation: 2, origin_ns: 1_000_000, sent_ns: 1_002_500 };
        assert_eq!(stamped(&stamp).1, "7  life 2  sent 2.5 us after due");
        assert_eq!(stamped(&Stamp { sent_ns: 0, ..stamp }).1, "7  life 2");
        let many: Vec<Field> = FleetSample::<crate::sample::TruthLayout>::fields(100).collect();
        assert!(told(&many[2], &vec![0; 1000]).1.ends_with("... of 300"));
        assert_eq!(told(&many[2], &[]).1, "", "a sample that is too short");
    }
}

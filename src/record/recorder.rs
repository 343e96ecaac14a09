//! Takes every sample of a run off a bus into a file, the truth included, and keeps count of what came.
//!
//! Warm-up samples apart, whatever was sent is written, as it was: second, late and broken samples too. Must not judge.

use super::RecordError;
use super::layout::Layout;
use super::writer::{Channel, Writer};
use crate::bus::{Bus, BusError, Carried, Read, Reader, Topic};
use crate::clock::{Grid, monotonic_ns};
use crate::config::{ClockKind, Scenario};
use crate::runtime::{RoleId, Visit, ports, visit_writes};
use crate::sample::{FleetLayout, FleetSample, Sample, Stamp, VOID};
use crate::telemetry::{Host, RoleReport};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;
use xxhash_rust::xxh3::xxh3_64;

/// The recorder's name where a role would have its own.
pub(crate) const RECORDER: &str = "recorder";
/// Layout version of the metadata.
pub const SCHEMA: &str = "corotate/recording/v1";
/// The metadata record that is written first, and the one that is written last.
pub const RUN: &str = "corotate.run";
pub const END: &str = "corotate.end";
/// The most gaps that are told one by one.
const GAPS_TOLD: usize = 1000;

/// How a recording went: what is in it, and what is not.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RecordingReport {
    /// The file.
    pub file: String,
    /// Whether every sample that was published is in it.
    pub complete: bool,
    /// Whether it was begun before the first tick.
    pub whole: bool,
    /// What ended it before its time, or kept it from being complete.
    pub problem: Option<String>,
    /// Samples written, of all signals.
    pub messages: u64,
    /// The file's length.
    pub bytes: u64,
    /// Per signal.
    pub signals: Vec<SignalReport>,
}

/// The books of one recorded signal, beside those of its writer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SignalReport {
    /// The service.
    pub service: String,
    /// Ticks of which there is a sample.
    pub recorded: u64,
    /// Ticks of which there is a void.
    pub void: u64,
    /// Samples beside the one of their tick: second, late, broken ones.
    pub extra: u64,
    /// Samples that its writer published by its own books; none if it keeps none.
    pub published: Option<u64>,
    /// Published and not recorded; none if that is not known.
    pub lost: Option<u64>,
    /// The last tick of which there is something.
    pub last_tick: Option<u64>,
    /// Ticks, first and last, of which there is nothing: never published, or lost.
    pub gaps: Vec<[u64; 2]>,
    /// Gaps beyond those told.
    pub more_gaps: u64,
}

/// What has come of one signal.
#[derive(Default)]
struct Book {
    next: u64,
    begun: bool,
    recorded: u64,
    void: u64,
    extra: u64,
    gaps: Vec<[u64; 2]>,
    more_gaps: u64,
}

impl Book {
    /// Enters a sample; `due` is the last tick that it can be of.
    fn enter(&mut self, stamp: &Stamp, due: u64) {
        if stamp.tick < self.next || stamp.tick > due {
            self.extra += 1;
            return;
        }
        self.gap_to(stamp.tick);
        *(if stamp.generation & VOID == 0 { &mut self.recorded } else { &mut self.void }) += 1;
        (self.next, self.begun) = (stamp.tick + 1, true);
    }

    fn gap_to(&mut self, tick: u64) {
        if tick > self.next {
            if self.gaps.len() < GAPS_TOLD {
                self.gaps.push([self.next, tick - 1]);
            } else {
                self.more_gaps += 1;
            }
        }
    }

    fn report(self, service: &str) -> SignalReport {
        SignalReport {
            service: service.to_owned(),
            recorded: self.recorded,
            void: self.void,
            extra: self.extra,
            published: None,
            lost: None,
            last_tick: self.next.checked_sub(1),
            gaps: self.gaps,
            more_gaps: self.more_gaps,
        }
    }
}

impl SignalReport {
    /// Holds what was recorded against the books of the roles. Again, if the loop went on after the recording.
    fn reconcile(&mut self, roles: &[RoleReport]) {
        let Some(link) = roles.iter().flat_map(|role| &role.written).find(|link| link.service == self.service) else {
            return;
        };
        self.published = Some(link.published);
        self.lost = Some(link.published.saturating_sub(self.recorded));
        let from = self.last_tick.map_or(0, |tick| tick + 1);
        if let Some(to) = link.last_tick.filter(|to| *to >= from) {
            self.gaps.retain(|gap| gap[0] != from);
            self.gaps.push([from, to]);
        }
    }
}

impl RecordingReport {
    /// Holds the recording against the roles' final books.
    pub fn reconcile(&mut self, roles: &[RoleReport]) {
        self.signals.iter_mut().for_each(|signal| signal.reconcile(roles));
        let lost: u64 = self.signals.iter().filter_map(|signal| signal.lost).sum();
        // Whoever began in the midst of a run knew that.
        if let (true, None, 1..) = (self.whole, &self.problem, lost) {
            self.problem = Some(format!("{lost} samples were published and are not in the recording"));
        }
        self.complete = self.whole && self.problem.is_none();
    }
}

/// What a tap needs to write what it takes.
struct Desk<'a> {
    writer: &'a mut Writer,
    grid: Grid,
    last_tick: u64,
    realtime: bool,
}

/// One signal.
trait Tap {
    /// Writes whatever has come; returns how many samples.
    fn drain(&mut self, desk: &mut Desk<'_>) -> Result<u64, RecordError>;
    fn announce(&mut self, writer: &mut Writer) -> Result<(), RecordError>;
    fn book(&mut self) -> &mut Book;
    fn service(&self) -> String;
}

struct SignalTap<B: Bus, S: Carried + ?Sized> {
    topic: Topic,
    role: String,
    reader: S::Reader<B>,
    bodies: usize,
    channel: Channel,
    book: Book,
}

impl<B: Bus, S: Carried + ?Sized> Tap for SignalTap<B, S> {
    fn drain(&mut self, desk: &mut Desk<'_>) -> Result<u64, RecordError> {
        let mut taken = 0;
        while self.reader.advance()? {
            let Some(sample) = self.reader.current() else { break };
            let stamp = *sample.stamp();
            if stamp.generation == 0 && !self.book.begun {
                continue;
            }
            let now_ns = monotonic_ns();
            let due = match (desk.realtime, self.book.begun) {
                (true, _) => desk.grid.tick_at(now_ns).min(desk.last_tick),
                // Where nothing is lost, a sample is of the next tick or of none.
                (false, true) => self.book.next,
                (false, false) => desk.last_tick,
            };
            let due_ns = if stamp.tick <= desk.last_tick { desk.grid.due_ns(stamp.tick) } else { now_ns };
            desk.writer.message(
                self.channel,
                stamp.tick as u32,
                due_ns,
                now_ns,
                bytemuck::cast_slice(sample.words()),
            )?;
            self.book.enter(&stamp, due);
            taken += 1;
        }
        Ok(taken)
    }

    fn announce(&mut self, writer: &mut Writer) -> Result<(), RecordError> {
        let about = [
            ("service", self.topic.to_string()),
            ("type_name", S::type_name().to_owned()),
            ("role", self.role.clone()),
            ("body", self.topic.body.clone()),
            ("signal", self.topic.signal.name().to_owned()),
        ];
        let about = about.map(|(key, value)| (key.to_owned(), value)).into();
        self.channel = writer.channel(&self.service(), &Layout::of(S::type_name(), &S::fields(self.bodies)), &about)?;
        Ok(())
    }

    fn book(&mut self) -> &mut Book {
        &mut self.book
    }

    fn service(&self) -> String {
        self.topic.to_string()
    }
}

/// Opens the signals of one role.
struct Open<'a, B> {
    bus: &'a B,
    role: &'a str,
}

impl<B: Bus + 'static> Open<'_, B> {
    fn tap<S: Carried + ?Sized>(&self, topic: Topic, bodies: usize) -> Result<Box<dyn Tap>, BusError> {
        let reader = S::reader(self.bus, &topic, Reader::Scorer, bodies)?;
        let role = self.role.to_owned();
        Ok(Box::new(SignalTap::<B, S> { topic, role, reader, bodies, channel: 0, book: Book::default() }))
    }
}

impl<B: Bus + 'static> Visit for Open<'_, B> {
    type Made = Result<Box<dyn Tap>, BusError>;

    fn visit<S: Sample>(&mut self, topic: Topic) -> Self::Made {
        self.tap::<S>(topic, 1)
    }

    fn visit_fleet<L: FleetLayout>(&mut self, topic: Topic, bodies: usize) -> Self::Made {
        self.tap::<FleetSample<L>>(topic, bodies)
    }
}

/// A recording in the making.
pub struct Recorder {
    taps: Vec<Box<dyn Tap>>,
    writer: Writer,
    file: String,
    run: BTreeMap<String, String>,
    grid: Grid,
    last_tick: u64,
    realtime: bool,
    begun: bool,
}

impl Recorder {
    /// Opens every signal of a scenario on its bus, and the file.
    ///
    /// # Errors
    /// [`RecordError::Bus`], [`RecordError::Write`].
    pub fn open<B: Bus + 'static>(scenario: &Scenario, bus: &B, path: &Path) -> Result<Self, RecordError> {
        let mut taps = Vec::new();
        for role in RoleId::all(scenario) {
            let made = visit_writes(scenario, role, &mut Open { bus, role: role.name(scenario) });
            taps.extend(made.into_iter().collect::<Result<Vec<_>, _>>()?);
        }
        Ok(Self {
            taps,
            writer: Writer::create(path)?,
            file: path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            run: about(scenario),
            grid: Grid { epoch_ns: 0, period_ns: scenario.period_ns },
            last_tick: scenario.last_tick,
            realtime: scenario.clock == ClockKind::Realtime,
            begun: false,
        })
    }

    /// Begins the file, once the epoch of the ticks is known: 0 where there is no time. `whole` tells that no tick has run.
    ///
    /// # Errors
    /// [`RecordError::Write`].
    pub fn start(&mut self, epoch_ns: u64, whole: bool) -> Result<(), RecordError> {
        self.grid.epoch_ns = epoch_ns;
        self.begun = true;
        self.run.insert("whole".to_owned(), whole.to_string());
        self.run.insert("epoch_ns".to_owned(), epoch_ns.to_string());
        let run = self.run.clone();
        self.taps.iter_mut().try_for_each(|tap| tap.announce(&mut self.writer))?;
        self.writer.metadata(RUN, run)
    }

    /// Writes whatever has come; returns how many samples.
    ///
    /// # Errors
    /// [`RecordError`]; the file can be [finished](Self::finish) then.
    pub fn poll(&mut self) -> Result<u64, RecordError> {
        let Self { taps, writer, grid, last_tick, realtime, .. } = self;
        let mut desk = Desk { writer, grid: *grid, last_tick: *last_tick, realtime: *realtime };
        let mut taken = 0;
        for tap in taps {
            taken += tap.drain(&mut desk)?;
        }
        if taken == 0 {
            self.writer.turn(monotonic_ns())?;
        }
        Ok(taken)
    }

    /// The tick of which not every signal is here yet.
    pub fn next_tick(&mut self) -> u64 {
        self.taps.iter_mut().map(|tap| tap.book().next).min().unwrap_or(0)
    }

    /// Ends the file, with the books of the recording beside those of the roles. `problem` is what ended it before its time.
    pub fn finish(mut self, roles: &[RoleReport], problem: Option<&RecordError>) -> RecordingReport {
        let signals = std::mem::take(&mut self.taps).into_iter().map(|mut tap| {
            let service = tap.service();
            std::mem::take(tap.book()).report(&service)
        });
        let mut report = RecordingReport {
            file: std::mem::take(&mut self.file),
            complete: true,
            whole: self.run.get("whole").is_some_and(|whole| whole == "true"),
            problem: problem.map(ToString::to_string),
            messages: 0,
            bytes: 0,
            signals: signals.collect(),
        };
        report.messages = report.signals.iter().map(|signal| signal.recorded + signal.void + signal.extra).sum();
        report.reconcile(roles);
        match self.end(&report, roles) {
            Ok(bytes) => report.bytes = bytes,
            Err(error) => {
                report.problem.get_or_insert_with(|| error.to_string());
                report.complete = false;
            }
        }
        report
    }

    fn end(&mut self, report: &RecordingReport, roles: &[RoleReport]) -> Result<u64, RecordError> {
        if !self.begun {
            self.start(0, false)?;
        }
        let grants: BTreeMap<&str, _> = roles.iter().map(|role| (role.role.as_str(), &role.grants)).collect();
        let ticks: BTreeMap<&str, _> = roles.iter().map(|role| (role.role.as_str(), role.ticks)).collect();
        let entries = [
            ("complete", report.complete.to_string()),
            ("problem", report.problem.clone().unwrap_or_default()),
            ("signals", json(&report.signals)),
            ("ticks", json(&ticks)),
            ("privileges", json(&grants)),
        ];
        self.writer.metadata(END, entries.map(|(key, value)| (key.to_owned(), value)).into())?;
        self.writer.finish()
    }
}

fn json(value: &impl Serialize) -> String {
    serde_json::to_string(value).expect("books of plain values are JSON")
}

/// What the file says of its run.
fn about(scenario: &Scenario) -> BTreeMap<String, String> {
    let (host, text) = (Host::this(), scenario.to_toml());
    let entries = [
        ("schema", SCHEMA.to_owned()),
        ("version", env!("CARGO_PKG_VERSION").to_owned()),
        ("revision", env!("COROTATE_REVISION").to_owned()),
        ("scenario_name", scenario.name.clone()),
        ("scenario_hash", format!("{:016x}", xxh3_64(text.as_bytes()))),
        ("scenario", text),
        ("seed", scenario.seed.to_string()),
        ("clock", scenario.clock.name().to_owned()),
        ("period_ns", scenario.period_ns.to_string()),
        ("last_tick", scenario.last_tick.to_string()),
        ("started_utc", jiff::Timestamp::now().to_string()),
        ("host", json(&host)),
    ];
    entries.map(|(key, value)| (key.to_owned(), value)).into()
}

/// The layout of every signal of a scenario in this version, by service, in the order of a tick.
pub(super) fn layouts(scenario: &Scenario) -> Vec<(String, Layout)> {
    let of = |role| ports(scenario, role).writes;
    let written = RoleId::all(scenario).into_iter().flat_map(of);
    written.map(|port| (port.topic.to_string(), Layout::of(port.type_name, &port.fields))).collect()
}

//! The link to a device that takes the place of a role.
//!
//! While the device is silent, the link repeats its request, greets the device again and reopens the line, for a
//! bounded time. Must not know the meaning of samples.

use super::absence::Absences;
use super::error::DeviceError;
use super::line::{Line, LineAddress};
use super::node::ports;
use super::pace::{Pace, PaceOptions, PaceState};
use super::role_id::RoleId;
use crate::bus::Port;
use crate::clock::{Grid, monotonic_ns, raw_ns, sleep_until};
use crate::config::{ClockKind, Rates, Settings};
use crate::role::Rearm;
use crate::sample::{Stamp, type_name_of};
use crate::serial::{
    Answer, DeviceEvent, Hello, HostSession, LineCounters, MAX_CONTENT, MAX_FRAME, MAX_NAMES, MAX_SAMPLES, Reason,
    Refuse, Samples, Terms, Welcome,
};
use crate::telemetry::{Outage, PaceReport};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

/// Pause between two attempts to reopen a line, ns.
const REOPEN_NS: u64 = 100_000_000;
/// Pause between two polls of the line during the first greeting, ns.
const LOOK_NS: u64 = 1_000_000;
/// Period in which refusals of earlier greetings are ignored, after the greeting dropped the layout hashes, ns.
const BARE_NS: u64 = 1_000_000_000;
/// Bytes per read, and reads per turn: garbage must not delay a tick, and a datagram is read whole.
const CHUNK: usize = MAX_FRAME;
const CHUNKS: usize = 4;
/// Pause between two polls of the line while the pace of a device is awaited, ns.
const LOOK_PACE_NS: u64 = 100_000;
/// The longest wait for the first frame of a device that sets the pace, ns and periods, and the longest wait for its pace
/// as a multiple of that: both machines may be loaded.
const PACE_NS: u64 = 5_000_000_000;
const PACE_PERIODS: u64 = 100;
const PACE_LOADED: u64 = 6;
/// Turns in which the frames that came during the start are taken.
const DRAIN_TURNS: usize = 200;
/// Bits on the line per byte: start, eight data bits, stop.
const BITS_PER_BYTE: u64 = 10;
/// Lower bound on the bytes of a frame besides its samples: delimiters, COBS, CRC, numbers.
const FRAME_OVERHEAD: u64 = 14;

/// The roles of a device, and its line.
#[derive(Debug, Clone)]
pub struct DeviceConfig {
    /// The domain's directory.
    pub domain: PathBuf,
    /// Role names: a driven body, `observer` or `controller`; or both of the latter.
    pub roles: Vec<String>,
    /// The place of the device.
    pub line: LineAddress,
    /// Patience with a silent or absent device, s.
    pub patience_s: f64,
    /// True to accept a device with another name during the run.
    pub other_device: bool,
    /// The settings if the device sets the pace.
    pub pace: Option<PaceOptions>,
}

/// The content of the greeting.
#[derive(Debug, Clone)]
struct Greeting {
    run: u64,
    realtime: bool,
    period_ns: u64,
    last_tick: u64,
    timeout_ticks: u64,
    manual_rearm: bool,
    role: String,
    reads: String,
    writes: String,
    /// Time since which samples are named without layout hashes, ns.
    bare_since_ns: Option<u64>,
}

impl Greeting {
    fn hello(&self) -> Hello<'_> {
        Hello {
            run: self.run,
            realtime: self.realtime,
            period_ns: self.period_ns,
            last_tick: self.last_tick,
            timeout_ticks: self.timeout_ticks,
            manual_rearm: self.manual_rearm,
            role: &self.role,
            reads: &self.reads,
            writes: &self.writes,
        }
    }

    /// Drops the layout hashes from the greeting if the device refuses because it knows none: it then names a sample
    /// without a hash. Returns false if the refusal has another reason.
    fn drop_hashes(&mut self, refuse: &Refuse<'_>, now_ns: u64) -> bool {
        let mut names = self.reads.split(' ').chain(self.writes.split(' '));
        if refuse.reason != Reason::Samples || !names.any(|name| type_name_of(name) == refuse.detail) {
            return false;
        }
        let bare = |names: &str| names.split(' ').map(type_name_of).collect::<Vec<_>>().join(" ");
        let since_ns = *self.bare_since_ns.get_or_insert(now_ns);
        (self.reads, self.writes) = (bare(&self.reads), bare(&self.writes));
        // Refusals of earlier greetings may still arrive.
        now_ns.saturating_sub(since_ns) < BARE_NS
    }
}

/// The samples on the line: layout names, and lengths without the stamp in bytes.
struct Layouts {
    reads: Vec<(&'static str, usize)>,
    writes: Vec<(&'static str, usize)>,
}

impl Layouts {
    /// Returns the layouts of one role, or of observer and controller together; the latter two exchange the estimate
    /// inside the device.
    fn for_roles(scenario: &Settings, roles: &[RoleId]) -> Self {
        let mut layouts = Self { reads: Vec::new(), writes: Vec::new() };
        for role in roles {
            let ports = ports(scenario, *role);
            let internal = usize::from(roles.len() > 1 && *role == RoleId::Controller);
            let layout = |port: &Port| (port.layout, port.size - size_of::<Stamp>());
            layouts.reads.extend(ports.reads.iter().skip(internal).map(layout));
            layouts.writes.extend(ports.writes.iter().map(layout));
        }
        layouts
    }

    fn lengths(layouts: &[(&'static str, usize)]) -> Vec<usize> {
        layouts.iter().map(|(_, length)| *length).collect()
    }

    fn names(layouts: &[(&'static str, usize)]) -> String {
        layouts.iter().map(|(name, _)| *name).collect::<Vec<_>>().join(" ")
    }

    /// Checks that a message can hold the samples.
    fn check(&self, role: &str) -> Result<(), DeviceError> {
        let [read, written]: [usize; 2] =
            [&self.reads, &self.writes].map(|layouts| Self::lengths(layouts).iter().sum());
        let samples = self.reads.len().max(self.writes.len());
        let names = Self::names(&self.reads).len().max(Self::names(&self.writes).len());
        if read.max(written) > MAX_CONTENT || samples > MAX_SAMPLES || names > MAX_NAMES {
            return Err(DeviceError::TooLong { role: role.to_owned(), read, written, samples });
        }
        Ok(())
    }
}

/// A device on its line, with the host's end of the protocol.
pub struct DeviceLink {
    line: Line,
    host: HostSession,
    greeting: Greeting,
    /// Length of each sample that the device reads, bytes.
    inputs: Vec<usize>,
    patience_ns: u64,
    reopen_ns: u64,
    /// The device's name, once known.
    device: Option<String>,
    other_device: bool,
    absences: Absences,
    /// Present if the device sets the pace.
    pace: Option<Box<Pace>>,
}

impl DeviceLink {
    /// Opens the line to a device that takes these roles of a scenario; `run` identifies the run.
    ///
    /// # Errors
    /// [`DeviceError::Line`], [`DeviceError::Delayed`], [`DeviceError::TooLong`] and [`DeviceError::TooSlow`].
    pub fn open(config: &DeviceConfig, scenario: &Settings, roles: &[RoleId], run: u64) -> Result<Self, DeviceError> {
        let body = matches!(roles, [RoleId::Plant(_)]);
        if body && scenario.actuation_delay_ticks > 1 {
            return Err(DeviceError::Delayed { ticks: scenario.actuation_delay_ticks });
        }
        let Rates { controller_ticks, observer_ticks, .. } = scenario.rates;
        if roles.len() > 1 && controller_ticks != observer_ticks {
            return Err(DeviceError::Rates { controller_ticks, observer_ticks });
        }
        let layouts = Layouts::for_roles(scenario, roles);
        let role = roles.iter().map(|role| role.name(scenario)).collect::<Vec<_>>().join(" ");
        layouts.check(&role)?;
        let (inputs, written) = (Layouts::lengths(&layouts.reads), Layouts::lengths(&layouts.writes));
        check_speed(&config.line, scenario, inputs.iter().chain(&written).sum())?;
        let realtime = scenario.clock == ClockKind::Realtime;
        let mut outputs = [0; MAX_SAMPLES];
        outputs.iter_mut().zip(&written).for_each(|(output, length)| *output = *length as u16);
        let terms = Terms {
            run,
            period_ns: realtime.then_some(scenario.period_ns),
            outputs,
            // A measurement or an estimate is required. A controller may omit any command.
            required: u32::from(roles != [RoleId::Controller]),
        };
        let greeting = Greeting {
            run,
            realtime,
            period_ns: scenario.period_ns,
            last_tick: scenario.last_tick,
            timeout_ticks: scenario.command_timeout_ticks,
            manual_rearm: scenario.rearm == Rearm::Manual,
            role,
            reads: Layouts::names(&layouts.reads),
            writes: Layouts::names(&layouts.writes),
            bare_since_ns: None,
        };
        let patience_ns = (config.patience_s * 1e9) as u64;
        let line = Line::to(config.line.clone())?;
        Ok(Self {
            line,
            host: HostSession::new(terms),
            greeting,
            inputs,
            patience_ns,
            reopen_ns: 0,
            device: None,
            other_device: config.other_device,
            absences: Absences::new(terms.period_ns, scenario.command_timeout_ticks),
            pace: None,
        })
    }

    /// Lets the greeted device set the pace: waits until the run's clock follows its frames. Returns false if `terminated`
    /// is set first.
    ///
    /// # Errors
    /// [`DeviceError`]; [`DeviceError::NoPace`] if the device sends no frames by its own timer.
    pub fn follow(&mut self, pace: Pace, terminated: &AtomicBool) -> Result<bool, DeviceError> {
        let (began_ns, period_ns) = (raw_ns(), self.greeting.period_ns);
        self.host.follow();
        let pace = self.pace.insert(Box::new(pace));
        // Once ticks run, frames have the number of their tick, and the grid is locked while it runs.
        if pace.begins_late() {
            return Ok(true);
        }
        let limit_ns = PACE_NS.max(PACE_PERIODS.saturating_mul(period_ns));
        while !terminated.load(Ordering::Relaxed) {
            self.exchange(monotonic_ns(), |_| {})?;
            if self.pace.as_ref().is_some_and(|pace| pace.state() == PaceState::Locked) {
                return Ok(true);
            }
            let (waited_ns, frames) = (raw_ns() - began_ns, self.pace.as_ref().map_or(0, |pace| pace.frames()));
            if waited_ns > if frames > 0 { PACE_LOADED * limit_ns } else { limit_ns } {
                let (line, waited_s) = (self.line.address().to_string(), waited_ns as f64 / 1e9);
                return Err(DeviceError::NoPace { line, tick_hz: 1e9 / period_ns as f64, frames, waited_s });
            }
            sleep_until(monotonic_ns() + LOOK_PACE_NS);
        }
        Ok(false)
    }

    /// Sets the time grid of the ticks. Takes the frames that have arrived during the start.
    ///
    /// # Errors
    /// [`DeviceError`].
    pub(super) fn start(&mut self, grid: Grid, now_ns: u64) -> Result<(), DeviceError> {
        if self.pace.is_none() {
            return Ok(());
        }
        for _ in 0..DRAIN_TURNS {
            self.exchange(now_ns, |_| {})?;
        }
        if let Some(pace) = &mut self.pace {
            pace.start(grid);
        }
        Ok(())
    }

    /// Returns true if the device gets no commands, because it was lost and the grid does not follow it again yet.
    pub(super) fn withholds_commands(&self) -> bool {
        self.pace.as_ref().is_some_and(|pace| pace.withholds())
    }

    /// Returns the relation of the grid to the device, if that sets the pace.
    pub fn pace(&self) -> Option<PaceReport> {
        self.pace.as_ref().map(|pace| pace.report(self.host.slips()))
    }

    /// Returns the names of the roles, separated by spaces.
    pub(crate) fn role(&self) -> &str {
        &self.greeting.role
    }

    /// Returns the length of each sample that the device reads, bytes.
    pub(super) fn inputs(&self) -> &[usize] {
        &self.inputs
    }

    /// Returns the length of each sample that the device writes, bytes.
    pub(super) fn outputs(&self) -> Vec<usize> {
        self.host.terms().outputs.iter().map(|length| usize::from(*length)).take_while(|length| *length > 0).collect()
    }

    /// Returns a remark on the device's samples, to follow its name.
    pub(crate) fn remark(&self) -> &'static str {
        match self.greeting.bare_since_ns.is_some() {
            true => " (states no layouts: its samples are trusted by their type names)",
            false => "",
        }
    }

    /// Greets the device until it answers; returns its name, or `None` if `terminated` is set first. `before` is the
    /// name of the device that an earlier bridge had in this run.
    ///
    /// # Errors
    /// [`DeviceError`] if the device refuses or stays silent for too long.
    pub fn greet(&mut self, before: Option<String>, terminated: &AtomicBool) -> Result<Option<String>, DeviceError> {
        self.device = before;
        while !terminated.load(Ordering::Relaxed) {
            self.exchange(monotonic_ns(), |_| {})?;
            if self.host.greeted() {
                self.host.restart_wait();
                return Ok(self.device.clone());
            }
            sleep_until(monotonic_ns() + LOOK_NS);
        }
        Ok(None)
    }

    /// Requests a tick, and repeats the request until it is answered.
    #[inline]
    pub fn request(&mut self, tick: u64, samples: Samples<'_>, now_ns: u64) {
        self.host.request(tick, samples, now_ns);
        self.absences.asked(tick, now_ns);
    }

    /// Stops requesting the current tick.
    pub fn give_up(&mut self) {
        self.host.give_up();
    }

    /// Processes received bytes and sends due frames. `answer` receives the answer to the current tick.
    ///
    /// # Errors
    /// [`DeviceError`] if the device was silent for too long or refuses to continue.
    #[inline]
    pub fn turn(&mut self, now_ns: u64, answer: impl FnMut(&Answer<'_>)) -> Result<(), DeviceError> {
        self.exchange(now_ns, answer)
    }

    fn exchange(&mut self, now_ns: u64, mut answer: impl FnMut(&Answer<'_>)) -> Result<(), DeviceError> {
        self.absences.look(now_ns, self.line.is_open());
        if self.host.silent_ns(now_ns) > self.patience_ns {
            return Err(self.silent(now_ns));
        }
        if !self.line.is_open() && !self.open_again(now_ns) {
            return Ok(());
        }
        let drained = self.take_in(now_ns, &mut answer)?;
        let Self { line, host, greeting, .. } = self;
        if let Some(pace) = &mut self.pace {
            pace.look(raw_ns(), drained, host.slips(), host.restarts())?;
        }
        let hello = greeting.hello();
        while let Some(frame) = host.due(now_ns, &hello) {
            if !line.write(frame) {
                host.unsent();
            }
        }
        line.flush();
        if !line.is_open() {
            host.cut(now_ns);
        }
        Ok(())
    }

    /// Takes received bytes; returns true if no more are left.
    fn take_in(&mut self, now_ns: u64, answer: &mut impl FnMut(&Answer<'_>)) -> Result<bool, DeviceError> {
        let mut bytes = [0; CHUNK];
        let Self { line, host, greeting, device, other_device, absences, pace, .. } = self;
        for _ in 0..CHUNKS {
            let count = line.read(&mut bytes);
            let arrived_ns = if pace.is_some() && count > 0 { line.arrived_ns() } else { 0 };
            for &byte in &bytes[..count] {
                match host.push(byte, now_ns) {
                    None => {}
                    Some(DeviceEvent::Refused(refuse)) if greeting.drop_hashes(&refuse, now_ns) => {}
                    Some(DeviceEvent::Refused(refuse)) => return Err(refused(line, greeting, &refuse)),
                    Some(DeviceEvent::OtherVersion(theirs)) => {
                        return Err(DeviceError::Version { line: line.address().to_string(), theirs });
                    }
                    Some(DeviceEvent::Answer(received)) => {
                        absences.answered(received.tick);
                        answer(&received);
                    }
                    Some(DeviceEvent::Welcome(welcome)) => {
                        let renamed = welcomed(line, &welcome, device, *other_device)?;
                        absences.greeted(welcome.next_tick, renamed.then_some(device.as_deref()).flatten());
                    }
                }
                if let Some(pace) = pace.as_deref_mut()
                    && let Some(cycle) = host.take_cycle()
                {
                    pace.arrived(cycle, arrived_ns);
                }
            }
            if count == 0 || line.is_stream() && count < CHUNK {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Tries at intervals to open the line; returns true if it is open.
    fn open_again(&mut self, now_ns: u64) -> bool {
        if now_ns < self.reopen_ns {
            return false;
        }
        self.reopen_ns = now_ns + REOPEN_NS;
        let open = self.line.reopen().is_ok();
        if open {
            self.host.reopened();
        }
        self.host.wait_since(now_ns);
        open
    }

    fn silent(&mut self, now_ns: u64) -> DeviceError {
        let (counters, refused) = (self.host.counters(), self.line.is_refused());
        let hint = match self.line.reopen() {
            Err(error) => error.to_string(),
            Ok(()) if counters.echoes > 0 => {
                "its own frames came back: is the line looped, or does the far end echo?".to_owned()
            }
            Ok(()) if counters.frames_received == 0 && counters.bytes_received > 0 => format!(
                "{} bytes came and no frame was among them: do both ends have the same speed (--baud)?",
                counters.bytes_received
            ),
            Ok(()) if refused => {
                "no program receives at that address: is the device's program running there?".to_owned()
            }
            Ok(()) if !self.line.is_stream() => {
                "is it powered, connected, and running a program of this protocol at that address?".to_owned()
            }
            Ok(()) => "is it powered, wired (RX to TX), and running a program of this protocol?".to_owned(),
        };
        let waited_s = self.host.silent_ns(now_ns) as f64 / 1e9;
        DeviceError::Silent { line: self.line.address().to_string(), waited_s, hint }
    }

    /// Returns the counters of the line.
    pub fn counters(&self) -> LineCounters {
        self.host.counters()
    }

    /// Returns the device's outages.
    pub fn outages(&self) -> Vec<Outage> {
        self.absences.outages()
    }
}

/// Stores the device's name; returns true if another name replaced an earlier one and that is allowed.
fn welcomed(
    line: &Line,
    welcome: &Welcome<'_>,
    device: &mut Option<String>,
    other_device: bool,
) -> Result<bool, DeviceError> {
    // The device is greeted again while ticks run: nothing is allocated for an unchanged name.
    if device.as_ref().is_some_and(|expected| welcome.device.escape_debug().eq(expected.chars())) {
        return Ok(false);
    }
    let found = printable(welcome.device);
    match device {
        Some(expected) if !other_device => {
            let line = line.address().to_string();
            Err(DeviceError::Other { line, expected: expected.clone(), found })
        }
        device => Ok(device.replace(found).is_some()),
    }
}

impl Drop for DeviceLink {
    /// Tells the device to apply its safe command. If that frame is lost, the device does so by its own timeout.
    fn drop(&mut self) {
        self.line.write(self.host.stop());
    }
}

/// Escapes text from the device, which may contain control characters.
fn printable(text: &str) -> String {
    text.escape_debug().to_string()
}

fn refused(line: &Line, greeting: &Greeting, refuse: &Refuse<'_>) -> DeviceError {
    let detail = printable(refuse.detail);
    let reason = match refuse.reason {
        Reason::Samples => format!(
            "it knows samples of type `{detail}`, and here it would read `{}` and write `{}`; give it the program for this \
             rig and version, or name another role with --role",
            greeting.reads, greeting.writes
        ),
        Reason::Version | Reason::Role | Reason::NotGreeted => {
            format!("{detail}; give it the program for this role, or name another one with --role")
        }
    };
    DeviceError::Refused { line: line.address().to_string(), role: greeting.role.clone(), reason }
}

/// Checks that a request and its answer fit into the period.
fn check_speed(line: &LineAddress, scenario: &Settings, content: usize) -> Result<(), DeviceError> {
    let (LineAddress::Serial { baud: Some(baud), .. }, ClockKind::Realtime) = (line, scenario.clock) else {
        return Ok(());
    };
    let bits = BITS_PER_BYTE * (2 * FRAME_OVERHEAD + content as u64);
    let tick_us = (scenario.period_ns as f64 * scenario.realtime.cutoff / 1e3) as u64;
    let line_us = bits * 1_000_000 / u64::from((*baud).max(1));
    if line_us > tick_us {
        let least = (bits * 1_000_000).div_ceil(tick_us.max(1));
        return Err(DeviceError::TooSlow { baud: *baud, line_us, tick_us, least });
    }
    Ok(())
}

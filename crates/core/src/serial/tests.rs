//! Both ends together over a line in memory, in virtual time: without faults, with faults, interrupted, and with
//! mismatches.

use super::*;
use crate::role::{Actuation, Body, CommandEvent, Law, LawInputs, Plant, Rearm};
use crate::sample::{RateCommand, RateEstimate, RateMeasurement, RateTruth, Sample, Stamp, content_length};
use proptest::prelude::*;
use rand_pcg::Pcg64;
use rand_pcg::rand_core::{Rng, SeedableRng};

const PERIOD_NS: u64 = 10_000_000;
const TIMEOUT_TICKS: u64 = 4;
const STEP_NS: u64 = 100_000;

/// A body that integrates its commands about the first axis.
#[derive(Debug, Clone, PartialEq)]
struct Spinner {
    rate: f64,
    applied: f64,
}

impl Body for Spinner {
    type Truth = RateTruth;
    type Measurement = RateMeasurement;
    type Command = RateCommand;

    fn apply(&mut self, command: &RateCommand) -> bool {
        self.applied = command.acceleration_rad_s2[0];
        self.applied.is_finite()
    }
    fn apply_safe(&mut self) {
        self.applied = 0.0;
    }
    fn truth(&self, status: u64, out: &mut RateTruth) {
        (out.omega_rad_s[0], out.applied_rad_s2[0], out.status) = (self.rate, self.applied, status);
    }
    fn measure(&mut self, _tick: u64, status: u64, out: &mut RateMeasurement) {
        (out.omega_rad_s[0], out.applied_rad_s2[0], out.status) = (self.rate, self.applied, status);
    }
    fn flow(&mut self, dt_s: f64) {
        self.rate += self.applied * dt_s;
    }
}

const WRITES: &str = "corotate/rigid-body/measurement/v1#bcfd8b41 corotate/rigid-body/truth/v1#6b083b5d";
const MEASUREMENT: usize = content_length::<RateMeasurement>();
const TRUTH: usize = content_length::<RateTruth>();

fn spinner() -> Spinner {
    Spinner { rate: 1.0, applied: 0.0 }
}

fn hello(run: u64, realtime: bool) -> Hello<'static> {
    Hello {
        run,
        realtime,
        period_ns: PERIOD_NS,
        last_tick: 1000,
        timeout_ticks: TIMEOUT_TICKS,
        manual_rearm: false,
        role: "follower",
        reads: RateCommand::LAYOUT,
        writes: WRITES,
    }
}

fn command(value: f64) -> RateCommand {
    RateCommand { acceleration_rad_s2: [value, 0.0, 0.0], ..RateCommand::default() }
}

type Make = fn(&Hello<'_>) -> Option<DevicePlant<Spinner>>;
type Spinning = Device<DevicePlant<Spinner>, Make>;

fn device() -> Spinning {
    Device::new("spinner 1", |hello| Some(DevicePlant::new(spinner(), hello)))
}

/// The fault probabilities of a line, per byte.
#[derive(Debug, Clone, Copy)]
struct Faults {
    drop: f64,
    corrupt: f64,
    garbage: f64,
}

const CLEAN: Faults = Faults { drop: 0.0, corrupt: 0.0, garbage: 0.0 };

/// Both ends, the line between them, and a clock moved by the test.
struct Rig {
    host: HostSession,
    device: Spinning,
    hello: Hello<'static>,
    faults: Faults,
    random: Pcg64,
    now_ns: u64,
    cut: bool,
}

/// The host's events, with their contents copied out.
#[derive(Debug, Clone, PartialEq)]
enum Event {
    Welcome(u64),
    Refused(Reason, String),
    OtherVersion(u8),
    Answer(u64, CommandEvent, RateMeasurement, RateTruth),
}

impl Rig {
    fn new(hello: Hello<'static>, faults: Faults, seed: u64) -> Self {
        let terms = Terms {
            run: hello.run,
            period_ns: hello.realtime.then_some(PERIOD_NS),
            outputs: std::array::from_fn(|index| [MEASUREMENT, TRUTH].get(index).map_or(0, |length| *length as u16)),
            required: 1,
        };
        let random = Pcg64::seed_from_u64(seed);
        Self { host: HostSession::new(terms), device: device(), hello, faults, random, now_ns: 1, cut: false }
    }

    fn damage(&mut self, bytes: &[u8]) -> Vec<u8> {
        let mut out = Vec::new();
        if self.cut {
            return out;
        }
        for &byte in bytes {
            let draw = self.random.next_u64() as f64 / u64::MAX as f64;
            let Faults { drop, corrupt, garbage } = self.faults;
            match draw {
                draw if draw < drop => {}
                draw if draw < drop + corrupt => out.push(byte ^ (1 << (out.len() % 8))),
                draw if draw < drop + corrupt + garbage => out.extend([byte, 0x55, 0, 0xaa]),
                _ => out.push(byte),
            }
        }
        out
    }

    /// Advances time by one step: due frames are sent, answered, and received.
    fn step(&mut self) -> Vec<Event> {
        self.now_ns += STEP_NS;
        let mut up = Vec::new();
        while let Some(frame) = self.host.due(self.now_ns, &self.hello) {
            up.extend_from_slice(frame);
        }
        let (up, mut down) = (self.damage(&up), Vec::new());
        self.device.receive(&up, self.now_ns, |frame| down.extend_from_slice(frame));
        self.device.elapse(self.now_ns);
        let down = self.damage(&down);
        self.receive(&down)
    }

    fn receive(&mut self, bytes: &[u8]) -> Vec<Event> {
        let mut events = Vec::new();
        for &byte in bytes {
            let Some(event) = self.host.push(byte, self.now_ns) else { continue };
            events.push(match event {
                DeviceEvent::Welcome(welcome) => Event::Welcome(welcome.next_tick),
                DeviceEvent::Refused(refuse) => Event::Refused(refuse.reason, refuse.detail.to_owned()),
                DeviceEvent::OtherVersion(version) => Event::OtherVersion(version),
                DeviceEvent::Answer(answer) => {
                    let (mut measurement, mut truth) = (RateMeasurement::default(), RateTruth::default());
                    let (measured, true_bytes) = answer.outputs.bytes.split_at(MEASUREMENT);
                    assert!(measurement.set_content(measured) && truth.set_content(true_bytes));
                    Event::Answer(answer.tick, answer.event, measurement, truth)
                }
            });
        }
        events
    }

    /// Steps until the host has an event, or for `ns`.
    fn until(&mut self, ns: u64) -> Option<Event> {
        let end_ns = self.now_ns + ns;
        while self.now_ns < end_ns {
            if let Some(event) = self.step().into_iter().next() {
                return Some(event);
            }
        }
        None
    }

    fn greet(&mut self) {
        assert!(matches!(self.until(PERIOD_NS), Some(Event::Welcome(_))));
    }

    /// Requests a tick and returns the answer.
    fn ask(&mut self, tick: u64, value: Option<f64>, ns: u64) -> Option<Event> {
        let command = value.map(command);
        let bytes = command.as_ref().map_or(&[][..], crate::sample::Message::content);
        self.host.request(tick, Samples { present: u32::from(value.is_some()), bytes }, self.now_ns);
        let end_ns = self.now_ns + ns;
        while self.now_ns < end_ns {
            let events = self.step();
            if let Some(event) = events.into_iter().find(|event| !matches!(event, Event::Welcome(_))) {
                return Some(event);
            }
        }
        self.host.give_up();
        None
    }
}

fn value(tick: u64) -> f64 {
    (tick as f64 * 0.7).sin()
}

/// Returns the answers of a plant in the host's own process.
fn built_in(ticks: u64) -> Vec<Event> {
    let actuation = Actuation { driven: true, delay_ticks: 1, timeout_ticks: TIMEOUT_TICKS, rearm: Rearm::Auto };
    let mut plant = Plant::new(spinner(), actuation, PERIOD_NS as f64 / 1e9);
    let answer = |tick: u64| {
        let mut command = command(value(tick));
        command.stamp.tick = tick.saturating_sub(1);
        let event = plant.command(tick, (tick > 0).then_some(&command));
        let (mut measurement, mut truth) = (RateMeasurement::default(), RateTruth::default());
        plant.measure(&Stamp::default(), &mut measurement);
        plant.truth(&Stamp::default(), &mut truth);
        plant.advance(1);
        Event::Answer(tick, event, measurement, truth)
    };
    (0..ticks).map(answer).collect()
}

#[test]
fn a_device_answers_like_the_built_in_plant() {
    let mut rig = Rig::new(hello(1, false), CLEAN, 1);
    for (tick, expected) in (0..).zip(built_in(50)) {
        assert_eq!(rig.ask(tick, (tick > 0).then(|| value(tick)), 1_000_000_000), Some(expected));
    }
    let counters = rig.host.counters();
    assert_eq!(
        (counters.handshakes, counters.repeats, counters.duplicates, counters.late, counters.sequence_gaps),
        (1, 0, 0, 0, 0)
    );
    assert_eq!(
        (counters.frames_sent, counters.frames_received, counters.crc_errors, counters.dropped_bytes),
        (51, 51, 0, 0)
    );
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    /// Without a clock every request is repeated until it is answered, so that faults of the line do not change the answers.
    #[test]
    fn no_fault_of_the_line_changes_an_answer(seed: u64, drop in 0.0..0.004, corrupt in 0.0..0.004, garbage in 0.0..0.004) {
        let mut rig = Rig::new(hello(1, false), Faults { drop, corrupt, garbage }, seed);
        for (tick, expected) in (0..).zip(built_in(100)) {
            prop_assert_eq!(rig.ask(tick, (tick > 0).then(|| value(tick)), 3_600_000_000_000), Some(expected));
        }
        let counters = rig.host.counters();
        prop_assert!(counters.frames_received + counters.crc_errors + counters.malformed + counters.sequence_gaps >= 101);
    }
}

/// Faults of this rate occur often enough to be tested.
#[test]
fn a_faulty_line_is_counted() {
    let mut rig = Rig::new(hello(1, false), Faults { drop: 0.002, corrupt: 0.002, garbage: 0.002 }, 5);
    for tick in 0..300 {
        assert!(rig.ask(tick, Some(0.0), 3_600_000_000_000).is_some());
    }
    let counters = rig.host.counters();
    assert!(
        counters.crc_errors > 10 && counters.repeats > 30 && counters.resyncs > 10 && counters.dropped_bytes > 500,
        "{counters:?}"
    );
    assert!(counters.sequence_gaps > 10 && counters.frames_sent > 330 && counters.late == 0, "{counters:?}");
}

/// A device that takes 20 ms is asked twice at first only, although 5 ms is the shortest repetition interval.
#[test]
fn a_slow_device_is_eventually_asked_once_per_tick() {
    const SLOW_STEPS: usize = 200;
    let mut rig = Rig::new(hello(1, false), CLEAN, 1);
    let mut line = std::collections::VecDeque::from(vec![Vec::new(); SLOW_STEPS]);
    let (mut tick, mut asked) = (0, Vec::new());
    rig.host.request(0, Samples::default(), rig.now_ns);
    while tick < 40 {
        rig.now_ns += STEP_NS;
        let mut up = Vec::new();
        while let Some(frame) = rig.host.due(rig.now_ns, &rig.hello) {
            up.extend_from_slice(frame);
        }
        let mut down = Vec::new();
        rig.device.receive(&up, rig.now_ns, |frame| down.extend_from_slice(frame));
        line.push_back(down);
        let down = line.pop_front().unwrap();
        if rig.receive(&down).iter().any(|event| matches!(event, Event::Answer(..))) {
            asked.push(rig.host.counters().repeats);
            tick += 1;
            rig.host.request(tick, Samples::default(), rig.now_ns);
        }
    }
    assert!(asked[0] > 0 && asked[39] == asked[9], "{asked:?}");
}

/// A device that takes more than half of a period per frame catches up after a delay, because it is not asked again while it
/// works on a late request.
#[test]
fn a_delayed_device_catches_up() {
    // The time per frame, ns: short at first, so that a request is repeated early.
    let slow = |tick: u64| if tick < 50 { 3_000_000 } else { 5_600_000 };
    const DELAYED: u64 = 50;
    const DELAYED_NS: u64 = 25_000_000;
    let mut rig = Rig::new(hello(1, true), CLEAN, 1);
    rig.greet();
    let (mut line, mut busy_ns, mut missed) = (std::collections::VecDeque::new(), 0, Vec::new());
    for tick in 0..200 {
        let end_ns = rig.now_ns + PERIOD_NS;
        rig.host.request(tick, Samples::default(), rig.now_ns);
        if tick == DELAYED {
            busy_ns = rig.now_ns + DELAYED_NS;
        }
        let mut answered = false;
        while rig.now_ns < end_ns {
            rig.now_ns += STEP_NS;
            while let Some(frame) = rig.host.due(rig.now_ns, &rig.hello) {
                busy_ns = busy_ns.max(rig.now_ns) + slow(tick);
                line.push_back((busy_ns, frame.to_vec()));
            }
            while let Some((_, up)) = line.pop_front_if(|(done_ns, _)| *done_ns <= rig.now_ns) {
                let mut down = Vec::new();
                rig.device.receive(&up, rig.now_ns, |frame| down.extend_from_slice(frame));
                answered |= rig.receive(&down).iter().any(|event| matches!(event, Event::Answer(..)));
            }
        }
        if !answered {
            rig.host.give_up();
            missed.push(tick);
        }
    }
    assert!(missed.contains(&DELAYED) && missed.len() < 10, "{missed:?}");
}

#[test]
fn a_tick_requested_twice_is_executed_once() {
    let mut rig = Rig::new(hello(1, true), CLEAN, 1);
    rig.greet();
    let first = rig.ask(0, None, PERIOD_NS);
    let moved = rig.ask(1, Some(2.0), PERIOD_NS);
    assert!(first.is_some() && moved.is_some());
    assert_eq!(rig.ask(1, Some(77.0), PERIOD_NS), moved, "the same answer, without the other command");
    assert_eq!(rig.ask(0, None, PERIOD_NS), None, "no answer to an older tick");
    let Some(Event::Answer(2, CommandEvent::Applied, measurement, _)) = rig.ask(2, Some(2.0), PERIOD_NS) else {
        panic!()
    };
    assert_eq!(measurement.omega_rad_s[0], 1.0 + 2.0 * 0.01);
}

/// Missing ticks are missing commands: the input is held, then the safe command acts.
#[test]
fn missing_ticks_expire_like_missing_commands() {
    let mut rig = Rig::new(hello(1, true), CLEAN, 1);
    rig.greet();
    rig.ask(0, None, PERIOD_NS);
    rig.ask(1, Some(1.0), PERIOD_NS);
    // Ticks 2 to 4 are lost and 5 has no command: the fourth missing command in a row.
    let Some(Event::Answer(5, CommandEvent::Expired, measurement, _)) = rig.ask(5, None, PERIOD_NS) else { panic!() };
    assert!((measurement.omega_rad_s[0] - 1.04).abs() < 1e-15 && measurement.applied_rad_s2[0] == 0.0);
    let Some(Event::Answer(6, CommandEvent::Applied, ..)) = rig.ask(6, Some(1.0), PERIOD_NS) else { panic!() };
}

#[test]
fn a_device_without_ticks_applies_the_safe_command_by_its_own_clock_and_recovers() {
    let mut rig = Rig::new(hello(1, true), CLEAN, 1);
    rig.greet();
    rig.ask(0, None, PERIOD_NS);
    rig.ask(1, Some(1.0), PERIOD_NS);
    assert!(!rig.device.is_safe());
    let executed_ns = rig.now_ns;
    rig.device.elapse(executed_ns + TIMEOUT_TICKS * PERIOD_NS + PERIOD_NS / 2 - STEP_NS);
    assert!(!rig.device.is_safe());
    rig.device.elapse(executed_ns + TIMEOUT_TICKS * PERIOD_NS + PERIOD_NS / 2);
    assert!(rig.device.is_safe());
    assert_eq!(rig.ask(5, Some(1.0), PERIOD_NS), None, "the device has passed that tick");
    let Some(Event::Answer(6, CommandEvent::Applied, measurement, _)) = rig.ask(6, Some(1.0), PERIOD_NS) else {
        panic!()
    };
    assert!((measurement.omega_rad_s[0] - 1.04).abs() < 1e-15, "{measurement:?}");
}

#[test]
fn without_a_clock_there_is_no_timeout() {
    let mut rig = Rig::new(hello(1, false), CLEAN, 1);
    rig.greet();
    rig.ask(0, None, PERIOD_NS);
    rig.ask(1, Some(1.0), PERIOD_NS);
    rig.device.elapse(rig.now_ns + 1000 * PERIOD_NS);
    assert!(!rig.device.is_safe());
}

#[test]
fn stop_applies_the_safe_command_at_once_and_the_run_can_continue() {
    let mut rig = Rig::new(hello(1, true), CLEAN, 1);
    assert!(rig.device.is_safe());
    rig.greet();
    rig.ask(0, None, PERIOD_NS);
    rig.ask(1, Some(1.0), PERIOD_NS);
    let stop = rig.host.stop().to_vec();
    rig.device.receive(&stop, rig.now_ns, |_| panic!("no answer to Stop"));
    assert!(rig.device.is_safe());
    let Some(Event::Answer(2, CommandEvent::Applied, ..)) = rig.ask(2, Some(1.0), PERIOD_NS) else { panic!() };
    assert!(!rig.device.is_safe());
}

/// A device replaced during a run does not answer, is greeted, and begins at its initial state.
#[test]
fn a_restarted_device_is_greeted_at_once() {
    let mut rig = Rig::new(hello(1, true), CLEAN, 1);
    rig.greet();
    rig.ask(0, None, PERIOD_NS);
    rig.ask(1, Some(50.0), PERIOD_NS);
    rig.device = device();
    let Some(Event::Answer(2, CommandEvent::Applied, measurement, _)) = rig.ask(2, Some(1.0), 20 * PERIOD_NS) else {
        panic!()
    };
    let counters = rig.host.counters();
    assert_eq!((measurement.omega_rad_s[0], counters.handshakes, counters.restarts), (1.0, 2, 1));
}

#[test]
fn a_silent_device_is_greeted_again_and_continues() {
    let mut rig = Rig::new(hello(1, true), CLEAN, 1);
    rig.greet();
    rig.ask(0, None, PERIOD_NS);
    rig.ask(1, Some(1.0), PERIOD_NS);
    rig.cut = true;
    for tick in 2..20 {
        assert_eq!(rig.ask(tick, Some(1.0), PERIOD_NS), None);
    }
    assert!(
        !rig.host.greeted() && rig.host.counters().unanswered == 18 && rig.host.silent_ns(rig.now_ns) > 10 * PERIOD_NS
    );
    rig.cut = false;
    let Some(Event::Answer(20, CommandEvent::Applied, measurement, _)) = rig.ask(20, Some(1.0), 20 * PERIOD_NS) else {
        panic!()
    };
    assert!(
        (measurement.omega_rad_s[0] - 1.04).abs() < 1e-15,
        "the safe command acted, and the body was not reset: {measurement:?}"
    );
    let counters = rig.host.counters();
    assert_eq!((counters.handshakes, counters.restarts, rig.host.silent_ns(rig.now_ns)), (2, 0, 0));
}

#[test]
fn another_run_begins_at_the_initial_state() {
    let mut rig = Rig::new(hello(1, false), CLEAN, 1);
    rig.ask(0, None, PERIOD_NS);
    rig.ask(1, Some(50.0), PERIOD_NS);
    let mut next = Rig::new(hello(2, false), CLEAN, 1);
    next.device = rig.device;
    let Some(Event::Answer(0, CommandEvent::NotDue, measurement, _)) = next.ask(0, None, PERIOD_NS) else { panic!() };
    assert_eq!(measurement.omega_rad_s[0], 1.0);
}

#[test]
fn mismatched_samples_and_roles_are_refused() {
    let (command, measurement) = (RateCommand::LAYOUT, RateMeasurement::LAYOUT);
    for (reads, writes, own) in [
        ("corotate/rigid-body/command/v0", WRITES, command),
        // Other fields under the same type name, and a host without hashes.
        ("corotate/rigid-body/command/v2#00000000", WRITES, command),
        (RateCommand::TYPE_NAME, WRITES, command),
        ("corotate/rigid-body/command/v2#ff8ce508 more", WRITES, "fewer samples"),
        (command, measurement, RateTruth::LAYOUT),
        ("", "", command),
    ] {
        let mut rig = Rig::new(Hello { reads, writes, ..hello(1, true) }, CLEAN, 1);
        assert_eq!(rig.until(PERIOD_NS), Some(Event::Refused(Reason::Samples, own.to_owned())));
    }
    let mut rig = Rig::new(hello(1, true), CLEAN, 1);
    rig.device = Device::new("none", |_| None);
    assert!(matches!(rig.until(PERIOD_NS), Some(Event::Refused(Reason::Role, _))));
    let mut rig = Rig::new(Hello { timeout_ticks: 0, ..hello(1, true) }, CLEAN, 1);
    assert!(matches!(rig.until(PERIOD_NS), Some(Event::Refused(Reason::Role, _))));
}

/// A law that commands 1 if it has an own estimate.
struct Aware;

impl Law for Aware {
    type Estimate = RateEstimate;
    type Measurement = RateMeasurement;
    type Command = RateCommand;

    fn command(&mut self, inputs: &LawInputs<'_, Self>, out: &mut RateCommand) {
        out.acceleration_rad_s2[0] = f64::from(u8::from(inputs.own_estimate.is_some()));
    }
}

#[test]
fn the_first_law_has_an_own_estimate_if_it_drives_the_first_body() {
    let controller = || DeviceController::new([Aware, Aware], &hello(1, true));
    let bytes = vec![0; content_length::<RateEstimate>() + 2 * content_length::<RateMeasurement>()];
    for (mut device, expected) in [(controller(), [0.0, 0.0]), (controller().driving_first(), [1.0, 0.0])] {
        let read = Samples { present: 0b111, bytes: &bytes };
        let (mut inputs, mut outputs) =
            (Inputs::new(read, DeviceController::<Aware, 2>::reads()).unwrap(), Outputs::default());
        device.execute(7, &mut inputs, &mut outputs);
        let mut written = Inputs::new(outputs.samples(), DeviceController::<Aware, 2>::writes()).unwrap();
        let commands = [(); 2].map(|()| written.take::<RateCommand>(7).unwrap().acceleration_rad_s2[0]);
        assert_eq!(commands, expected);
    }
}

/// Returns the bytes of a Stop of another version.
fn foreign(version: u8) -> Vec<u8> {
    encode(&[version, 0, 5], &mut [0; MAX_FRAME]).unwrap().to_vec()
}

#[test]
fn another_version_is_refused_by_both_ends() {
    let mut rig = Rig::new(hello(1, true), CLEAN, 1);
    for version in [1, 9] {
        assert_eq!(rig.receive(&foreign(version)), [Event::OtherVersion(version)]);
        let mut reply = Vec::new();
        rig.device.receive(&foreign(version), 1, |frame| reply.extend_from_slice(frame));
        assert!(matches!(&rig.receive(&reply)[..], [Event::Refused(Reason::Version, _)]));
    }
}

#[test]
fn late_and_repeated_answers_and_echoes_are_counted_and_dropped() {
    let mut rig = Rig::new(hello(1, true), CLEAN, 1);
    rig.greet();
    rig.host.request(0, Samples::default(), rig.now_ns);
    let asked = rig.host.due(rig.now_ns, &rig.hello).unwrap().to_vec();
    let mut answer = Vec::new();
    rig.device.receive(&asked, rig.now_ns, |frame| answer.extend_from_slice(frame));
    rig.host.give_up();
    assert!(rig.receive(&answer).is_empty());
    rig.ask(1, Some(1.0), PERIOD_NS).unwrap();
    rig.host.request(2, Samples::default(), rig.now_ns);
    let asked = rig.host.due(rig.now_ns, &rig.hello).unwrap().to_vec();
    let mut answer = Vec::new();
    rig.device.receive(&asked, rig.now_ns, |frame| answer.extend_from_slice(frame));
    assert_eq!(rig.receive(&answer).len(), 1);
    assert!(rig.receive(&answer).is_empty() && rig.receive(&asked).is_empty());
    let counters = rig.host.counters();
    assert_eq!((counters.late, counters.duplicates, counters.echoes, counters.unanswered), (1, 1, 1, 1));
}

/// Returns a frame of the device with this sequence number that answers no request.
fn frame_of(sequence: u32) -> Vec<u8> {
    let outputs = Samples { present: 1, bytes: &[0; MEASUREMENT] };
    let answer = Answer { echo: 0, tick: 1000, event: CommandEvent::Held, outputs };
    let mut payload = [0; MAX_PAYLOAD];
    let payload = write(sequence, Message::Answer(answer), &mut payload).unwrap();
    encode(payload, &mut [0; MAX_FRAME]).unwrap().to_vec()
}

proptest! {
    /// Lost frames are counted once, across the wrap of the sequence number and with repeated frames.
    #[test]
    fn repeated_frames_are_not_lost_frames(first: u32, fates in prop::collection::vec((any::<bool>(), any::<prop::sample::Index>(), any::<bool>()), 1..200)) {
        let mut rig = Rig::new(hello(1, true), CLEAN, 1);
        let (mut received, mut lost) = (vec![first], 0);
        rig.receive(&frame_of(first));
        let (mut sequence, mut pending) = (first, 0);
        for (arrives, old, again) in fates {
            sequence = sequence.wrapping_add(1);
            if arrives {
                rig.receive(&frame_of(sequence));
                received.push(sequence);
                lost += std::mem::take(&mut pending);
            } else {
                pending += 1;
            }
            if again {
                rig.receive(&frame_of(received[old.index(received.len())]));
            }
            prop_assert_eq!(rig.host.counters().sequence_gaps, lost);
        }
    }

    /// Every restart of the device after an answer is counted once, and no other handshake counts as one.
    #[test]
    fn a_restarted_device_is_distinguished_from_an_unreachable_one(fates in prop::collection::vec(0..4_u8, 1..30)) {
        let mut rig = Rig::new(hello(1, true), CLEAN, 1);
        rig.greet();
        let (mut restarts, mut tick) = (0, 0);
        for fate in fates {
            prop_assert!(rig.ask(tick, None, 20 * PERIOD_NS).is_some());
            tick += 1;
            match fate {
                0 => {
                    rig.device = device();
                    restarts += 1;
                }
                // The device was only unreachable.
                1 => rig.host.cut(rig.now_ns),
                // Both at once.
                2 => {
                    rig.host.cut(rig.now_ns);
                    rig.device = device();
                    restarts += 1;
                }
                _ => {}
            }
        }
        prop_assert!(rig.ask(tick, None, 20 * PERIOD_NS).is_some());
        let counters = rig.host.counters();
        prop_assert_eq!((counters.restarts, counters.sequence_gaps), (restarts, 0));
    }
}

/// Answers with samples of another length than agreed are malformed.
#[test]
fn an_answer_of_another_length_is_malformed() {
    let mut rig = Rig::new(hello(1, true), CLEAN, 1);
    rig.greet();
    rig.host.request(0, Samples::default(), rig.now_ns);
    let mut payload = [0; MAX_PAYLOAD];
    let zeros = [0; MEASUREMENT + TRUTH];
    let cases = [
        (0b11, 16, 0),
        (0b11, MEASUREMENT, 0),
        (0b10, TRUTH, 0),
        (0b101, MEASUREMENT, 0),
        (0, 0, 0),
        (0b01, MEASUREMENT, 1),
    ];
    for (present, length, expected) in cases {
        let outputs = Samples { present, bytes: &zeros[..length] };
        let answer = Answer { echo: 0, tick: 0, event: CommandEvent::NotDue, outputs };
        let payload = write(0, Message::Answer(answer), &mut payload).unwrap();
        let frame = encode(payload, &mut [0; MAX_FRAME]).unwrap().to_vec();
        let mut events = 0;
        frame.iter().for_each(|byte| events += usize::from(rig.host.push(*byte, rig.now_ns).is_some()));
        assert_eq!(events, expected);
    }
    assert_eq!(rig.host.counters().malformed, 5);
}

#[test]
fn a_real_device_sends_no_truth() {
    let seat = |hello: &Hello<'_>| Some(DevicePlant::new(spinner(), hello).without_truth());
    let mut device = Device::new("real", seat);
    let mut payload = [0; MAX_PAYLOAD];
    let mut lengths = Vec::new();
    for (sequence, message) in
        [(0, Message::Hello(hello(1, true))), (1, Message::Tick(Tick { tick: 3, inputs: Samples::default() }))]
    {
        let payload = write(sequence, message, &mut payload).unwrap();
        device.receive(encode(payload, &mut [0; MAX_FRAME]).unwrap(), 0, |frame| {
            decode(frame, |message| {
                if let Ok((_, Message::Answer(answer))) = message {
                    lengths.push((answer.tick, answer.outputs.present, answer.outputs.bytes.len()));
                }
            });
        });
    }
    assert_eq!(lengths, [(3, 1, MEASUREMENT)]);
}

proptest! {
    /// Neither end panics on any bytes, in any state.
    #[test]
    fn no_bytes_panic(bytes in prop::collection::vec(any::<u8>(), 0..2000), payloads in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..60), 0..20)) {
        let mut rig = Rig::new(hello(1, true), CLEAN, 1);
        rig.greet();
        let frames = payloads.iter().flat_map(|payload| encode(&[&[VERSION][..], payload].concat(), &mut [0; MAX_FRAME]).unwrap().to_vec());
        let bytes = [bytes, frames.collect()].concat();
        rig.receive(&bytes);
        rig.device.receive(&bytes, 0, |_| {});
        rig.device.elapse(u64::MAX);
    }
}

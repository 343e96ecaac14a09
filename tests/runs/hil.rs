//! Hardware in the loop: the foreign follower tests/hil/follower.py with corotate's leader, observer and controller. Verdicts are
//! read from the JUnit file, as a CI does.

use crate::common::{Bench, Done, Loop, Running, await_some, next, python, root};
use corotate::bus::domain::{Domain, OwnedDomain};
use corotate::bus::iox::IoxBus;
use corotate::bus::memory::MemoryBus;
use corotate::bus::{Bus, Read, Reader, Signal, Write};
use corotate::clock::monotonic_ns;
use corotate::config::ClockKind;
use corotate::inputs::{Answer, InputError, Request, WantedChange, request};
use corotate::runtime::{Input, Poll, RoleId, RunCondition, Seek, depths, private_ledger, topic};
use corotate::sample::{
    FieldKind, Health, NO_SAMPLE, Phase, RateCommand, RateMeasurement, RateTruth, RoleState, Sample, Schedule, status,
};
use corotate::scenario::Scenario;
use corotate::scenario::build;
use corotate::seat::describe_seat;
use libc::{SIGINT, SIGKILL};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// Largest difference between a run with the foreign follower and one with the built-in follower, in measurement, truth and command,
/// rad/s and rad/s². Both integrate by Runge-Kutta steps with an error far below rounding, the foreign one in twice as many steps.
/// They differ by a rounding of 1e-16 per step, which the closed loop damps within a second, times the gain of 6/s in a command. The
/// tolerance is ten times the result.
const TOLERANCE: f64 = 1e-14;

fn file(name: &str) -> PathBuf {
    root().join("tests/hil").join(name)
}

/// Starts the foreign follower with a seat file.
fn start_follower(bench: &Bench, seat: &Path, options: &[&str]) -> Running {
    let program = file("follower.py");
    bench.start_program(&python("hil"), &[&[program.to_str().unwrap(), seat.to_str().unwrap()], options].concat())
}

/// A long timeout, because roles run late beside other tests. Tests of the timeout override it.
const PATIENT: [&str; 2] = ["--set", "supervision.heartbeat_timeout_s=30"];

/// Makes the foreign follower write all samples that it published and received.
const RECORD: [&str; 2] = ["--record", "record"];

/// Starts a run that waits for the foreign follower. Returns the run and its seat file.
fn start_waiting(bench: &Bench, arguments: &[&str]) -> (Running, PathBuf) {
    let scenario = file("pair.toml");
    let common = ["run", scenario.to_str().unwrap(), "--json", "--junit", "verdict.xml", "--out", "out", "--overwrite"];
    let running = bench.start(&[&common[..], &PATIENT, arguments].concat());
    let seat = bench.await_seat("follower");
    (running, seat)
}

/// Runs with the foreign follower; both programs must succeed.
fn run_with_follower(bench: &Bench, clock: &str, options: &[&str]) -> Done {
    let (running, seat) = start_waiting(bench, &["--clock", clock]);
    let domains = bench.domains();
    let follower = start_follower(bench, &seat, options);
    let (run, follower) = (running.wait(), follower.wait());
    assert_eq!((run.code, follower.code), (Some(0), Some(0)), "{run:?} {follower:?}");
    bench.assert_clean(&domains);
    run
}

/// Returns the test cases of the JUnit file: name, and element and message of a failure.
fn junit_cases(bench: &Bench) -> Vec<(String, Option<String>)> {
    let text = std::fs::read_to_string(bench.path("verdict.xml")).unwrap();
    let document = roxmltree::Document::parse(&text).unwrap();
    let case = |node: roxmltree::Node<'_, '_>| {
        let failure = node.first_element_child();
        let text = |node: roxmltree::Node<'_, '_>| {
            format!("{}: {}", node.tag_name().name(), node.attribute("message").unwrap_or_default())
        };
        (node.attribute("name").unwrap().to_owned(), failure.map(text))
    };
    document.descendants().filter(|node| node.has_tag_name("testcase")).map(case).collect()
}

/// Asserts that all cases of the JUnit file succeeded.
fn assert_accepted(bench: &Bench) {
    let expected = ["run", "books", "estimate_error_rad_s_max", "sync_error_rad_s_max", "unscored_ticks_max"];
    assert_eq!(junit_cases(bench), expected.map(|name| (name.to_owned(), None)));
}

fn print_metrics(clock: &str, run: &Done) -> Value {
    let summary = run.json();
    let (metrics, missed) = (&summary["score"]["metrics"], &summary["books"]["missed_ticks"]);
    println!("{clock}: {metrics}, {missed} ticks missed or starved");
    summary
}

/// Asserts that the summary contains the foreign follower's counters.
fn assert_counted(summary: &Value) {
    let follower = &summary["books"]["roles"]["follower"];
    let ticks = |key: &str| follower[key].as_u64().unwrap();
    assert_eq!(ticks("executed") + ticks("missed"), 10_001, "ticks of the foreign follower: {follower}");
    let link = |link: &Value| link["service"] == "corotate/hil-pair/follower/command";
    assert!(summary["books"]["links"].as_array().unwrap().iter().any(link), "the links lack its commands");
}

#[test]
fn the_foreign_follower_synchronises_in_real_time() {
    let bench = Bench::new();
    let run = run_with_follower(&bench, "realtime", &[]);
    assert_counted(&print_metrics("realtime", &run));
    assert_accepted(&bench);
}

#[test]
fn in_lockstep_all_samples_equal_those_of_the_built_in_follower() {
    let bench = Bench::new();
    let run = run_with_follower(&bench, "lockstep", &RECORD);
    assert_counted(&print_metrics("lockstep", &run));
    assert_accepted(&bench);
    let expected = built_in();
    let worst = [
        deviation(&record::<RateMeasurement>(&bench, "measurement"), &expected.0),
        deviation(&record::<RateTruth>(&bench, "truth"), &expected.1),
        // No tick follows the last one, so its command is not read.
        deviation(&record::<RateCommand>(&bench, "command"), &expected.2[..expected.2.len() - 1]),
    ];
    println!("lockstep: measurement, truth and command deviate by at most {worst:?}");
    assert!(worst.iter().all(|worst| *worst <= TOLERANCE), "{worst:?}");
}

/// Runs the scenario with the built-in follower. Returns what that publishes and receives.
fn built_in() -> (Vec<RateMeasurement>, Vec<RateTruth>, Vec<RateCommand>) {
    let overrides = ["launch.external=[]", "clock=in-process"].map(str::to_owned);
    let scenario = Scenario::load(&file("pair.toml"), &overrides).unwrap();
    let mut all = Loop::open(&scenario);
    let mut measurement = all.input("follower", Signal::Measurement);
    let mut truth = all.input("follower", Signal::Truth);
    let mut command = all.input("follower", Signal::Command);
    let mut seen = (Vec::new(), Vec::new(), Vec::new());
    all.run(|_| {
        seen.0.push(next(&mut measurement));
        seen.1.push(next(&mut truth));
        seen.2.push(next(&mut command));
    });
    seen
}

/// Reads the samples of a signal that the foreign follower wrote.
fn record<S: Sample>(bench: &Bench, signal: &str) -> Vec<S> {
    let bytes = std::fs::read(bench.path("record").join(format!("{signal}.bin"))).unwrap();
    bytes.chunks(size_of::<S>()).map(bytemuck::pod_read_unaligned).collect()
}

/// Returns the largest difference of any floating-point number in two series of samples. Stamps and integers must be equal.
fn deviation<S: Sample>(seen: &[S], expected: &[S]) -> f64 {
    assert_eq!(seen.len(), expected.len(), "{}", S::TYPE_NAME);
    let mut worst = 0.0_f64;
    for (seen, expected) in seen.iter().zip(expected) {
        assert_eq!(seen.stamp(), expected.stamp(), "{}", S::TYPE_NAME);
        for field in S::FIELDS {
            for at in (field.offset..).step_by(8).take(field.count) {
                let word = |sample: &S| bytemuck::pod_read_unaligned::<u64>(&bytemuck::bytes_of(sample)[at..at + 8]);
                let difference = match field.kind {
                    FieldKind::F64 => (f64::from_bits(word(seen)) - f64::from_bits(word(expected))).abs(),
                    FieldKind::U64 if word(seen) == word(expected) => 0.0,
                    FieldKind::U64 => f64::INFINITY,
                };
                assert!(difference < 1.0, "{} {}: {seen:?}, not {expected:?}", S::TYPE_NAME, field.name);
                worst = worst.max(difference);
            }
        }
    }
    worst
}

/// Last tick of the runs that this process leads itself.
const LED_TICKS: u64 = 100;

/// Returns a scenario in which this process replaces the launcher and the controller.
fn led_scenario(rearm: &str) -> Scenario {
    let rearm = format!("actuator.rearm={rearm}");
    let overrides = ["clock=lockstep", "duration_s=0.1", "accept={}", "actuator.command_timeout_ticks=5", &rearm];
    let scenario = Scenario::load(&file("pair.toml"), &overrides.map(str::to_owned)).unwrap();
    assert_eq!(scenario.last_tick, LED_TICKS);
    scenario
}

/// Returns the command of a tick. Some are faulty: one missing, fewer missing than the timeout, more missing than it, one not finite.
/// In lockstep a no-sample marker replaces a missing one.
fn command(tick: u64) -> RateCommand {
    let mut command = RateCommand::default();
    let missing = matches!(tick, 10 | 20..24 | 40..50);
    (command.stamp.tick, command.stamp.generation) = (tick, if missing { 1 | NO_SAMPLE } else { 1 });
    if !missing {
        let third = if tick == 60 { f64::NAN } else { 0.25 };
        command.acceleration_rad_s2 = [0.1 + 0.01 * tick as f64, -0.005 * tick as f64, third];
    }
    command
}

/// Returns the truth of the built-in body under [`command`].
fn built_in_under_commands(scenario: &Scenario) -> Vec<RateTruth> {
    let bus = MemoryBus::new(depths(scenario));
    let follower = RoleId::named(scenario, "follower").unwrap();
    let ledger = private_ledger(scenario, follower);
    let mut node = build(scenario, follower, &bus, &ledger).unwrap();
    let truth = topic(scenario, "follower", Signal::Truth);
    let mut truth = Input::<MemoryBus, RateTruth>::open(&bus, &truth, Reader::Scorer).unwrap();
    let mut writer = bus.writer::<RateCommand>(&topic(scenario, "follower", Signal::Command), 1).unwrap();
    let mut seen = Vec::new();
    for tick in 0..=LED_TICKS {
        assert_eq!(node.poll(RunCondition::Inputs { up_to: tick }).unwrap(), Poll::Executed);
        node.finish_tick().unwrap();
        seen.push(next(&mut truth));
        writer.send(|sample| *sample = command(tick)).unwrap();
    }
    seen
}

/// Leads the foreign body through a run like the launcher, and answers its measurements like a controller.
fn lead_run(scenario: &Scenario, domain: &OwnedDomain) {
    let bus = IoxBus::enter(domain.domain(), "conductor", depths(scenario)).unwrap();
    let mut schedule = bus.writer::<Schedule>(&topic(scenario, "run", Signal::Schedule), 1).unwrap();
    let mut health = bus.reader::<Health>(&topic(scenario, "follower", Signal::Health), Reader::Role).unwrap();
    let measurement = topic(scenario, "follower", Signal::Measurement);
    let mut measurement = Input::<IoxBus, RateMeasurement>::open(&bus, &measurement, Reader::Role).unwrap();
    let mut writer = bus.writer::<RateCommand>(&topic(scenario, "follower", Signal::Command), 1).unwrap();
    let mut next_tick = 0;
    let mut lead = |phase: Phase, until: RoleState| {
        await_some(|| {
            schedule
                .send(|schedule| (schedule.phase, schedule.credit_tick) = (phase as u64, scenario.last_tick))
                .unwrap();
            while measurement.advance().unwrap() {
                assert_eq!(measurement.sample().unwrap().stamp.tick, next_tick);
                writer.send(|sample| *sample = command(next_tick)).unwrap();
                next_tick += 1;
            }
            while health.advance().unwrap() {}
            health.current().filter(|health| RoleState::from_number(health.state) >= until).map(|_| ())
        });
    };
    lead(Phase::Gather, RoleState::Open);
    lead(Phase::WarmUp, RoleState::Ready);
    lead(Phase::Run, RoleState::Done);
    lead(Phase::Stop, RoleState::Absent);
    assert_eq!(next_tick, scenario.last_tick + 1);
}

/// Holding, going safe after the timeout and re-arming are compared tick by tick.
#[test]
fn the_foreign_follower_handles_faulty_commands_like_the_built_in_one() {
    for (rearm, safe_ticks) in [("auto", 6), ("manual", 56)] {
        let (bench, scenario, domain) = (Bench::new(), led_scenario(rearm), OwnedDomain::create(0).unwrap());
        let role = RoleId::named(&scenario, "follower").unwrap();
        let seat = bench.path("seat.json");
        std::fs::write(&seat, describe_seat(&scenario, role, Some(domain.domain())).to_json()).unwrap();
        let follower = start_follower(&bench, &seat, &RECORD);
        lead_run(&scenario, &domain);
        follower.wait().succeeded();
        let (seen, expected) = (record::<RateTruth>(&bench, "truth"), built_in_under_commands(&scenario));
        let worst = deviation(&seen, &expected);
        println!("{rearm}: truth deviates by at most {worst:e}");
        assert!(worst <= TOLERANCE, "{worst:e}");
        let count = |bit: u64| seen.iter().filter(|truth| truth.status & bit != 0).count();
        assert_eq!(count(status::SAFE), safe_ticks, "{rearm}: ticks with the safe command");
        assert!(count(status::HOLDING) >= 9, "{rearm}: ticks that hold a command");
        assert_eq!(count(status::REJECTED), 1, "{rearm}: ticks with a rejected command");
    }
}

/// Waits until a signal of the run has a sample that matches `wanted`.
fn await_sample<S: Sample>(domain: &Path, body: &str, signal: Signal, wanted: impl Fn(&S) -> bool) {
    let scenario = Scenario::load(&domain.join("scenario.toml"), &[]).unwrap();
    let bus = IoxBus::enter(&Domain::join(domain).unwrap(), "watcher", depths(&scenario)).unwrap();
    let mut reader = bus.reader::<S>(&topic(&scenario, body, signal), Reader::Role).unwrap();
    await_some(|| (reader.advance().unwrap() && reader.current().is_some_and(&wanted)).then_some(()));
}

/// Waits for the first tick of the follower.
fn await_ticks(domain: &Path) {
    await_sample(domain, "follower", Signal::Measurement, |sample: &RateMeasurement| sample.stamp.generation > 0);
}

#[test]
fn a_waiting_run_writes_the_seat_that_the_seat_command_prints() {
    let bench = Bench::new();
    let (running, seat) = start_waiting(&bench, &["--clock", "lockstep", "--set", "controller.predict=false"]);
    let (domains, domain) = (bench.domains(), seat.parent().unwrap().to_str().unwrap());
    // The launcher prints the missing roles before it checks its roles a second time.
    await_sample(&domains[0], "run", Signal::Schedule, |schedule: &Schedule| schedule.stamp.tick > 2);
    let own = format!("{domain}/scenario.toml");
    let printed = bench.run(&["seat", &own, "follower", "--domain", domain]);
    assert_eq!(printed.stdout, std::fs::read_to_string(&seat).unwrap(), "{printed:?}");
    assert_eq!(printed.code, Some(0));
    let foreign = bench.run(&["seat", file("pair.toml").to_str().unwrap(), "follower", "--domain", domain]);
    assert_eq!((foreign.code, foreign.stdout.as_str()), (Some(2), ""), "{foreign:?}");
    assert!(foreign.stderr.contains(&own), "{foreign:?}");
    running.signal(SIGINT);
    let done = running.wait();
    assert_eq!(done.code, Some(128 + SIGINT), "{done:?}");
    assert!(done.stderr.contains(seat.to_str().unwrap()), "{done:?}");
    let (name, failure) = junit_cases(&bench).remove(0);
    assert!(name == "run" && failure.is_some_and(|text| text.starts_with("error: ") && text.contains("signal 2")));
    bench.assert_clean(&domains);
}

/// The foreign follower sees the change of the scenario and live ones; a recording has them as messages.
#[test]
fn a_foreign_role_sees_changes_of_inputs_as_a_signal() {
    let bench = Bench::new();
    let scripted = r#"input=[{at_s = 1.0, key = "observer.decay_rate_per_s", value = 9.0},
        {at_s = 2.0, key = "follower.0.disturbance_rad_s2", value = [0.0, 0.0, 0.0]}]"#;
    let fixed = ["--clock", "lockstep", "--set", "accept={}", "--duration", "30", "--record"];
    let (run, seat) = start_waiting(&bench, &[&fixed[..], &["--set", scripted]].concat());
    let domain = seat.parent().unwrap().to_owned();
    let follower = start_follower(&bench, &seat, &["--changes", "changes.json"]);
    await_ticks(&domain);
    let set = |gain: f64| {
        let value = vec![gain; 3].into();
        let changes = vec![WantedChange { key: "controller.gain_per_s".to_owned(), value, ramp_s: 0.5 }];
        match request(&domain, &Request::Set { changes, at_tick: None }) {
            Ok(Answer::Accepted { tick, .. }) => tick,
            answer => panic!("{answer:?}"),
        }
    };
    let ticks = [set(6.0), set(3.0)];
    // The follower's program does not take a change for itself.
    let own = WantedChange { key: "actuator.safe".to_owned(), value: true.into(), ramp_s: 0.0 };
    match request(&domain, &Request::Set { changes: vec![own], at_tick: None }) {
        Err(InputError::Refused { code, .. }) => assert_eq!(code, "external-role"),
        answer => panic!("{answer:?}"),
    }
    let (run, follower) = (run.wait(), follower.wait());
    assert_eq!((run.code, follower.code), (Some(0), Some(0)), "{run:?} {follower:?}");
    let seen: Value = serde_json::from_slice(&std::fs::read(bench.path("changes.json")).unwrap()).unwrap();
    let gain = "controller.gain_per_s";
    let expected = serde_json::json!([
        [0, 1000, "observer.decay_rate_per_s", [9.0]],
        [1, 2000, "follower.0.disturbance_rad_s2", [0.0, 0.0, 0.0]],
        [2, ticks[0], gain, [6.0, 6.0, 6.0]],
        [3, ticks[1], gain, [3.0, 3.0, 3.0]],
    ]);
    assert_eq!(seen, expected);
    let bytes = std::fs::read(bench.path("out/run.mcap")).unwrap();
    let messages = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap);
    let changes = messages.filter(|message| message.channel.topic.ends_with("/run/input"));
    let recorded: Vec<u64> =
        changes.map(|message| u64::from_le_bytes(message.data[4..12].try_into().unwrap())).collect();
    assert_eq!(recorded, [1000, 2000, ticks[0], ticks[1]]);
    let ignored = |text: &str| text.contains("follower.0.disturbance_rad_s2 is used by follower");
    assert!(ignored(&run.stderr), "{}", run.stderr);
    let scenario = file("pair.toml");
    let external = ["check", scenario.to_str().unwrap(), "--set", "launch.external=[\"follower\"]", "--set", scripted];
    assert!(ignored(&bench.run(&external).succeeded().stdout));
}

#[test]
fn a_signal_while_roles_start_ends_the_run_without_leftovers() {
    for pause_ms in [0, 3, 6, 10, 20, 40, 80] {
        let bench = Bench::new();
        let (running, _) = start_waiting(&bench, &["--clock", "lockstep"]);
        let domains = bench.domains();
        std::thread::sleep(Duration::from_millis(pause_ms));
        running.signal(SIGINT);
        let done = running.wait();
        assert_eq!(done.code, Some(128 + SIGINT), "after {pause_ms} ms: {done:?}");
        bench.assert_clean(&domains);
    }
}

/// Hardware need not send heartbeats or write a report.
#[test]
fn a_follower_without_heartbeats_is_supervised_by_its_samples() {
    for clock in ["lockstep", "realtime"] {
        let bench = Bench::new();
        let summary = print_metrics(clock, &run_with_follower(&bench, clock, &["--silent"]));
        assert_accepted(&bench);
        assert_eq!(summary["books"]["unbooked"], serde_json::json!(["follower"]));
        assert!(summary["books"]["roles"]["follower"].is_null());
        assert!(summary["score"]["scored_ticks"].as_u64().unwrap() > 1_000, "{summary:#}");
    }
}

/// In real time the last ticks may be missed like all others.
#[test]
fn a_follower_without_heartbeats_that_misses_its_last_ticks_is_not_an_incident() {
    let bench = Bench::new();
    let brief = ["--duration", "1", "--set", "accept={}", "--set", "supervision.heartbeat_timeout_s=5"];
    let (running, _) = start_waiting(&bench, &[&["--clock", "realtime"], &brief[..]].concat());
    let domains = bench.domains();
    let partner = Partner::new(&domains[0], |tick, _| (tick < 990, tick < 990));
    let done = running.wait();
    drop(partner);
    assert_eq!(done.code, Some(0), "{done:?}");
    let summary = done.json();
    assert_eq!(summary["incidents"].as_array().unwrap().len(), 0, "{summary:#}");
    assert_eq!(summary["books"]["unbooked"], serde_json::json!(["follower"]));
    bench.assert_clean(&domains);
}

/// With and without heartbeats.
#[test]
fn a_killed_follower_ends_the_run_with_an_incident() {
    // The cause is a timeout of heartbeats or samples, or an early end if its files have been removed by then.
    const CODES: [&str; 3] = ["silent", "no-samples", "left"];
    let silent = &["--silent"][..];
    for (clock, options) in [("realtime", &[][..]), ("lockstep", &[]), ("realtime", silent), ("lockstep", silent)] {
        let bench = Bench::new();
        let endless = ["--duration", "100000", "--set", "accept={}", "--set", "supervision.heartbeat_timeout_s=3"];
        let (running, seat) = start_waiting(&bench, &[&["--clock", clock], &endless[..]].concat());
        let domains = bench.domains();
        let follower = start_follower(&bench, &seat, options);
        await_ticks(&domains[0]);
        follower.signal(SIGKILL);
        let (done, _) = (running.wait(), follower.wait());
        assert_eq!(done.code, Some(4), "{clock} {options:?}: {done:?}");
        let summary = done.json();
        let incident = &summary["incidents"][0];
        let (code, cause) = (incident["code"].as_str().unwrap(), incident["cause"].as_str().unwrap());
        assert!(CODES.contains(&code) && done.says(code), "{clock} {options:?}: {done:?}");
        assert!(code == "left" || cause.contains("3 s"), "{clock} {options:?}: {incident}");
        assert_eq!((&incident["role"], &incident["action"]), (&"follower".into(), &"stopped".into()), "{incident}");
        let (name, failure) = junit_cases(&bench).remove(0);
        assert!(name == "run" && failure.is_some_and(|failure| failure.contains(cause)), "{clock} {options:?}");
        assert_eq!((&summary["books"]["balanced"], &summary["accepted"]), (&true.into(), &false.into()), "{summary:#}");
        bench.assert_clean(&domains);
    }
}

/// A foreign follower without heartbeats. `misbehave` changes its measurement of a tick, and returns true for measurement and truth if
/// they are to be sent.
struct Partner {
    on: Arc<AtomicBool>,
    /// Its next tick.
    tick: Arc<AtomicU64>,
    thread: Option<JoinHandle<()>>,
}

type Misbehave = fn(u64, &mut RateMeasurement) -> (bool, bool);

impl Partner {
    fn new(domain: &Path, misbehave: Misbehave) -> Self {
        let (on, tick) = (Arc::new(AtomicBool::new(true)), Arc::new(AtomicU64::new(0)));
        let (domain, flag, current) = (domain.to_owned(), on.clone(), tick.clone());
        let thread = std::thread::spawn(move || Self::serve(&domain, misbehave, &flag, &current));
        Self { on, tick, thread: Some(thread) }
    }

    fn serve(domain: &Path, misbehave: Misbehave, on: &AtomicBool, current: &AtomicU64) {
        let scenario = Scenario::load(&domain.join("scenario.toml"), &[]).unwrap();
        let bus = IoxBus::enter(&Domain::join(domain).unwrap(), "partner", depths(&scenario)).unwrap();
        let signal = |signal| topic(&scenario, "follower", signal);
        let mut command = Input::<IoxBus, RateCommand>::open(&bus, &signal(Signal::Command), Reader::Role).unwrap();
        let mut schedule = bus.reader::<Schedule>(&topic(&scenario, "run", Signal::Schedule), Reader::Role).unwrap();
        let mut measurement = bus.writer::<RateMeasurement>(&signal(Signal::Measurement), 1).unwrap();
        let mut truth = bus.writer::<RateTruth>(&signal(Signal::Truth), 1).unwrap();
        let (mut next, mut phase, mut epoch_ns) = (0, Phase::Gather, 0);
        while on.load(Ordering::Relaxed) {
            while schedule.advance().unwrap() {
                let newest = schedule.current().unwrap();
                (phase, epoch_ns) = (Phase::from_number(newest.phase), newest.epoch_ns);
            }
            let ready = match scenario.clock {
                ClockKind::Realtime => monotonic_ns() >= epoch_ns + next * scenario.period_ns,
                _ => next == 0 || command.seek(next - 1).unwrap() != Seek::NotYet,
            };
            if phase != Phase::Run || !ready || next > scenario.last_tick {
                std::thread::sleep(Duration::from_micros(50));
                continue;
            }
            let mut sample = RateMeasurement { valid: 0b111, ..RateMeasurement::default() };
            (sample.stamp.tick, sample.stamp.generation) = (next, 1);
            let (sends_measurement, sends_truth) = misbehave(next, &mut sample);
            if sends_measurement {
                measurement.send(|slot| *slot = sample).unwrap();
            }
            if sends_truth {
                truth.send(|slot| (slot.stamp.tick, slot.stamp.generation) = (next, 1)).unwrap();
            }
            next += 1;
            current.store(next, Ordering::Relaxed);
        }
    }
}

impl Drop for Partner {
    fn drop(&mut self) {
        self.on.store(false, Ordering::Relaxed);
        let ended = self.thread.take().unwrap().join();
        assert!(std::thread::panicking() || ended.is_ok(), "the partner failed");
    }
}

/// First tick at which partners misbehave.
const BAD_TICK: u64 = 41;

/// Returns the only line of stderr that has the follower and `text` after the prefix.
fn follower_line<'a>(done: &'a Done, prefix: &str, text: &str) -> &'a str {
    let found = |line: &&str| line.starts_with(prefix) && line.contains("follower") && line.contains(text);
    let lines: Vec<&str> = done.stderr.lines().filter(found).collect();
    assert_eq!(lines.len(), 1, "{text}: {done:?}");
    lines[0]
}

/// Lockstep waits for a sample that never arrives: the run names it, and ends at the timeout.
#[test]
fn a_role_that_stalls_lockstep_is_named_with_its_missing_sample() {
    let cases: [(Misbehave, &str, u64, &[&str]); 4] = [
        (|tick, _| (tick < BAD_TICK, tick < BAD_TICK), "measurement", BAD_TICK, &["tick 40"]),
        (|tick, _| (true, tick < BAD_TICK), "truth", BAD_TICK, &["tick 40"]),
        (
            |tick, sample| {
                sample.stamp.tick += if tick < BAD_TICK { 0 } else { 2 };
                (true, true)
            },
            "measurement",
            BAD_TICK,
            &["tick 43"],
        ),
        (
            |_, sample| {
                sample.stamp.generation = 0;
                (true, true)
            },
            "measurement",
            0,
            &["tick 0", "generation 0"],
        ),
    ];
    for (misbehave, signal, tick, found) in cases {
        let bench = Bench::new();
        let (running, _) = start_waiting(&bench, &["--clock", "lockstep", "--set", "launch.external_timeout_s=6"]);
        let domains = bench.domains();
        let partner = Partner::new(&domains[0], misbehave);
        let done = running.wait();
        drop(partner);
        assert_eq!(done.code, Some(4), "{signal}: {done:?}");
        let summary = done.json();
        let incident = &summary["incidents"][0];
        assert_eq!(
            (incident["role"].as_str(), incident["tick"].as_u64()),
            (Some("follower"), Some(tick)),
            "{incident}"
        );
        assert_eq!(
            (&incident["code"], &incident["action"]),
            (&"waited-too-long".into(), &"stopped".into()),
            "{incident}"
        );
        let (cause, missing) = (incident["cause"].as_str().unwrap(), format!("tick {tick}"));
        for word in [signal, &missing].iter().chain(found) {
            assert!(cause.contains(word), "{word}: {incident}");
            assert!(follower_line(&done, "", "5 s").contains(word), "{word}: {done:?}");
        }
        assert!(
            cause.contains("6 s") && follower_line(&done, "corotate: ", "[waited-too-long]").contains(cause),
            "{done:?}"
        );
        assert!(!done.stderr.contains("undisturbed") && done.stderr.contains("10001"), "{done:?}");
        assert_eq!(summary["books"]["balanced"], true, "{summary:#}");
        let (name, failure) = junit_cases(&bench).remove(0);
        assert!(name == "run" && failure.is_some_and(|failure| failure.contains(cause)));
        bench.assert_clean(&domains);
    }
}

#[test]
fn a_run_interrupted_while_it_waits_is_not_called_undisturbed() {
    let bench = Bench::new();
    let (running, _) = start_waiting(&bench, &["--clock", "lockstep"]);
    let domains = bench.domains();
    let partner = Partner::new(&domains[0], |tick, _| (tick < BAD_TICK, tick < BAD_TICK));
    await_some(|| (partner.tick.load(Ordering::Relaxed) >= BAD_TICK).then_some(()));
    running.signal(SIGINT);
    let done = running.wait();
    drop(partner);
    assert_eq!(done.code, Some(128 + SIGINT), "{done:?}");
    assert!(done.stderr.contains("10001") && !done.stderr.contains("undisturbed"), "{done:?}");
    bench.assert_clean(&domains);
}

#[test]
fn an_external_role_that_never_connects_ends_the_run_at_the_timeout() {
    let bench = Bench::new();
    let limits = ["--set", "launch.external_timeout_s=8", "--set", "launch.startup_timeout_s=3"];
    let (running, _) = start_waiting(&bench, &[&["--clock", "lockstep"], &limits[..]].concat());
    let domains = bench.domains();
    let done = running.wait();
    assert_eq!(done.code, Some(4), "{done:?}");
    let summary = done.json();
    let [incident] = &summary["incidents"].as_array().unwrap()[..] else { panic!("{summary:#}") };
    assert_eq!((&incident["role"], &incident["tick"]), (&"follower".into(), &0.into()), "{incident}");
    assert_eq!((&incident["code"], &incident["action"]), (&"waited-too-long".into(), &"stopped".into()), "{incident}");
    let cause = incident["cause"].as_str().unwrap();
    assert!(
        cause.contains("8 s") && follower_line(&done, "corotate: ", "[waited-too-long]").contains(cause),
        "{done:?}"
    );
    follower_line(&done, "", "5 s");
    assert!(junit_cases(&bench)[0].1.as_ref().is_some_and(|failure| failure.contains(cause)));
    bench.assert_clean(&domains);
}

/// The writer has no counters, so the summary has those of the reader.
#[test]
fn rejected_samples_of_a_role_without_a_report_are_counted_by_their_reader() {
    let bench = Bench::new();
    let (running, _) = start_waiting(&bench, &["--clock", "lockstep", "--duration", "0.1", "--set", "accept={}"]);
    let domains = bench.domains();
    let partner = Partner::new(&domains[0], |tick, sample| {
        sample.omega_rad_s[1] = if tick < BAD_TICK { 0.0 } else { f64::NAN };
        // A lower generation belongs to a restarted sender, and must not stall the run.
        sample.stamp.generation = u64::from(tick < BAD_TICK);
        (true, true)
    });
    let done = running.wait();
    drop(partner);
    assert_eq!(done.code, Some(0), "{done:?}");
    let summary = done.json();
    let links = summary["books"]["links"].as_array().unwrap();
    let link = links.iter().find(|link| link["service"] == "corotate/hil-pair/follower/measurement").unwrap();
    let expected = serde_json::json!({
        "service": "corotate/hil-pair/follower/measurement", "reader": "controller", "published": null, "received": 101,
        "skipped": null, "gaps": 0, "unread": null, "void": [null, 0], "stale": 0, "rejected": 60, "injected": null,
        "rejected_by": {"stamp": 1, "not_finite": 59},
    });
    assert_eq!(*link, expected);
    assert_eq!(summary["books"]["rejected_samples"], 60);
    assert_eq!(summary["books"]["rejected_by"], link["rejected_by"]);
    assert_eq!(summary["books"]["balanced"], true);
    assert_eq!(summary["state"]["first_disturbed_tick"], BAD_TICK);
    let verdict = std::fs::read_to_string(bench.path("verdict.xml")).unwrap();
    for name in ["rejected_samples", "rejected_samples of corotate/hil-pair/follower/measurement at controller"] {
        assert!(verdict.contains(&format!("<property name=\"{name}\" value=\"60\"/>")), "{verdict}");
    }
    bench.assert_clean(&domains);
}

#[test]
fn an_external_role_may_be_started_again_before_the_ticks() {
    let bench = Bench::new();
    let (running, seat) = start_waiting(&bench, &["--clock", "lockstep", "--external", "observer"]);
    let domains = bench.domains();
    let first = start_follower(&bench, &seat, &[]);
    await_sample(&domains[0], "follower", Signal::Health, |health: &Health| health.state == RoleState::Open as u64);
    first.signal(SIGINT);
    assert_eq!(first.wait().code, Some(128 + SIGINT));
    let second = start_follower(&bench, &seat, &[]);
    let observer = bench.start(&["observer", "--domain", domains[0].to_str().unwrap()]);
    let done = [running, second, observer].map(Running::wait);
    assert!(done.iter().all(|done| done.code == Some(0)), "{done:?}");
    assert_accepted(&bench);
    bench.assert_clean(&domains);
}

#[test]
fn an_unreadable_report_fails_the_accounting() {
    let bench = Bench::new();
    let (running, seat) = start_waiting(&bench, &["--clock", "lockstep"]);
    std::fs::write(seat.with_file_name("follower.report.json"), "{}").unwrap();
    let follower = start_follower(&bench, &seat, &["--silent"]);
    let (done, follower) = (running.wait(), follower.wait());
    assert_eq!((done.code, follower.code), (Some(1), Some(0)), "{done:?} {follower:?}");
    let books = junit_cases(&bench).into_iter().find(|(name, _)| name == "books").unwrap().1.unwrap();
    assert!(books.starts_with("failure: ") && books.contains("follower"), "{books}");
}

#[test]
fn the_foreign_follower_refuses_seats_without_a_domain_and_of_other_roles() {
    let bench = Bench::new();
    for (role, reason) in [("follower", "domain"), ("leader", "driven body"), ("observer", "driven body")] {
        let printed = bench.run(&["seat", file("pair.toml").to_str().unwrap(), role]);
        assert!(printed.stderr.contains("--domain"), "{printed:?}");
        std::fs::write(bench.path("seat.json"), printed.stdout).unwrap();
        let refused = start_follower(&bench, &bench.path("seat.json"), &[]).wait();
        assert_eq!(refused.code, Some(2), "{refused:?}");
        assert!(refused.stderr.contains(reason), "{refused:?}");
    }
}

#[test]
fn the_foreign_follower_ends_if_the_launcher_is_killed() {
    for clock in ["realtime", "lockstep"] {
        let bench = Bench::new();
        let (running, seat) = start_waiting(&bench, &["--clock", clock, "--duration", "100000", "--set", "accept={}"]);
        let domains = bench.domains();
        let follower = start_follower(&bench, &seat, &RECORD);
        await_sample(&domains[0], "follower", Signal::Measurement, |sample: &RateMeasurement| {
            sample.stamp.generation > 0
        });
        running.signal(SIGKILL);
        running.wait();
        let follower = follower.wait();
        assert_eq!(follower.code, Some(1), "{follower:?}");
        assert!(follower.stderr.contains("follower.seat.json"), "{follower:?}");
        bench.assert_clean(&domains);
    }
}

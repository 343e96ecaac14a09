//! Roles computed by a function of the caller: the same bits as built-in roles if the function computes the same, in one
//! thread step by step and as a process of a run.

use crate::common::{Bench, Running, await_some};
use bytemuck::{bytes_of, from_bytes};
use corotate::config::SHIPPED;
use corotate::inputs::{Answer, Request, WantedChange, current, request};
use corotate::launch::{Launch, LaunchError, Outcome, Steps, Summary, run};
use corotate::rig::{Command, Estimate, Measurement, Rig, RigidBodyRig};
use corotate::role::Controller;
use corotate::runtime::{RoleFunction, TickSamples};
use corotate::sample::Message;
use corotate::scenario::Scenario;
use corotate::seat::{RoleAddress, RoleError, run_function};
use std::sync::atomic::{AtomicBool, AtomicUsize};
use std::time::{Duration, SystemTime};

type R = RigidBodyRig;

fn scenario(name: &str, overrides: &[&str]) -> Scenario {
    let text = SHIPPED.iter().find(|(shipped, _)| *shipped == name).unwrap().1;
    Scenario::parse(text, name, &overrides.iter().map(|set| (*set).to_owned()).collect::<Vec<_>>()).unwrap()
}

fn hash(scenario: &Scenario, outcome: &Outcome) -> String {
    let summary = Summary::new(scenario, outcome, SystemTime::UNIX_EPOCH);
    serde_json::to_value(summary).unwrap()["state"]["hash"].as_str().unwrap().to_owned()
}

/// The rig's own laws, called from outside the library.
struct Laws(Vec<Controller<<R as Rig>::Law>>);

impl Laws {
    fn new(scenario: &Scenario) -> Self {
        let rig = scenario.rig.downcast_ref::<R>().unwrap();
        Self((1..rig.bodies().len()).map(|index| Controller::new(rig.law(index), scenario.tick_s())).collect())
    }

    /// Computes the content of each command.
    fn commands(&mut self, inputs: &[Option<&[u64]>]) -> Vec<Vec<u64>> {
        let estimate: &Estimate<R> = from_bytes(bytemuck::cast_slice(inputs[0].unwrap()));
        let command = |(controller, input): (&mut Controller<<R as Rig>::Law>, &Option<&[u64]>)| {
            let mut command = Command::<R>::default();
            // In real time a measurement may be missing.
            if let Some(words) = input {
                let measurement: &Measurement<R> = from_bytes(bytemuck::cast_slice(words));
                controller.step(estimate, None, measurement, &mut command);
            }
            assert_eq!(bytes_of(&command).len(), 8 * command.words().len());
            command.words()[4..].to_vec()
        };
        self.0.iter_mut().zip(&inputs[1..]).map(command).collect()
    }
}

impl RoleFunction for Laws {
    fn compute(&mut self, tick: TickSamples<'_>) -> Result<(), String> {
        for (output, command) in tick.outputs.iter_mut().zip(self.commands(tick.inputs)) {
            output.copy_from_slice(&command);
        }
        Ok(())
    }
}

#[test]
fn a_stepped_run_equals_a_normal_run_bit_by_bit() {
    let sensor = r#"sensor=[{body="leader",field="omega_rad_s",every_ticks=3},{body="follower",field="omega_rad_s",every_ticks=2}]"#;
    for (name, set) in [
        ("rigid-pair", None),
        ("rigid-trio", None),
        ("noisy-pair", None),
        ("gyro-loss", None),
        ("rigid-pair", Some(sensor)),
    ] {
        let overrides: Vec<&str> = ["clock=in-process", "accept={}", "duration_s=3"].into_iter().chain(set).collect();
        let create = || scenario(name, &overrides);
        let scenario = create();
        let mut steps = Steps::new(create()).unwrap();
        let mut laws = Laws::new(&scenario);
        while steps.observe().unwrap() {
            let inputs: Vec<Option<&[u64]>> = steps.inputs().iter().map(Option::as_deref).collect();
            let commands = laws.commands(&inputs);
            steps.act(&commands.iter().map(Vec::as_slice).collect::<Vec<_>>()).unwrap();
        }
        assert_eq!(steps.tick(), scenario.last_tick + 1);
        let stepped = steps.finish().unwrap();
        let ran = run(&scenario, &mut Launch::new(&AtomicUsize::new(0), &mut |_| {})).unwrap();
        assert_eq!(hash(&scenario, &stepped), hash(&scenario, &ran), "{name}");
        assert_eq!(stepped.score.metrics, ran.score.metrics, "{name}");
    }
}

#[test]
fn a_scenario_that_cannot_be_stepped_is_refused_with_a_reason() {
    for (name, word) in [("rigid-fleet", "fleet"), ("inertia", "controller")] {
        let error = Steps::new(scenario(name, &["clock=in-process", "accept={}"])).err().unwrap();
        assert!(matches!(&error, LaunchError::NotStepped { reason } if reason.contains(word)), "{error}");
    }
    let killed =
        scenario("rigid-pair", &["clock=in-process", r#"fault=[{kind="kill",role="observer",from_tick=3,ticks=1}]"#]);
    let mut steps = Steps::new(killed).unwrap();
    let nothing = vec![0; steps.outputs()[0].size / 8 - 4];
    let error = loop {
        match steps.observe() {
            Ok(_) => steps.act(&[&nothing]).unwrap(),
            Err(error) => break error,
        }
    };
    assert!(matches!(&error, LaunchError::NotStepped { reason } if reason.contains("fault")), "{error}");
}

/// The controller runs in this process, the run in another.
#[test]
fn a_foreign_controller_equals_the_built_in_one_bit_by_bit() {
    let bench = Bench::new();
    let quick = ["--set", "accept={}", "--duration", "3", "--json"];
    let alone = bench.run(&[&["run", "rigid-pair", "--clock", "in-process"], &quick[..]].concat());
    for clock in ["lockstep", "realtime"] {
        let running =
            bench.start(&[&["run", "rigid-pair", "--clock", clock, "--external", "controller"], &quick[..]].concat());
        let domain = bench.await_domain();
        let seat = await_some(|| {
            let seat = domain.join("controller.seat.json");
            seat.exists().then(|| RoleAddress { domain: domain.clone(), role: "controller".to_owned() })
        });
        let laws = Laws::new(&scenario("rigid-pair", &[]));
        run_function(&seat, Box::new(laws), &AtomicBool::new(false)).unwrap();
        let done = running.wait().succeeded();
        let (own, built_in) = (done.json(), alone.json());
        if own["state"]["first_disturbed_tick"].is_null() {
            assert_eq!(own["state"]["hash"], built_in["state"]["hash"], "{clock}");
        }
        assert!(clock == "realtime" || own["state"]["first_disturbed_tick"].is_null());
        // In real time the number depends on the machine.
        let least = if clock == "realtime" { 0 } else { 2000 };
        assert!(own["books"]["roles"]["controller"]["executed"].as_u64().unwrap() > least, "{own:#}");
        bench.assert_clean(&[domain]);
    }
}

/// Starts a run that waits for a controller of this process.
fn start_waiting(bench: &Bench, options: &[&str]) -> (Running, RoleAddress) {
    let waits = ["run", "rigid-pair", "--external", "controller", "--set", "accept={}", "--json"];
    let running = bench.start(&[&waits[..], options].concat());
    let domain = bench.await_seat("controller").parent().unwrap().to_owned();
    (running, RoleAddress { domain, role: "controller".to_owned() })
}

/// A function can read the changes of inputs: they are accepted for its role.
#[test]
fn changes_are_accepted_for_a_role_of_a_function() {
    let bench = Bench::new();
    let (running, seat) = start_waiting(&bench, &["--clock", "lockstep", "--duration", "3600"]);
    let domain = seat.domain.clone();
    let function = std::thread::spawn(move || {
        let laws = Laws::new(&scenario("rigid-pair", &[]));
        run_function(&seat, Box::new(laws), &AtomicBool::new(false))
    });
    await_some(|| current(&domain).ok());
    let changes =
        vec![WantedChange { key: "controller.gain_per_s".to_owned(), value: vec![6.0; 3].into(), ramp_s: 0.0 }];
    let answer = request(&domain, &Request::Set { changes, at_tick: None }).unwrap();
    assert!(matches!(answer, Answer::Accepted { .. }), "{answer:?}");
    running.signal(15);
    let done = running.wait();
    assert_eq!(done.code, Some(128 + 15), "{done:?}");
    assert!(!done.stderr.contains("takes no changes of inputs"), "{done:?}");
    function.join().unwrap().unwrap();
}

/// The error itself ends the run, not the silence that follows: the heartbeat timeout is an hour.
#[test]
fn an_error_of_the_function_ends_the_run_in_order() {
    struct Fails(u64);
    impl RoleFunction for Fails {
        fn compute(&mut self, tick: TickSamples<'_>) -> Result<(), String> {
            if tick.tick < self.0 { Ok(()) } else { Err("it cannot divide by zero".to_owned()) }
        }
    }
    for (clock, tick) in [("lockstep", 0), ("lockstep", 100), ("realtime", 0), ("realtime", 5)] {
        let bench = Bench::new();
        let patient = ["--clock", clock, "--duration", "1000", "--set", "supervision.heartbeat_timeout_s=3600"];
        let (running, seat) = start_waiting(&bench, &patient);
        let error = run_function(&seat, Box::new(Fails(tick)), &AtomicBool::new(false)).unwrap_err();
        assert_eq!(error.to_string(), "it cannot divide by zero");
        let done = running.wait();
        assert_eq!(done.code, Some(4), "{done:?}");
        let summary = done.json();
        let incident = &summary["incidents"][0];
        assert_eq!(incident["last_words"], "it cannot divide by zero", "{incident}");
        // In real time earlier ticks may have been missed; they are counted with the next executed one.
        assert!(clock == "realtime" || incident["tick"] == tick, "{incident}");
        assert_eq!(summary["accepted"], false, "a run that lost a role is not accepted");
        bench.assert_clean(&[seat.domain]);
    }
}

/// Lockstep waits longer than the heartbeat timeout. If `launch.external_timeout_s` is shorter, the run ends at the tick
/// of the function, which gets an error. Meanwhile the janitor looks for files of dead processes only now and then.
#[test]
fn lockstep_waits_for_a_slow_function_up_to_the_external_timeout() {
    struct Slow {
        janitor: u32,
        more: Duration,
    }
    impl RoleFunction for Slow {
        fn compute(&mut self, tick: TickSamples<'_>) -> Result<(), String> {
            if tick.tick == 50 {
                std::thread::sleep(Duration::from_secs(4));
                let stat = std::fs::read_to_string(format!("/proc/{}/stat", self.janitor)).unwrap();
                // The 14th and 15th field: time as user and in the kernel, in hundredths of a second.
                let used: u64 =
                    stat.split_whitespace().skip(13).take(2).map(|field| field.parse::<u64>().unwrap()).sum();
                assert!(used < 100, "the janitor computed for {used} of 400 hundredths of a second");
                std::thread::sleep(self.more);
            }
            Ok(())
        }
    }
    let brief = ["--clock", "lockstep", "--duration", "0.2", "--set", "supervision.heartbeat_timeout_s=0.2"];
    // The limit is also the time in which the function must connect.
    for (limit_s, more_s, exit) in [(600, 0, 0), (10, 20, 4)] {
        let bench = Bench::new();
        let limit = format!("launch.external_timeout_s={limit_s}");
        let (running, seat) = start_waiting(&bench, &[&brief[..], &["--set", &limit]].concat());
        let slow = Slow { janitor: bench.await_role("janitor"), more: Duration::from_secs(more_s) };
        let served = run_function(&seat, Box::new(slow), &AtomicBool::new(false));
        let done = running.wait();
        assert_eq!(done.code, Some(exit), "{done:?}");
        let summary = done.json();
        if exit == 0 {
            served.unwrap();
            assert_eq!(summary["incidents"], serde_json::json!([]));
        } else {
            // It may return before the run has ended; its launcher was not killed.
            assert!(matches!(served, Ok(()) | Err(RoleError::Late)), "{served:?}");
            assert_eq!(summary["incidents"][0]["tick"], 50, "{summary:#}");
        }
        bench.assert_clean(&[seat.domain]);
    }
}

//! Commands that act d ticks after their measurement: the same motion under every clock, in every replay and after
//! every kill, and a loop rate equal to that of an independent computation.

use crate::common::{Bench, shipped};
use corotate::config::SHIPPED;
use corotate::launch::{Launch, Summary, run};
use corotate::nalgebra::{Matrix3, Vector3};
use corotate::record::{Recording, SignalInfo, Track};
use corotate::scenario::Scenario;
use corotate::scenario::claims;
use serde_json::Value;
use std::path::Path;
use std::sync::atomic::AtomicUsize;
use std::time::SystemTime;

const DELAYS: [usize; 3] = [1, 2, 5];

/// Runs and records a scenario, and returns its summary.
fn run_program(bench: &Bench, scenario: &str, clock: &str, further: &[String]) -> Value {
    let arguments = [
        "run",
        scenario,
        "--json",
        "--clock",
        clock,
        "--out",
        clock,
        "--overwrite",
        "--set=accept={}",
        "--set=record=true",
    ];
    let sets: Vec<&str> = further.iter().flat_map(|set| ["--set", set]).collect();
    let done = bench.run(&[&arguments[..], &sets].concat());
    assert_eq!(done.code, Some(0), "{further:?}: {done:?}");
    let summary = done.json();
    assert_eq!(summary["books"]["balanced"], true, "{further:?}: {}", summary["books"]["problems"]);
    summary
}

/// Returns the summary of an unrecorded run in this thread, which uses the fast path without links.
fn direct(name: &str, overrides: &[String]) -> Value {
    let text = SHIPPED.iter().find(|(known, _)| *known == name).unwrap().1;
    let overrides = [&["clock=in-process".to_owned(), "accept={}".to_owned()], overrides].concat();
    let scenario = Scenario::parse(text, "test", &overrides).unwrap();
    let outcome = run(&scenario, &mut Launch::new(&AtomicUsize::new(0), &mut |_| {})).unwrap();
    serde_json::to_value(Summary::new(&scenario, &outcome, SystemTime::UNIX_EPOCH)).unwrap()
}

fn owned(overrides: &[&str]) -> Vec<String> {
    overrides.iter().map(|set| (*set).to_owned()).collect()
}

#[test]
fn every_clock_and_replay_gives_the_same_hash_at_each_delay() {
    const ATTEMPTS: usize = 20;
    for (scenario, further) in [
        ("rigid-pair", &["controller.predict=true"][..]),
        ("rigid-fleet", &["controller.predict=true", "follower.0.count=7"]),
        ("orbit-rendezvous", &["controller.predict=true"]),
        ("orbit-hold", &[]),
    ] {
        let mut hashes = Vec::new();
        for delay in DELAYS {
            let bench = Bench::new();
            let delay = format!("actuation_delay_ticks={delay}");
            let sets = owned(&[further, &["tick_hz=50", "duration_s=1.5", &delay]].concat());
            let expected = direct(scenario, &sets)["state"]["hash"].clone();
            for clock in ["in-process", "lockstep"] {
                assert_eq!(run_program(&bench, scenario, clock, &sets)["state"]["hash"], expected, "{sets:?} {clock}");
            }
            let mut runs = (0..ATTEMPTS).map(|_| run_program(&bench, scenario, "realtime", &sets));
            let clean = runs.find(|summary| summary["books"]["missed_ticks"] == 0);
            let clean = clean.unwrap_or_else(|| panic!("{sets:?}: each of {ATTEMPTS} runs missed ticks"));
            assert_eq!(clean["state"]["hash"], expected, "{sets:?}");
            let roles = clean["books"]["roles"].as_object().unwrap().len();
            for arguments in
                [&["replay", "lockstep"][..], &["replay", "realtime"], &["replay", "--processes", "realtime"]]
            {
                let done = bench.run(&[arguments, &["--json"]].concat());
                assert_eq!((done.code, done.roles_replayed()), (Some(0), (roles, roles)), "{sets:?}: {done:?}");
            }
            hashes.push(expected);
        }
        hashes.dedup();
        assert_eq!(hashes.len(), DELAYS.len(), "{scenario}: different delays give different motions");
    }
}

/// In the recording, command k acts at tick k + d, and nothing acts before the first.
#[test]
fn a_command_acts_exactly_d_ticks_after_its_measurement() {
    for delay in DELAYS {
        let bench = Bench::new();
        let sets = owned(&["duration_s=0.2", &format!("actuation_delay_ticks={delay}")]);
        run_program(&bench, "rigid-pair", "in-process", &sets);
        let recording = Recording::open(&bench.path("in-process/run.mcap")).unwrap();
        let track = |signal: &str| -> Track {
            recording.tracks(|info| info.body == "follower" && info.signal == signal).unwrap().remove(0)
        };
        let (commands, truths) = (track("command"), track("truth"));
        for axis in 0..3 {
            let requested = commands.column("acceleration_rad_s2", axis).unwrap();
            let applied = truths.column("applied_rad_s2", axis).unwrap();
            assert_eq!((requested.len(), &applied[..delay]), (201, &vec![0.0; delay][..]), "{delay}");
            assert_eq!(requested[..201 - delay], applied[delay..], "{delay}");
            assert!(requested.iter().all(|value| *value != 0.0));
        }
    }
}

/// Bodies, laws and pending commands outlive their processes.
#[test]
fn a_kill_with_pending_commands_does_not_change_the_hash() {
    let bench = Bench::new();
    let text = std::fs::read_to_string(shipped("rigid-pair")).unwrap();
    let sets = owned(&["duration_s=0.5", "actuation_delay_ticks=5", "controller.predict=true"]);
    let whole = direct("rigid-pair", &sets);
    for role in ["leader", "follower", "observer", "controller"] {
        let file = bench.path(&format!("{role}.toml"));
        let fault = format!("\n[[fault]]\nkind = \"kill\"\nrole = \"{role}\"\nfrom_tick = 222\n");
        std::fs::write(&file, text.clone() + &fault).unwrap();
        for clock in ["in-process", "lockstep"] {
            let killed = run_program(&bench, file.to_str().unwrap(), clock, &sets);
            assert_eq!(killed["state"]["hash"], whole["state"]["hash"], "{role} {clock}");
            assert_eq!(killed["incidents"].as_array().unwrap().len(), 1, "{role} {clock}");
        }
    }
}

/// A command starves the plant only if it has not arrived when it is due.
#[test]
fn a_delay_absorbs_shorter_jitter() {
    let bench = Bench::new();
    let text = std::fs::read_to_string(shipped("rigid-pair")).unwrap();
    let file = |name: &str, fault: &str| {
        let head = "\n[[fault]]\nrole = \"controller\"\nfrom_tick = 100\nticks = 50\n";
        std::fs::write(bench.path(name), text.clone() + head + fault).unwrap();
        name.to_owned()
    };
    let sets = |delay: u64| owned(&["duration_s=0.4", &format!("actuation_delay_ticks={delay}")]);
    let counts = |summary: &Value| {
        let follower = &summary["books"]["roles"]["follower"];
        [follower["starved"].as_u64().unwrap(), follower["safe"].as_u64().unwrap()]
    };
    let silence = file("silence.toml", "kind = \"drop\"");
    for clock in ["in-process", "lockstep"] {
        assert_eq!(counts(&run_program(&bench, &silence, clock, &sets(5))), [50, 31], "{clock}: expiry after 20");
    }
    let late = file("late.toml", "kind = \"delay\"\ndelay_ticks = 2\njitter_ticks = 1");
    for (delay, missed) in [(1, 50..51), (2, 50..51), (3, 10..41)] {
        let [in_process, lockstep] =
            ["in-process", "lockstep"].map(|clock| run_program(&bench, &late, clock, &sets(delay)));
        assert_eq!(in_process["state"], lockstep["state"], "{delay}");
        assert!(missed.contains(&counts(&in_process)[0]), "{delay}: {:?}", counts(&in_process));
    }
    let done = bench.run(&["check", &late, "--set", "actuation_delay_ticks=4"]);
    assert_eq!(done.code, Some(2), "{done:?}");
    assert!(done.says("no-effect"), "{done:?}");
    for wrong in ["0", "65"] {
        let done = bench.run(&["check", "rigid-pair", "--set", &format!("actuation_delay_ticks={wrong}")]);
        assert_eq!(done.code, Some(2), "{done:?}");
        assert!(done.says("out-of-range"), "{done:?}");
    }
}

/// Compares the rate of `check`, which runs the code, with the product of the one-tick transitions.
#[test]
fn the_claimed_rate_is_that_of_the_linearised_loop_with_its_delay() {
    for (gain, decay, tick_hz, predict) in
        [(20.0, 200.0, 100.0, false), (190.0, 200.0, 100.0, true), (4.0, 6.0, 20.0, false)]
    {
        let mut found = Vec::new();
        for delay in DELAYS {
            let overrides = [
                format!("controller.gain_per_s={:?}", [gain; 3]),
                format!("controller.predict={predict}"),
                format!("observer.decay_rate_per_s={decay:?}"),
                format!("tick_hz={tick_hz:?}"),
                format!("actuation_delay_ticks={delay}"),
            ];
            let text = SHIPPED.iter().find(|(name, _)| *name == "rigid-pair").unwrap().1;
            let claim = claims(&Scenario::parse(text, "test", &overrides).unwrap()).remove(0);
            let rate = claim.loop_rate_per_s.unwrap_or_else(|| panic!("{overrides:?}: {:?}", claim.reason));
            let expected = linearised_rate(gain, decay, 1.0 / tick_hz, predict, delay);
            println!(
                "gain {gain}, decay {decay}, {tick_hz} Hz, predict {predict}, d = {delay}: {rate:.4}, {expected:.4}"
            );
            assert!((rate / expected - 1.0).abs() < 0.03, "{overrides:?}: {rate} is not {expected}");
            found.push(rate);
        }
        let alike = found.iter().all(|rate| (rate / found[0] - 1.0).abs() < 0.02);
        assert_eq!(alike, predict, "only prediction makes the rate independent of the delay: {found:?}");
    }
}

/// With prediction the rate is that of one tick's delay. Without it a longer delay makes the loop slower, then unstable.
#[test]
fn a_run_converges_at_the_rate_claimed_for_its_delay() {
    let mut refused = 0;
    for (delay, gain, predict) in DELAYS
        .into_iter()
        .flat_map(|d| [4.0, 40.0, 70.0].into_iter().flat_map(move |gain| [(d, gain, false), (d, gain, true)]))
    {
        let sets = [
            format!("controller.gain_per_s={:?}", [gain; 3]),
            format!("controller.predict={predict}"),
            "observer.decay_rate_per_s=150.0".to_owned(),
            "tick_hz=200.0".to_owned(),
            "duration_s=10.0".to_owned(),
            format!("actuation_delay_ticks={delay}"),
        ];
        let text = SHIPPED.iter().find(|(name, _)| *name == "rigid-pair").unwrap().1;
        let Ok(scenario) = Scenario::parse(text, "test", &sets) else {
            println!("d = {delay}, gain {gain}, predict {predict}: refused, unstable");
            assert!(!predict, "{sets:?}");
            refused += 1;
            continue;
        };
        let claimed = claims(&scenario).remove(0).loop_rate_per_s.unwrap();
        let bench = Bench::new();
        run_program(&bench, "rigid-pair", "in-process", &sets);
        let observed = observed_rate(&bench.path("in-process/run.mcap"), 200.0);
        println!("d = {delay}, gain {gain}, predict {predict}: claimed {claimed:.2}, observed {observed:.2} 1/s");
        assert!((observed / claimed - 1.0).abs() < 0.02, "{sets:?}: claimed {claimed}, observed {observed}");
    }
    assert_eq!(refused, 1);
}

/// Returns the rate at which the true distance of both motions falls from 1e-7 to 1e-12 rad/s, 1/s, by least squares.
fn observed_rate(recording: &Path, tick_hz: f64) -> f64 {
    let recording = Recording::open(recording).unwrap();
    let motion = |body: &str| {
        let truth = |info: &SignalInfo| info.body == body && info.signal == "truth";
        let track = recording.tracks(truth).unwrap().remove(0);
        [0, 1, 2].map(|axis| track.column("omega_rad_s", axis).unwrap())
    };
    let (leader, follower) = (motion("leader"), motion("follower"));
    let distance =
        |tick: usize| (0..3).map(|axis| (leader[axis][tick] - follower[axis][tick]).powi(2)).sum::<f64>().sqrt();
    let below = |limit: f64| (0..leader[0].len()).find(|tick| distance(*tick) < limit).unwrap();
    let points: Vec<[f64; 2]> =
        (below(1e-7)..below(1e-12)).map(|tick| [tick as f64 / tick_hz, distance(tick).ln()]).collect();
    let mean = |value: &dyn Fn(&[f64; 2]) -> f64| points.iter().map(value).sum::<f64>() / points.len() as f64;
    let [t, y] = [mean(&|point| point[0]), mean(&|point| point[1])];
    -mean(&|point| (point[0] - t) * (point[1] - y)) / mean(&|point| (point[0] - t).powi(2))
}

/// Returns the decay rate, 1/s, of (e, pending commands, ε) along the free motion of `rigid-pair`'s leader: the largest
/// exponent of the variational equation, integrated by Runge-Kutta. Shares no code with the program.
fn linearised_rate(gain: f64, decay: f64, h: f64, predict: bool, delay: usize) -> f64 {
    const TICKS: usize = 12_000;
    let a = Vector3::new((2.0 - 2.5) / 1.0, (2.5 - 1.0) / 2.0, (1.0 - 2.0) / 2.5);
    let products = |w: &Vector3<f64>| Vector3::new(w.y * w.z, w.z * w.x, w.x * w.y).component_mul(&a);
    let jacobian = |w: &Vector3<f64>| {
        Matrix3::new(0.0, a.x * w.z, a.x * w.y, a.y * w.z, 0.0, a.y * w.x, a.z * w.y, a.z * w.x, 0.0)
    };
    type State = (Vector3<f64>, Matrix3<f64>, Matrix3<f64>);
    let slope = |(w, p, g): &State| (products(w), jacobian(w) * p, jacobian(w) * g + Matrix3::identity());
    let on = |(w, p, g): &State, k: &State, by: f64| (w + k.0 * by, p + k.1 * by, g + k.2 * by);
    let (mut path, mut steps) = (vec![Vector3::new(0.6, -0.4, 0.8)], Vec::new());
    for tick in 0..TICKS + delay {
        let begin = (path[tick], Matrix3::identity(), Matrix3::zeros());
        let k1 = slope(&begin);
        let k2 = slope(&on(&begin, &k1, h / 2.0));
        let k3 = slope(&on(&begin, &k2, h / 2.0));
        let k4 = slope(&on(&begin, &k3, h));
        let weighted = [(k1, 1.0), (k2, 2.0), (k3, 2.0), (k4, 1.0)];
        let (w, p, g) = weighted.iter().fold(begin, |sum, (k, weight)| on(&sum, k, weight * h / 6.0));
        path.push(w);
        steps.push((p, g));
    }
    let (mut e, mut hidden, mut acting) =
        (Vector3::new(1.0, -0.7, 1.3), 1.0, vec![Vector3::new(0.3, 0.1, -0.2); delay]);
    let mut growth = 0.0;
    for tick in 0..TICKS {
        // The hidden component is the third.
        let mut seen = e + Vector3::z() * hidden;
        if predict {
            seen = (0..delay)
                .fold(seen, |seen, ahead| steps[tick + ahead].0 * seen + steps[tick + ahead].1 * acting[ahead]);
        }
        let at = if predict { tick + delay } else { tick };
        let command = -(jacobian(&path[at]) + Matrix3::identity() * gain) * seen;
        e = steps[tick].0 * e + steps[tick].1 * acting.remove(0);
        hidden *= (-decay * h).exp();
        acting.push(command);
        let norm = (e.norm_squared() + hidden * hidden + acting.iter().map(|u| u.norm_squared()).sum::<f64>()).sqrt();
        acting.iter_mut().for_each(|u| *u /= norm);
        (e, hidden) = (e / norm, hidden / norm);
        growth += if tick >= TICKS / 4 { norm.ln() } else { 0.0 };
    }
    -growth / ((TICKS - TICKS / 4) as f64 * h)
}

//! Inputs that change while a loop runs: scripted and received ones, under every clock, after kills and in replays.

use crate::common::{Bench, WITHOUT_TICK_LIMITS, await_some, send_signal};
use corotate::inputs::{Answer, InputError, Request, WantedChange, current, request};
use corotate::record::Recording;
use serde_json::{Value, json};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};

/// The changes of a scenario: a set point, a gain, a filter, disturbances, and the safe command.
const CHANGES: &str = r#"
[[input]]
at_s = 1.0
key = "follower.0.offset_rad_s"
value = [0.0, 0.1, 0.2]

[[input]]
at_s = 1.2
key = "controller.gain_per_s"
value = [6.0, 5.0, 4.5]
shape = "ramp"
duration_s = 0.5

[[input]]
at_s = 1.2
key = "observer.decay_rate_per_s"
value = 9.0

[[input]]
at_s = 1.5
key = "follower[0].disturbance_rad_s2"
value = [0.05, 0.0, 0.0]
shape = "sine"
duration_s = 0.6
frequency_hz = 5.0

[[input]]
at_s = 1.6
key = "leader.disturbance_rad_s2"
value = [0.0, 0.0, 0.01]
shape = "prbs"
duration_s = 0.2
hold_s = 0.02

[[input]]
at_s = 2.2
key = "actuator.safe"
value = true
shape = "pulse"
duration_s = 0.1

[[input]]
at_s = 2.35
key = "actuator.disconnected"
value = true
shape = "pulse"
duration_s = 0.05

[[input]]
at_s = 2.4
key = "follower.0.offset_rad_s"
value = [0.1, 0.0, 0.0]
shape = "chirp"
duration_s = 0.5
frequency_hz = 1.0
end_frequency_hz = 20.0
"#;

/// Writes a scenario of three seconds with these tables and returns its path.
fn scenario(bench: &Bench, tables: &str) -> String {
    let text = std::fs::read_to_string(crate::common::shipped("rigid-pair")).unwrap();
    let path = bench.path("pair.toml");
    std::fs::write(&path, format!("{text}\n{tables}")).unwrap();
    path.to_str().unwrap().to_owned()
}

fn run(bench: &Bench, file: &str, clock: &str, options: &[&str]) -> Value {
    let fixed = ["run", file, "--clock", clock, "--duration", "3", "--set", "accept={}", "--record", "--overwrite"];
    let done = bench.run(&[&fixed[..], &["--out", clock, "--json"], options].concat()).succeeded();
    done.json()
}

fn replayed(bench: &Bench, run: &str) -> (usize, usize) {
    bench.run(&["replay", run, "--json"]).succeeded().roles_replayed()
}

#[test]
fn scripted_changes_give_one_hash_in_every_clock_and_replay() {
    let bench = Bench::new();
    let file = scenario(&bench, CHANGES);
    let expected = run(&bench, &file, "in-process", &[]);
    assert_eq!(expected["inputs"].as_array().unwrap().len(), 8);
    // The pulse of the safe command, and the 50 ticks without a controller, 19 of them held. No command was missing.
    assert_eq!(expected["books"]["roles"]["follower"]["starved"], 0);
    assert_eq!(expected["score"]["statuses"]["follower/truth"], json!({"holding": 19, "safe": 131}));
    let constant = bench.summary("rigid-pair", &["--clock", "in-process", "--duration", "3", "--set", "accept={}"]);
    assert_ne!(expected["state"]["hash"], constant["state"]["hash"]);
    assert_eq!(run(&bench, &file, "lockstep", &[])["state"]["hash"], expected["state"]["hash"]);
    let realtime = run(&bench, &file, "realtime", &[]);
    if realtime["state"]["first_disturbed_tick"].is_null() {
        assert_eq!(realtime["state"]["hash"], expected["state"]["hash"]);
    }
    for clock in ["in-process", "lockstep", "realtime"] {
        assert_eq!(replayed(&bench, clock).0, 4, "{clock}");
    }
    bench.run(&["diff", "in-process", "lockstep"]).succeeded();
}

/// Each role is killed in the tick of a change, and within a ramp, a sine and a pulse.
#[test]
fn a_kill_in_the_tick_of_a_change_costs_no_bit() {
    let bench = Bench::new();
    let file = scenario(&bench, CHANGES);
    let expected = run(&bench, &file, "in-process", &[])["state"]["hash"].clone();
    for (role, tick) in [
        ("controller", 1000),
        ("controller", 1201),
        ("controller", 1450),
        ("follower", 2360),
        ("follower", 2380),
        ("observer", 1200),
        ("observer", 1201),
        ("follower", 1500),
        ("follower", 1777),
        ("follower", 2200),
        ("follower", 2250),
        ("follower", 2300),
        ("leader", 1600),
        ("leader", 1701),
    ] {
        let kill = format!("fault=[{{kind=\"kill\",role=\"{role}\",from_tick={tick}}}]");
        for clock in ["in-process", "lockstep"] {
            let killed = run(&bench, &file, clock, &["--set", &kill]);
            assert_eq!(killed["incidents"].as_array().unwrap().len(), 1);
            assert_eq!(killed["state"]["hash"], expected, "{role} at {tick}, {clock}");
        }
    }
}

/// Returns a component of the angular velocity of a body, tick by tick.
fn rates(run: &Path, body: &str, component: usize) -> Vec<f64> {
    let recording = Recording::open(&run.join("run.mcap")).unwrap();
    let track = recording.tracks(|info| info.body == body && info.signal == "truth").unwrap().remove(0);
    track.column("omega_rad_s", component).unwrap()
}

/// With the leader at rest and a motion about one axis the loop is linear: u(k) = −g (p(k) − δ(k)), p(k + 1) = p(k) + h u(k − d).
#[test]
fn the_response_to_a_step_is_that_of_the_difference_equation() {
    let bench = Bench::new();
    let step = "[[input]]\nat_s = 0.5\nkey = \"follower.0.offset_rad_s\"\nvalue = [0.0, 0.0, 0.02]\n\
                [[input]]\nat_s = 1.5\nkey = \"follower.0.disturbance_rad_s2\"\nvalue = [0.0, 0.0, 0.03]\n\
                [[input]]\nat_s = 2.0\nkey = \"controller.gain_per_s\"\nvalue = [4.0, 4.0, 7.0]\n";
    let file = scenario(&bench, step);
    for delay in [1_usize, 3] {
        let delayed = format!("actuation_delay_ticks={delay}");
        let still = [
            "--set=leader.initial_rate_rad_s=[0,0,0]",
            "--set=follower.0.initial_rate_rad_s=[0,0,0]",
            "--set=observer.initial_guess_rad_s=0",
            "--set=limits.rate_rad_s=1.0",
            "--set=controller.predict=false",
            "--set",
            &delayed,
        ];
        run(&bench, &file, "in-process", &still);
        let measured = rates(&bench.path("in-process"), "follower", 2);
        let h = 1e-3;
        let (mut p, mut commands, mut worst) = (0.0, vec![0.0; delay], 0.0_f64);
        for (tick, measured) in measured.iter().enumerate() {
            worst = worst.max((measured - p).abs());
            let offset = if tick >= 500 { 0.02 } else { 0.0 };
            let disturbance = if tick >= 1500 { 0.03 } else { 0.0 };
            let gain = if tick >= 2000 { 7.0 } else { 4.0 };
            commands.push(-gain * (p - offset));
            // The command of tick k acts from tick k + d on.
            p += h * (commands[commands.len() - 1 - delay] + disturbance);
        }
        assert!(worst < 1e-9 && measured.len() == 3001, "{delay}: {worst}");
        // The steady state: the disturbance over the gain.
        assert!((p - 0.02 - 0.03 / 7.0).abs() < 1e-4, "{p}");
    }
}

#[test]
fn the_orbit_rigs_follow_a_new_set_point() {
    let bench = Bench::new();
    let text = std::fs::read_to_string(crate::common::shipped("orbit-hold")).unwrap();
    let scenario: toml::Table = text.parse().unwrap();
    let target = scenario["controller"]["target_radius_du"].as_float().unwrap();
    let half_s = scenario["duration_s"].as_float().unwrap() / 2.0;
    let wanted = 1.02 * target;
    let tables = format!(
        "\n[[input]]\nat_s = {half_s:?}\nkey = \"controller.target_radius_du\"\nvalue = {wanted:?}\nshape = \"ramp\"\nduration_s = 1.0\n\
         [[input]]\nat_s = 0.1\nkey = \"spacecraft.disturbance_du_s2\"\nvalue = [1e-4, 0.0]\nshape = \"pulse\"\nduration_s = 0.5\n\
         [[input]]\nat_s = 0.2\nkey = \"controller.gain.radial_per_s\"\nvalue = 3.0\n"
    );
    let file = bench.path("hold.toml");
    std::fs::write(&file, text + &tables).unwrap();
    let options = ["run", file.to_str().unwrap(), "--set", "accept={}", "--record", "--json", "--out"];
    let in_process = bench.run(&[&options[..], &["in-process", "--clock", "in-process"]].concat()).succeeded().json();
    let lockstep = bench.run(&[&options[..], &["lockstep", "--clock", "lockstep"]].concat()).succeeded().json();
    assert_eq!(in_process["state"]["hash"], lockstep["state"]["hash"]);
    // The metric follows the set point.
    assert!(in_process["score"]["metrics"][0]["last"].as_f64().unwrap() < 1e-3 * target, "{}", in_process["score"]);
    let recording = Recording::open(&bench.path("in-process/run.mcap")).unwrap();
    let track = recording.tracks(|info| info.signal == "truth").unwrap().remove(0);
    let radius = track.column("radius_du", 0).unwrap();
    assert!((radius.last().unwrap() - wanted).abs() < 1e-3 * target, "{:?} of {wanted}", radius.last());
}

/// The domain of the only run of a bench.
fn domain(bench: &Bench) -> PathBuf {
    await_some(|| bench.domains().into_iter().next())
}

fn ask(
    root: &Path,
    key: &str,
    value: impl Into<toml::Value>,
    ramp_s: f64,
    at_tick: Option<u64>,
) -> Result<u64, InputError> {
    let changes = vec![WantedChange { key: key.to_owned(), value: value.into(), ramp_s }];
    match request(root, &Request::Set { changes, at_tick })? {
        Answer::Accepted { tick, .. } => Ok(tick),
        answer => panic!("{answer:?}"),
    }
}

/// Waits until the ticks run: before, no change is accepted.
fn await_inputs(root: &Path) -> u64 {
    await_some(|| current(root).ok()).0
}

/// A generator of numbers from 0 to 1.
fn draws() -> impl FnMut() -> f64 {
    let mut state = 45_u64;
    move || {
        state = corotate::fault::mix(state);
        state as f64 / u64::MAX as f64
    }
}

/// A hundred changes at random, and a controller that is killed in their midst.
#[test]
fn received_changes_are_replayed_to_the_same_bits() {
    for clock in ["realtime", "lockstep"] {
        let bench = Bench::new();
        let mut arguments = vec!["--clock", clock, "--record"];
        arguments.extend(WITHOUT_TICK_LIMITS.iter().filter(|_| false));
        let running = bench.start_endless(&arguments);
        let root = domain(&bench);
        await_inputs(&root);
        let mut draw = draws();
        for number in 0..100 {
            if number == 50 {
                send_signal(bench.role("controller").unwrap(), 9);
            }
            let ramp_s = if draw() < 0.3 { 0.02 * draw() } else { 0.0 };
            let mut vector = |scale: f64| [(); 3].map(|()| scale * (draw() - 0.5)).to_vec();
            match number % 4 {
                0 => ask(&root, "follower.0.offset_rad_s", vector(0.2), ramp_s, None),
                1 => ask(&root, "follower.0.disturbance_rad_s2", vector(0.1), ramp_s, None),
                2 => ask(&root, "observer.decay_rate_per_s", 6.0 + 2.0 * draw(), ramp_s, None),
                _ => {
                    let gains = [(); 3].map(|()| 4.0 + 2.0 * draw()).to_vec();
                    ask(&root, "controller.gain_per_s", gains, ramp_s, None)
                }
            }
            .unwrap();
        }
        running.signal(15);
        let done = running.wait();
        assert_eq!(done.code, Some(128 + 15), "{done:?}");
        let summary = bench.summary_in("out");
        let received = summary["inputs"].as_array().unwrap().iter().filter(|change| change["received"] == true);
        // The last ones may act after the end.
        assert!(received.count() > 90, "{}", summary["inputs"]);
        assert_eq!(summary["incidents"].as_array().unwrap().len(), 1);
        assert_eq!(replayed(&bench, "out").0, 4, "{clock}");
        let by_processes = bench.run(&["replay", "--processes", "out", "--json"]).succeeded();
        assert_eq!(by_processes.roles_replayed().0, 4);
        bench.assert_clean(&[root]);
    }
}

/// A change may wait for its tick, and is applied exactly there.
#[test]
fn a_change_at_a_later_tick_is_as_if_it_were_scripted() {
    let bench = Bench::new();
    let mut running = bench.start(&[
        "run",
        "rigid-pair",
        "--clock",
        "lockstep",
        "--set",
        "duration_s=200",
        "--set",
        "accept={}",
        "--out",
        "out",
        "--record",
        "--set",
        "realtime.trace=\"off\"",
    ]);
    let root = domain(&bench);
    let begun = await_inputs(&root);
    let at = [begun + 60_000, begun + 40_000, begun + 40_000];
    // Out of order, and two at one tick.
    for (tick, z) in at.into_iter().zip([0.3, 0.1, 0.2]) {
        if running.has_ended() {
            break;
        }
        assert_eq!(ask(&root, "follower.0.offset_rad_s", vec![0.0, 0.0, z], 0.0, Some(tick)).unwrap(), tick);
    }
    running.wait().succeeded();
    let received = bench.summary_in("out");
    let step = |tick: u64, z: f64| {
        let at_s = tick as f64 * 1e-3;
        format!("[[input]]\nat_s = {at_s:?}\nkey = \"follower.0.offset_rad_s\"\nvalue = [0.0, 0.0, {z}]\n")
    };
    let tables = step(at[0], 0.3) + &step(at[1], 0.1) + &step(at[2], 0.2);
    let file = scenario(&bench, &tables);
    let options =
        ["--clock", "in-process", "--set", "duration_s=200", "--set", "accept={}", "--out", "scripted", "--json"];
    let scripted = bench.run(&[&["run", &*file][..], &options].concat()).succeeded().json();
    assert_eq!(received["state"]["hash"], scripted["state"]["hash"]);
    assert_eq!(replayed(&bench, "out").0, 4);
}

#[test]
fn impossible_changes_are_refused_with_their_reason() {
    let bench = Bench::new();
    let running = bench.start_endless(&[]);
    let set = |arguments: &[&str]| {
        let done = bench.run(&[&["set", "out"], arguments].concat());
        (done.code, done.codes().first().map(|code| (*code).to_owned()))
    };
    let refused = |code: &str| (Some(2), Some(code.to_owned()));
    await_inputs(&domain(&bench));
    assert_eq!(set(&["leader.inertia_kg_m2=[1,2,3]"]), refused("not-tunable"));
    assert_eq!(set(&["controller.gian_per_s=[1,2,3]"]), refused("not-tunable"));
    assert_eq!(set(&[]), refused("no-change"));
    assert_eq!(set(&["controller.gain_per_s"]), refused("no-equals"));
    assert_eq!(set(&["controller.gain_per_s=[1,2]"]), refused("wrong-length"));
    assert_eq!(set(&["controller.gain_per_s=[1,2,-3]"]), refused("not-positive"));
    assert_eq!(set(&["controller.gain_per_s=[1,2,nan]"]), refused("not-finite"));
    assert_eq!(set(&["controller.gain_per_s=[1,2,1500]"]), refused("unstable-loop"));
    assert_eq!(set(&["actuator.safe=1"]), refused("wrong-type"));
    assert_eq!(set(&["actuator.safe=true", "--ramp", "1"]), refused("wrong-shape"));
    assert_eq!(set(&["follower.0.offset_rad_s=[0,0,1e6]"]), refused("out-of-range"));
    assert_eq!(set(&["controller.gain_per_s=[5,5,5]", "--at", "1"]), refused("too-early"));
    assert_eq!(set(&["controller.gain_per_s=[5,5,5]", "--at", "999999999999"]), refused("after-end"));
    assert_eq!(set(&["controller.gain_per_s=[5,5,5]"]), (Some(0), None));
    // Several keys at once: all or none.
    assert_eq!(set(&["controller.gain_per_s=[6,6,6]", "observer.decay_rate_per_s=-1"]), refused("not-positive"));
    let (_, values) = current(&domain(&bench)).unwrap();
    assert_eq!(values["controller.gain_per_s"], toml::Value::from(vec![5.0, 5.0, 5.0]));
    // Keys at one tick act together.
    let both = bench.run(&["set", "out", "controller.gain_per_s=[7,7,7]", "observer.decay_rate_per_s=8", "--json"]);
    let tick = both.succeeded().json()["tick"].as_u64().unwrap();
    let shown = await_some(|| {
        let shown = bench.run(&["get", "out", "controller.gain_per_s", "observer.decay_rate_per_s", "--json"]).json();
        (shown["tick"].as_u64().unwrap() >= tick).then_some(shown)
    });
    assert_eq!(shown["values"], json!({"controller.gain_per_s": [7.0, 7.0, 7.0], "observer.decay_rate_per_s": 8.0}));
    running.signal(15);
    running.wait();
    assert_eq!(set(&["controller.gain_per_s=[5,5,5]"]), refused("run-over"));
    let none = bench.run(&["get"]);
    assert_eq!(none.code, Some(2), "{none:?}");
}

/// A campaign varies a change, and finds the largest disturbance that the loop endures.
#[test]
fn a_campaign_varies_inputs_and_finds_a_margin_over_them() {
    let bench = Bench::new();
    let text = std::fs::read_to_string(crate::common::shipped("rigid-pair")).unwrap();
    let mut base: toml::Table = text.parse().unwrap();
    base.insert(
        "accept".to_owned(),
        toml::Table::from_iter([("steady_state_error_max".to_owned(), 1e-2.into())]).into(),
    );
    std::fs::write(bench.path("base.toml"), base.to_string()).unwrap();
    let campaign = "name = \"push\"\nbase = \"./base.toml\"\n\
        [set]\nduration_s = 4\n\
        [[input]]\nat_s = 2.0\nkey = \"follower.0.disturbance_rad_s2\"\nvalue = [0.01, 0.0, 0.0]\n\
        [[axis]]\nkey = \"controller.gain_per_s\"\nvalues = [4.0, 8.0]\n\
        [[margin]]\nfind = \"largest\"\nkey = \"input.0.value.0\"\nsuch_that = \"accepted\"\nfrom = 0.001\nto = 1.0\ntolerance = 1e-3\n";
    std::fs::write(bench.path("push.toml"), campaign).unwrap();
    let found = bench.run(&["sweep", "./push.toml", "--out", "push", "--json"]).succeeded().json();
    let points = found["margins"][0]["points"].as_array().unwrap();
    // The disturbance over the gain is the error that stays.
    for (point, gain) in points.iter().zip([4.0, 8.0]) {
        let largest = point["value"].as_f64().unwrap();
        assert!((largest - 1e-2 * gain).abs() < 2e-3, "{gain}: {point}");
    }
    assert_eq!(points.len(), 2, "{found}");
}

#[test]
fn tuned_values_are_saved_in_the_scenario_file_with_its_comments() {
    let bench = Bench::new();
    let text = std::fs::read_to_string(crate::common::shipped("rigid-pair")).unwrap();
    let file = bench.path("pair.toml");
    std::fs::write(&file, format!("# first\n{text}\n# last\n")).unwrap();
    let running = bench.start_endless(&[]);
    let root = domain(&bench);
    let before = await_inputs(&root);
    assert!(before < 1_000_000_000);
    let save = |words: &[&str]| bench.run(&[&["set", "out"], words, &["--save", "pair.toml"]].concat());
    save(&[]).succeeded();
    assert_eq!(std::fs::read_to_string(&file).unwrap(), format!("# first\n{text}\n# last\n"), "nothing differs");
    let tick = ask(&root, "follower.0.offset_rad_s", vec![0.0, 0.25, 0.0], 0.0, None).unwrap();
    await_some(|| (current(&root).unwrap().0 > tick).then_some(()));
    let gains = bench.run(&["set", "out", "controller.gain_per_s=[7,6.5,5]", "--json"]).succeeded().json();
    await_some(|| (current(&root).unwrap().0 > gains["tick"].as_u64().unwrap()).then_some(()));
    save(&[]).succeeded();
    let saved = std::fs::read_to_string(&file).unwrap();
    let table: toml::Table = saved.parse().unwrap();
    assert_eq!(table["controller"]["gain_per_s"], toml::Value::from(vec![7.0, 6.5, 5.0]));
    assert_eq!(table["follower"][0]["offset_rad_s"], toml::Value::from(vec![0.0, 0.25, 0.0]));
    let comments = |text: &str| text.lines().filter(|line| line.contains('#')).count();
    assert_eq!(comments(&saved), comments(&text) + 2);
    assert!(saved.starts_with("# first") && saved.trim_end().ends_with("# last"));
    bench.run(&["check", "pair.toml"]).succeeded();
    // A change that acts later is saved with its new value.
    let later = ["set", "out", "observer.decay_rate_per_s=9", "--ramp", "3600", "--save", "pair.toml"];
    bench.run(&later).succeeded();
    let table: toml::Table = std::fs::read_to_string(&file).unwrap().parse().unwrap();
    assert_eq!(table["observer"]["decay_rate_per_s"], toml::Value::Float(9.0));
    assert_eq!(bench.run(&["set", "out", "--save", "absent.toml"]).code, Some(2));
    running.signal(15);
    running.wait();
}

/// Two programs at once: each change is made, one after the other.
#[test]
fn two_programs_may_set_at_once_and_malformed_requests_harm_nothing() {
    use std::io::{Read, Write};
    let bench = Bench::new();
    let running = bench.start_endless(&["--clock", "lockstep"]);
    let root = domain(&bench);
    await_inputs(&root);
    let socket = root.join("inputs");
    for bytes in [&b""[..], b"\n", b"{}\n", b"{\"request\":\"set\",\"changes\":[]}\n", &[255; 70_000], b"{\"request\":"]
    {
        let mut stream = std::os::unix::net::UnixStream::connect(&socket).unwrap();
        // The launcher may answer before it has read all of it.
        let _ = stream.write_all(bytes);
        stream.shutdown(std::net::Shutdown::Write).unwrap();
        let mut answer = String::new();
        let _ = stream.read_to_string(&mut answer);
        assert!(answer.is_empty() || answer.contains("refused"), "{answer}");
    }
    // A client that sends nothing holds up no other.
    let _silent = std::os::unix::net::UnixStream::connect(&socket).unwrap();
    let set = |key: &'static str| {
        let root = root.clone();
        std::thread::spawn(move || {
            (0..20)
                .map(|number| ask(&root, key, vec![0.0, 0.0, 1e-3 * f64::from(number)], 0.0, None).unwrap())
                .collect()
        })
    };
    let threads = ["follower.0.offset_rad_s", "follower.0.disturbance_rad_s2"].map(set);
    let ticks: Vec<Vec<u64>> = threads.into_iter().map(|thread| thread.join().unwrap()).collect();
    assert!(ticks.iter().all(|ticks| ticks.is_sorted() && ticks.len() == 20));
    running.signal(15);
    running.wait();
}

#[test]
fn another_user_cannot_change_a_run() {
    let bench = Bench::new();
    if !rustix::process::geteuid().is_root() {
        return crate::common::skipped("the refusal of another user's change", "it needs root");
    }
    let running = bench.start_endless(&[]);
    let root = domain(&bench);
    await_inputs(&root);
    let program = bench.path("copy");
    std::fs::copy(env!("CARGO_BIN_EXE_corotate"), &program).unwrap();
    std::os::unix::fs::chown(bench.path("."), Some(65534), Some(65534)).unwrap();
    let mut command = bench.command_of(&program);
    command.uid(65534).gid(65534).args(["set", root.to_str().unwrap(), "controller.gain_per_s=[5,5,5]"]);
    let stranger = crate::common::Running::new(&mut command).wait();
    assert!(stranger.code != Some(0), "{stranger:?}");
    assert_eq!(current(&root).unwrap().1["controller.gain_per_s"], toml::Value::from(vec![4.0, 4.0, 4.0]));
    running.signal(15);
    running.wait();
}

#[test]
fn mistakes_in_input_tables_are_refused() {
    let bench = Bench::new();
    let check = |tables: &str| {
        let done = bench.run(&["check", &scenario(&bench, tables)]);
        (done.code, done.codes().first().map(|code| (*code).to_owned()))
    };
    let input = |rest: &str| format!("[[input]]\nat_s = 1.0\n{rest}\n");
    let gain = "key = \"controller.gain_per_s\"\nvalue = [5.0, 5.0, 5.0]\n";
    let refused = |code: &str| (Some(2), Some(code.to_owned()));
    assert_eq!(check(&input(gain)), (Some(0), None));
    assert_eq!(check(&input("key = \"tick_hz\"\nvalue = 5.0")), refused("not-tunable"));
    assert_eq!(check(&input("key = \"controller.gain_per_s\"\nvalue = 5.0")), refused("wrong-type"));
    assert_eq!(check(&input("key = \"controller.gain_per_s\"\nvalue = [5.0, 5.0, 2000.0]")), refused("unstable-loop"));
    assert_eq!(check(&input("key = \"controller.gain_per_s\"\nvalue = [0.0, 5.0, 5.0]")), refused("not-positive"));
    assert_eq!(check(&input(&format!("{gain}shape = \"ramp\""))), refused("missing-key"));
    assert_eq!(check(&input(&format!("{gain}duration_s = 1.0"))), refused("unused-key"));
    assert_eq!(check(&input(&format!("{gain}shape = \"ramp\"\nduration_s = 1e-4"))), refused("out-of-range"));
    assert_eq!(check(&input(&format!("{gain}shape = \"ramp\"\nduration_s = -1.0"))), refused("out-of-range"));
    // The amplitude of an excitation may take a gain below zero.
    let sine = "shape = \"sine\"\nduration_s = 1.0\nfrequency_hz = 2.0";
    assert_eq!(check(&input(&format!("{gain}{sine}"))), refused("out-of-range"));
    let offset = "key = \"follower.0.offset_rad_s\"\nvalue = [0.1, 0.0, 0.0]\n";
    assert_eq!(check(&input(&format!("{offset}{sine}"))), (Some(0), None));
    assert_eq!(check(&(input(&format!("{offset}{sine}")) + &input(&format!("{offset}{sine}")))), refused("overlap"));
    let fast = "shape = \"sine\"\nduration_s = 1.0\nfrequency_hz = 600.0";
    assert_eq!(check(&input(&format!("{offset}{fast}"))), refused("out-of-range"));
    assert_eq!(check(&input("key = \"actuator.safe\"\nvalue = 1.0")), refused("wrong-type"));
    assert_eq!(check(&input(&format!("key = \"actuator.safe\"\nvalue = true\n{sine}"))), refused("wrong-shape"));
    assert_eq!(check("[[input]]\nkey = \"actuator.safe\"\nvalue = true"), refused("missing-key"));
}

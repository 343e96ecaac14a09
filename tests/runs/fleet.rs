//! Fleets: many followers in one process. Each body moves as it does alone, under every clock; a fault affects the whole
//! fleet at once.

use crate::common::{ANY_TICKS, Bench, Loop, await_some, send_signal, shipped};
use corotate::bus::{Carried, Signal};
use corotate::runtime::window_ticks;
use corotate::sample::{FleetTruth, RateTruth};
use corotate::scenario::Scenario;
use libc::SIGKILL;
use serde_json::Value;

/// Rate and applied acceleration of one body at each tick.
type Motion = Vec<([f64; 3], [f64; 3])>;

/// Runs a scenario in this thread and passes every true state of its follower to `look`.
fn watch<S: Carried + ?Sized>(name: &str, overrides: &[String], mut look: impl FnMut(&S)) {
    let common =
        ["accept={}", "limits={rate_rad_s=10.0, acceleration_rad_s2=3.0}", "duration_s=2.0", "clock=in-process"];
    let overrides: Vec<String> = common.iter().map(|text| (*text).to_owned()).chain(overrides.to_vec()).collect();
    let scenario = Scenario::load(&shipped(name), &overrides).unwrap();
    let mut all = Loop::open(&scenario);
    let mut truth = all.input::<S>(&scenario.rig.bodies()[1].name, Signal::Truth);
    all.run(|_| {
        assert!(truth.advance().unwrap());
        look(truth.sample().unwrap());
    });
}

fn alone(rate: [f64; 3], overrides: &[String]) -> Motion {
    let mut motion = Motion::new();
    let start = format!("follower.0.initial_rate_rad_s={rate:?}");
    watch::<RateTruth>("rigid-pair", &[overrides, &[start]].concat(), |truth| {
        motion.push((truth.omega_rad_s, truth.applied_rad_s2));
    });
    motion
}

fn fleet(count: usize, overrides: &[String]) -> Vec<Motion> {
    let mut motions = vec![Motion::new(); count];
    let many = [format!("follower.0.count={count}"), "follower.0.initial_rate_spread_rad_s=[2.0, 2.0, 2.0]".to_owned()];
    watch::<FleetTruth>("rigid-pair", &[overrides, &many].concat(), |truth| {
        for (body, motion) in motions.iter_mut().enumerate() {
            motion.push((truth.vector(0).map(|rates| rates[body]), truth.vector(1).map(|applied| applied[body])));
        }
    });
    motions
}

/// Every tenth body is compared, at one and at several integration steps per tick, also while an actuator saturates.
#[test]
fn every_body_of_a_fleet_moves_bit_by_bit_as_it_does_alone() {
    for (count, predict, tick_hz) in
        [(1, false, 1000), (31, false, 1000), (31, true, 1000), (21, true, 50), (1, true, 50)]
    {
        let overrides = [format!("controller.predict={predict}"), format!("tick_hz={tick_hz}")];
        for (body, motion) in fleet(count, &overrides).iter().enumerate().step_by(10) {
            let single = alone(motion[0].0, &overrides);
            assert_eq!(motion.len(), single.len());
            let limited = single.iter().any(|(_, applied)| applied.iter().any(|value| value.abs() == 3.0));
            assert!(limited || tick_hz != 1000 || motion[0].0[0].abs() < 1.0, "the limit was never reached");
            for (tick, (ours, theirs)) in motion.iter().zip(&single).enumerate() {
                assert_eq!(ours.0.map(f64::to_bits), theirs.0.map(f64::to_bits), "{count}: body {body}, tick {tick}");
                assert_eq!(ours.1, theirs.1, "{count}: body {body}, tick {tick}");
            }
        }
    }
}

fn hash(bench: &Bench, clock: &str, sets: &[&str]) -> (Value, Value) {
    let sets = sets.iter().flat_map(|set| ["--set", set]);
    let arguments: Vec<&str> = ["--clock", clock, "--set", "accept={}"].into_iter().chain(sets).collect();
    let summary = bench.summary("rigid-fleet", &arguments);
    assert_eq!(summary["books"]["balanced"], true, "{summary:#}");
    (summary["state"]["hash"].clone(), summary)
}

#[test]
fn faults_of_a_fleet_are_the_same_in_one_thread_and_in_lockstep() {
    for (fault, rejected, safe) in [
        ("{kind=\"not-a-number\", role=\"fleet\", from_tick=100, component=150}", 1, 0),
        ("{kind=\"out-of-range\", role=\"fleet\", from_tick=100, component=7, value=1e3}", 1, 0),
        ("{kind=\"infinite\", role=\"controller\", from_tick=100, component=99}", 1, 0),
        ("{kind=\"bit-flip\", role=\"fleet\", from_tick=100, field=\"bodies\", bit=3}", 1, 0),
        ("{kind=\"bit-flip\", role=\"controller\", from_tick=100, ticks=50, field=\"acceleration_rad_s2\"}", 0, 0),
        ("{kind=\"freeze\", role=\"fleet\", from_tick=100, ticks=5}", 0, 0),
        ("{kind=\"drop\", role=\"controller\", from_tick=100, ticks=30}", 0, 11),
        ("{kind=\"delay\", role=\"controller\", from_tick=100, ticks=10, delay_ticks=3}", 0, 0),
        ("{kind=\"duplicate\", role=\"fleet\", from_tick=100, ticks=10}", 0, 0),
        ("{kind=\"kill\", role=\"fleet\", from_tick=150}", 0, 0),
        ("{kind=\"kill\", role=\"controller\", from_tick=150}", 0, 0),
    ] {
        let bench = Bench::new();
        let sets = [&format!("fault=[{fault}]"), "duration_s=0.6", "follower.0.count=77"];
        let ((in_process, summary), (lockstep, _)) =
            (hash(&bench, "in-process", &sets), hash(&bench, "lockstep", &sets));
        assert_eq!(in_process, lockstep, "{fault}");
        assert_eq!(summary["books"]["roles"]["fleet"]["safe"], safe, "{fault}: {summary:#}");
        let all = summary["books"]["rejected_samples"].as_u64().unwrap();
        assert!(if rejected > 0 { all == rejected } else { true }, "{fault}: {all} rejected");
    }
}

#[test]
fn in_lockstep_a_killed_fleet_continues_without_a_changed_bit() {
    let bench = Bench::new();
    let sets = ["duration_s=0.6", "follower.0.count=333", "controller.predict=true"];
    let whole = hash(&bench, "lockstep", &sets).0;
    let kill = "fault=[{kind=\"kill\", role=\"fleet\", from_tick=123}]";
    let (killed, summary) = hash(&bench, "lockstep", &[&sets[..], &[kill]].concat());
    assert_eq!(whole, killed);
    assert_eq!(summary["incidents"][0]["role"], "fleet");
}

#[test]
fn in_real_time_a_killed_fleet_is_restarted_and_settles() {
    let bench = Bench::new();
    let file = shipped("rigid-fleet");
    let limits = format!("accept={{settled_by_s=5.0, sync_error_rad_s_max=1e-3, {ANY_TICKS}}}");
    let arguments = ["run", file.to_str().unwrap(), "--tick-hz", "100", "--duration", "6", "--set", &limits, "--json"];
    let running = bench.start(&arguments);
    let fleet = bench.await_ticks("fleet");
    let domains = bench.domains();
    send_signal(fleet, SIGKILL);
    let done = running.wait();
    let summary = done.json();
    assert_eq!(done.code, Some(0), "{done:?}");
    assert_eq!(summary["incidents"][0]["role"], "fleet", "{summary:#}");
    assert_eq!(summary["books"]["balanced"], true, "{summary:#}");
    bench.assert_clean(&domains);
}

/// The seat describes the fleet's signals as slices.
#[test]
fn a_fleet_can_be_an_external_role_but_not_a_device() {
    let bench = Bench::new();
    let short = ["duration_s=0.4", "follower.0.count=50"];
    let whole = hash(&bench, "in-process", &short).0;
    let file = shipped("rigid-fleet");
    let sets = short.iter().flat_map(|set| ["--set", set]);
    let run =
        ["run", file.to_str().unwrap(), "--json", "--set", "accept={}", "--clock", "lockstep", "--external", "fleet"];
    let running = bench.start(&run.into_iter().chain(sets).collect::<Vec<_>>());
    let seat = await_some(|| {
        let seat = bench.domains().first()?.join("fleet.seat.json");
        seat.is_file().then_some(seat)
    });
    let described: Value = serde_json::from_slice(&std::fs::read(&seat).unwrap()).unwrap();
    let truth = &described["writes"][1];
    assert_eq!((&truth["slice"], &truth["size"]), (&true.into(), &(8 * (6 + 6 * 50)).into()));
    assert_eq!((&described["health"]["slice"], &described["reads"][0]["slice"]), (&false.into(), &true.into()));
    let domain = seat.parent().unwrap().to_str().unwrap();
    let refused = bench.run(&["bridge", "--serial", "/dev/null", "--role", "fleet", "--domain", domain]);
    assert!(refused.code == Some(2) && refused.says("no-device-role"), "{refused:?}");
    bench.run(&["plant", "--body", "fleet", "--domain", domain]).succeeded();
    let done = running.wait();
    assert!(done.stderr.contains("--body fleet") && !done.stderr.contains("bridge"), "{done:?}");
    let summary = done.json();
    assert_eq!(summary["state"]["hash"], whole, "{summary:#}");
}

#[test]
fn a_fleet_of_a_hundred_thousand_bodies_runs() {
    let bench = Bench::new();
    let (_, summary) = hash(&bench, "in-process", &["follower.0.count=100000", "duration_s=0.1"]);
    assert_eq!(summary["books"]["missed_ticks"], 0);
    assert_eq!(summary["score"]["scored_ticks"], 51);
}

#[test]
fn fleets_and_single_followers_can_be_mixed() {
    let bench = Bench::new();
    let single = |name: &str| format!("{{name=\"{name}\", initial_rate_rad_s=[0.1, 0.2, 0.3]}}");
    let fleet =
        |name: &str, count: usize| format!("{{name=\"{name}\", count={count}, initial_rate_rad_s=[0.1, 0.2, 0.3]}}");
    let followers = [fleet("f", 5), single("a"), fleet("g", 9), single("b")].join(", ");
    let sets = [&format!("follower=[{followers}]"), "duration_s=0.4"];
    let ((in_process, summary), (lockstep, _)) = (hash(&bench, "in-process", &sets), hash(&bench, "lockstep", &sets));
    assert_eq!(in_process, lockstep);
    assert_eq!(summary["books"]["missed_ticks"], 0);
    assert!(
        summary["score"]["certificate"]["held"].as_u64().unwrap() > 100,
        "certificates of single followers: {summary:#}"
    );
}

/// This bounds the number of samples that wait for one reader.
#[test]
fn with_more_bodies_lockstep_runs_fewer_ticks_ahead() {
    for (followers, window) in [(1, 64), (7, 64), (40, 12), (100, 5)] {
        let follower = |index| format!("{{name='f{index}', initial_rate_rad_s=[0.1,0.2,0.3]}}");
        let list: Vec<String> = (0..followers).map(follower).collect();
        let scenario = Scenario::load(&shipped("rigid-pair"), &[format!("follower=[{}]", list.join(","))]).unwrap();
        assert_eq!(window_ticks(&scenario), window, "{followers} followers");
    }
}

#[test]
fn an_invalid_fleet_is_refused() {
    for (set, code) in [
        ("follower.0.count=0", "out-of-range"),
        ("follower.0.count=-1", "out-of-range"),
        ("follower.0.count=1000000000", "out-of-range"),
        ("follower.0.count=2.5", "wrong-type"),
        ("follower.0.initial_rate_spread_rad_s=[0.1, -0.1, 0.1]", "negative"),
        ("follower.0.initial_rate_spread_rad_s=[4000.0, 0.0, 0.0]", "turns-too-far"),
        ("follower.0.noise_rad_s=[1e-3, 0.0, 0.0]", "fleet-key"),
        ("follower.0.bias_rad_s=[1e-3, 0.0, 0.0]", "fleet-key"),
        ("follower.0.inertia_factor=[1.0, 1.1, 1.0]", "fleet-key"),
        ("controller.adaptation_gain=1.0", "fleet-key"),
        ("limits.repeats=10", "fleet-key"),
        ("watchdog.lyapunov_rad2_s2_max=1.0", "unused-key"),
        ("follower=[{name=\"a\", initial_rate_rad_s=[0,0,0], initial_rate_spread_rad_s=[1,1,1]}]", "unused-key"),
        ("fault=[{kind=\"lost-axis\", role=\"fleet\", from_tick=1, component=1}]", "wrong-signal"),
        ("fault=[{kind=\"infinite\", role=\"fleet\", from_tick=1, component=3001}]", "no-such-component"),
    ] {
        let done = Bench::new().run(&["check", shipped("rigid-fleet").to_str().unwrap(), "--set", set]);
        assert!(done.code == Some(2) && done.says(code), "{set}: {done:?}");
    }
}

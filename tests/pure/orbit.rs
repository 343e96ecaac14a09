//! Checks the third paper's system: the motion against an independent reference, the observer's floor, decay and
//! order, the loop with and without a measured velocity, the clocks against each other, faults, and invalid input.

use crate::common::{Bench, Loop, WITHOUT_TICK_LIMITS, cases, next, reference, shipped};
use corotate::bus::Signal;
use corotate::control::{OrbitGains, OrbitHold};
use corotate::model::{CentralField, OrbitState};
use corotate::observe::{InvariantFilter, OrbitSample, OrbitVelocity, to_inertial, to_polar};
use corotate::sample::{OrbitEstimate, OrbitTruth};
use corotate::scenario::Scenario;
use nalgebra::{Vector2, Vector4};
use proptest::prelude::*;
use serde_json::Value;

/// The paper's −L, 1/s.
const DECAY_PER_S: f64 = 4.0;

/// The start of `free_orbit.csv` and of both shipped scenarios.
const START: OrbitState = OrbitState { r: 1.0, vr: 0.1, theta: 0.0, vtheta: 0.95 };

fn field() -> CentralField {
    CentralField::new(1.0, 0.05, 20.0).unwrap()
}

/// A motion as sampled by its position sensors: the states, one more than there are steps, and the steps, s.
struct Motion {
    states: Vec<OrbitState>,
    steps: Vec<f64>,
    thrust: Vector2<f64>,
}

impl Motion {
    fn new(start: OrbitState, thrust: Vector2<f64>, tick_s: f64, ticks_per_sample: impl Iterator<Item = u32>) -> Self {
        let (mut state, mut states, mut steps) = (start, vec![start], Vec::new());
        for ticks in ticks_per_sample {
            for _ in 0..ticks {
                state = field().flow(&state, &thrust, tick_s).unwrap();
            }
            states.push(state);
            steps.push(f64::from(ticks) * tick_s);
        }
        Self { states, steps, thrust }
    }

    fn free(tick_s: f64, duration_s: f64) -> Self {
        let ticks = (duration_s / tick_s).round() as usize;
        Self::new(START, Vector2::zeros(), tick_s, std::iter::repeat_n(1, ticks))
    }

    fn times(&self) -> Vec<f64> {
        let sums = self.steps.iter().scan(0.0, |time, step| {
            *time += step;
            Some(*time)
        });
        std::iter::once(0.0).chain(sums).collect()
    }

    /// Returns the error of (vx, vy) at each sample, from a guess in polar components.
    fn errors(&self, decay: Vector2<f64>, guess: Vector2<f64>) -> Vec<Vector2<f64>> {
        let relation = OrbitVelocity::new(field().mu());
        let velocity = |x: &OrbitState| to_inertial(x.theta, &Vector2::new(x.vr, x.vtheta));
        let sample = |x: &OrbitState| OrbitSample { r: x.r, theta: x.theta, thrust: self.thrust };
        let mut filter = InvariantFilter::new(decay, to_inertial(self.states[0].theta, &guess));
        let mut errors = vec![velocity(&self.states[0]) - filter.estimate()];
        for (ends, step) in self.states.windows(2).zip(&self.steps) {
            filter.step(&relation.observe(&sample(&ends[0]), &sample(&ends[1]), *step));
            errors.push(velocity(&ends[1]) - filter.estimate());
        }
        errors
    }
}

#[test]
fn free_motion_follows_the_reference_trajectory() {
    let rows = reference("free_orbit.csv");
    assert_eq!((rows.len(), rows[200][0]), (201, 20.0));
    let motion = Motion::free(1e-3, 20.0);
    let deviation = |(row, expected): (usize, &Vec<f64>)| {
        (Vector4::from(motion.states[100 * row]) - Vector4::from_column_slice(&expected[1..])).amax()
    };
    let worst = rows.iter().enumerate().map(deviation).fold(0.0, f64::max);
    println!("free orbit, 20 s at 1 kHz: worst deviation {worst:.2e}");
    assert!(worst <= 1e-10, "{worst:e}");
}

#[test]
fn a_settled_estimate_is_the_true_velocity() {
    let floor = |tick_s| {
        let motion = Motion::free(tick_s, 30.0);
        let errors = motion.errors(Vector2::repeat(DECAY_PER_S), Vector2::zeros());
        motion.times().iter().zip(&errors).filter(|(time, _)| **time > 12.0).map(|(_, e)| e.amax()).fold(0.0, f64::max)
    };
    let (coarse, fine) = (floor(1e-2), floor(1e-3));
    println!("velocity floor: {coarse:.2e} du/s at 100 Hz, {fine:.2e} du/s at 1 kHz");
    assert!(fine <= 1e-11, "{fine:e}");
}

#[test]
fn each_axis_has_the_designed_decay() {
    for (axis, decay) in [(0, DECAY_PER_S), (1, 2.5)] {
        let motion = Motion::free(1e-3, 4.0);
        let errors = motion.errors(Vector2::new(DECAY_PER_S, 2.5), Vector2::new(-0.4, 0.1));
        let points: Vec<(f64, f64)> = motion
            .times()
            .into_iter()
            .zip(&errors)
            .map(|(time, error)| (time, error[axis].abs()))
            .filter(|(_, error)| *error > 1e-7)
            .map(|(time, error)| (time, error.ln()))
            .collect();
        let n = points.len() as f64;
        let mean = points.iter().fold((0.0, 0.0), |(t, l), p| (t + p.0 / n, l + p.1 / n));
        let (square, product) = points.iter().fold((0.0, 0.0), |(square, product), p| {
            (square + (p.0 - mean.0).powi(2), product + (p.0 - mean.0) * (p.1 - mean.1))
        });
        let slope = product / square;
        println!("axis {axis}: decay {slope:.9} 1/s from {n} points");
        assert!(n > 1000.0 && (slope / -decay - 1.0).abs() < 1e-6, "{slope}");
    }
}

#[test]
fn the_error_is_of_fourth_order_in_the_tick() {
    let ticks_s = [0.2, 0.1, 0.05, 0.025];
    let rms = ticks_s.map(|tick_s| {
        let errors = Motion::free(tick_s, 60.0).errors(Vector2::repeat(0.5), Vector2::new(START.vr, START.vtheta));
        // At the instants that all ticks share, and with a slow L; otherwise the fifth order of one step would show.
        let shared = errors.iter().step_by((ticks_s[0] / tick_s).round() as usize).skip(100);
        (shared.clone().map(Vector2::norm_squared).sum::<f64>() / shared.count() as f64).sqrt()
    });
    let orders: Vec<f64> = rms.windows(2).map(|pair| (pair[0] / pair[1]).log2()).collect();
    let shown = rms.map(|error| format!("{error:.2e}")).join(", ");
    println!("rms errors {shown} du/s at ticks of {ticks_s:?} s, orders {orders:.3?}");
    assert!((orders[2] - 4.0).abs() < 0.1, "{orders:?}");
}

/// Runs a shipped scenario in this thread and returns the truths of all bodies and the estimate per tick.
fn run(name: &str, overrides: &[&str]) -> Vec<(Vec<OrbitTruth>, OrbitEstimate)> {
    let overrides: Vec<String> = overrides.iter().map(|text| (*text).to_owned()).collect();
    let scenario = &Scenario::load(&shipped(name), &overrides).unwrap();
    let mut all = Loop::open(scenario);
    let bodies = scenario.rig.bodies();
    let mut truths: Vec<_> = bodies.iter().map(|body| all.input::<OrbitTruth>(&body.name, Signal::Truth)).collect();
    let mut estimate = all.input::<OrbitEstimate>(&bodies[0].name, Signal::Estimate);
    let mut rows = Vec::new();
    all.run(|_| rows.push((truths.iter_mut().map(next).collect(), next(&mut estimate))));
    rows
}

/// The paper's comparison: the law with the measured and with the estimated velocity.
#[test]
fn with_and_without_a_measured_velocity_the_target_orbit_is_reached() {
    let full = run("orbit-hold", &["controller.feedback=full-state"]);
    let observed = run("orbit-hold", &[]);
    for rows in [&full, &observed] {
        let end = rows.last().unwrap().0[0];
        let [vr, vtheta] = end.velocity_du_s;
        println!("ends at r = {}, Vr = {vr:.2e}, Vtheta = {vtheta}", end.radius_du);
        assert!((end.radius_du - 1.3).abs() < 1e-5 && vr.abs() < 1e-5 && (vtheta - 0.87706).abs() < 1e-5, "{end:?}");
    }
    let apart = |tick: usize| (full[tick].0[0].radius_du - observed[tick].0[0].radius_du).abs();
    let farthest = (0..full.len()).map(apart).fold(0.0, f64::max);
    println!("the two are at most {farthest:.3} du apart in radius");
    assert!(farthest > 1e-2, "the law with an estimate moves differently at first");
}

/// The reference is the paper's own observer (15), (16) and a plant in Cartesian coordinates, in another language.
#[test]
fn the_closed_loop_follows_the_reference() {
    let expected = reference("let_orbit_hold_100hz.csv");
    let rows = run("orbit-hold", &["tick_hz=100", "duration_s=10", "accept={}"]);
    assert_eq!(rows.len(), expected.len());
    let mut worst = 0.0_f64;
    for ((truths, estimate), expected) in rows.iter().zip(&expected) {
        let truth = truths[0];
        let row =
            [&[truth.radius_du][..], &truth.velocity_du_s, &estimate.velocity_du_s, &truth.applied_du_s2].concat();
        for (value, expected) in row.iter().zip(&expected[2..]) {
            worst = worst.max((value - expected).abs());
            assert!((value - expected).abs() < 1e-9, "tick {}: {value} instead of {expected}", truth.stamp.tick);
        }
    }
    println!("closed loop at 100 Hz: worst deviation {worst:.2e}");
}

#[test]
fn the_estimate_in_the_closed_loop_decays_as_designed() {
    let rows = run("orbit-hold", &["duration_s=4", "accept={}"]);
    let error = |tick: usize| {
        let (truth, estimate) = (&rows[tick].0[0], &rows[tick].1);
        (Vector2::from(truth.velocity_du_s) - Vector2::from(estimate.velocity_du_s)).norm()
    };
    for tick in [1, 500, 1000, 2000, 3000] {
        let expected = error(0) * (-DECAY_PER_S * tick as f64 * 1e-3).exp();
        assert!((error(tick) / expected - 1.0).abs() < 1e-6, "tick {tick}: {:e} for {expected:e}", error(tick));
    }
}

#[test]
fn thrust_is_limited_and_vanishes_at_the_end() {
    let rows = run("orbit-hold", &["duration_s=25"]);
    let thrust = |row: &(Vec<OrbitTruth>, OrbitEstimate)| Vector2::from(row.0[0].applied_du_s2).amax();
    assert!(rows.iter().all(|row| thrust(row) <= 0.5) && rows.iter().any(|row| thrust(row) == 0.5));
    assert!(thrust(rows.last().unwrap()) < 1e-8);
}

#[test]
fn a_follower_moves_like_its_leader_at_another_angle() {
    for predict in ["controller.predict=true", "controller.predict=false"] {
        let rows = run("orbit-rendezvous", &[predict, "duration_s=25"]);
        let difference = |row: &(Vec<OrbitTruth>, OrbitEstimate)| {
            let [leader, follower] = [row.0[0], row.0[1]];
            let velocity = Vector2::from(follower.velocity_du_s) - Vector2::from(leader.velocity_du_s);
            (follower.radius_du - leader.radius_du, velocity.norm(), follower.angle_rad - leader.angle_rad)
        };
        let (radius, velocity, angle) = difference(rows.last().unwrap());
        let before = difference(&rows[rows.len() - 3000]).2;
        println!("{predict}: {radius:.1e} du, {velocity:.1e} du/s, phase offset {angle:.6} rad");
        assert!(radius.abs() < 1e-8 && velocity < 1e-8 && (angle - before).abs() < 1e-7, "{radius} {velocity}");
        assert!(angle.abs() > 0.1, "the initial offset of the angle stays");
        // The leader's orbit is an ellipse: its radius varies, and no thrust acts on it.
        let radii = rows.iter().map(|row| row.0[0].radius_du);
        assert!(radii.clone().fold(0.0, f64::max) - radii.fold(9.0, f64::min) > 0.2);
        assert!(rows.iter().all(|row| row.0[0].applied_du_s2 == [0.0; 2]));
    }
}

#[test]
fn processes_publish_the_bits_of_one_thread() {
    for (scenario, set) in [
        ("orbit-hold", "controller.predict=false"),
        ("orbit-hold", "controller.predict=true"),
        ("orbit-hold", "controller.feedback=full-state"),
        ("orbit-rendezvous", "controller.predict=true"),
    ] {
        let bench = Bench::new();
        let run = |clock: &str| {
            bench.summary(scenario, &["--clock", clock, "--duration", "5", "--set", "accept={}", "--set", set])
        };
        let (in_process, lockstep) = (run("in-process"), run("lockstep"));
        assert_eq!(in_process["state"]["hash"], lockstep["state"]["hash"], "{scenario} {set}");
        assert_eq!((&lockstep["books"]["balanced"], &lockstep["last_tick"]), (&true.into(), &5000.into()));
        let links = lockstep["books"]["links"].as_array().unwrap();
        assert!(links.iter().all(|link| !link["service"].as_str().unwrap().ends_with("/truth")), "{links:?}");
        bench.assert_clean(&[]);
    }
}

/// Both rigs in real time meet their criteria; a slow machine may miss ticks, but must not degrade the result.
#[test]
fn the_shipped_scenarios_are_accepted_in_real_time() {
    for scenario in ["orbit-hold", "orbit-rendezvous"] {
        let bench = Bench::new();
        let summary = bench.summary(scenario, &[&["--clock", "realtime"][..], &WITHOUT_TICK_LIMITS].concat());
        println!("{scenario}: {} missed or starved", summary["books"]["missed_ticks"]);
        assert_eq!((&summary["accepted"], &summary["books"]["balanced"]), (&true.into(), &true.into()));
        bench.assert_clean(&[]);
    }
}

#[test]
fn full_state_feedback_is_noted_in_every_output() {
    let bench = Bench::new();
    let note = "spacecraft measures its own velocity";
    let set = ["--set", "controller.feedback=full-state"];
    let short = ["--clock", "in-process", "--duration", "1", "--set", "accept={}"];
    let summary = bench.summary("orbit-hold", &[&set[..], &short, &["--out", "out"]].concat());
    assert!(summary["notes"][0].as_str().unwrap().contains(note), "{summary:#}");
    let resolved = std::fs::read_to_string(bench.path("out/scenario.toml")).unwrap();
    assert!(resolved.contains("feedback = \"full-state\""), "{resolved}");
    let file = bench.path("orbit-hold.toml");
    let shown = bench.run(&[&["run", file.to_str().unwrap()], &set[..], &short].concat());
    assert!(shown.stdout.contains(note), "{shown:?}");
    assert!(bench.run(&[&["check", file.to_str().unwrap()], &set[..]].concat()).stdout.contains(note));
    let usual = bench.summary("orbit-hold", &short);
    assert_eq!(usual["notes"], Value::Array(Vec::new()));
}

#[test]
fn a_body_that_hits_or_leaves_fails_the_run() {
    let plunge = ["spacecraft.initial_radius_du=0.2", "spacecraft.initial_velocity_du_s=[-3.0, 0.0]"];
    let leave = ["spacecraft.initial_radius_du=9.0", "spacecraft.initial_velocity_du_s=[5.0, 0.0]"];
    let lost_leader = ["leader.initial_velocity_du_s=[-9.0, 0.0]", "leader.initial_angle_rad=1.0"];
    for (scenario, set) in [("orbit-hold", plunge), ("orbit-hold", leave), ("orbit-rendezvous", lost_leader)] {
        let bench = Bench::new();
        let file = shipped(scenario);
        for clock in ["in-process", "lockstep"] {
            // Without the scenario's own criteria.
            let common = ["--clock", clock, "--duration", "1", "--set", "accept={}", "--json", "--out", clock];
            let run = [&["run", file.to_str().unwrap(), "--set", set[0], "--set", set[1]], &common[..]].concat();
            let done = bench.run(&run);
            assert_eq!(done.code, Some(3), "{done:?}");
            assert!(done.stderr.contains("faulted_ticks_max"), "{done:?}");
            let summary = done.json();
            let faulted = summary["score"]["faulted_ticks"].as_u64().unwrap();
            assert!(faulted > 500 && faulted < 1001, "{faulted}");
            assert_eq!(summary["score"]["metrics"][0]["last"], Value::Null, "infinite");
            assert_eq!(summary["books"]["balanced"], true);
        }
        let hashes = |clock: &str| std::fs::read_to_string(bench.path(&format!("{clock}/hashes.txt"))).unwrap();
        // The first line names the run.
        let (in_process, lockstep) = (hashes("in-process"), hashes("lockstep"));
        assert!(in_process.lines().count() > 2 && in_process.lines().skip(1).eq(lockstep.lines().skip(1)));
        bench.assert_clean(&[]);
    }
}

#[test]
fn invalid_values_are_refused_with_key_and_code() {
    let bench = Bench::new();
    let hold = [
        ("spacecraft.initial_radius_du=0.0", "spacecraft.initial_radius_du", "out-of-range"),
        ("spacecraft.initial_radius_du=-1.0", "spacecraft.initial_radius_du", "out-of-range"),
        ("spacecraft.initial_radius_du=10.0", "spacecraft.initial_radius_du", "out-of-range"),
        ("spacecraft.initial_velocity_du_s=[nan, 1.0]", "spacecraft.initial_velocity_du_s[0]", "not-finite"),
        ("spacecraft.initial_velocity_du_s=[1.0]", "spacecraft.initial_velocity_du_s", "wrong-length"),
        (
            "central_body.gravitational_parameter_du3_s2=0.0",
            "central_body.gravitational_parameter_du3_s2",
            "not-attracting",
        ),
        (
            "central_body.gravitational_parameter_du3_s2=-1.0",
            "central_body.gravitational_parameter_du3_s2",
            "not-attracting",
        ),
        ("central_body.radius_du=0.0", "central_body.radius_du", "empty-region"),
        ("central_body.escape_radius_du=0.01", "central_body.escape_radius_du", "empty-region"),
        ("central_body.escape_radius_du=0.9", "spacecraft.initial_radius_du", "out-of-range"),
        ("controller.target_radius_du=0.0", "controller.target_radius_du", "out-of-range"),
        ("controller.target_radius_du=11.0", "controller.target_radius_du", "out-of-range"),
        ("controller.thrust_max_du_s2=0.0", "controller.thrust_max_du_s2", "not-positive"),
        ("controller.gain.radius_per_s2=0.0", "controller.gain.radius_per_s2", "not-positive"),
        ("controller.gain.radial_per_s=-1.8", "controller.gain.radial_per_s", "not-positive"),
        ("controller.gain.transverse_per_s=0.0", "controller.gain.transverse_per_s", "not-positive"),
        ("controller.gain.transverse_per_s=1001.0", "controller.gain", "unstable-loop"),
        ("controller.gain.transvers_per_s=1.0", "controller.gain.transvers_per_s", "unknown-key"),
        ("controller.feedback=truth", "controller.feedback", "unknown-choice"),
        ("observer.decay_rate_per_s=[4.0, 0.0]", "observer.decay_rate_per_s", "not-positive"),
        ("accept.sync_error_rad_s_max=1.0", "accept.sync_error_rad_s_max", "unknown-criterion"),
        ("leader.initial_radius_du=1.0", "leader", "unknown-key"),
        ("central_body.gravitational_parameter_du3_s2=1e18", "tick_hz", "tick-too-long"),
        ("rig=orbit-hole", "rig", "unknown-rig"),
    ];
    let rendezvous = [
        ("leader.initial_radius_du=0.0", "leader.initial_radius_du", "out-of-range"),
        ("follower.0.initial_radius_du=20.0", "follower[0].initial_radius_du", "out-of-range"),
        ("follower=[]", "controller", "unused-key"),
        ("follower.0.name=leader", "follower[0].name", "taken-name"),
        ("follower.0.name=\"Not this\"", "follower[0].name", "bad-name"),
        ("controller.target_radius_du=1.0", "controller.target_radius_du", "unknown-key"),
        ("controller.thrust_max_du_s2=-0.5", "controller.thrust_max_du_s2", "not-positive"),
    ];
    let cases =
        hold.iter().map(|case| ("orbit-hold", case)).chain(rendezvous.iter().map(|case| ("orbit-rendezvous", case)));
    for (scenario, (set, key, code)) in cases {
        let done = bench.run(&["check", shipped(scenario).to_str().unwrap(), "--set", set]);
        assert_eq!(done.code, Some(2), "{set}: {done:?}");
        let (place, code) = (format!(" {key}: "), format!("[{code}]"));
        assert!(done.stderr.lines().any(|line| line.contains(&place) && line.ends_with(&code)), "{set}: {done:?}");
    }
    // A hyperbolic start is valid too.
    let set = "spacecraft.initial_velocity_du_s=[0.5, 1.6]";
    assert_eq!(bench.run(&["check", shipped("orbit-hold").to_str().unwrap(), "--set", set]).code, Some(0));
}

/// Generates a state on an orbit that stays between 0.5 and 5 du.
fn orbit() -> impl Strategy<Value = OrbitState> {
    let start = (0.6..2.0_f64, -0.4..0.4_f64, -9.0..9.0_f64, 0.7..1.2_f64, any::<bool>());
    start
        .prop_map(|(r, vr, theta, part, back)| {
            let vtheta = part * field().circular_velocity(r);
            OrbitState { r, vr: vr * vtheta, theta, vtheta: if back { -vtheta } else { vtheta } }
        })
        .prop_filter("too near or too far", |state| {
            let (energy, pericentre) = (field().energy(state), field().pericentre(state));
            energy < 0.0 && pericentre > 0.5 && -1.0 / energy - pericentre < 5.0
        })
}

fn vector(bound: f64) -> impl Strategy<Value = Vector2<f64>> {
    prop::array::uniform2(-bound..bound).prop_map(Vector2::from)
}

/// Generates any number, including invalid ones.
fn anything() -> impl Strategy<Value = f64> {
    prop_oneof![any::<f64>(), -1e3..1e3_f64, Just(0.0)]
}

proptest! {
    #![proptest_config(cases(64))]

    #[test]
    fn free_motion_keeps_energy_and_momentum(start in orbit()) {
        let end = (0..2000).fold(start, |x, _| field().flow(&x, &Vector2::zeros(), 5e-3).unwrap());
        prop_assert!((field().energy(&end) - field().energy(&start)).abs() < 1e-10);
        prop_assert!((end.momentum() - start.momentum()).abs() < 1e-10);
    }

    #[test]
    fn a_flow_may_be_cut_anywhere(start in orbit(), thrust in vector(0.3), cut in 0.0..1.0_f64) {
        let whole = field().flow(&start, &thrust, 0.5).unwrap();
        let first = field().flow(&start, &thrust, 0.5 * cut).unwrap();
        let parts = field().flow(&first, &thrust, 0.5 * (1.0 - cut)).unwrap();
        prop_assert!((Vector4::from(whole) - Vector4::from(parts)).amax() < 1e-11);
    }

    /// With r ≥ 0.5 the acceleration's fourth derivative stays below 2e4 in these units, so 2 ms ticks leave less
    /// than 1e-9; the gaps of up to five ticks make that 1e-7.
    #[test]
    fn the_error_contracts_as_designed_under_thrust_and_missed_ticks(
        start in orbit(), thrust in vector(0.05), guess in vector(2.0), decay in prop::array::uniform2(0.5..10.0_f64),
        tick_s in 5e-4..2e-3_f64, gaps in prop::collection::vec(1..=5_u32, 400)
    ) {
        for (gaps, floor) in [(vec![1; gaps.len()], 1e-9), (gaps, 1e-7)] {
            let motion = Motion::new(start, thrust, tick_s, gaps.into_iter());
            let errors = motion.errors(decay.into(), guess);
            for (time, error) in motion.times().into_iter().zip(&errors) {
                let decayed = errors[0].component_mul(&Vector2::from(decay).map(|rate| (-rate * time).exp()));
                prop_assert!((error - decayed).amax() <= floor, "{error} for {decayed} at {time} s");
            }
        }
    }

    #[test]
    fn conversions_between_axes_are_inverse(theta in -100.0..100.0_f64, v in vector(10.0)) {
        prop_assert!((to_polar(theta, &to_inertial(theta, &v)) - v).amax() < 1e-14);
        prop_assert!((to_inertial(theta, &v).norm() - v.norm()).abs() < 1e-14);
    }
}

proptest! {
    #![proptest_config(cases(2000))]

    /// Any state and thrust yield a state within the field, or a fault with the last valid one; both are finite.
    #[test]
    fn a_state_is_always_finite(
        r in 0.06..19.0_f64, v in prop::array::uniform2(-50.0..50.0_f64), thrust in prop::array::uniform2(anything()),
        dt_s in 0.0..0.1_f64
    ) {
        let start = OrbitState { r, vr: v[0], theta: 0.0, vtheta: v[1] };
        let end = field().flow(&start, &thrust.into(), dt_s).unwrap_or_else(|fault| fault.last());
        prop_assert!(end.is_finite() && field().holds(end.r), "{end:?}");
    }

    #[test]
    fn a_command_is_always_finite_and_within_the_limit(
        leader in prop::array::uniform4(anything()), body in prop::array::uniform4(anything()), predict in any::<bool>()
    ) {
        let gains = OrbitGains { radius_per_s2: 1.0, radial_per_s: 1.8, transverse_per_s: 1.0 };
        let law = OrbitHold::new(field(), gains, 0.5, if predict { 1e-3 } else { 0.0 });
        let [leader, body] = [leader, body].map(|x| OrbitState::from(Vector4::from(x)));
        for thrust in [law.to_leader(&leader, &body, &Vector2::zeros()), law.to_circle(1.3, &body, &Vector2::zeros())] {
            prop_assert!(thrust.amax() <= 0.5, "{thrust}");
        }
    }

    /// ë_r = −k_r e_r − k_v ė_r and ė_θ = −k_θ e_θ for any two orbits.
    #[test]
    fn the_law_makes_the_error_linear(leader in orbit(), body in orbit(), gain in prop::array::uniform3(0.1..3.0_f64)) {
        let [radius_per_s2, radial_per_s, transverse_per_s] = gain;
        let gains = OrbitGains { radius_per_s2, radial_per_s, transverse_per_s };
        let thrust = OrbitHold::new(field(), gains, 1e3, 0.0).to_leader(&leader, &body, &Vector2::zeros());
        let rate = |x: OrbitState, thrust| field().derivative(&x.into(), &thrust);
        let error_rate = rate(body, thrust) - rate(leader, Vector2::zeros());
        let radial = -radius_per_s2 * (body.r - leader.r) - radial_per_s * (body.vr - leader.vr);
        prop_assert!((error_rate.y - radial).abs() < 1e-13);
        prop_assert!((error_rate.w + transverse_per_s * (body.vtheta - leader.vtheta)).abs() < 1e-13);
    }
}

//! Logs that others wrote: `identify` and `estimate` as a user runs them, on throws of a body that was never measured.

mod common;

use common::{Bench, Done};
use corotate::model::{Inertia, Noise, RigidBody};
use nalgebra::{Rotation3, Vector3};
use serde_json::Value;
use std::fmt::Write;

const MOMENTS: [f64; 3] = [0.93, 0.08, 1.0];
/// Of the air, 1/s.
const DAMPING: f64 = 0.2;

/// Throws of a damped body, as a gyro that is turned against it has them at 100 Hz: in deg/s with two decimals.
fn throws(count: u64, turn: &Rotation3<f64>) -> String {
    let body = RigidBody::new(&Inertia::new(MOMENTS).unwrap());
    let mut noise = Noise::new(11, 0, [0.01; 3], [0.0; 3]);
    let mut start = Noise::new(12, 1, [6.0; 3], [0.0; 3]);
    let mut text = String::from("throw,time_ms,gyro_x_dps,gyro_y_dps,gyro_z_dps\n");
    for throw in 0..count {
        let mut rate = start.sample();
        for tick in 0..90 {
            let [x, y, z] = (turn * rate + noise.sample()).map(f64::to_degrees).into();
            writeln!(text, "t{throw},{},{x:.2},{y:.2},{z:.2}", tick * 10).unwrap();
            // Damped, a free motion goes slower and slower.
            let growth = (DAMPING * 0.01_f64).exp();
            rate = body.flow(&rate, &Vector3::zeros(), (1.0 - 1.0 / growth) / DAMPING) / growth;
        }
    }
    text
}

fn run(bench: &Bench, arguments: &[&str]) -> Done {
    let done = bench.run(arguments);
    assert_eq!(done.code, Some(0), "{arguments:?}: {done:?}");
    done
}

fn json(done: &Done) -> Value {
    serde_json::from_str(&done.stdout).unwrap_or_else(|error| panic!("{error}: {done:?}"))
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect()
}

#[test]
fn a_body_is_identified_and_each_of_its_rates_found_from_the_other_two() {
    let bench = Bench::new();
    std::fs::write(bench.path("throws.csv"), throws(30, &Rotation3::identity())).unwrap();
    let identified = run(&bench, &["identify", "throws.csv", "--by", "throw", "--json"]);
    let found = json(&identified);
    assert_eq!(found["schema"], "corotate/identify/v1");
    assert_eq!((&found["motion"]["segments"], &found["logs"][0]["counts"]["rows"]), (&30.into(), &2700.into()));
    for way in ["one_body", "tensor"] {
        for (moment, expected) in numbers(&found[way]["moments"]).into_iter().zip(MOMENTS) {
            assert!((moment - expected).abs() < 0.01, "{way}: {found}");
        }
        assert!((found[way]["damping_per_s"].as_f64().unwrap() - DAMPING).abs() < 0.02, "{found}");
    }
    assert!(found["axes"]["closure"].as_f64().unwrap().abs() < 0.01, "{found}");
    let coefficients = Inertia::new(MOMENTS).unwrap().coefficients();
    for (coefficient, expected) in numbers(&found["recursive"]["coefficients"]).into_iter().zip(&coefficients) {
        assert!((coefficient - expected).abs() < 0.05, "{found}");
    }
    std::fs::write(bench.path("body.json"), &identified.stdout).unwrap();
    for (axis, filter) in [("x", "first"), ("y", "first"), ("z", "first"), ("x", "second"), ("y", "kalman")] {
        let arguments = [
            "estimate",
            "throws.csv",
            "--by",
            "throw",
            "--hidden",
            axis,
            "--body",
            "body.json",
            "--filter",
            filter,
            "--table",
            "table.csv",
            "--json",
        ];
        let estimated = json(&run(&bench, &arguments));
        assert_eq!((&estimated["schema"], &estimated["hidden_axis"]), (&"corotate/estimate/v1".into(), &axis.into()));
        assert_eq!(estimated["score"]["segments"], 30, "{estimated}");
        let part = estimated["score"]["part"]["median"].as_f64().unwrap();
        assert!(part < 0.02, "{axis} {filter}: {part} {}", estimated["choice"]);
        let table = std::fs::read_to_string(bench.path("table.csv")).unwrap();
        assert_eq!(table.lines().count(), 2701);
        let last: Vec<&str> = table.lines().last().unwrap().split(',').collect();
        assert_eq!((last[0], last[1], last.len()), ("t29", "2701", 8), "{last:?}");
        assert!((last[3].parse::<f64>().unwrap() - last[5].parse::<f64>().unwrap()).abs() < 1.0, "{last:?}");
    }
}

#[test]
fn a_sensor_that_is_turned_against_the_body_is_no_hindrance() {
    let bench = Bench::new();
    let turn = Rotation3::from_euler_angles(0.3, -0.5, 0.2);
    std::fs::write(bench.path("throws.csv"), throws(30, &turn)).unwrap();
    let log = ["throws.csv", "--by", "throw"];
    let identified = run(&bench, &[&["identify"], &log[..], &["--method", "tensor", "--json"]].concat());
    let found = json(&identified);
    assert!(found["findings"].to_string().contains("give these axes to an estimate"), "{found}");
    std::fs::write(bench.path("body.json"), &identified.stdout).unwrap();
    let hidden = ["--hidden", "z", "--body", "body.json"];
    let estimated = json(&run(&bench, &[&["estimate"], &log[..], &hidden, &["--json"]].concat()));
    let part = estimated["score"]["part"]["median"].as_f64().unwrap();
    assert!(part < 0.02, "{part}");
    // Without its third sensor the principal rates are not known.
    let two = ["--rates", "gyro_x_dps,gyro_y_dps,-"];
    let refused = bench.run(&[&["estimate"], &log[..], &hidden, &two].concat());
    assert_eq!(refused.code, Some(2), "{refused:?}");
    assert!(refused.stderr.contains("it takes all three"), "{refused:?}");
}

#[test]
fn a_log_that_lacks_the_rate_is_estimated_without_a_score() {
    let bench = Bench::new();
    let text = throws(3, &Rotation3::identity());
    let two: String = text.lines().map(|line| line.rsplit_once(',').unwrap().0.to_owned() + "\n").collect();
    std::fs::write(bench.path("two.csv"), two).unwrap();
    let arguments =
        ["estimate", "two.csv", "--by", "throw", "--hidden", "z", "--inertia", "0.93,0.08,1", "--damping", "0.2"];
    let told = run(&bench, &arguments);
    assert!(told.stdout.contains("no score: the log does not have the rate about z"), "{}", told.stdout);
    assert!(told.stdout.contains("that rate is chosen"), "{}", told.stdout);
}

#[test]
fn what_cannot_be_done_is_refused_with_place_reason_and_remedy() {
    let bench = Bench::new();
    std::fs::write(bench.path("comma.csv"), "t_s;wx;wy;wz\n0,0;1;2;3\n").unwrap();
    std::fs::write(bench.path("good.csv"), "t_s,wx,wy,wz\n0,1,2,3\n0.1,1,2,3\n0.2,1,2,3\n0.3,1,2,3\n0.4,1,2,3\n")
        .unwrap();
    std::fs::write(bench.path("none.json"), "{\"schema\":\"corotate/identify/v1\",\"body\":null}").unwrap();
    let body = ["--inertia", "1,2,2.5"];
    for (arguments, words) in [
        (&["identify", "missing.csv"][..], "cannot read missing.csv"),
        (&["identify", "comma.csv"], "comma.csv:2: column t_s: `0,0` has a decimal comma"),
        (&["identify", "good.csv", "--rates", "a,b,c"], "there is no column `a`"),
        (&["identify", "good.csv", "--rates", "wx,wy"], "give three names"),
        (&["identify", "good.csv", "--time-unit", "min"], "the units of time are"),
        (&["identify", "good.csv", "--gap", "0"], "above 0"),
        (&["identify", "good.csv", "--decay", "-1"], "above 0"),
        (&["identify", "good.csv", "--decay=0"], "above 0"),
        (&["identify", "good.csv", "--method", "axisymmetric"], "add --symmetry-axis"),
        (&["estimate", "good.csv", "--hidden", "z"], "--body <FILE>"),
        (&["estimate", "good.csv", "--hidden", "w", "--inertia", "1,2,2.5"], "the axes are x, y and z"),
        (&["estimate", "good.csv", "--hidden", "z", "--inertia", "1,2,9"], "triangle inequality"),
        (&["estimate", "good.csv", "--hidden", "z", "--inertia", "1,1,1"], "turns like a sphere"),
        (&["estimate", "good.csv", "--hidden", "z", "--body", "none.json"], "found no body"),
        (&["estimate", "good.csv", "--hidden", "z", "--body", "good.csv"], "it has no body"),
        (
            &["estimate", "good.csv", "--hidden", "z", "--inertia", "1,2,2.5", "--axes", "1,0,0,0,1,0,0,0,2"],
            "no rotation",
        ),
        (&["estimate", "good.csv", "--hidden", "z", "--inertia", "1,2,2.5", "--decay=-1"], "above 0"),
        (
            &["estimate", "good.csv", "--hidden", "z", "--inertia", "1,2,2.5", "--table", "good.csv"],
            "that is the log; name another",
        ),
    ] {
        let refused = bench.run(arguments);
        assert_eq!(refused.code, Some(2), "{arguments:?}: {refused:?}");
        assert!(refused.stderr.contains(words), "{arguments:?}: {}", refused.stderr);
    }
    assert!(std::fs::read_to_string(bench.path("good.csv")).unwrap().starts_with("t_s"));
    // A log that says nothing of a body: read, told, and no body, however well zeros fit it.
    let empty = bench.run(&["identify", "good.csv"]);
    assert_eq!(empty.code, Some(1), "{empty:?}");
    assert!(empty.stderr.contains("tells of no body"), "{empty:?}");
    assert_eq!(run(&bench, &[&["estimate", "good.csv", "--hidden", "z"], &body[..]].concat()).code, Some(0));
}

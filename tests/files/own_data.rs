//! A user's logs: `identify` and `estimate` on throws of an unknown body, and a log as the motion of a leader.

use crate::common::Bench;
use corotate::model::{Inertia, Noise, RigidBody};
use nalgebra::{Rotation3, Vector3};
use serde_json::Value;
use std::fmt::Write;

const MOMENTS: [f64; 3] = [0.93, 0.08, 1.0];
/// Damping by the air, 1/s.
const DAMPING: f64 = 0.2;

/// Returns a log of throws of a damped body, by a gyro rotated by `turn`: 100 Hz, deg/s with two decimals.
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
            // A damped free motion is an undamped one in slowing time.
            let growth = (DAMPING * 0.01_f64).exp();
            rate = body.flow(&rate, &Vector3::zeros(), (1.0 - 1.0 / growth) / DAMPING) / growth;
        }
    }
    text
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect()
}

#[test]
fn a_body_is_identified_and_each_rate_is_estimated_from_the_other_two() {
    let bench = Bench::new();
    std::fs::write(bench.path("throws.csv"), throws(30, &Rotation3::identity())).unwrap();
    let identified = bench.run(&["identify", "throws.csv", "--by", "throw", "--json"]).succeeded();
    let found = identified.json();
    assert_eq!(found["schema"], "corotate/identify/v1");
    assert_eq!((&found["motion"]["segments"], &found["logs"][0]["counts"]["rows"]), (&30.into(), &2700.into()));
    for method in ["one_body", "tensor"] {
        for (moment, expected) in numbers(&found[method]["moments"]).into_iter().zip(MOMENTS) {
            assert!((moment - expected).abs() < 0.01, "{method}: {found}");
        }
        assert!((found[method]["damping_per_s"].as_f64().unwrap() - DAMPING).abs() < 0.02, "{found}");
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
        let estimated = bench.run(&arguments).succeeded().json();
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
fn a_rotated_sensor_is_identified_and_compensated() {
    let bench = Bench::new();
    let turn = Rotation3::from_euler_angles(0.3, -0.5, 0.2);
    std::fs::write(bench.path("throws.csv"), throws(30, &turn)).unwrap();
    let log = ["throws.csv", "--by", "throw"];
    let identified = bench.run(&[&["identify"], &log[..], &["--method", "tensor", "--json"]].concat()).succeeded();
    let found = identified.json();
    let tilts = found["tensor"]["tilt_rad"].as_array().unwrap().iter().map(|tilt| tilt.as_f64().unwrap());
    let largest = format!("{:.1} degrees", tilts.fold(0.0, f64::max).to_degrees());
    assert!(found["findings"].to_string().contains(&largest), "{largest}: {found}");
    std::fs::write(bench.path("body.json"), &identified.stdout).unwrap();
    let hidden = ["--hidden", "z", "--body", "body.json"];
    let estimated = bench.run(&[&["estimate"], &log[..], &hidden, &["--json"]].concat()).succeeded().json();
    let part = estimated["score"]["part"]["median"].as_f64().unwrap();
    assert!(part < 0.02, "{part}");
    // Two sensor axes do not determine the principal rates.
    let two = ["--rates", "gyro_x_dps,gyro_y_dps,-"];
    let refused = bench.run(&[&["estimate"], &log[..], &hidden, &two].concat());
    assert_eq!(refused.code, Some(2), "{refused:?}");
    assert!(refused.says("mixed-axes"), "{refused:?}");
}

#[test]
fn a_log_without_the_hidden_rate_is_estimated_without_a_score() {
    let bench = Bench::new();
    let text = throws(3, &Rotation3::identity());
    let two: String = text.lines().map(|line| line.rsplit_once(',').unwrap().0.to_owned() + "\n").collect();
    std::fs::write(bench.path("two.csv"), two).unwrap();
    let arguments =
        ["estimate", "two.csv", "--by", "throw", "--hidden", "z", "--inertia", "0.93,0.08,1", "--damping", "0.2"];
    bench.run(&arguments).succeeded();
    let estimated = bench.run(&[&arguments[..], &["--json"]].concat()).succeeded().json();
    assert!(estimated["score"].is_null(), "{estimated:#}");
}

#[test]
fn a_wrong_argument_or_log_is_refused_with_a_code_and_its_place() {
    let bench = Bench::new();
    std::fs::write(bench.path("comma.csv"), "t_s;wx;wy;wz\n0,0;1;2;3\n0,1;1;2;x\n").unwrap();
    std::fs::write(bench.path("good.csv"), "t_s,wx,wy,wz\n0,1,2,3\n0.1,1,2,3\n0.2,1,2,3\n0.3,1,2,3\n0.4,1,2,3\n")
        .unwrap();
    std::fs::write(bench.path("none.json"), "{\"schema\":\"corotate/identify/v1\",\"body\":null}").unwrap();
    let body = ["--inertia", "1,2,2.5"];
    for (arguments, parts) in [
        (&["identify", "missing.csv"][..], &["missing.csv", "[cannot-read]"][..]),
        (&["identify", "comma.csv"], &["comma.csv:3: column wz: `x`", "[not-a-number]"]),
        (&["identify", "good.csv", "--rates", "a,b,c"], &["`a`", "[no-such-column]"]),
        (&["identify", "good.csv", "--rates", "wx,wy"], &["--rates <X,Y,Z>"]),
        (&["identify", "good.csv", "--time-unit", "min"], &["--time-unit <UNIT>"]),
        (&["identify", "good.csv", "--gap", "0"], &["gap", "[impossible-option]"]),
        (&["identify", "good.csv", "--decay", "-1"], &["decay", "[impossible-option]"]),
        (&["identify", "good.csv", "--decay=0"], &["decay", "[impossible-option]"]),
        (&["identify", "good.csv", "--method", "axisymmetric"], &["--symmetry-axis", "[missing-axis]"]),
        (&["estimate", "good.csv", "--hidden", "z"], &["--body <FILE>"]),
        (&["estimate", "good.csv", "--hidden", "w", "--inertia", "1,2,2.5"], &["--hidden <AXIS>"]),
        (&["estimate", "good.csv", "--hidden", "z", "--inertia", "1,2,9"], &["[triangle-inequality]"]),
        (&["estimate", "good.csv", "--hidden", "z", "--inertia", "1,1,1"], &["[impossible-estimate]"]),
        (&["estimate", "good.csv", "--hidden", "z", "--body", "none.json"], &["none.json", "[no-body]"]),
        (&["estimate", "good.csv", "--hidden", "z", "--body", "good.csv"], &["good.csv", "[not-a-body]"]),
        (
            &["estimate", "good.csv", "--hidden", "z", "--inertia", "1,2,2.5", "--axes", "1,0,0,0,1,0,0,0,2"],
            &["[no-rotation]"],
        ),
        (
            &["estimate", "good.csv", "--hidden", "z", "--inertia", "1,2,2.5", "--decay=-1"],
            &["decay", "[impossible-estimate]"],
        ),
        (
            &["estimate", "good.csv", "--hidden", "z", "--inertia", "1,2,2.5", "--table", "good.csv"],
            &["good.csv", "[same-file]"],
        ),
    ] {
        let refused = bench.run(arguments);
        assert_eq!(refused.code, Some(2), "{arguments:?}: {refused:?}");
        assert!(parts.iter().all(|part| refused.stderr.contains(part)), "{arguments:?}: {}", refused.stderr);
    }
    assert!(std::fs::read_to_string(bench.path("good.csv")).unwrap().starts_with("t_s"));
    // Five equal samples determine no body, although zeros would fit them.
    let short = bench.run(&["identify", "good.csv"]);
    assert!(short.code == Some(1) && short.says("log-too-short"), "{short:?}");
    // Without a step there are no coefficients.
    assert_eq!(bench.run(&["identify", "good.csv", "--by", "t_s", "--json"]).json()["recursive"], Value::Null);
    assert_eq!(bench.run(&[&["estimate", "good.csv", "--hidden", "z"], &body[..]].concat()).succeeded().code, Some(0));
}

fn hash(summary: &Value) -> &Value {
    &summary["state"]["hash"]
}

#[test]
fn a_leader_repeats_a_log_under_every_clock_with_the_same_bits() {
    let bench = Bench::new();
    let first = bench.summary("recorded-leader", &["--clock", "in-process", "--out", "first"]);
    assert_eq!(first["verdict"], "accepted", "{first:#}");
    let lockstep = bench.summary("recorded-leader", &["--clock", "lockstep", "--record", "--out", "lockstep"]);
    assert_eq!((hash(&lockstep), &lockstep["score"]), (hash(&first), &first["score"]));
    bench.run(&["replay", "lockstep"]).succeeded();
    let live = bench.summary("recorded-leader", &["--clock", "realtime", "--set", "accept={}", "--out", "live"]);
    let hashes = |directory: &str| std::fs::read_to_string(bench.path(directory).join("hashes.txt")).unwrap();
    let clean = live["state"]["clean_ticks"].as_u64().unwrap() as usize;
    let [expected, seen] = [hashes("first"), hashes("live")];
    let ticks = |text: &str| text.lines().skip(1).take(clean).map(str::to_owned).collect::<Vec<_>>();
    assert_eq!(ticks(&seen), ticks(&expected));
    // The resolved scenario has the absolute path of the log.
    let again = bench.path("first/scenario.toml");
    let again = bench.run(&["run", again.to_str().unwrap(), "--json"]);
    assert_eq!(hash(&again.json()), hash(&first), "{again:?}");
}

#[test]
fn a_users_log_moves_the_leader_and_wrong_keys_are_refused_with_their_place() {
    let bench = Bench::new();
    std::fs::write(bench.path("throws.csv"), throws(3, &Rotation3::identity())).unwrap();
    let template = bench.run(&["init", "recorded-leader"]).succeeded().stdout;
    let scenario =
        template.replace("tumbling-throw.csv", "throws.csv").replace("at_end = \"repeat\"", "at_end = \"refuse\"");
    std::fs::create_dir(bench.path("bench")).unwrap();
    std::fs::rename(bench.path("throws.csv"), bench.path("bench/throws.csv")).unwrap();
    // A path in a scenario is relative to the scenario's directory.
    std::fs::write(bench.path("bench/own.toml"), &scenario).unwrap();
    let base = ["run", "bench/own.toml", "--clock=in-process", "--json", "--set=accept={}"];
    let with = |more: &[&str]| bench.run(&[&base[..], more].concat());
    let segment = ["--set", "leader.playback.by=throw", "--set", "leader.playback.segment=t1"];
    let line = |key: &str| 1 + scenario.lines().position(|line| line.starts_with(key)).unwrap();
    let (data, duration) = (line("data ="), line("duration_s"));
    for (more, place) in [
        (&segment[..2], "t0, t1, t2".to_owned()),
        (&segment, format!("bench/own.toml:{duration}: duration_s: ")),
        (&["--set=leader.data=none.csv"], "leader.data: ".to_owned()),
        (&["--set=leader.playback.rates=['a','b','c']"], format!("bench/own.toml:{data}: leader.data: ")),
        (&["--set=leader.initial_rate_rad_s=[1,2,3]"], "initial_rate_rad_s".to_owned()),
        (&["--set=leader.playback.at_ned=repeat"], "`at_end`".to_owned()),
        (&["--set=leader.playback.hash='0'"], "[log-changed]".to_owned()),
    ] {
        let more = if more.len() == 1 { [&segment[..], &["--duration=0.5"], more].concat() } else { more.to_vec() };
        let refused = with(&more);
        assert_eq!(refused.code, Some(2), "{more:?}: {refused:?}");
        assert!(refused.stderr.contains(&place), "{more:?}: {place}: {}", refused.stderr);
    }
    with(&[&segment[..], &["--duration=0.8", "--out=once"]].concat()).succeeded();
    let repeated = with(&[&segment[..], &["--set=leader.playback.at_end=repeat", "--duration=3"]].concat());
    assert_eq!((repeated.code, &repeated.json()["books"]["missed_ticks"]), (Some(0), &0.into()), "{repeated:?}");
    // The resolved scenario has the hash of the log, and refuses a changed one.
    let log = std::fs::read_to_string(bench.path("bench/throws.csv")).unwrap();
    std::fs::write(bench.path("bench/throws.csv"), log.replace("t1,10,", "t1,11,")).unwrap();
    let changed = bench.run(&["check", "once/scenario.toml"]);
    assert!(changed.code == Some(2) && changed.says("log-changed"), "{changed:?}");
}

/// Truth has all axes; measurement lacks the hidden one, so its estimate has no score.
#[test]
fn a_recording_is_read_as_a_log() {
    let bench = Bench::new();
    bench.summary("rigid-pair", &["--clock", "in-process", "--record", "--out", "run"]);
    let about = ["estimate", "run/run.mcap", "--hidden", "z", "--inertia", "1,2,2.5", "--json", "--topic"];
    let [truth, measured] = ["leader/truth", "leader/measurement"].map(|topic| {
        let done = bench.run(&[&about[..], &[topic]].concat()).succeeded();
        done.json()
    });
    assert_eq!((&truth["log"]["counts"]["used"], &truth["segments"][0]["samples"]), (&10_001.into(), &10_001.into()));
    let error = truth["score"]["error_rad_s"]["median"].as_f64().unwrap();
    assert!(error < 1e-6, "{truth:#}");
    assert!(measured["score"].is_null() && measured["log"]["counts"]["used"] == 10_001, "{measured:#}");
    let several = bench.run(&about[..about.len() - 1]);
    assert!(several.code == Some(2) && several.stderr.contains("leader/measurement"), "{several:?}");
}

#[cfg(feature = "parquet")]
#[test]
fn a_parquet_table_equals_the_csv_table() {
    let bench = Bench::new();
    std::fs::write(bench.path("throws.csv"), throws(3, &Rotation3::identity())).unwrap();
    let arguments = ["estimate", "throws.csv", "--by", "throw", "--hidden", "z", "--inertia", "0.93,0.08,1", "--table"];
    for table in ["z.csv", "z.parquet"] {
        bench.run(&[&arguments[..], &[table]].concat()).succeeded();
    }
    use parquet::file::reader::{FileReader, SerializedFileReader};
    let reader = SerializedFileReader::new(std::fs::File::open(bench.path("z.parquet")).unwrap()).unwrap();
    let text = std::fs::read_to_string(bench.path("z.csv")).unwrap();
    let mut lines = text.lines();
    let names: Vec<&str> = lines.next().unwrap().split(',').collect();
    let mut rows = 0;
    for (row, line) in reader.get_row_iter(None).unwrap().map(Result::unwrap).zip(lines.by_ref()) {
        let columns: Vec<(String, String)> =
            row.get_column_iter().map(|(name, value)| (name.clone(), value.to_string())).collect();
        assert_eq!(columns.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>(), names);
        for ((name, value), cell) in columns.iter().zip(line.split(',')) {
            let same = match name.as_str() {
                "segment" => value.trim_matches('"') == cell,
                _ if cell.is_empty() => value == "NaN",
                _ => value.parse::<f64>().unwrap() == cell.parse::<f64>().unwrap(),
            };
            assert!(same, "{name}: {value} and {cell}");
        }
        rows += 1;
    }
    assert_eq!((rows, lines.next()), (270, None));
}

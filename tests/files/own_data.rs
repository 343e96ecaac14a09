//! Logs that others wrote: `identify` and `estimate` as a user runs them, on throws of a body that was never measured.

use crate::common::Bench;
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

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect()
}

#[test]
fn a_body_is_identified_and_each_of_its_rates_found_from_the_other_two() {
    let bench = Bench::new();
    std::fs::write(bench.path("throws.csv"), throws(30, &Rotation3::identity())).unwrap();
    let identified = bench.run(&["identify", "throws.csv", "--by", "throw", "--json"]).succeeded();
    let found = identified.json();
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
fn a_sensor_that_is_turned_against_the_body_is_no_hindrance() {
    let bench = Bench::new();
    let turn = Rotation3::from_euler_angles(0.3, -0.5, 0.2);
    std::fs::write(bench.path("throws.csv"), throws(30, &turn)).unwrap();
    let log = ["throws.csv", "--by", "throw"];
    let identified = bench.run(&[&["identify"], &log[..], &["--method", "tensor", "--json"]].concat()).succeeded();
    let found = identified.json();
    assert!(found["findings"].to_string().contains("give these axes to an estimate"), "{found}");
    std::fs::write(bench.path("body.json"), &identified.stdout).unwrap();
    let hidden = ["--hidden", "z", "--body", "body.json"];
    let estimated = bench.run(&[&["estimate"], &log[..], &hidden, &["--json"]].concat()).succeeded().json();
    let part = estimated["score"]["part"]["median"].as_f64().unwrap();
    assert!(part < 0.02, "{part}");
    // Without its third sensor the principal rates are not known.
    let two = ["--rates", "gyro_x_dps,gyro_y_dps,-"];
    let refused = bench.run(&[&["estimate"], &log[..], &hidden, &two].concat());
    assert_eq!(refused.code, Some(2), "{refused:?}");
    assert!(refused.says("mixed-axes"), "{refused:?}");
}

#[test]
fn a_log_that_lacks_the_rate_is_estimated_without_a_score() {
    let bench = Bench::new();
    let text = throws(3, &Rotation3::identity());
    let two: String = text.lines().map(|line| line.rsplit_once(',').unwrap().0.to_owned() + "\n").collect();
    std::fs::write(bench.path("two.csv"), two).unwrap();
    let arguments =
        ["estimate", "two.csv", "--by", "throw", "--hidden", "z", "--inertia", "0.93,0.08,1", "--damping", "0.2"];
    let told = bench.run(&arguments).succeeded();
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
    assert_eq!(bench.run(&[&["estimate", "good.csv", "--hidden", "z"], &body[..]].concat()).succeeded().code, Some(0));
}

fn hash(summary: &Value) -> &Value {
    &summary["state"]["hash"]
}

/// The same motion by every clock, recorded and replayed; the hidden axis is scored against the log's own.
#[test]
fn a_leader_repeats_a_log_under_every_clock_with_the_same_bits() {
    let bench = Bench::new();
    let one = bench.summary("recorded-leader", &["--clock", "in-process", "--out", "one"]);
    assert_eq!(one["verdict"], "accepted", "{one:#}");
    let lockstep = bench.summary("recorded-leader", &["--clock", "lockstep", "--record", "--out", "lockstep"]);
    assert_eq!((hash(&lockstep), &lockstep["score"]), (hash(&one), &one["score"]));
    bench.run(&["replay", "lockstep"]).succeeded();
    let live = bench.summary("recorded-leader", &["--clock", "realtime", "--set", "accept={}", "--out", "live"]);
    let hashes = |directory: &str| std::fs::read_to_string(bench.path(directory).join("hashes.txt")).unwrap();
    let clean = live["state"]["clean_ticks"].as_u64().unwrap() as usize;
    let [expected, seen] = [hashes("one"), hashes("live")];
    let ticks = |text: &str| text.lines().skip(1).take(clean).map(str::to_owned).collect::<Vec<_>>();
    assert_eq!(ticks(&seen), ticks(&expected));
    // What was resolved names the log for good.
    let again = bench.path("one/scenario.toml");
    let again = bench.run(&["run", again.to_str().unwrap(), "--json"]);
    assert_eq!(hash(&again.json()), hash(&one), "{again:?}");
}

#[test]
fn a_log_of_ones_own_leads_and_what_it_cannot_is_refused_with_its_place() {
    let bench = Bench::new();
    std::fs::write(bench.path("throws.csv"), throws(3, &Rotation3::identity())).unwrap();
    let template = bench.run(&["init", "recorded-leader"]).succeeded().stdout;
    let scenario =
        template.replace("tumbling-throw.csv", "throws.csv").replace("at_end = \"repeat\"", "at_end = \"refuse\"");
    std::fs::create_dir(bench.path("bench")).unwrap();
    std::fs::rename(bench.path("throws.csv"), bench.path("bench/throws.csv")).unwrap();
    // A file is looked for beside the scenario that names it, wherever that is read from.
    std::fs::write(bench.path("bench/own.toml"), &scenario).unwrap();
    let base = ["run", "bench/own.toml", "--clock=in-process", "--json", "--set=accept={}"];
    let with = |more: &[&str]| bench.run(&[&base[..], more].concat());
    let segment = ["--set", "leader.playback.by=throw", "--set", "leader.playback.segment=t1"];
    let line = |key: &str| 1 + scenario.lines().position(|line| line.starts_with(key)).unwrap();
    let (data, duration) = (line("data ="), line("duration_s"));
    for (more, words) in [
        (&segment[..2], "has 3 segments; name one with leader.playback.segment, one of: t0, t1, t2".to_owned()),
        (
            &segment,
            format!("bench/own.toml:{duration}: duration_s: 1.5 s is longer than the motion of leader.data, 0.89 s"),
        ),
        (&["--set=leader.data=none.csv"], "leader.data: cannot read".to_owned()),
        (&["--set=leader.playback.rates=['a','b','c']"], format!("bench/own.toml:{data}: leader.data: ")),
        (&["--set=leader.initial_rate_rad_s=[1,2,3]"], "remove one of them".to_owned()),
        (&["--set=leader.playback.at_ned=repeat"], "did you mean `at_end`?".to_owned()),
        (&["--set=leader.playback.hash='0'"], "[log-changed]".to_owned()),
    ] {
        let more = if more.len() == 1 { [&segment[..], &["--duration=0.5"], more].concat() } else { more.to_vec() };
        let refused = with(&more);
        assert_eq!(refused.code, Some(2), "{more:?}: {refused:?}");
        assert!(refused.stderr.contains(&words), "{more:?}: {words}: {}", refused.stderr);
    }
    with(&[&segment[..], &["--duration=0.8", "--out=once"]].concat()).succeeded();
    let repeated = with(&[&segment[..], &["--set=leader.playback.at_end=repeat", "--duration=3"]].concat());
    assert_eq!((repeated.code, &repeated.json()["books"]["missed_ticks"]), (Some(0), &0.into()), "{repeated:?}");
    // Whoever changes the log is told by what was resolved before.
    let log = std::fs::read_to_string(bench.path("bench/throws.csv")).unwrap();
    std::fs::write(bench.path("bench/throws.csv"), log.replace("t1,10,", "t1,11,")).unwrap();
    let changed = bench.run(&["check", "once/scenario.toml"]);
    assert!(changed.code == Some(2) && changed.says("log-changed"), "{changed:?}");
}

/// What a run has published is a log like any other: its truth has all axes, its measurement lacks the hidden one.
#[test]
fn a_recording_of_ours_is_read_as_a_log() {
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
    assert!(several.code == Some(2) && several.stderr.contains("more than one topic may be meant"), "{several:?}");
}

#[cfg(feature = "parquet")]
#[test]
fn a_table_as_parquet_says_what_the_one_as_csv_says() {
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

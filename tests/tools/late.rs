//! `corotate why` and the report of a run with late ticks: selection, and refused input.

use crate::common::{Bench, Done, rewrite_metadata, summary_in};
use serde_json::{Value, json};
use std::fs;
use std::path::{Path, PathBuf};

/// Makes a run's directory, with the late ticks of a run in real time: `controller` at tick 755 is late by `leader`, and the
/// follower misses ticks 300 to 302.
fn run_with_late_ticks(bench: &Bench) -> PathBuf {
    let common = ["run", "rigid-pair", "--clock", "in-process", "--duration", "1", "--set", "accept={}"];
    bench.run(&[&common[..], &["--record", "--out", "run"]].concat()).succeeded();
    let directory = bench.path("run");
    write_late(&directory, &late_report(&summary_in(&directory)["run"]));
    directory
}

fn late_report(run: &Value) -> Value {
    let late = |role: &str, tick: u64, ticks: u64, kind: &str, late_us: f64, causes: Value| {
        json!({
            "role": role, "tick": tick, "ticks": ticks, "kind": kind, "time_s": tick as f64 / 1e3, "late_us": late_us,
            "causes": causes,
        })
    };
    let mut controller =
        late("controller", 755, 1, "late", 905.0, json!([{ "kind": "input", "name": "leader", "us": 900.0 }]));
    controller["caused_by"] = json!({ "role": "leader", "tick": 755 });
    let mut leader =
        late("leader", 755, 1, "late", 900.0, json!([{ "kind": "task", "name": "hog", "tid": 7, "us": 890.0 }]));
    leader["slices"] = json!([
        { "core": 0, "kind": "role", "name": "leader", "from_us": -50.0, "to_us": 2.0 },
        { "core": 0, "kind": "task", "name": "<hog>", "from_us": 2.0, "to_us": 892.0 },
        { "core": 1, "kind": "idle", "name": "idle", "from_us": -500.0, "to_us": 1400.0 },
    ]);
    json!({
        "schema": "corotate/late/v1", "run": run, "scenario": "rigid-pair", "period_us": 1000.0, "late_us": 100.0,
        "source": "kernel", "counted": 5, "examined": 5, "traced": 2,
        "ticks": [late("follower", 300, 3, "missed", 2900.0, json!([])), leader, controller],
        "causes": [
            { "cause": "late input from leader", "kind": "input", "name": "leader", "ticks": 1, "worst_us": 900.0, "sum_us": 900.0 },
            { "cause": "task \"hog\"", "kind": "task", "name": "hog", "ticks": 1, "worst_us": 890.0, "sum_us": 890.0 },
        ],
        "patterns": [{ "cause": "task \"hog\"", "period_ms": 100.0, "ticks": 2, "compared": 3, "hint": "a quota" }],
    })
}

fn write_late(directory: &Path, report: &Value) {
    fs::write(directory.join("late.json"), report.to_string()).unwrap();
}

fn why(bench: &Bench, options: &[&str]) -> Done {
    bench.run(&[&["why", "run"], options].concat())
}

/// Returns role and first tick of the late ticks that `why --json` prints.
fn printed(bench: &Bench, options: &[&str]) -> Vec<(String, u64)> {
    let done = why(bench, &[options, &["--json"]].concat()).succeeded();
    let object = done.json();
    assert_eq!(object["schema"], "corotate/why/v1");
    let ticks = object["ticks"].as_array().unwrap().iter();
    ticks.map(|late| (late["role"].as_str().unwrap().to_owned(), late["tick"].as_u64().unwrap())).collect()
}

#[test]
fn late_ticks_are_selected_by_tick_role_and_number() {
    let bench = Bench::new();
    run_with_late_ticks(&bench);
    let [follower, controller, leader] = [("follower", 300), ("controller", 755), ("leader", 755)]
        .map(|(role, tick): (&str, u64)| (role.to_owned(), tick));
    assert_eq!(printed(&bench, &[]), [follower.clone(), controller.clone(), leader.clone()]);
    assert_eq!(printed(&bench, &["-n", "1"]), std::slice::from_ref(&follower));
    assert_eq!(printed(&bench, &["--tick", "755"]), [controller, leader.clone()]);
    assert_eq!(printed(&bench, &["--tick", "302"]), [follower]);
    assert_eq!(printed(&bench, &["--role", "leader", "--tick", "755"]), [leader]);
    assert!(printed(&bench, &["--tick", "303"]).is_empty() && printed(&bench, &["--role", "observer"]).is_empty());

    let object = why(&bench, &["--json", "--tick", "755"]).json();
    assert_eq!(object["traced"], 2);
    assert_eq!((&object["counted"], &object["examined"], &object["selected"]), (&json!(5), &json!(5), &json!(2)));
    assert_eq!(object["ticks"][0]["chain"], json!([{ "role": "leader", "tick": 755 }]));
    assert_eq!(object["ticks"][1]["unknown_us"], 10.0);

    let text = why(&bench, &[]).succeeded().stdout;
    for part in ["task \"hog\" (thread 7)", "follower ticks 300 to 302", "2900.0 us  unknown", "2 of 3", "a quota"] {
        assert!(text.contains(part), "{part}: {text}");
    }
    assert!(text.lines().all(|line| line.chars().count() <= 80), "{text}");
    assert!(why(&bench, &["--tick", "303"]).succeeded().stdout.contains("303"));
}

#[test]
fn what_the_run_does_not_have_is_refused() {
    let bench = Bench::new();
    let directory = run_with_late_ticks(&bench);
    let refused = |options: &[&str], code: &str| {
        let done = why(&bench, options);
        assert!(done.code == Some(2) && done.codes() == [code] && done.stdout.is_empty(), "{code}: {done:?}");
        done.stderr
    };
    assert!(refused(&["--tick", "1001"], "out-of-range").contains("1000"));
    assert!(refused(&["--role", "x"], "unknown-role").contains("controller"));
    for options in [&["-n", "0"][..], &["-n", "-1"], &["--tick", "x"], &["--tick"]] {
        assert_eq!(why(&bench, options).code, Some(2), "{options:?}");
    }
    assert_eq!(bench.run(&["why", "nothing"]).codes(), ["no-such-run"]);
    fs::remove_file(directory.join("late.json")).unwrap();
    assert!(refused(&[], "no-late-ticks").contains("realtime"));
    fs::remove_file(directory.join("summary.json")).unwrap();
    refused(&[], "no-results");
}

#[test]
fn the_report_has_a_section_only_if_there_are_late_ticks() {
    let bench = Bench::new();
    let directory = run_with_late_ticks(&bench);
    let page = || {
        let done = bench.run(&["report", "run"]).succeeded();
        (fs::read_to_string(directory.join("report.html")).unwrap(), done.stderr)
    };
    let (html, _) = page();
    assert!(html.contains("<section id=\"late\">") && html.contains("cores around tick 755 of leader"));
    assert!(html.contains("&lt;hog&gt;") && !html.contains("<hog>"), "{html}");
    fs::remove_file(directory.join("late.json")).unwrap();
    let (html, remarks) = page();
    assert!(!html.contains("<section id=\"late\">") && !remarks.contains("late ticks"), "{remarks}");
    // A run in real time always has late.json, unless it was switched off.
    let summary = fs::read_to_string(directory.join("summary.json")).unwrap();
    fs::write(
        directory.join("summary.json"),
        summary
            .replace("\"clock\":\"in-process\"", "\"clock\":\"realtime\"")
            .replace("\"clock\": \"in-process\"", "\"clock\": \"realtime\""),
    )
    .unwrap();
    let (html, remarks) = page();
    assert!(!html.contains("<section id=\"late\">") && remarks.contains("late ticks"), "{remarks}");
}

/// A run in real time with a recording: every sample is on the axis of the late ticks.
#[test]
fn a_trace_has_late_ticks_cores_and_samples_on_one_axis() {
    let bench = Bench::new();
    let common = ["run", "rigid-pair", "--clock", "realtime", "--duration", "1", "--set", "accept={}"];
    bench.run(&[&common[..], &["--record", "--out", "run"]].concat()).succeeded();
    let directory = bench.path("run");
    write_late(&directory, &late_report(&summary_in(&directory)["run"]));
    why(&bench, &["--perfetto", "trace.json"]).succeeded();
    let trace: Value = serde_json::from_slice(&fs::read(bench.path("trace.json")).unwrap()).unwrap();
    let events = trace["traceEvents"].as_array().unwrap();
    let with = |phase: &'static str| events.iter().filter(move |event| event["ph"] == phase);
    let samples: Vec<&Value> = with("i").collect();
    // Four roles send at least one sample per tick.
    assert!(samples.len() > 4 * 800, "{}", samples.len());
    for sample in samples {
        let (at, tick) = (sample["ts"].as_f64().unwrap(), sample["args"]["tick"].as_f64().unwrap());
        assert!(at >= 1000.0 * tick && at < 1000.0 * tick + 500_000.0, "{sample}");
    }
    let late = with("X")
        .find(|event| event["args"]["about"].as_str().is_some_and(|about| about.starts_with("leader")))
        .unwrap();
    assert_eq!((&late["ts"], &late["dur"]), (&json!(755_000.0), &json!(900.0)));
    assert!(with("X").any(|event| event["name"] == "<hog>" && event["ts"] == 755_002.0 && event["dur"] == 890.0));
    let refused = why(&bench, &["--perfetto", "run/run.mcap"]);
    assert!(refused.code == Some(2) && refused.codes() == ["same-file"], "{refused:?}");
    let refused = why(&bench, &["--perfetto", "no/such/file"]);
    assert!(refused.code == Some(1) && refused.codes() == ["cannot-write"], "{refused:?}");
}

/// The file is emptied before the run, so that an older trace is not taken for that of a killed run.
#[test]
fn a_run_writes_its_trace() {
    let bench = Bench::new();
    let run = |options: &[&str]| {
        let common = ["run", "rigid-pair", "--duration", "0.5", "--set", "accept={}", "--out", "run", "--overwrite"];
        bench.run(&[&common[..], options].concat())
    };
    let done = run(&[
        "--clock",
        "realtime",
        "--set",
        "realtime.late_us=0",
        "--trace-out",
        "new/trace.json",
        "--junit",
        "verdict.xml",
    ])
    .succeeded();
    assert!(done.stderr.contains("new/trace.json: open it at https://ui.perfetto.dev"), "{done:?}");
    let trace: Value = serde_json::from_slice(&fs::read(bench.path("new/trace.json")).unwrap()).unwrap();
    let events = trace["traceEvents"].as_array().unwrap();
    let late = events.iter().filter(|event| event["args"]["about"].is_string()).count();
    assert!(late > 100, "every tick is late: {late}");
    let (verdict, summary) = (fs::read_to_string(bench.path("verdict.xml")).unwrap(), summary_in(&bench.path("run")));
    for (name, value) in [("late_ticks", &summary["late"]["counted"]), ("late_source", &summary["late"]["source"])] {
        let value = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
        assert!(verdict.contains(&format!("<property name=\"{name}\" value=\"{value}\"/>")), "{verdict}");
    }

    for options in [&["--clock", "lockstep"][..], &["--clock", "realtime", "--set", "realtime.trace=\"off\""]] {
        let refused = run(&[options, &["--trace-out", "other.json"]].concat());
        assert!(refused.code == Some(2) && refused.codes() == ["no-late-ticks"], "{refused:?}");
        assert!(!bench.path("other.json").exists());
    }
    fs::write(bench.path("taken"), "").unwrap();
    let refused = run(&["--clock", "realtime", "--trace-out", "taken/trace.json"]);
    assert!(refused.code == Some(1) && refused.codes() == ["cannot-write"], "{refused:?}");
    let refused = run(&["--clock", "realtime", "--trace-out", "run/summary.json"]);
    assert!(refused.code == Some(2) && refused.codes() == ["same-file"], "{refused:?}");
    assert_eq!(summary_in(&bench.path("run"))["clock"], "realtime", "the result is kept");
}

/// A recording that was copied to another place has the late ticks of its run, with the same causes and totals.
#[test]
fn a_recording_alone_has_the_late_ticks() {
    let bench = Bench::new();
    let common = ["run", "rigid-pair", "--clock", "realtime", "--duration", "1", "--set", "accept={}"];
    // Every tick is late, and the recording has a part of them.
    let options = ["--set", "realtime.late_us=0", "--record", "--out", "run"];
    bench.run(&[&common[..], &options].concat()).succeeded();
    fs::create_dir(bench.path("elsewhere")).unwrap();
    fs::copy(bench.path("run/run.mcap"), bench.path("elsewhere/run.mcap")).unwrap();
    let report: Value = serde_json::from_slice(&fs::read(bench.path("run/late.json")).unwrap()).unwrap();
    let late = report["ticks"].as_array().unwrap();
    assert!(late.len() > 2000, "{}", late.len());
    for source in ["elsewhere", "elsewhere/run.mcap"] {
        let object = bench.run(&["why", source, "--json", "-n", "100000"]).succeeded().json();
        for key in ["run", "scenario", "source", "note", "counted", "examined", "causes", "patterns"] {
            assert_eq!(object[key], report[key], "{key}");
        }
        let ticks = object["ticks"].as_array().unwrap();
        assert_eq!(ticks.len(), 1000);
        for tick in ticks {
            let key = |value: &Value| (value["role"].clone(), value["tick"].clone());
            let same = late.iter().find(|late| key(late) == key(tick)).unwrap();
            assert_eq!((&tick["late_us"], &tick["causes"]), (&same["late_us"], &same["causes"]));
        }
        let least = ticks.iter().map(|late| late["late_us"].as_f64().unwrap()).fold(f64::INFINITY, f64::min);
        assert!(late.iter().filter(|late| late["late_us"].as_f64().unwrap() > least).count() < 1000);
        let text = bench.run(&["why", source]).succeeded().stdout;
        assert!(text.contains("short ones left out of this file"), "{text}");
        bench.run(&["report", source, "--out", "page.html"]).succeeded();
        assert!(fs::read_to_string(bench.path("page.html")).unwrap().contains("<section id=\"late\">"));
    }
    let refused = bench.run(&["why", "elsewhere/run.mcap", "--role", "x"]);
    assert!(refused.codes() == ["unknown-role"] && refused.stderr.contains("controller"), "{refused:?}");
    bench.run(&["why", "elsewhere/run.mcap", "--perfetto", "trace.json"]).succeeded();
    let trace: Value = serde_json::from_slice(&fs::read(bench.path("trace.json")).unwrap()).unwrap();
    assert!(trace["traceEvents"].as_array().unwrap().iter().filter(|event| event["ph"] == "i").count() > 4 * 800);

    // A changed letter of the late ticks is a damage, and other commands do not read them.
    let bytes = fs::read(bench.path("run/run.mcap")).unwrap();
    let at = bytes.windows(16).position(|part| part == b"corotate/late/v1").unwrap();
    let damaged = [&bytes[..at + 9], b"L", &bytes[at + 10..]].concat();
    fs::write(bench.path("damaged.mcap"), damaged).unwrap();
    let refused = bench.run(&["why", "damaged.mcap"]);
    assert!(refused.code == Some(1) && refused.codes() == ["damaged-recording"], "{refused:?}");
    rewrite_metadata(&bench.path("run/run.mcap"), &bench.path("other.mcap"), |name, entries| {
        if name == "corotate.late" {
            entries.insert("report".to_owned(), "{}".to_owned());
        }
    });
    bench.run(&["diff", "run/run.mcap", "other.mcap"]).succeeded();
    let refused = bench.run(&["why", "other.mcap"]);
    assert!(refused.code == Some(2) && refused.codes() == ["unreadable-late-ticks"], "{refused:?}");
}

#[test]
fn a_damaged_file_is_named() {
    let bench = Bench::new();
    let directory = run_with_late_ticks(&bench);
    let file = directory.join("late.json");
    let text = fs::read_to_string(&file).unwrap();
    let mut damaged = vec![b"\xff\0".to_vec(), b"[]".to_vec(), text.replace("late/v1", "late/v9").into_bytes()];
    damaged.push(text.replace("900.0", "1e999").into_bytes());
    damaged.extend((0..text.len()).step_by(331).map(|end| text.as_bytes()[..end].to_vec()));
    for bytes in damaged {
        fs::write(&file, &bytes).unwrap();
        for command in ["why", "report"] {
            let done = bench.run(&[command, "run"]);
            assert!(done.code == Some(2) && done.codes() == ["unreadable-late-ticks"], "{done:?}");
            assert!(done.stderr.contains("late.json"), "{done:?}");
        }
    }
    write_late(&directory, &late_report(&json!("0123456789abcdef0123456789abcdef")));
    for command in ["why", "report"] {
        let done = bench.run(&[command, "run"]);
        assert!(done.code == Some(2) && done.codes() == ["two-runs"], "{done:?}");
    }
}

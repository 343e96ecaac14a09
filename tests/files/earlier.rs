//! Files of earlier versions, as `tests/files/VERSION` keeps them. docs/formats.md promises that they are read.
//!
//! `run` is a loop with faults and a change of an input in lockstep, `realtime` one with late ticks, `campaign` three cases and a
//! margin. They are never made again: a new version adds a directory of its own.

use crate::common::{Bench, root, summary_in};
use corotate::record::Recording;
use serde_json::Value;
use std::fs;
use std::path::Path;

/// The directories of files, with the version that wrote them.
const VERSIONS: [(&str, &str); 1] = [("0.1", "0.1.0")];

/// Copies a version's files to a bench, because commands write beside what they read.
fn copy(version: &str) -> Bench {
    let bench = Bench::new();
    for directory in ["run", "realtime", "campaign"] {
        fs::create_dir(bench.path(directory)).unwrap();
        for entry in fs::read_dir(root().join("tests/files").join(version).join(directory)).unwrap() {
            let entry = entry.unwrap();
            fs::copy(entry.path(), bench.path(directory).join(entry.file_name())).unwrap();
        }
    }
    bench
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

#[test]
fn recordings_are_read_replayed_compared_and_exported() {
    for (directory, version) in VERSIONS {
        let bench = copy(directory);
        for run in ["run", "realtime"] {
            let recording = Recording::open(&bench.path(run).join("run.mcap")).unwrap();
            recording.require_whole().unwrap();
            let (info, summary) = (recording.info(), bench.summary_in(run));
            assert_eq!((info.version.as_str(), &summary["version"]), (version, &Value::from(version)));
            assert_eq!(info.run.unwrap().to_string(), summary["run"].as_str().unwrap());
            assert!(recording.signals().len() >= 5 && recording.signals().iter().all(|signal| signal.samples > 90));
            assert!(recording.signals().iter().any(|signal| signal.signal == "estimate"));
            let replayed = bench.run(&["replay", run, "--json"]).succeeded();
            let (same, all) = replayed.roles_replayed();
            assert!(same == all && all >= 3, "{run}: {replayed:?}");
            let compared = bench.run(&["diff", run, &format!("{run}/run.mcap"), "--json"]).succeeded();
            assert_eq!(compared.json()["same"], true, "{compared:?}");
            let exported = bench.run(&["export", run, "--csv", &format!("{run}/tables"), "--json"]).succeeded();
            let tables = exported.json()["tables"].as_array().unwrap().clone();
            assert_eq!(tables.len(), recording.signals().len(), "{exported:?}");
        }
        let late = Recording::open(&bench.path("realtime/run.mcap")).unwrap().late_ticks().unwrap().unwrap();
        assert_eq!(late.ticks.len() as u64, json(&bench.path("realtime/late.json"))["examined"]);
    }
}

#[test]
fn results_become_reports_with_their_late_ticks() {
    for (directory, _) in VERSIONS {
        let bench = copy(directory);
        for run in ["run", "realtime", "campaign"] {
            bench.run(&["report", run]).succeeded();
        }
        for run in ["run", "realtime"] {
            let page = fs::read_to_string(bench.path(run).join("report.html")).unwrap();
            assert!(page.contains(bench.summary_in(run)["run"].as_str().unwrap()));
        }
        bench.run(&["report", "realtime", "run"]).succeeded();
        let examined = json(&bench.path("realtime/late.json"))["examined"].clone();
        let why = bench.run(&["why", "realtime", "--json"]).succeeded().json();
        assert!(why["selected"] == examined && examined.as_u64() > Some(0), "{why}");
    }
}

/// A scenario gives the same bits. A version that changes them on purpose is listed in CHANGELOG.md and here.
#[test]
fn scenarios_give_the_same_bits() {
    for (directory, _) in VERSIONS {
        let bench = copy(directory);
        for run in ["run", "realtime"] {
            let scenario = format!("{run}/scenario.toml");
            bench.run(&["check", &scenario]).succeeded();
            bench.run(&["run", &scenario, "--clock", "in-process", "--out", "again"]).succeeded();
            let (earlier, again) = (summary_in(&bench.path(run)), bench.summary_in("again"));
            assert_eq!(earlier["state"]["hash"], again["state"]["hash"], "{scenario}");
            fs::remove_dir_all(bench.path("again")).unwrap();
        }
    }
}

#[test]
fn campaigns_are_read_but_continued_only_by_the_program_that_began_them() {
    for (directory, _) in VERSIONS {
        let bench = copy(directory);
        let journal = || fs::read(bench.path("campaign/journal")).unwrap();
        let before = journal();
        let continued = bench.run(&["sweep", "campaign/campaign.toml", "--out", "campaign"]);
        assert!(continued.code == Some(2) && continued.says("other-campaign"), "{continued:?}");
        assert_eq!(journal(), before);
        // The same cases have the same results.
        let again = bench.run(&["sweep", "campaign/campaign.toml", "--out", "again", "--json"]).succeeded().json();
        let earlier = json(&bench.path("campaign/summary.json"));
        for key in ["schema", "identity", "counts", "margins"] {
            assert_eq!(again[key], earlier[key], "{key}");
        }
    }
}

//! The verdict as JUnit XML, read by a parser that is not the writer's: it says what the exit code says, with value and
//! limit, and is never empty nor older than the run.

use crate::common::{Bench, Done, Running, send_signal, shipped};
use libc::{SIGINT, SIGKILL};
use roxmltree::{Document, Node};

fn run_for_verdict(bench: &Bench, arguments: &[&str]) -> Done {
    bench.run(&[&["run", shipped("rigid-pair").to_str().unwrap(), "--junit", "verdict.xml"], arguments].concat())
}

fn verdict(bench: &Bench) -> String {
    std::fs::read_to_string(bench.path("verdict.xml")).unwrap()
}

/// The one suite of a file, whose counts must be those of its cases.
fn suite<'a>(document: &'a Document<'_>) -> Node<'a, 'a> {
    let root = document.root_element();
    let suites: Vec<Node<'_, '_>> = root.children().filter(Node::is_element).collect();
    assert_eq!((root.tag_name().name(), suites.len()), ("testsuites", 1));
    for (count, element) in
        [("failures", "failure"), ("errors", "error"), ("skipped", "skipped"), ("tests", "testcase")]
    {
        let there = suites[0].descendants().filter(|node| node.has_tag_name(element)).count().to_string();
        assert_eq!(suites[0].attribute(count), Some(&*there), "{count}");
        assert_eq!(root.attribute(count), Some(&*there), "{count}");
    }
    suites[0]
}

/// What is not well: case, element, message.
fn troubles(suite: Node<'_, '_>) -> Vec<(String, String, String)> {
    let text = |node: Node<'_, '_>, name: &str| node.attribute(name).unwrap().to_owned();
    let cases = suite.children().filter(|node| node.has_tag_name("testcase"));
    let trouble = |case: Node<'_, '_>| {
        let trouble = case.first_element_child()?;
        Some((text(case, "name"), trouble.tag_name().name().to_owned(), text(trouble, "message")))
    };
    cases.filter_map(trouble).collect()
}

#[test]
fn an_accepted_run_has_a_case_per_criterion_and_none_that_fails() {
    for clock in ["in-process", "lockstep"] {
        let bench = Bench::new();
        run_for_verdict(&bench, &["--clock", clock, "--set", "accept.missed_ticks_max=0"]).succeeded();
        let text = verdict(&bench);
        let document = Document::parse(&text).unwrap();
        let suite = suite(&document);
        assert_eq!(suite.attribute("name"), Some("rigid-pair"));
        let cases = suite.children().filter(|node| node.has_tag_name("testcase"));
        let names: Vec<&str> = cases.map(|case| case.attribute("name").unwrap()).collect();
        let metrics = ["estimate_error_rad_s_max", "sync_error_rad_s_max"];
        let criteria = [&metrics[..], &["missed_ticks_max", "starved_ticks_max", "safe_ticks_max"]].concat();
        assert_eq!(names, [&["run", "books"][..], &criteria].concat());
        assert_eq!(troubles(suite), []);
        let property = suite.descendants().find(|node| node.attribute("name") == Some("clock")).unwrap();
        assert_eq!(property.attribute("value"), Some(clock));
    }
}

#[test]
fn a_criterion_that_does_not_hold_is_a_failure_with_value_and_limit() {
    let bench = Bench::new();
    let short = ["--clock", "in-process", "--duration", "1", "--set", "accept.settled_by_s=0.5"];
    let done = run_for_verdict(&bench, &[&short[..], &["--set", "accept.step_latency_p99_us_max=50"]].concat());
    assert_eq!(done.code, Some(3), "{done:?}");
    let text = verdict(&bench);
    let document = Document::parse(&text).unwrap();
    let troubles = troubles(suite(&document));
    let [estimate, sync, latency] = &troubles[..] else { panic!("{troubles:?}") };
    for (trouble, name) in [(estimate, "estimate_error_rad_s_max"), (sync, "sync_error_rad_s_max")] {
        assert_eq!((trouble.0.as_str(), trouble.1.as_str()), (name, "failure"));
        let (value, limit) = trouble.2.split_once(" is above the limit ").unwrap();
        assert!(value.parse::<f64>().unwrap() > 1e-6 && limit == "1e-6", "{trouble:?}");
    }
    assert_eq!(
        (latency.0.as_str(), latency.1.as_str()),
        ("step_latency_p99_us_max", "skipped"),
        "no clock, no latency"
    );
}

/// Whatever keeps a run from its end is an error in the file, even where a verdict of an older run lay.
#[test]
fn a_run_without_an_end_is_an_error() {
    let bench = Bench::new();
    assert_eq!(run_for_verdict(&bench, &["--clock", "in-process"]).code, Some(0));
    for (arguments, code, reason) in [
        (&["--set", "tick_herz=1"][..], 2, "did you mean"),
        (&["--external", "nosuch"], 2, "no such role"),
        (&["--clock", "in-process", "--out", "/dev/null/x"], 1, "name another directory with --out"),
        (&["--clock", "realtime", "--set", "realtime.cores=[1023]"], 2, "core 1023"),
    ] {
        let done = run_for_verdict(&bench, arguments);
        assert_eq!(done.code, Some(code), "{done:?}");
        let text = verdict(&bench);
        let document = Document::parse(&text).unwrap();
        let troubles = troubles(suite(&document));
        assert_eq!(troubles.len(), 1, "{troubles:?}");
        assert_eq!((troubles[0].0.as_str(), troubles[0].1.as_str()), ("run", "error"));
        assert!(troubles[0].2.contains(reason) && done.stderr.contains(reason), "{troubles:?} {done:?}");
    }
    bench.assert_clean(&[]);
}

#[test]
fn a_run_that_was_cut_short_is_an_error() {
    type Cut = fn(&Bench, &Running);
    let cuts: [(Cut, Option<i32>, &str); 3] = [
        (|_, running| running.signal(SIGINT), Some(128 + SIGINT), "ended by signal 2"),
        (|bench, _| send_signal(bench.await_role("observer"), SIGKILL), Some(4), "observer died at tick"),
        (|_, running| running.signal(SIGKILL), None, "did not come to an end"),
    ];
    for (cut, code, reason) in cuts {
        let bench = Bench::new();
        let stop = ["--clock", "lockstep", "--junit", "verdict.xml", "--set", "supervision.on_failure=stop"];
        let running = bench.start_endless(&stop);
        let domains = bench.domains();
        cut(&bench, &running);
        let done = running.wait();
        assert_eq!(done.code, code, "{done:?}");
        let text = verdict(&bench);
        let document = Document::parse(&text).unwrap();
        let troubles = troubles(suite(&document));
        assert!(troubles[0].1 == "error" && troubles[0].2.contains(reason), "{troubles:?}");
        bench.assert_clean(&domains);
    }
}

#[test]
fn a_file_that_cannot_be_written_is_told_before_anything_runs() {
    let bench = Bench::new();
    std::fs::write(bench.path("taken"), "").unwrap();
    let file = shipped("rigid-pair");
    let done = bench.run(&["run", file.to_str().unwrap(), "--clock", "in-process", "--junit", "taken/verdict.xml"]);
    assert_eq!(done.code, Some(1), "{done:?}");
    assert!(done.stderr.contains("taken/verdict.xml") && done.stderr.contains("with --junit"), "{done:?}");
    assert!(!bench.path("runs").exists(), "nothing was run");

    bench.run(&["run", file.to_str().unwrap(), "--clock", "in-process", "--junit", "new/verdict.xml"]).succeeded();
    assert!(bench.path("new/verdict.xml").is_file());
}

//! The verdict as JUnit XML, read by an independent parser: it agrees with the exit code, has value and limit of each
//! failure, and is never empty or older than the run.

use crate::common::{Bench, Done, Running, send_signal, shipped};
use libc::{SIGINT, SIGKILL};
use roxmltree::{Document, Node};

fn run_for_verdict(bench: &Bench, arguments: &[&str]) -> Done {
    bench.run(&[&["run", shipped("rigid-pair").to_str().unwrap(), "--junit", "verdict.xml"], arguments].concat())
}

fn verdict(bench: &Bench) -> String {
    std::fs::read_to_string(bench.path("verdict.xml")).unwrap()
}

/// Returns the only suite of a file, after checking its counts against its cases.
fn suite<'a>(document: &'a Document<'_>) -> Node<'a, 'a> {
    let root = document.root_element();
    let suites: Vec<Node<'_, '_>> = root.children().filter(Node::is_element).collect();
    assert_eq!((root.tag_name().name(), suites.len()), ("testsuites", 1));
    for (count, element) in
        [("failures", "failure"), ("errors", "error"), ("skipped", "skipped"), ("tests", "testcase")]
    {
        let expected = suites[0].descendants().filter(|node| node.has_tag_name(element)).count().to_string();
        assert_eq!(suites[0].attribute(count), Some(&*expected), "{count}");
        assert_eq!(root.attribute(count), Some(&*expected), "{count}");
    }
    suites[0]
}

/// Returns case, element and message of every case that did not pass.
fn problems(suite: Node<'_, '_>) -> Vec<(String, String, String)> {
    let text = |node: Node<'_, '_>, name: &str| node.attribute(name).unwrap().to_owned();
    let cases = suite.children().filter(|node| node.has_tag_name("testcase"));
    let problem = |case: Node<'_, '_>| {
        let element = case.first_element_child()?;
        Some((text(case, "name"), element.tag_name().name().to_owned(), text(element, "message")))
    };
    cases.filter_map(problem).collect()
}

#[test]
fn an_accepted_run_has_a_passed_case_per_criterion() {
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
        assert_eq!(problems(suite), []);
        let property = suite.descendants().find(|node| node.attribute("name") == Some("clock")).unwrap();
        assert_eq!(property.attribute("value"), Some(clock));
    }
}

#[test]
fn an_exceeded_limit_is_a_failure_with_value_and_limit() {
    let bench = Bench::new();
    let short = ["--clock", "in-process", "--duration", "1", "--set", "accept.settled_by_s=0.5"];
    let done = run_for_verdict(&bench, &[&short[..], &["--set", "accept.step_latency_p99_us_max=50"]].concat());
    assert_eq!(done.code, Some(3), "{done:?}");
    let text = verdict(&bench);
    let document = Document::parse(&text).unwrap();
    let problems = problems(suite(&document));
    let [estimate, sync, latency] = &problems[..] else { panic!("{problems:?}") };
    for (problem, name) in [(estimate, "estimate_error_rad_s_max"), (sync, "sync_error_rad_s_max")] {
        assert_eq!((problem.0.as_str(), problem.1.as_str()), (name, "failure"));
        let (value, limit) = (problem.2.split(' ').next().unwrap(), problem.2.rsplit(' ').next().unwrap());
        assert!(value.parse::<f64>().unwrap() > 1e-6 && limit == "1e-6", "{problem:?}");
    }
    assert_eq!(
        (latency.0.as_str(), latency.1.as_str()),
        ("step_latency_p99_us_max", "skipped"),
        "an in-process run has no latency"
    );
}

#[test]
fn a_run_that_does_not_start_replaces_the_old_verdict_by_an_error() {
    let bench = Bench::new();
    assert_eq!(run_for_verdict(&bench, &["--clock", "in-process"]).code, Some(0));
    for (arguments, code, reason) in [
        (&["--set", "tick_herz=1"][..], 2, "tick_herz"),
        (&["--external", "nosuch"], 2, "nosuch"),
        (&["--clock", "in-process", "--out", "/dev/null/x"], 1, "--out"),
        (&["--clock", "realtime", "--set", "realtime.cores=[1023]"], 2, "1023"),
    ] {
        let done = run_for_verdict(&bench, arguments);
        assert_eq!(done.code, Some(code), "{done:?}");
        let text = verdict(&bench);
        let document = Document::parse(&text).unwrap();
        let problems = problems(suite(&document));
        assert_eq!(problems.len(), 1, "{problems:?}");
        assert_eq!((problems[0].0.as_str(), problems[0].1.as_str()), ("run", "error"));
        assert!(problems[0].2.contains(reason) && done.stderr.contains(reason), "{problems:?} {done:?}");
    }
    bench.assert_clean(&[]);
}

#[test]
fn an_interrupted_run_is_an_error() {
    type Interrupt = fn(&Bench, &Running);
    let interrupts: [(Interrupt, Option<i32>, &str); 3] = [
        (|_, running| running.signal(SIGINT), Some(128 + SIGINT), "signal 2"),
        (|bench, _| send_signal(bench.await_role("observer"), SIGKILL), Some(4), "observer"),
        (|_, running| running.signal(SIGKILL), None, ""),
    ];
    for (interrupt, code, reason) in interrupts {
        let bench = Bench::new();
        let stop = ["--clock", "lockstep", "--junit", "verdict.xml", "--set", "supervision.on_failure=stop"];
        let running = bench.start_endless(&stop);
        let domains = bench.domains();
        interrupt(&bench, &running);
        let done = running.wait();
        assert_eq!(done.code, code, "{done:?}");
        let text = verdict(&bench);
        let document = Document::parse(&text).unwrap();
        let problems = problems(suite(&document));
        assert!(problems[0].1 == "error" && problems[0].2.contains(reason), "{problems:?}");
        bench.assert_clean(&domains);
    }
}

#[test]
fn an_unwritable_verdict_file_is_refused_before_the_run() {
    let bench = Bench::new();
    std::fs::write(bench.path("taken"), "").unwrap();
    let file = shipped("rigid-pair");
    let done = bench.run(&["run", file.to_str().unwrap(), "--clock", "in-process", "--junit", "taken/verdict.xml"]);
    assert_eq!(done.code, Some(1), "{done:?}");
    assert!(done.stderr.contains("taken/verdict.xml") && done.stderr.contains("--junit"), "{done:?}");
    assert!(!bench.path("runs").exists(), "nothing was run");

    bench.run(&["run", file.to_str().unwrap(), "--clock", "in-process", "--junit", "new/verdict.xml"]).succeeded();
    assert!(bench.path("new/verdict.xml").is_file());
}

//! Reports of real runs: complete, well-formed, without references to other files, equal to the summary; and refused input.

use crate::common::{self, Bench, Done, shipped, summary_in};
use corotate::bus::memory::MemoryBus;
use corotate::bus::{Bus, Signal, Write};
use corotate::record::Recorder;
use corotate::scenario::Scenario;
use roxmltree::{Document, Node, ParsingOptions};
use serde_json::Value;
use std::borrow::Cow;
use std::path::{Path, PathBuf};

/// Runs a shipped scenario in one thread with a recording.
fn run_recorded(bench: &Bench, scenario: &str, options: &[&str]) -> PathBuf {
    let file = shipped(scenario);
    let common = ["run", file.to_str().unwrap(), "--clock", "in-process", "--record", "--overwrite", "--out", scenario];
    let done = bench.run(&[&common, options].concat());
    assert!(matches!(done.code, Some(0 | 3)), "{done:?}");
    bench.path(scenario)
}

fn report(bench: &Bench, source: &Path, options: &[&str]) -> Done {
    bench.run(&[&["report", source.to_str().unwrap()], options].concat())
}

/// Writes a report, which must succeed, and returns the page.
pub(super) fn page(bench: &Bench, source: &Path) -> String {
    let done = report(bench, source, &["--out", "page.html"]);
    assert_eq!((done.code, done.stdout.as_str()), (Some(0), "page.html\n"), "{done:?}");
    std::fs::read_to_string(bench.path("page.html")).unwrap()
}

pub(super) fn parse(html: &str) -> Document<'_> {
    Document::parse_with_options(html, ParsingOptions { allow_dtd: true, ..ParsingOptions::default() }).unwrap()
}

pub(super) fn sections<'a>(page: &'a Document<'_>) -> Vec<&'a str> {
    let sections = page.descendants().filter(|node| node.has_tag_name("section"));
    sections.map(|node| node.attribute("id").unwrap()).collect()
}

pub(super) fn section<'a, 'i>(page: &'a Document<'i>, id: &str) -> Node<'a, 'i> {
    page.descendants().find(|node| node.has_tag_name("section") && node.attribute("id") == Some(id)).unwrap()
}

fn text(node: Node<'_, '_>) -> String {
    node.descendants().filter(|node| node.is_text()).filter_map(|node| node.text()).collect()
}

/// Returns the cells of all tables of a section, by row.
pub(super) fn rows(section: Node<'_, '_>) -> Vec<Vec<String>> {
    let rows = section.descendants().filter(|node| node.has_tag_name("tr"));
    rows.map(|row| row.children().filter(Node::is_element).map(text).collect()).collect()
}

/// Asserts that the page refers to no other file, and that every figure has a path and a label.
pub(super) fn check_page(html: &str) {
    for outside in ["http:", "https:", "//", "@import", "url("] {
        assert!(!html.contains(outside), "{outside}");
    }
    for not_drawn in ["NaN", "inf"] {
        assert!(!html.contains(&format!("\"{not_drawn}")) && !html.contains(&format!(" {not_drawn}\"")), "{not_drawn}");
    }
    let page = parse(html);
    assert_eq!(page.descendants().filter(|node| node.has_tag_name("script")).count(), 1);
    for node in page.descendants().filter(|node| node.has_tag_name("a") || node.has_tag_name("use")) {
        let target = node.attribute("href").unwrap().strip_prefix('#').unwrap();
        assert!(page.descendants().any(|node| node.attribute("id") == Some(target)), "{target}");
    }
    for figure in page.descendants().filter(|node| node.has_tag_name("figure")) {
        let drawn = figure.descendants().filter(|node| node.has_tag_name("path"));
        assert!(drawn.filter_map(|path| path.attribute("d")).any(|path| path.len() > 12), "{}", text(figure));
        assert!(
            !figure
                .descendants()
                .find(|node| node.has_tag_name("svg"))
                .unwrap()
                .attribute("aria-label")
                .unwrap()
                .is_empty()
        );
    }
}

/// Asserts that the verdict shows the values of summary.json with three digits.
fn check_verdict(page: &Document<'_>, summary: &Value) {
    let shown = rows(section(page, "verdict"));
    let criteria = summary["criteria"].as_array().unwrap();
    assert_eq!(shown.len(), criteria.len() + 1, "a head, and a row for each criterion");
    for (row, criterion) in shown[1..].iter().zip(criteria) {
        assert_eq!(row[0], criterion["name"].as_str().unwrap());
        // A count is a whole number.
        let value = criterion["value"].as_f64().unwrap();
        let digits = if value.fract() == 0.0 { format!("{value}") } else { format!("{value:.2e}") };
        assert_eq!(row[1], digits, "{row:?}");
        assert_eq!(row[2].parse::<f64>().unwrap(), criterion["limit"].as_f64().unwrap());
        assert_eq!(row[3].contains("holds"), criterion["holds"].as_bool().unwrap());
    }
    let heading = text(page.descendants().find(|node| node.has_tag_name("h1")).unwrap());
    assert_eq!(heading.contains("not accepted"), summary["accepted"] == false, "{heading}");
}

/// Copies a recording with another name for a layout.
fn relabel(from: &Path, to: &Path, old: &str, new: &str) {
    let bytes = std::fs::read(from).unwrap();
    let options = mcap::WriteOptions::new().compression(Some(mcap::Compression::Lz4));
    let mut writer = options.create(std::io::BufWriter::new(std::fs::File::create(to).unwrap())).unwrap();
    for index in &mcap::Summary::read(&bytes).unwrap().unwrap().metadata_indexes {
        writer.write_metadata(&mcap::read::metadata(&bytes, index).unwrap()).unwrap();
    }
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let mut message = message.unwrap();
        let mut channel = (*message.channel).clone();
        let mut schema = (**channel.schema.as_ref().unwrap()).clone();
        schema.data = Cow::Owned(String::from_utf8_lossy(&schema.data).replace(old, new).into_bytes());
        channel.schema = Some(schema.into());
        message.channel = channel.into();
        writer.write(&message).unwrap();
    }
    writer.finish().unwrap();
}

#[test]
fn the_report_of_rigid_bodies_has_all_sections() {
    let bench = Bench::new();
    let directory = run_recorded(&bench, "rigid-pair", &[]);
    let html = page(&bench, &directory);
    check_page(&html);
    assert!(!html.contains("njected fault"), "the scenario has none");
    let (page, summary) = (parse(&html), summary_in(&directory));
    let expected = ["verdict", "motion", "errors", "lyapunov", "lateness", "events", "books", "certificate", "machine"];
    assert_eq!(sections(&page), expected);
    check_verdict(&page, &summary);
    // The metrics recomputed from the recording are those of the summary.
    let metrics = rows(section(&page, "errors"));
    for (row, metric) in metrics[1..].iter().zip(summary["score"]["metrics"].as_array().unwrap()) {
        assert_eq!(row[0], metric["name"].as_str().unwrap());
        for (cell, key) in [(1, "last"), (2, "last"), (3, "settled_max"), (4, "settled_max"), (5, "peak")] {
            assert_eq!(row[cell], format!("{:.4e}", metric[key].as_f64().unwrap()), "{row:?} {key}");
        }
    }
    let motion = text(section(&page, "motion"));
    assert!(motion.contains("10001 ticks are drawn in columns of 8"), "{motion}");
    assert!(text(section(&page, "errors")).contains("loop: exp(−4.0"));
    assert!(text(section(&page, "books")).contains("The counters balance."));
}

#[test]
fn an_orbit_is_drawn_with_its_full_state_motion() {
    let bench = Bench::new();
    let directory = run_recorded(&bench, "orbit-hold", &[]);
    let html = page(&bench, &directory);
    check_page(&html);
    let page = parse(&html);
    check_verdict(&page, &summary_in(&directory));
    let motion = section(&page, "motion");
    let labels: Vec<String> =
        motion.descendants().filter_map(|node| node.attribute("aria-label")).map(str::to_owned).collect();
    for picture in ["motion in the plane", "r, du", "Vr, du/s", "Vθ, du/s", "Ur, du/s²", "Uθ, du/s²"] {
        assert!(labels.iter().any(|label| label.starts_with(picture)), "{picture}: {labels:?}");
    }
    // Full state in black, observer in blue: two paths from the same point.
    let plane = motion.descendants().find(|node| node.has_tag_name("svg")).unwrap();
    let path = |class: &str| {
        let drawn =
            |node: &Node<'_, '_>| node.attribute("class") == Some(class) && node.attribute("d").unwrap().len() > 99;
        plane.descendants().find(drawn).unwrap().attribute("d").unwrap()
    };
    let (full, observed) = (path("line k d0"), path("line b d1"));
    assert_eq!(full.split('L').next(), observed.split('L').next());
    assert_ne!(full, observed);
}

#[test]
fn faults_and_incidents_are_marked_on_every_time_axis() {
    let bench = Bench::new();
    let kill = r#"fault.0={kind="kill",role="observer",from_tick=5000}"#;
    let directory = run_recorded(&bench, "faults", &["--set", kill]);
    let html = page(&bench, &directory);
    check_page(&html);
    let (page, summary) = (parse(&html), summary_in(&directory));
    check_verdict(&page, &summary);
    let by_id = |id: &str| page.descendants().find(|node| node.attribute("id") == Some(id)).unwrap();
    let marks = by_id("marks-half");
    let marked = |class: &str| marks.descendants().filter(|node| node.attribute("class") == Some(class)).count();
    assert_eq!((marked("fault"), marked("incident")), (12, 1));
    assert_eq!(by_id("names-half").descendants().filter(|node| node.attribute("class") == Some("flag")).count(), 1);
    // Above a figure of full width every mark has a name, and the names do not overlap.
    let names: Vec<Node<'_, '_>> = by_id("names-whole").children().collect();
    let words: Vec<String> = names.iter().map(|node| text(*node)).collect();
    assert!(names.len() == 13 && words.contains(&"▾ observer restarted".to_owned()), "{words:?}");
    let number = |node: &Node<'_, '_>, name: &str| node.attribute(name).unwrap().parse::<f64>().unwrap();
    for (index, right) in names.iter().enumerate() {
        for left in &names[..index] {
            let length = 5.0 * text(*left).chars().count() as f64;
            let apart = number(right, "y") != number(left, "y") || number(left, "x") + length < number(right, "x");
            assert!(apart, "{} and {}", text(*left), text(*right));
        }
    }
    assert_eq!(summary["incidents"].as_array().unwrap().len(), 1);
    let missing = marks.descendants().find(|node| node.attribute("class") == Some("missing")).unwrap();
    assert!(missing.attribute("d").unwrap().contains('M'), "ticks without a sample");
    let over_time =
        |node: &Node<'_, '_>| node.attribute("aria-label").is_some_and(|label| label.ends_with("over time"));
    for picture in page.descendants().filter(over_time) {
        assert!(picture.descendants().any(|node| node.attribute("href").is_some_and(|id| id.starts_with("#marks-"))));
    }
    let events = rows(section(&page, "events"));
    assert!(events.iter().any(|row| row[3..] == ["noise-burst", "observer"]), "{events:?}");
    assert!(html.contains("numbered band: injected fault") && html.contains("injected faults acted"));
    assert!(events.iter().any(|row| row[1] == "observer" && row[3] == "restarted"), "{events:?}");
}

#[test]
fn degraded_estimates_are_marked_on_every_time_axis() {
    let bench = Bench::new();
    let directory = run_recorded(&bench, "gyro-loss", &[]);
    let html = page(&bench, &directory);
    check_page(&html);
    let (document, summary) = (parse(&html), summary_in(&directory));
    let marks = document.descendants().find(|node| node.attribute("id") == Some("marks-half")).unwrap();
    let bands = marks.descendants().filter(|node| node.attribute("class") == Some("unseen"));
    let widths: Vec<f64> = bands.map(|band| band.attribute("width").unwrap().parse().unwrap()).collect();
    // The loss of the axis takes a quarter of the time; at a single tick the motion does not determine the estimate.
    assert!(widths.len() == 2 && widths.iter().any(|width| (130.0..150.0).contains(width)), "{widths:?}");
    assert!(html.contains("grey band: degraded estimate"));
    let lost = summary["score"]["statuses"]["leader/estimate"]["axis_lost"].as_u64().unwrap().to_string();
    let events = rows(section(&document, "events"));
    assert!(events.iter().any(|row| row[..2] == ["axis_lost".to_owned(), lost.clone()]), "{lost}: {events:?}");
    // A run without degraded estimates has neither bands nor legend.
    let intact = Bench::new();
    let whole = page(&intact, &run_recorded(&intact, "rigid-pair", &["--duration", "2", "--set", "accept={}"]));
    assert!(!whole.contains("class=\"unseen\"") && !whole.contains("rey band"));
}

#[test]
fn every_shipped_scenario_has_a_report() {
    for (scenario, _) in corotate::config::SHIPPED {
        let bench = Bench::new();
        let plain = ["accept={}", "fault=[]", "watchdog={}"].map(|table| ["--set", table]).concat();
        let directory = run_recorded(&bench, scenario, &[&["--duration", "0.3"], plain.as_slice()].concat());
        let html = page(&bench, &directory);
        check_page(&html);
        let page = parse(&html);
        assert!(section(&page, "motion").descendants().any(|node| node.has_tag_name("figure")), "{scenario}");
        assert!(text(section(&page, "events")).ends_with("all roles: 0.\n"), "{scenario}");
    }
}

#[test]
fn latencies_are_drawn_from_the_run_histograms() {
    let bench = Bench::new();
    let file = shipped("rigid-pair");
    let options = ["--tick-hz", "200", "--duration", "1", "--set", "accept={}", "--record", "--out", "out"];
    bench.run(&[&["run", file.to_str().unwrap()][..], &options].concat()).succeeded();
    let html = page(&bench, &bench.path("out"));
    check_page(&html);
    let (page, summary) = (parse(&html), summary_in(&bench.path("out")));
    let latency = section(&page, "latency");
    let shown = latency.descendants().filter(|node| node.has_tag_name("figure")).count();
    assert!(shown >= 4, "lateness, hop, step, age: {shown}");
    assert!(text(latency).contains("baseline"));
    let table = rows(latency);
    assert_eq!(table.len(), summary["latencies"].as_array().unwrap().len() + 1);
    for (row, stage) in table[1..].iter().zip(summary["latencies"].as_array().unwrap()) {
        assert_eq!(row[2], stage["count"].to_string());
        assert_eq!(row[3], stage["missed"].to_string());
        assert_eq!(row[7], format!("{:.2}", stage["max_us"].as_f64().unwrap()));
    }
    // A row for every role.
    let strip = text(section(&page, "lateness"));
    assert!(["leader", "follower", "observer", "controller"].iter().all(|role| strip.contains(role)), "{strip}");
    let broken = bench.path("out/latency/leader.step.hgrm");
    std::fs::write(&broken, "Value\n\n1.0 oops\n").unwrap();
    let done = report(&bench, &bench.path("out"), &[]);
    assert!(done.code == Some(2) && done.says("unreadable-latency"), "{done:?}");
    assert!(["leader.step.hgrm", " 3:"].iter().all(|place| done.stderr.contains(place)), "{done:?}");
}

/// Returns every file under a directory.
fn files(directory: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(directory).unwrap().map(|entry| entry.unwrap().path());
    entries.flat_map(|path| if path.is_dir() { files(&path) } else { vec![path] }).collect()
}

fn run_id(directory: &Path) -> String {
    summary_in(directory)["run"].as_str().unwrap().to_owned()
}

/// Runs for half a second in real time, which writes every kind of file.
fn realtime(bench: &Bench, out: &str, options: &[&str]) -> Done {
    let file = shipped("rigid-pair");
    let common = ["run", file.to_str().unwrap(), "--tick-hz", "200", "--duration", "0.5", "--set", "accept={}"];
    bench.run(&[&common[..], &["--out", out], options].concat())
}

/// Each file names its run, and the next run into the directory removes the files of the previous one.
#[test]
fn a_directory_holds_one_run_whose_files_name_it() {
    let bench = Bench::new();
    let out = bench.path("out");
    let verdict = out.join("verdict.xml");
    realtime(&bench, "out", &["--record", "--junit", verdict.to_str().unwrap()]).succeeded();
    assert_eq!(report(&bench, &out, &[]).code, Some(0));
    let first = run_id(&out);
    let names = |run: &str| {
        let mut files = files(&out);
        files.sort();
        for file in &files {
            let bytes = std::fs::read(file).unwrap();
            assert!(bytes.windows(32).any(|window| window == run.as_bytes()), "{} names its run", file.display());
        }
        files
    };
    let found = names(&first);
    for name in ["summary.json", "scenario.toml", "hashes.txt", "run.mcap", "report.html", "latency/latency.hlog"] {
        assert!(found.contains(&out.join(name)), "{name}: {found:?}");
    }
    assert!(found.contains(&out.join("latency/controller.step.hgrm")), "{found:?}");
    std::fs::remove_file(verdict).unwrap();
    std::fs::write(out.join("latency/gone.step.hgrm"), format!("# run {first}\n")).unwrap();
    let scenario = out.join("scenario.toml");
    let again = ["run", scenario.to_str().unwrap(), "--out", "out", "--set", "record=false"];
    let refused = bench.run(&again);
    assert!(refused.code == Some(2) && refused.stderr.contains("run.mcap"), "{refused:?}");
    assert_eq!(run_id(&out), first);
    let again = bench.run(&[&again[..], &["--overwrite"]].concat()).succeeded();
    assert!(again.stderr.contains("run.mcap") && again.stderr.contains("report.html"), "{again:?}");
    let second = run_id(&out);
    assert_ne!(first, second);
    let found = names(&second);
    assert!(!found.iter().any(|file| file.ends_with("run.mcap") || file.ends_with("report.html")), "{found:?}");
    assert!(!out.join("latency/gone.step.hgrm").exists());
}

/// Whichever file is of another run; the error names both.
#[test]
fn files_of_two_runs_are_refused() {
    let bench = Bench::new();
    for out in ["a", "b"] {
        assert_eq!(realtime(&bench, out, &["--record"]).code, Some(0));
    }
    let (a, b) = (bench.path("a"), bench.path("b"));
    assert_eq!(report(&bench, &a, &[]).code, Some(0));
    for name in ["run.mcap", "scenario.toml", "latency/controller.step.hgrm"] {
        let own = std::fs::read(a.join(name)).unwrap();
        std::fs::copy(b.join(name), a.join(name)).unwrap();
        let done = report(&bench, &a, &[]);
        assert!(done.code == Some(2) && done.says("two-runs"), "{name}: {done:?}");
        for word in [name, "summary.json", &run_id(&a), &run_id(&b)] {
            assert!(done.stderr.contains(word), "{name}: {word}: {done:?}");
        }
        std::fs::write(a.join(name), own).unwrap();
    }
    // A file that does not name its run is refused, too.
    let scenario = Scenario::load(&a.join("scenario.toml"), &[]).unwrap();
    std::fs::write(a.join("scenario.toml"), scenario.to_toml()).unwrap();
    let done = report(&bench, &a, &[]);
    assert!(done.code == Some(2) && done.says("two-runs"), "{done:?}");
}

/// A directory with the user's own files is refused before anything is removed or started.
#[test]
fn a_directory_with_a_foreign_file_is_refused() {
    let bench = Bench::new();
    let (out, own) = (bench.path("out"), "# my own scenario\nname = \"mine\"\n");
    assert_eq!(realtime(&bench, "out", &["--record"]).code, Some(0));
    std::fs::write(out.join("scenario.toml"), own).unwrap();
    let before = files(&out);
    let file = shipped("rigid-pair");
    let done = bench.run(&["run", file.to_str().unwrap(), "--clock", "in-process", "--out", "out"]);
    assert!(done.code == Some(2) && done.says("foreign-file"), "{done:?}");
    assert!(done.stderr.contains("scenario.toml") && done.stderr.contains("--out"), "{done:?}");
    assert_eq!(files(&out), before);
    assert_eq!(std::fs::read_to_string(out.join("scenario.toml")).unwrap(), own);
}

#[test]
fn missing_parts_are_named_with_their_remedy() {
    let bench = Bench::new();
    let directory = run_recorded(&bench, "rigid-pair", &["--duration", "2", "--set", "accept={}"]);
    let done = report(&bench, &directory.join("run.mcap"), &["--out", "alone.html"]);
    assert!(done.code == Some(0) && done.stderr.contains("summary.json"), "{done:?}");
    let html = std::fs::read_to_string(bench.path("alone.html")).unwrap();
    check_page(&html);
    let page = parse(&html);
    assert!(sections(&page).contains(&"motion") && text(section(&page, "verdict")).contains("not judged"));
    std::fs::remove_file(directory.join("run.mcap")).unwrap();
    let done = report(&bench, &directory, &[]);
    assert!(done.code == Some(0) && done.stderr.contains("--record"), "{done:?}");
    let html = std::fs::read_to_string(directory.join("report.html")).unwrap();
    check_page(&html);
    assert!(html.contains("corotate run FILE --record") && !sections(&parse(&html)).contains(&"motion"));
}

/// Shows the contents of files as text, even if they look like markup.
#[test]
fn contents_of_files_are_escaped() {
    let bench = Bench::new();
    let directory = run_recorded(&bench, "rigid-pair", &["--duration", "1", "--set", "accept={}"]);
    let mut summary = summary_in(&directory);
    let evil = "</td><script>alert('\"&amp;')</script>\u{1b}";
    for key in ["scenario", "started_utc", "clock"] {
        summary[key] = evil.into();
    }
    summary["host"]["cpu"] = evil.into();
    summary["books"]["problems"] = vec![evil].into();
    summary["notes"] = vec![evil].into();
    std::fs::write(directory.join("summary.json"), summary.to_string()).unwrap();
    let html = page(&bench, &directory);
    check_page(&html);
    let page = parse(&html);
    assert!(text(section(&page, "machine")).contains("<script>alert"));
}

#[test]
fn bad_input_is_refused_without_a_panic() {
    let bench = Bench::new();
    let directory = run_recorded(&bench, "rigid-pair", &["--duration", "2", "--set", "accept={}"]);
    let recording = std::fs::read(directory.join("run.mcap")).unwrap();
    let assert_refused = |source: &Path, code: &str, words: &[&str]| {
        let done = report(&bench, source, &[]);
        assert!(done.code == Some(2) && done.says(code), "{}: {done:?}", source.display());
        assert!(words.iter().all(|word| done.stderr.contains(word)) && !done.stderr.contains("panicked"), "{done:?}");
    };
    assert_refused(&bench.path("missing"), "no-such-run", &["run.mcap"]);
    std::fs::create_dir(bench.path("empty")).unwrap();
    assert_refused(&bench.path("empty"), "no-results", &["summary.json", "run.mcap"]);
    let file = |name: &str, bytes: &[u8]| {
        std::fs::write(bench.path(name), bytes).unwrap();
        bench.path(name)
    };
    assert_refused(&file("text.mcap", b"no recording"), "not-a-recording", &[]);
    assert_refused(&file("empty.mcap", b""), "not-a-recording", &[]);
    relabel(&directory.join("run.mcap"), &bench.path("other.mcap"), "estimate/v2", "estimate/v9");
    assert_refused(&bench.path("other.mcap"), "other-layout", &["estimate/v9"]);
    // A recording that is cut is shown up to there with its number of ticks, or refused.
    for part in [1, 10, 25, 50, 75, 99] {
        let cut = file("cut.mcap", &recording[..recording.len() * part / 100]);
        let done = report(&bench, &cut, &["--out", "cut.html"]);
        let refused = done.code == Some(2) && done.says("not-a-recording");
        assert!(refused || (done.code == Some(0) && done.stderr.contains("of 2000")), "{part} %: {done:?}");
        assert!(!done.stderr.contains("panicked"), "{done:?}");
    }
    let schema = summary_in(&directory).to_string().replace("summary/v1", "summary/v9");
    for (text, word) in
        [(schema.as_str(), "summary/v9"), ("{", "EOF"), ("{\"schema\":\"corotate/summary/v1\"}", "missing")]
    {
        std::fs::write(directory.join("summary.json"), text).unwrap();
        assert_refused(&directory, "unreadable-summary", &["summary.json", word]);
    }
    let done = report(&bench, &directory.join("run.mcap"), &["--out", "no/such/directory/page.html"]);
    assert!(done.code == Some(1) && done.says("cannot-write") && done.stderr.contains("--out"), "{done:?}");
}

/// A recording of a million ticks gives a page of less than 2 MB that shows a spike of a single tick.
#[test]
fn a_million_ticks_fit_in_two_megabytes_with_every_spike() {
    use corotate::sample::{RateCommand, RateEstimate, RateMeasurement, RateTruth};
    const TICKS: u64 = 1_000_000;
    const SPIKE: u64 = 654_321;
    let bench = Bench::new();
    let overrides = ["clock=in-process", "duration_s=1000", "accept={}"].map(str::to_owned);
    let scenario = Scenario::load(&shipped("rigid-pair"), &overrides).unwrap();
    let bus = MemoryBus::new(corotate::runtime::depths(&scenario));
    let file = bench.path("long.mcap");
    let mut recorder = Recorder::open(&scenario, &bus, &file).unwrap();
    recorder.start(0, None).unwrap();
    let topic = |body: &str, signal| corotate::runtime::topic(&scenario, body, signal);
    let mut truths =
        ["leader", "follower"].map(|body| bus.writer::<RateTruth>(&topic(body, Signal::Truth), 1).unwrap());
    let mut estimate = bus.writer::<RateEstimate>(&topic("leader", Signal::Estimate), 1).unwrap();
    let mut measured =
        ["leader", "follower"].map(|body| bus.writer::<RateMeasurement>(&topic(body, Signal::Measurement), 1).unwrap());
    let mut command = bus.writer::<RateCommand>(&topic("follower", Signal::Command), 1).unwrap();
    let noise = |tick: u64, axis: u64| ((tick * 2_654_435_761 + axis * 40_503) % 1_000_003) as f64 / 1e6 - 0.5;
    for tick in 0..TICKS {
        let omega = [0, 1, 2].map(|axis| noise(tick, axis));
        let stamp = corotate::sample::Stamp { tick, generation: 1, ..Default::default() };
        for (body, truth) in truths.iter_mut().enumerate() {
            let mut omega = omega;
            if body == 1 && tick == SPIKE {
                omega[0] = 5.0;
            }
            let applied_rad_s2 = omega;
            truth.send(|sample| *sample = RateTruth { stamp, omega_rad_s: omega, applied_rad_s2, status: 0 }).unwrap();
            measured[body].send(|sample| *sample = RateMeasurement { stamp, ..RateMeasurement::default() }).unwrap();
        }
        estimate
            .send(|sample| *sample = RateEstimate { stamp, omega_rad_s: omega, ..RateEstimate::default() })
            .unwrap();
        let v = noise(tick, 3).abs() + 1e-3;
        let sent =
            RateCommand { stamp, acceleration_rad_s2: [0.0; 3], lyapunov_rad2_s2: v, lyapunov_rate_bound_rad2_s3: -v };
        command.send(|sample| *sample = sent).unwrap();
        recorder.poll().unwrap();
    }
    recorder.finish(&[], None);
    let html = page(&bench, &file);
    check_page(&html);
    assert!(html.len() < 2 << 20, "{} bytes", html.len());
    let page = parse(&html);
    let metrics = rows(section(&page, "errors"));
    assert!(metrics[1][3].parse::<f64>().unwrap() > 4.4, "{metrics:?}");
    let first = section(&page, "motion").descendants().find(|node| node.has_tag_name("svg")).unwrap();
    assert!(text(first).contains('5'), "the axis reaches the spike");
}

/// A saturated actuator applies less than was asked for: both are drawn, of the driven bodies only.
#[test]
fn commands_are_drawn_as_asked_for_and_as_applied() {
    let bench = Bench::new();
    for (scenario, names) in [("rigid-pair", &["u1", "u2", "u3"][..]), ("orbit-hold", &["Ur", "Uθ"])] {
        let html = page(&bench, &run_recorded(&bench, scenario, &["--duration", "1", "--set", "accept={}"]));
        let drawn = |name: &str, what: &str| html.matches(&format!("data-label=\"{name} {what}\"")).count();
        for name in names {
            assert_eq!((drawn(name, "asked for"), drawn(name, "applied")), (1, 1), "{scenario}: {name}");
        }
    }
}

/// Draws the coefficients of an identifier, noisy measurements, and fields chosen with --show.
#[test]
fn coefficients_measurements_and_chosen_fields_are_drawn() {
    let bench = Bench::new();
    let labels = |html: &str| -> Vec<String> {
        let page = parse(html);
        page.descendants().filter_map(|node| node.attribute("aria-label")).map(str::to_owned).collect()
    };
    let learner = page(&bench, &run_recorded(&bench, "inertia", &["--duration", "1", "--set", "accept={}"]));
    assert_eq!(labels(&learner).iter().filter(|label| label.starts_with("coefficient a")).count(), 3, "{learner}");
    let known = page(&bench, &run_recorded(&bench, "rigid-pair", &["--duration", "1", "--set", "accept={}"]));
    assert!(!labels(&known).iter().any(|label| label.starts_with("coefficient")) && !known.contains(">measured<"));
    let noisy = run_recorded(&bench, "noisy-pair", &["--duration", "1", "--set", "accept={}"]);
    // Two of the three axes have a gyro.
    assert_eq!(page(&bench, &noisy).matches("data-label=\"measured\"").count(), 2);
    let shown = ["--show", "follower/command.acceleration_rad_s2", "--show", "leader/estimate.omega_rad_s[2]"];
    assert_eq!(report(&bench, &noisy, &shown).code, Some(0));
    let html = std::fs::read_to_string(noisy.join("report.html")).unwrap();
    check_page(&html);
    let fields = section(&parse(&html), "fields").descendants().filter(|node| node.has_tag_name("figure")).count();
    assert_eq!((fields, html.matches("acceleration_rad_s2[2]").count() > 0), (2, true));
    let unknown = report(&bench, &noisy, &["--show", "leader/estimate.omega"]);
    assert_eq!(unknown.code, Some(2), "{unknown:?}");
    assert!(unknown.says("no-such-field") && unknown.stderr.contains("leader/truth.omega_rad_s"));
}

/// The first difference is the one that `diff` finds, and is marked on every time axis.
#[test]
fn a_comparison_shows_the_first_difference_of_two_runs() {
    let bench = Bench::new();
    let (plain, faulted) = (run_recorded(&bench, "rigid-pair", &[]), bench.path("other"));
    let run = ["run", "rigid-pair", "--clock", "in-process", "--record", "--out", faulted.to_str().unwrap()];
    let fault = ["--set", r#"fault=[{kind="drop",role="observer",from_tick=4000,ticks=5}]"#];
    assert!(matches!(bench.run(&[&run[..], &fault].concat()).code, Some(0 | 3)));
    let pair = |b: &Path| {
        let done = report(&bench, &plain, &[b.to_str().unwrap(), "--show", "leader/estimate.omega_rad_s"]);
        assert_eq!((done.code, done.stdout.as_str()), (Some(0), "comparison.html\n"), "{done:?}");
        std::fs::read_to_string(bench.path("comparison.html")).unwrap()
    };
    let html = pair(&faulted);
    check_page(&html);
    let page = parse(&html);
    assert_eq!(sections(&page), ["verdict", "scenarios", "differences", "fields", "errors", "motion"]);
    let done = bench.run(&["diff", plain.to_str().unwrap(), faulted.to_str().unwrap(), "--json"]);
    let differences = done.json();
    let firsts = differences["signals"].as_array().unwrap().iter().filter_map(|s| s["first"]["tick"].as_u64());
    let first = firsts.min().unwrap();
    let words = text(section(&page, "differences"));
    assert!((4000..4010).contains(&first) && words.contains(&format!("at tick {first} ")), "{first}: {words}");
    assert!(html.contains("first difference</text>") && html.contains("leader, A") && html.contains("leader, B"));
    // The comparison names exactly the changed keys.
    let differing = rows(section(&page, "scenarios"));
    let keys: Vec<&str> = differing[1..].iter().map(|row| row[0].as_str()).collect();
    assert_eq!(keys, ["from_tick", "kind", "probability", "role", "ticks"].map(|key| format!("fault[0].{key}")));
    assert_eq!(differing[1][1..], ["–", "4000"]);
    // A run compared with itself.
    let same = pair(&plain);
    assert!(same.contains("✓ no value differs") && !same.contains("first difference</text>"));
    let same = parse(&same);
    assert!(
        rows(section(&same, "scenarios")).is_empty() && text(section(&same, "scenarios")).contains("same scenario")
    );
    // Without recordings only the summaries are compared.
    assert_eq!(bench.run(&["run", "rigid-pair", "--clock", "in-process", "--out", "bare"]).code, Some(0));
    let bare = pair_without_fields(&bench, &plain, &bench.path("bare"));
    assert!(bare.contains("only recorded runs have samples"), "{bare}");
    // Another rig has other signals.
    let orbit = run_recorded(&bench, "orbit-hold", &[]);
    assert!(pair_without_fields(&bench, &plain, &orbit).contains("orbit-hold"));
}

pub(super) fn pair_without_fields(bench: &Bench, a: &Path, b: &Path) -> String {
    report(bench, a, &[b.to_str().unwrap(), "--out", "pair.html"]).succeeded();
    std::fs::read_to_string(bench.path("pair.html")).unwrap()
}

/// For papers: each figure is an SVG file with its own colours.
#[test]
fn figures_are_written_as_separate_files() {
    let bench = Bench::new();
    let directory = run_recorded(&bench, "faults", &[]);
    report(&bench, &directory, &["--figures", "figures"]).succeeded();
    let html = std::fs::read_to_string(directory.join("report.html")).unwrap();
    let figures = files(&bench.path("figures"));
    assert_eq!(figures.len(), html.matches("<figure>").count());
    for path in figures {
        let svg = std::fs::read_to_string(&path).unwrap();
        let picture = Document::parse(&svg).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        assert_eq!(picture.root_element().tag_name().namespace(), Some("http://www.w3.org/2000/svg"));
        assert!(!svg.contains("var(") && svg.contains(".line"), "{}", path.display());
    }
}

/// Moves a pointer over the first time plot and drags it over a part; writes the results into the title.
const READER: &str = r#"<script>
const svg = document.querySelector("svg.time"), box = svg.getBoundingClientRect();
const at = (kind, part) => svg.dispatchEvent(new PointerEvent(kind, { clientX: box.left + part * box.width, clientY: box.top + box.height / 2, bubbles: true }));
at("pointermove", 0.5);
const readout = svg.closest("figure").querySelector(".readout").textContent;
at("pointerdown", 0.4); at("pointermove", 0.5); at("pointerup", 0.6);
const ticks = [...svg.querySelectorAll("g.ticks text")].map((text) => text.textContent).join(" ");
const last = [...document.querySelectorAll("svg.time")].at(-1).querySelector("svg.plot").getAttribute("viewBox");
svg.dispatchEvent(new MouseEvent("dblclick"));
const back = [...document.querySelectorAll("svg.plot")].every((plot) => plot.getAttribute("viewBox").startsWith("64 "));
document.title = [readout, ticks, !last.startsWith("64 ") && back, svg.querySelectorAll("g.ticks text").length].join("|");
</script></body>"#;

/// Returns a page after a browser has run its scripts; `None` without a browser.
pub(super) fn in_browser(bench: &Bench, html: &str) -> Option<String> {
    let browser = ["chromium", "chromium-browser", "google-chrome"].into_iter().find(|name| {
        std::process::Command::new(name).arg("--version").output().is_ok_and(|output| output.status.success())
    })?;
    std::fs::write(bench.path("read.html"), html).unwrap();
    let profile = format!("--user-data-dir={}", bench.path("profile").display());
    let url = format!("file://{}", bench.path("read.html").display());
    let options =
        ["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--disable-background-networking"];
    let dumped =
        std::process::Command::new(browser).args(options).args([&profile, "--dump-dom", &url]).output().unwrap();
    let dom = String::from_utf8_lossy(&dumped.stdout).into_owned();
    assert!(dom.contains("<title>"), "{}", String::from_utf8_lossy(&dumped.stderr));
    Some(dom)
}

/// Measures every page in a frame; writes into the title what is cut off or too small to be read.
const MEASURE: &str = r#"<script>
addEventListener("load", () => {
  const defects = [...document.querySelectorAll("iframe")].flatMap((frame) => {
    const page = frame.contentDocument, width = frame.contentWindow.innerWidth;
    const seen = (selector) => [...page.querySelectorAll(selector)].filter((node) => node.getBoundingClientRect().width > 0);
    const cut = (node) => node.getBoundingClientRect().right > width || node.closest(".table, figure").scrollWidth > node.closest(".table, figure").clientWidth;
    const found = seen("figure > svg, figure > div > svg, #verdict td:last-child").filter(cut).map((node) => node.getAttribute("aria-label") || node.textContent);
    if (page.scrollingElement.scrollWidth > width) found.push("the page");
    for (const picture of seen("svg.time")) {
      const labels = [...picture.querySelectorAll("g.ticks text")].map((label) => label.getBoundingClientRect());
      if (!labels.length || labels.at(-1).right > width || labels[0].height < 8) found.push("labels of " + picture.getAttribute("aria-label"));
    }
    if (!seen("figure svg").length) found.push("every picture");
    return found.map((name) => `${frame.title} at ${width}: ${name}`);
  });
  document.title = `${document.querySelectorAll("iframe").length} pages;` + defects.join("; ");
});
</script>"#;

#[test]
fn in_a_browser_every_page_fits_a_phone_and_a_screen() {
    let bench = Bench::new();
    let (faulted, plain) =
        (run_recorded(&bench, "faults", &[]), run_recorded(&bench, "rigid-pair", &["--duration", "9"]));
    let step = r#"input=[{at_s=1.0,key="follower.0.offset_rad_s",value=[0.1,0.0,-0.1]}]"#;
    let stepped = ["--duration", "3", "--set", step, "--set", "accept={}"];
    let stepped = run_recorded(&bench, "noisy-pair", &stepped);
    let campaign = "name = \"map\"\nbase = \"rigid-pair\"\nset = { duration_s = 0.5, accept = {} }\n\
                    axis = [{ key = \"tick_hz\", values = [100.0, 200.0] }, { key = \"controller.gain_per_s\", values = [2.0, 4.0] }]\n";
    std::fs::write(bench.path("map.toml"), campaign).unwrap();
    assert_eq!(bench.run(&["sweep", "./map.toml", "--out", "map", "-q"]).code, Some(0));
    let row = |n: u32| {
        format!("{0},{1},{2},{3}\n", 0.01 * f64::from(n), (0.02 * f64::from(n)).sin(), (0.03 * f64::from(n)).cos(), 0.5)
    };
    let log: String = ["t_s,wx_rad_s,wy_rad_s,wz_rad_s\n".to_owned()].into_iter().chain((0..500).map(row)).collect();
    std::fs::write(bench.path("log.csv"), log).unwrap();
    let estimate = ["estimate", "log.csv", "--hidden", "z", "--inertia", "1,2,2.5", "--page", "log.html"];
    assert_eq!(bench.run(&estimate).code, Some(0));
    let log = std::fs::read_to_string(bench.path("log.html")).unwrap();
    // Input, method and result are three paragraphs; there is no verdict.
    let paragraphs = section(&parse(&log), "result").children().filter(|node| node.has_tag_name("p")).count();
    assert!(paragraphs == 3 && !log.contains("class=\"verdict"), "{paragraphs}");
    let pages = [
        ("run", page(&bench, &faulted)),
        ("comparison", pair_without_fields(&bench, &plain, &faulted)),
        ("inputs", page(&bench, &stepped)),
        ("tuning", pair_without_fields(&bench, &plain, &stepped)),
        ("campaign", page(&bench, &bench.path("map"))),
        ("log", log),
    ];
    let quoted = |html: &str| html.replace('&', "&amp;").replace('"', "&quot;");
    let frame = |name: &str, html: &str, width: u32| {
        format!(
            "<iframe title=\"{name}\" width=\"{width}\" height=\"844\" style=\"border: 0\" srcdoc=\"{}\"></iframe>",
            quoted(html)
        )
    };
    let frames: String =
        [390, 1280].iter().flat_map(|width| pages.iter().map(|(name, html)| frame(name, html, *width))).collect();
    let Some(dom) = in_browser(&bench, &format!("<!DOCTYPE html><title></title>{MEASURE}<body>{frames}</body>")) else {
        return common::skipped("the width of pages", "there is no chromium (Debian: apt install chromium)");
    };
    let title = dom.split("<title>").nth(1).and_then(|rest| rest.split("</title>").next()).unwrap();
    assert_eq!(title, "12 pages;");
}

#[test]
fn in_a_browser_time_plots_show_values_and_zoom_together() {
    let bench = Bench::new();
    let html = page(&bench, &run_recorded(&bench, "rigid-pair", &[]));
    let Some(dom) = in_browser(&bench, &html.replace("</body>", READER)) else {
        return common::skipped("the page in a browser", "there is no chromium (Debian: apt install chromium)");
    };
    let title = dom.split("<title>").nth(1).and_then(|rest| rest.split("</title>").next()).unwrap_or_default();
    let parts: Vec<&str> = title.split('|').collect();
    let [readout, ticks, same, all] = parts[..] else { panic!("{title}") };
    // Because of the margins, the middle of the plot is a little before the middle of its axis.
    assert!(
        readout.starts_with("t = 4.6") && readout.contains("leader:") && readout.contains("observer:"),
        "{readout}"
    );
    let closer: Vec<f64> = ticks.split(' ').map(|tick| tick.parse().unwrap()).collect();
    assert!(closer.len() > 3 && closer[0] > 3.0 && closer[closer.len() - 1] < 6.5, "{ticks}");
    assert_eq!((same, all), ("true", "6"), "all plots zoom together, in and out");
}

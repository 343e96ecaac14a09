//! Reports of runs whose inputs change: marks, tables, responses to steps, and metrics that follow the set point.

use super::report::{check_page, in_browser, page, pair_without_fields, parse, rows, section, sections};
use crate::common::{self, Bench, await_some, shipped, summary_in};
use roxmltree::Node;
use serde_json::Value;
use std::path::PathBuf;

/// A step of the set point, a ramp of a gain, a disturbance, and a step of two components.
const CHANGES: &str = r#"
[[input]]
at_s = 3.0
key = "follower.0.offset_rad_s"
value = [0.0, 0.0, 0.1]

[[input]]
at_s = 5.0
key = "controller.gain_per_s"
value = [6.0, 6.0, 6.0]
shape = "ramp"
duration_s = 0.5

[[input]]
at_s = 6.0
key = "follower.0.disturbance_rad_s2"
value = [0.05, 0.0, 0.0]

[[input]]
at_s = 8.0
key = "follower.0.offset_rad_s"
value = [0.05, 0.0, 0.0]
"#;

/// Runs a shipped scenario with more tables in one thread.
fn run(bench: &Bench, (scenario, tables): (&str, &str), out: &str, options: &[&str]) -> PathBuf {
    let text = std::fs::read_to_string(shipped(scenario)).unwrap();
    let file = bench.path("scenario.toml");
    std::fs::write(&file, format!("{text}\n{tables}")).unwrap();
    let common = ["run", file.to_str().unwrap(), "--clock", "in-process", "--overwrite", "--out", out];
    let done = bench.run(&[&common, options].concat());
    assert!(matches!(done.code, Some(0 | 3)), "{done:?}");
    bench.path(out)
}

/// Returns the elements with a class.
fn with_class<'a, 'i>(node: Node<'a, 'i>, class: &str) -> Vec<Node<'a, 'i>> {
    node.descendants().filter(|node| node.attribute("class") == Some(class)).collect()
}

/// Returns the element with an id.
fn by_id<'a, 'i>(page: Node<'a, 'i>, id: &str) -> Node<'a, 'i> {
    page.descendants().find(|node| node.attribute("id") == Some(id)).unwrap()
}

/// Asserts that the metrics that a page computed from the recording are those of the run.
fn assert_metrics(html: &str, summary: &Value) {
    let metrics = summary["score"]["metrics"].as_array().unwrap();
    let shown = rows(section(&parse(html), "errors"));
    assert_eq!(shown.len(), metrics.len() + 1);
    for (row, metric) in shown[1..].iter().zip(metrics) {
        for (cell, key) in [(1, "last"), (3, "settled_max")] {
            assert_eq!(row[cell], format!("{:.4e}", metric[key].as_f64().unwrap()), "{row:?} {key}");
        }
    }
}

/// Ticks without an estimate are scored after later ones, whose set point would give a larger error.
#[test]
fn metrics_from_a_recording_follow_the_set_point() {
    let bench = Bench::new();
    let step = |(at_s, z): (f64, f64)| {
        format!("[[input]]\nat_s = {at_s:?}\nkey = \"follower.0.offset_rad_s\"\nvalue = [0.0, 0.0, {z:?}]\n")
    };
    let tables: String = [(3.0, 0.1), (4.0, 0.5), (6.0, 0.3)].map(step).concat();
    let faults = r#"fault=[{kind="drop",role="observer",from_tick=2990,ticks=30}]"#;
    let options = ["--record", "--set", "accept={settled_by_s=2.5}", "--set", faults];
    let directory = run(&bench, ("rigid-pair", &tables), "out", &options);
    let summary = summary_in(&directory);
    assert!(summary["score"]["unscored_ticks"].as_u64().unwrap() >= 30, "{}", summary["score"]);
    let metric = &summary["score"]["metrics"][0];
    let [largest, last] = ["settled_max", "last"].map(|key| metric[key].as_f64().unwrap());
    assert!(largest < 0.45 && last < 0.01, "with the set point of another tick they would be larger: {metric}");
    assert_metrics(&page(&bench, &directory), &summary);
    let alone = page(&bench, &directory.join("run.mcap"));
    let alone = parse(&alone);
    assert_eq!(rows(section(&alone, "inputs")).len(), 1 + 3, "without a summary there are changes, and no responses");
    // The bound on V does not apply beyond the first step.
    let bound = by_label(section(&alone, "lyapunov"), "bound");
    let plot = plot_of(bound);
    let last = points(bound).last().unwrap().0;
    let [left, width] = ["x", "width"].map(|name| number(plot, name));
    assert!(((last - left) / width - 0.3).abs() < 0.002, "3 s of 10 s: {last}");
}

fn by_label<'a, 'i>(node: Node<'a, 'i>, label: &str) -> Node<'a, 'i> {
    node.descendants().find(|node| node.attribute("data-label") == Some(label)).unwrap()
}

fn plot_of<'a, 'i>(line: Node<'a, 'i>) -> Node<'a, 'i> {
    line.ancestors().find(|node| node.attribute("class") == Some("plot")).unwrap()
}

fn number(node: Node<'_, '_>, name: &str) -> f64 {
    node.attribute(name).unwrap().parse().unwrap()
}

/// Returns the points of a line in px.
fn points(line: Node<'_, '_>) -> Vec<(f64, f64)> {
    let path = line.attribute("d").unwrap();
    let pair = |at: &str| {
        let (x, y) = at.split_once(' ')?;
        Some((x.parse().unwrap(), y.parse().unwrap()))
    };
    path.split(['M', 'L']).filter_map(pair).collect()
}

/// Returns the values of a line, and the least difference that is drawn.
fn values(line: Node<'_, '_>) -> (Vec<f64>, f64) {
    let plot = plot_of(line);
    let ends: Vec<f64> = plot.attribute("data-y").unwrap().split(' ').map(|end| end.parse().unwrap()).collect();
    let (top, height) = (number(plot, "y"), number(plot, "height"));
    let per_px = (ends[1] - ends[0]) / height;
    (points(line).iter().map(|(_, y)| ends[0] + per_px * (top + height - y)).collect(), 0.11 * per_px)
}

#[test]
fn every_change_is_marked_on_every_time_axis_and_listed() {
    let bench = Bench::new();
    let directory = run(&bench, ("rigid-pair", CHANGES), "out", &["--record", "--set", "accept={}"]);
    let html = page(&bench, &directory);
    check_page(&html);
    let document = parse(&html);
    for marks in ["marks-half", "marks-whole"] {
        let marks = with_class(by_id(document.root(), marks), "change");
        let titles: Vec<&str> = marks.iter().map(|mark| mark.first_element_child().unwrap().text().unwrap()).collect();
        assert_eq!(titles.len(), 4, "{titles:?}");
        assert!(titles[0].contains("follower.0.offset_rad_s = [0.0, 0.0, 0.1]"), "{titles:?}");
    }
    // The chart over the logarithm of time has an axis of its own; it is drawn in two sizes.
    let logarithmic = |node: &Node<'_, '_>| {
        node.attribute("aria-label").is_some_and(|label| label.ends_with("over the logarithm of time"))
    };
    let charts: Vec<Node<'_, '_>> = document.descendants().filter(logarithmic).collect();
    assert_eq!(charts.iter().map(|chart| with_class(*chart, "change").len()).collect::<Vec<_>>(), [4, 4]);
    let listed = rows(section(&document, "inputs"));
    let summary = summary_in(&directory);
    let changes = summary["inputs"].as_array().unwrap();
    for (row, change) in listed[1..=4].iter().zip(changes) {
        assert_eq!(row[0].parse::<f64>().unwrap(), change["time_s"].as_f64().unwrap());
        assert_eq!((row[1].as_str(), row[4].as_str()), (change["key"].as_str().unwrap(), "scenario"));
    }
    assert_eq!(listed[2][3], "ramp, 0.5 s");
    let constant = page(&bench, &run(&bench, ("rigid-pair", ""), "constant", &["--record", "--duration", "1"]));
    assert!(!sections(&parse(&constant)).contains(&"inputs") && !constant.contains("class=\"change"));
}

#[test]
fn many_changes_are_ticks_and_the_table_has_the_first_of_them() {
    let bench = Bench::new();
    let step = |n: u32| {
        let (at_s, z) = (1.0 + 0.02 * f64::from(n), 1e-3 * f64::from(n));
        format!("[[input]]\nat_s = {at_s:?}\nkey = \"follower.0.offset_rad_s\"\nvalue = [0.0, 0.0, {z:?}]\n")
    };
    let tables: String = (1..=200).map(step).collect();
    let html = page(&bench, &run(&bench, ("rigid-pair", &tables), "out", &["--record", "--set", "accept={}"]));
    check_page(&html);
    let page = parse(&html);
    let marks = by_id(page.root(), "marks-half");
    let ticks = with_class(marks, "changes")[0].attribute("d").unwrap();
    assert!(with_class(marks, "change").is_empty() && ticks.matches('M').count() == 200, "{ticks}");
    let inputs = section(&page, "inputs");
    // Two tables of at most 50 rows, each with a head.
    assert_eq!(rows(inputs).len(), 2 * (1 + 50));
    assert_eq!(inputs.descendants().filter(|node| node.has_tag_name("figure")).count(), 6);
}

#[test]
fn a_response_is_drawn_and_its_figures_are_those_of_the_run() {
    let bench = Bench::new();
    let directory = run(&bench, ("rigid-pair", CHANGES), "out", &["--record", "--set", "accept={}"]);
    let html = page(&bench, &directory);
    let (document, summary) = (parse(&html), summary_in(&directory));
    let inputs = section(&document, "inputs");
    let responses = summary["score"]["responses"].as_array().unwrap();
    let figures: Vec<Node<'_, '_>> = inputs.descendants().filter(|node| node.has_tag_name("figure")).collect();
    assert!(responses.len() == 4 && figures.len() == 4, "{responses:?}");
    let table = &rows(inputs)[5..];
    for ((figure, row), response) in figures.iter().zip(&table[1..]).zip(responses) {
        let key = format!("{}[{}]", response["key"].as_str().unwrap(), response["component"]);
        assert_eq!(row[0], key);
        for (cell, key) in [(3, "rise_time_s"), (5, "settling_time_s")] {
            let expected = response[key].as_f64();
            assert!(
                row[cell].parse().ok().map(|shown: f64| (shown * 1e4).round()) == expected.map(|s| (s * 1e4).round())
            );
        }
        assert_eq!(row[6], format!("{:.3e}", response["steady_state_error"].as_f64().unwrap()));
        let line = |label: &str| values(by_label(*figure, label));
        let ((set_point, _), (values, least), (command, least_command)) =
            (line("set point"), line("response"), line("command"));
        let from_set_point = (values.last().unwrap() - set_point.last().unwrap()).abs();
        assert!((from_set_point - response["steady_state_error"].as_f64().unwrap()).abs() < 2.0 * least, "{key}");
        if response["key"] == "follower.0.offset_rad_s" {
            for (value, key) in [(set_point[0], "from"), (*set_point.last().unwrap(), "to")] {
                assert!((value - response[key].as_f64().unwrap()).abs() < least, "{key}: {value}");
            }
        }
        let peak = command.iter().fold(0.0, |peak: f64, value| peak.max(value.abs()));
        assert!((peak - response["command_max"].as_f64().unwrap()).abs() < least_command, "{key}: {peak}");
    }
    // Without a recording there are the tables alone.
    std::fs::remove_file(directory.join("run.mcap")).unwrap();
    let bare = page(&bench, &directory);
    let bare = parse(&bare);
    let inputs = section(&bare, "inputs");
    assert_eq!(rows(inputs).len(), (1 + 4) + (1 + 4));
    assert!(!inputs.descendants().any(|node| node.has_tag_name("svg")));
}

/// The reference run with full state follows the same set point.
#[test]
fn an_orbit_and_its_reference_follow_a_new_set_point() {
    let bench = Bench::new();
    let step = "[[input]]\nat_s = 2.0\nkey = \"controller.target_radius_du\"\nvalue = 1.2\n";
    let directory = run(&bench, ("orbit-hold", step), "out", &["--record", "--set", "accept={}"]);
    let html = page(&bench, &directory);
    check_page(&html);
    assert_metrics(&html, &summary_in(&directory));
    let document = parse(&html);
    for label in ["with full state (computed here)", "with the observer (this run)"] {
        let radius = section(&document, "motion").descendants().find(|node| {
            node.attribute("class") == Some("time")
                && node.attribute("aria-label").is_some_and(|l| l.starts_with("r, du"))
        });
        let (radius, least) = values(by_label(radius.unwrap(), label));
        assert!((radius.last().unwrap() - 1.2).abs() < least + 1e-3, "{label}: {:?}", radius.last());
    }
}

#[test]
fn two_runs_have_their_responses_side_by_side() {
    let bench = Bench::new();
    let common = ["--record", "--set", "accept={}", "--set"];
    let a = run(&bench, ("rigid-pair", CHANGES), "a", &[&common[..], &["seed=1"]].concat());
    // The second run makes its first step later.
    let later = CHANGES.replacen("at_s = 3.0", "at_s = 3.5", 1);
    let b = run(&bench, ("rigid-pair", &later), "b", &[&common[..], &["controller.gain_per_s=[8,8,8]"]].concat());
    let html = pair_without_fields(&bench, &a, &b);
    check_page(&html);
    let document = parse(&html);
    let inputs = section(&document, "inputs");
    let listed = rows(inputs);
    let runs: Vec<&str> = listed[1..=5].iter().map(|row| row[5].as_str()).collect();
    assert_eq!(runs, ["A", "B", "A, B", "A, B", "A, B"]);
    let summaries = [&a, &b].map(|directory| summary_in(directory));
    let table = &listed[7..];
    assert_eq!(table.len(), 2 * 4);
    for (number, rows) in table.chunks(2).enumerate() {
        for (row, (name, summary)) in rows.iter().zip(["A", "B"].iter().zip(&summaries)) {
            let response = &summary["score"]["responses"][number];
            assert_eq!(row[2], *name);
            assert_eq!(row[7], format!("{:.3e}", response["steady_state_error"].as_f64().unwrap()), "{row:?}");
        }
    }
    let figure = inputs.descendants().find(|node| node.has_tag_name("figure")).unwrap();
    for label in ["set point", "response, A", "response, B", "command, A", "command, B"] {
        assert!(points(by_label(figure, label)).len() > 2, "{label}");
    }
    assert_eq!(with_class(by_id(document.root(), "marks-half"), "change").len(), 5);
}

/// Received changes are in the recording, not in the scenario's file.
#[test]
fn received_changes_are_listed_and_the_metrics_follow_them() {
    let bench = Bench::new();
    let running = bench.start_endless(&["--clock", "lockstep", "--record"]);
    await_some(|| {
        let done = bench.run(&["set", "out", "follower.0.offset_rad_s=[0,0,0.1]"]);
        (done.code == Some(0)).then_some(())
    });
    let tick = bench.run(&["set", "out", "follower.0.offset_rad_s=[0,0,0.2]", "--ramp", "1", "--json"]).succeeded();
    let tick = tick.json()["tick"].as_u64().unwrap();
    await_some(|| {
        let shown = bench.run(&["get", "out", "--json"]);
        (shown.code == Some(0) && shown.json()["tick"].as_u64()? > tick + 2000).then_some(())
    });
    running.signal(15);
    running.wait();
    let directory = bench.path("out");
    let summary = summary_in(&directory);
    for source in [directory.clone(), directory.join("run.mcap")] {
        let html = page(&bench, &source);
        check_page(&html);
        let shown = rows(section(&parse(&html), "errors"));
        let last = summary["score"]["metrics"][0]["last"].as_f64().unwrap();
        assert_eq!(shown[1][1], format!("{last:.4e}"), "{}", source.display());
        let document = parse(&html);
        let listed = rows(section(&document, "inputs"));
        assert!(listed[1..=2].iter().all(|row| row[4] == "received"), "{listed:?}");
        assert_eq!(with_class(by_id(document.root(), "marks-half"), "change").len(), 2);
    }
}

/// Moves a pointer to a mark, and zooms the first chart of a response; writes the results into the title.
const READER: &str = r##"<script>
const [svg, own] = ["svg.time", "#inputs svg.time"].map((selector) => document.querySelector(selector));
const at = (svg, kind, part) => {
  const plot = svg.querySelector("svg.plot"), box = svg.getBoundingClientRect(), scale = box.width / svg.viewBox.baseVal.width;
  const x = Number(plot.getAttribute("x")) + part * Number(plot.getAttribute("width"));
  svg.dispatchEvent(new PointerEvent(kind, { clientX: box.left + scale * x, clientY: box.top + 20, bubbles: true }));
};
const readout = (svg) => svg.closest("figure").querySelector(".readout").textContent;
at(svg, "pointermove", 0.3);
const mark = readout(svg);
at(own, "pointermove", 0.9);
const both = readout(own);
at(own, "pointerdown", 0.2); at(own, "pointerup", 0.6);
const boxes = (svg) => [...svg.querySelectorAll("svg.plot")].map((plot) => plot.getAttribute("viewBox").split(" ")[0]);
const labels = own.querySelectorAll("g.ticks text").length > 3;
document.title = [mark, both, boxes(svg).join(), new Set(boxes(own)).size, boxes(own)[0] > 100, labels].join("|");
</script></body>"##;

#[test]
fn in_a_browser_a_pointer_names_a_change_and_responses_zoom_by_themselves() {
    let bench = Bench::new();
    let html = page(&bench, &run(&bench, ("rigid-pair", CHANGES), "out", &["--record", "--set", "accept={}"]));
    let Some(dom) = in_browser(&bench, &html.replace("</body>", READER)) else {
        return common::skipped("the responses in a browser", "there is no chromium (Debian: apt install chromium)");
    };
    let title = dom.split("<title>").nth(1).and_then(|rest| rest.split("</title>").next()).unwrap_or_default();
    let parts: Vec<&str> = title.split('|').collect();
    let [mark, both, main, plots, zoomed, labels] = parts[..] else { panic!("{title}") };
    assert!(mark.contains("at 3 s: follower.0.offset_rad_s = [0.0, 0.0, 0.1]"), "{mark}");
    assert!(["set point:", "response:", "command:"].iter().all(|label| both.contains(label)), "{both}");
    assert_eq!((main, plots, zoomed, labels), ("64", "1", "true", "true"));
}

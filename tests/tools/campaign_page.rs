//! The page of a campaign: complete, well-formed, without references to other files, equal to the table; and refused options.

use crate::common::{Bench, Done};
use corotate::campaign::{End, Table};
use roxmltree::{Document, Node, ParsingOptions};
use std::fs;

/// Gains and tick rates on both sides of the borders of acceptance and validity; short, so that a debug build is quick.
const MAP: &str = r#"
name = "map"
base = "rigid-pair"
rate = true

[set]
duration_s = 1.5
accept = { settled_by_s = 1.2, sync_error_rad_s_max = 0.02, estimate_error_rad_s_max = 1.0 }

[[axis]]
key = "controller.gain_per_s"
label = "gain, 1/s"
range = { from = 1.0, to = 200.0, points = 6, log = true }

[[axis]]
key = "tick_hz"
values = [50.0, 100.0, 200.0]

[[margin]]
find = "smallest"
key = "controller.gain_per_s"
from = 0.5
to = 20.0
tolerance = 4.0
"#;

fn bench() -> Bench {
    let bench = Bench::new();
    fs::write(bench.path("map.toml"), MAP).unwrap();
    bench
}

fn well(done: Done) -> Done {
    assert_eq!(done.code, Some(0), "{done:?}");
    done
}

fn page(bench: &Bench, options: &[&str]) -> String {
    let done = well(bench.run(&[&["report", "results"], options].concat()));
    assert_eq!(done.stdout, "results/report.html\n");
    fs::read_to_string(bench.path("results/report.html")).unwrap()
}

fn parse(html: &str) -> Document<'_> {
    for outside in ["http:", "https:", "//", "@import", "url("] {
        assert!(!html.contains(outside), "{outside}");
    }
    Document::parse_with_options(html, ParsingOptions { allow_dtd: true, ..ParsingOptions::default() }).unwrap()
}

fn text(node: Node<'_, '_>) -> String {
    node.descendants().filter(|node| node.is_text()).filter_map(|node| node.text()).collect()
}

fn section<'a, 'i>(page: &'a Document<'i>, id: &str) -> Node<'a, 'i> {
    page.descendants().find(|node| node.has_tag_name("section") && node.attribute("id") == Some(id)).unwrap()
}

fn rows(section: Node<'_, '_>) -> Vec<Vec<String>> {
    let rows = section.descendants().filter(|node| node.has_tag_name("tr"));
    rows.map(|row| row.children().filter(Node::is_element).map(text).collect()).collect()
}

#[test]
fn the_page_of_a_campaign_agrees_with_its_table() {
    let bench = bench();
    let printed = well(bench.run(&["sweep", "./map.toml", "--out", "results"])).stdout;
    let html = page(&bench, &["--figures", "figures"]);
    let (page, table) = (parse(&html), Table::read(&bench.path("results")).unwrap());
    let sections: Vec<&str> = page
        .descendants()
        .filter(|node| node.has_tag_name("section"))
        .map(|node| node.attribute("id").unwrap())
        .collect();
    assert_eq!(sections, ["result", "maps", "axes", "distribution", "margins", "certificate", "worst", "reasons"]);
    let accepted = table.rows.iter().filter(|row| row.accepted == Some(true)).count();
    assert!(0 < accepted && accepted < 18, "{accepted}");
    let heading = text(page.descendants().find(|node| node.has_tag_name("h1")).unwrap());
    assert!(heading.contains(&format!("{accepted} of 18 cases accepted")), "{heading}");
    // A cell for every case, with its number and its verdict.
    let map = section(&page, "maps").descendants().find(|node| node.has_tag_name("svg")).unwrap();
    let titles: Vec<&str> =
        map.descendants().filter(|node| node.has_tag_name("title")).filter_map(|node| node.text()).collect();
    assert_eq!(titles.len(), 18);
    for row in &table.rows {
        let title = titles.iter().find(|title| title.ends_with(&format!("; case {}", row.case))).unwrap();
        let verdict = match row.accepted {
            Some(true) => "; accepted; ",
            Some(false) => "; not accepted; ",
            None => ": no value; not judged; ",
        };
        assert!(title.contains(verdict), "{title}: {row:?}");
        assert_eq!(title.contains("; a rate is claimed"), row.predicted_rate_per_s.is_some_and(|rate| rate > 0.0));
    }
    assert!(map.descendants().any(|node| node.attribute("data-label") == Some("border of acceptance")));
    // In slow loops the largest gains are invalid; the page lists each reason once.
    let invalid = table.rows.iter().filter(|row| row.exit == End::Invalid).count();
    let refused =
        rows(section(&page, "reasons"))[1..].iter().map(|row| row[0].parse::<usize>().unwrap()).sum::<usize>();
    assert!(invalid > 0 && refused == invalid, "{refused} {invalid}");
    // The printed counts: each case once under its verdict, and in brackets how invalid ones ended.
    let (mut cases, mut ended, mut nested) = (0, 0, false);
    for word in printed.lines().nth(1).unwrap().split([' ', ',']) {
        nested |= word.starts_with('(');
        let count = word.trim_matches(['(', ')']).parse::<usize>().unwrap_or(0);
        *(if nested { &mut ended } else { &mut cases }) += count;
        nested &= !word.ends_with(')');
    }
    assert_eq!((cases, ended), (18, invalid), "{printed}");
    let head: Vec<&str> = printed.lines().next().unwrap().split_whitespace().collect();
    assert!(head.contains(&"18") && head.contains(&"3"), "cases and margin points: {printed}");
    assert!(html.contains("bar across the scale marks the limit, 0.02"));
    let margins = rows(section(&page, "margins"));
    assert_eq!(margins.len(), 1 + table.margins[0].points.len());
    assert_eq!(margins[0], ["tick_hz", "holds at", "fails at", "runs"]);
    // The command in a row of the worst cases reproduces the case.
    let worst = rows(section(&page, "worst"));
    let command: Vec<&str> = worst[1][1].split(' ').collect();
    assert_eq!(command[..2], ["corotate", "run"]);
    let done = bench.run(&[&command[1..], &["--json"]].concat());
    let summary = done.json();
    let row = table.rows.iter().find(|row| row.case.to_string() == worst[1][0]).unwrap();
    assert_eq!((summary["accepted"].as_bool(), row.accepted), (Some(false), Some(false)), "{row:?}");
    let metric = summary["score"]["metrics"].as_array().unwrap().iter().find(|m| m["name"] == "sync_error_rad_s");
    let place = table.metrics.iter().position(|metric| metric.name == "sync_error_rad_s.settled_max").unwrap();
    assert_eq!(metric.unwrap()["settled_max"].as_f64(), row.metrics[place]);
    let figures = fs::read_dir(bench.path("figures")).unwrap();
    let drawn = figures.filter(|file| file.as_ref().unwrap().path().extension().is_some_and(|kind| kind == "svg"));
    assert_eq!(drawn.count(), html.matches("<figure>").count());
}

#[test]
fn an_unfinished_campaign_is_shown_and_options_of_runs_are_refused() {
    let bench = bench();
    well(bench.run(&["sweep", "./map.toml", "--out", "results", "--shard", "0/3", "-q"]));
    let html = page(&bench, &[]);
    assert!(html.contains("12 of 18 cases are missing"), "{html}");
    assert!(text(section(&parse(&html), "result")).contains("cases run6"));
    // Half a line at the end is ignored.
    let journal = bench.path("results/journal");
    let whole = fs::read(&journal).unwrap();
    fs::write(&journal, &whole[..whole.len() - 40]).unwrap();
    assert!(page(&bench, &[]).contains("cases are missing"));
    for options in [&["--show", "leader/truth.omega_rad_s"][..], &["results"]] {
        let done = bench.run(&[&["report", "results"], options].concat());
        assert_eq!(done.code, Some(2), "{done:?}");
        assert!(done.says("campaign-alone"), "{done:?}");
    }
    fs::write(&journal, "no journal").unwrap();
    let done = bench.run(&["report", "results"]);
    assert!(done.code == Some(2) && done.says("not-a-journal"), "{done:?}");
}

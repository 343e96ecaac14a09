//! Pages of small tables: every number comes from a row, and unusual tables also yield valid pages.

use super::facts::Facts;
use super::number::few;
use super::*;
use crate::campaign::{Axis, AxisKind, End, Find, Margin, MarginPoint, Metric, Parameter, Row, Statistic};
use crate::report::page::{figures, page};
use crate::telemetry::quantile;
use roxmltree::{Document, Node};

fn axis(key: &str, kind: AxisKind, values: Vec<Parameter>) -> Axis {
    Axis { key: key.to_owned(), label: None, kind, values }
}

fn numbers(values: &[f64]) -> Vec<Parameter> {
    values.iter().copied().map(Parameter::Number).collect()
}

fn row(case: u64, parameters: Vec<Parameter>, value: Option<f64>, accepted: Option<bool>) -> Row {
    let word = |accepted| if accepted { "accepted" } else { "not accepted" };
    Row {
        case,
        seed: 100 + case,
        parameters,
        accepted,
        verdict: accepted.map_or("not judged", word).to_owned(),
        exit: End::Completed,
        settled_at_s: value.filter(|_| accepted == Some(true)),
        metrics: vec![None, value, Some(7.0), None],
        executed: 4,
        ..Row::default()
    }
}

fn table(axes: Vec<Axis>, rows: Vec<Row>) -> Table {
    let metric = |statistic: Statistic| Metric {
        name: format!("sync_error_rad_s.{}", statistic.name()),
        metric: "sync_error_rad_s".to_owned(),
        statistic,
    };
    Table {
        name: "map".to_owned(),
        base: "rigid-pair".to_owned(),
        axes,
        metrics: Statistic::ALL.map(metric).to_vec(),
        cases: rows.len() as u64,
        rows,
        margins: Vec::new(),
    }
}

/// Four by three points with two seeds each: cases below one diagonal are accepted, below another a rate is claimed.
fn square() -> Table {
    let axes = vec![
        axis("gain", AxisKind::Linear, numbers(&[1.0, 2.0, 3.0, 4.0])),
        axis("delay", AxisKind::Values, (0..3).map(Parameter::Whole).collect()),
    ];
    let mut rows = Vec::new();
    for (x, y, seed) in (0..4).flat_map(|x| (0..3).flat_map(move |y| (0..2).map(move |seed| (x, y, seed)))) {
        let parameters = vec![Parameter::Number(f64::from(x + 1)), Parameter::Whole(y.into())];
        let value = 0.01 * f64::from(10 * x + y) + 0.001 * f64::from(seed);
        // At one corner the seeds have different verdicts.
        let accepted = x + y < 4 || (x == 3 && y == 1 && seed == 0);
        let mut row = row(rows.len() as u64, parameters, Some(value), Some(accepted));
        row.predicted_rate_per_s = (x + y < 2).then_some(1.5);
        if (x, y, seed) == (3, 2, 1) {
            (row.metrics[1], row.exit) = (None, End::Lost);
        }
        rows.push(row);
    }
    table(axes, rows)
}

/// Returns the page of a table and checks that it is well-formed.
fn html(table: &Table) -> String {
    let directory = tempfile::tempdir().unwrap();
    let model = model(table, directory.path());
    let html = page(&model);
    let document = parse(&html);
    for node in document.descendants().filter(|node| node.has_tag_name("figure")) {
        assert!(node.descendants().any(|node| node.has_tag_name("path") || node.has_tag_name("rect")));
        let svg = node.descendants().find(|node| node.has_tag_name("svg")).unwrap();
        assert!(!svg.attribute("aria-label").unwrap().is_empty());
    }
    for not_drawn in ["NaN", "inf ", "inf\""] {
        assert!(!html.split("<script>").next().unwrap().contains(not_drawn), "{not_drawn}");
    }
    for (name, svg) in figures(&model) {
        assert!(Document::parse(&svg).is_ok() && !name.is_empty() && !svg.contains("var("), "{name}");
    }
    html
}

fn parse(html: &str) -> Document<'_> {
    Document::parse(html.trim_start_matches("<!DOCTYPE html>")).unwrap()
}

fn picture<'a, 'i>(document: &'a Document<'i>, label: &str) -> Node<'a, 'i> {
    let labelled = |node: &Node<'_, '_>| node.attribute("aria-label").is_some_and(|found| found.starts_with(label));
    document.descendants().find(labelled).unwrap_or_else(|| panic!("{label}"))
}

/// Returns the number of pieces of a border.
fn pieces(picture: Node<'_, '_>, label: &str) -> usize {
    let path = picture.descendants().find(|node| node.attribute("data-label") == Some(label)).unwrap();
    path.attribute("d").unwrap().matches('M').count()
}

#[test]
fn a_map_has_a_cell_per_point_and_its_borders_lie_between_them() {
    let html = html(&square());
    let document = parse(&html);
    let map = picture(&document, "map: delay over gain");
    let titles: Vec<&str> =
        map.descendants().filter(|node| node.has_tag_name("title")).filter_map(|node| node.text()).collect();
    assert_eq!(titles.len(), 12);
    assert_eq!(titles[0], "gain = 1, delay = 0: 0, median of 2; 2 of 2 accepted; a rate is claimed; worst is case 1");
    assert!(
        titles
            .contains(&"gain = 4, delay = 1: 0.31, median of 2; 1 of 2 accepted; no rate is claimed; worst is case 21")
    );
    // Accepted: all but (2, 2) and (3, 2); half of (3, 1). Claimed: (0, 0), (0, 1), (1, 0).
    assert_eq!((pieces(map, "border of acceptance"), pieces(map, "border of the certificate’s claim")), (3, 4));
    let share = picture(&document, "acceptance: delay over gain");
    assert_eq!(pieces(share, "border of acceptance"), 3);
    assert!(html.contains("19 of 24 cases accepted") && html.contains("Up to 2 cases have the same values"));
    assert!(html.contains("median per cell: sync error (largest once settled), rad/s"));
    // Claimed cases and their verdicts.
    let cells = |row: &str| {
        let row = document
            .descendants()
            .find(|node| node.has_tag_name("tr") && node.descendants().any(|node| node.text() == Some(row)));
        row.unwrap()
            .descendants()
            .filter_map(|node| node.text())
            .filter(|text| text.trim() != "")
            .skip(2)
            .step_by(2)
            .map(str::to_owned)
            .collect::<Vec<_>>()
    };
    let (claimed, unclaimed) = (cells("a rate is claimed"), cells("no rate is claimed"));
    assert_eq!((claimed.len(), unclaimed.len()), (3, 3), "{unclaimed:?}");
    assert_eq!((claimed[0].as_str(), unclaimed[1].as_str()), ("6", "5"));
}

#[test]
fn the_worst_case_is_first_and_every_command_names_its_case() {
    let directory = tempfile::Builder::new().prefix("a b").tempdir().unwrap();
    let accept = "[scenario.accept]\nsync_error_rad_s_max = 1\nsync_error_rad_s_peak = 0.5\n";
    std::fs::write(directory.path().join("campaign.toml"), accept).unwrap();
    let table = square();
    let facts = Facts::new(&table, directory.path());
    // The peak exceeds its limit in every case.
    assert_eq!((facts.metric, facts.limit), (Some(2), Some(0.5)));
    assert!(
        facts.command(3).starts_with("corotate run '/")
            && facts.command(3).ends_with("/campaign.toml' --case 3 --clock in-process")
    );
    let worst = tables::worst(&facts).unwrap();
    let Some(Block::Table { rows, .. }) = worst.blocks.last() else { panic!("{worst:?}") };
    let cases: Vec<&str> = rows.iter().map(|row| row[0].as_str()).collect();
    assert_eq!((cases.len(), &cases[..4]), (10, &["23", "16", "17", "21"][..]), "lost, then not accepted");
    assert!(rows.iter().all(|row| row[1] == format!("`{}`", facts.command(row[0].parse().unwrap()))));
    // If the limit itself is varied, there is no common limit.
    let mut varied = square();
    varied.axes[0].key = "accept.sync_error_rad_s_max".to_owned();
    let facts = Facts::new(&varied, directory.path());
    assert_eq!((facts.metric, facts.limit), (Some(1), None));
}

#[test]
fn quantiles_are_values_that_some_case_has() {
    let sorted = [1.0, 2.0, 3.0, f64::INFINITY];
    let quantiles = [0.05, 0.25, 0.5, 0.75, 0.95].map(|part| quantile(&sorted, part));
    assert_eq!(quantiles, [1.0, 1.0, 2.0, 3.0, f64::INFINITY].map(Some));
    assert_eq!((quantile(&[], 0.5), quantile(&[4.0], 0.0)), (None, Some(4.0)));
    let formatted = [0.0, 1.5, 0.01234, 123.46, 2.5e-7, 1e-9, -3.25, 1e6].map(few);
    assert_eq!(formatted, ["0", "1.5", "0.0123", "123.5", "2.5e-7", "1e-9", "-3.25", "1e6"]);
}

#[test]
fn any_table_makes_a_page() {
    let word = |text: &str| Parameter::Word(text.to_owned());
    let single_case = |parameters: Vec<Parameter>, axes| table(axes, vec![row(0, parameters, Some(1e-7), Some(true))]);
    let empty = Table { cases: 9, ..table(vec![axis("a", AxisKind::Linear, numbers(&[1.0, 2.0]))], Vec::new()) };
    let text = html(&empty);
    assert!(text.contains("no case has been run") && text.contains("9 of 9 cases are missing"));
    let single =
        single_case(vec![Parameter::Flag(true)], vec![axis("a", AxisKind::Values, vec![Parameter::Flag(true)])]);
    assert!(html(&single).contains("all 1 cases accepted"));
    assert!(html(&single_case(Vec::new(), Vec::new())).contains("distribution of the metric"));
    // Words and flags, with characters of markup.
    let axes = vec![
        axis("<filter>", AxisKind::Values, vec![word("first & \"second\" order of a filter"), word("</svg>")]),
        axis("guard", AxisKind::Values, vec![Parameter::Flag(true), Parameter::Flag(false)]),
    ];
    let rows = (0..4).map(|case| {
        let parameters = vec![axes[0].values[case / 2].clone(), axes[1].values[case % 2].clone()];
        row(case as u64, parameters, [None, Some(1e300), Some(0.0), Some(1e-300)][case], [None, Some(false)][case % 2])
    });
    let words = html(&table(axes.clone(), rows.collect()));
    assert!(words.contains("map: guard over &lt;filter&gt;") && words.contains("no value"));
    // No case has a value, all bodies are lost, all values are equal, no case ran.
    for (value, end) in [(None, End::Completed), (None, End::Lost), (Some(0.0), End::Completed), (None, End::Invalid)] {
        let mut table = square();
        for row in &mut table.rows {
            (row.metrics, row.exit) = (vec![value; 4], end);
            if end == End::Invalid {
                (row.accepted, row.reason) = (None, Some("delay: is <too> long".to_owned()));
            }
        }
        let html = html(&table);
        assert_eq!(html.contains("is &lt;too&gt; long"), end == End::Invalid);
        assert_eq!(html.contains("body lost"), end == End::Lost);
    }
    // A row with fewer values than axes.
    html(&single_case(Vec::new(), axes));
}

#[test]
fn drawn_axes_are_points_or_for_many_cases_maps() {
    let drawn = |cases: u64| {
        let axes = ["a", "b", "c"].map(|key| axis(key, AxisKind::Linear, Vec::new())).to_vec();
        let part = |case: u64, prime: u64| ((case * prime) % 4999) as f64 / 4999.0;
        let rows = (0..cases).map(|case| {
            let [a, b, c] = [part(case, 7), part(case, 1009), part(case, 3001)];
            let parameters = numbers(&[a, 10.0 * b, c - 0.5]);
            row(case, parameters, Some((12.0 * a).exp()), Some(a + b < 1.0))
        });
        table(axes, rows.collect())
    };
    let few = html(&drawn(300));
    let document = parse(&few);
    let points = picture(&document, "cases: b over a").descendants().filter(|node| node.has_tag_name("title"));
    assert_eq!(points.count(), 300);
    let bands = picture(&document, "sync error (largest once settled) along a");
    assert_eq!(
        bands.descendants().filter(|node| node.attribute("class").is_some_and(|c| c.starts_with("band "))).count(),
        2
    );
    let many = html(&drawn(4999));
    assert!(
        many.contains("map: b over a")
            && !many.contains("cases: b over a")
            && many.contains("maps: b over a, separate")
    );
    assert!(few.len().max(many.len()) < 2 << 20, "{} {}", few.len(), many.len());
}

#[test]
fn margins_show_their_brackets_and_whether_they_exceed_the_range() {
    let mut table = square();
    let point = |case: u64, gain: f64, value: Option<f64>, bracket| MarginPoint {
        case,
        parameters: vec![Some(Parameter::Number(gain)), None],
        value,
        bracket,
        runs: 9,
    };
    table.margins = vec![Margin {
        key: "delay".to_owned(),
        find: Find::Largest,
        such_that: "accepted".to_owned(),
        range: [0.0, 40.0],
        tolerance: 0.25,
        points: vec![
            point(0, 1.0, Some(12.25), [Some(12.25), Some(12.5)]),
            point(6, 2.0, Some(40.0), [Some(40.0), None]),
            point(12, 3.0, None, [None, Some(0.0)]),
        ],
    }];
    let html = html(&table);
    let document = parse(&html);
    let section = document.descendants().find(|node| node.attribute("id") == Some("margins")).unwrap();
    let rows = section.descendants().filter(|node| node.has_tag_name("tr"));
    let rows: Vec<String> = rows
        .map(|row| {
            row.descendants().filter_map(|node| node.text().filter(|_| node.is_text())).collect::<Vec<_>>().join("|")
        })
        .collect();
    assert_eq!(rows[1..], ["1|12.25|12.50|9", "2|40|nowhere|9", "3|nowhere|0|9"]);
    let plot = picture(&document, "margin of delay along gain");
    let arrows =
        plot.descendants().filter(|node| node.attribute("class").is_some_and(|class| class.starts_with("arrow")));
    assert_eq!(arrows.count(), 2);
    table.margins[0].points.clear();
    assert!(self::html(&table).contains("No point has been searched yet."));
}

//! Cases as points: form and edge show the verdict, the shade shows the metric.
//!
//! Must not omit a case: if there are too many points to distinguish, the page has a map instead.

use super::facts::Facts;
use super::number::few;
use super::shades::Shades;
use crate::campaign::Row;
use crate::report::chart::Picture;
use crate::report::frame::{Frame, LEFT, TOP, WIDTH};
use crate::report::html::escape;
use std::fmt::Write;

/// The largest number of cases that are drawn as points.
pub const POINTS: usize = 1000;
const HEIGHT: f64 = 430.0;
const SCALE: f64 = 104.0;
const ABOVE: f64 = 32.0;
/// The width of a letter of the key.
const LETTER: f64 = 6.9;
/// The largest number of letters of a label beside an axis.
const LABEL: usize = 14;
const ALL: [Verdict; 3] = [Verdict::Accepted, Verdict::Refused, Verdict::Open];

/// The verdict of a case.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Verdict {
    Accepted,
    Refused,
    Open,
}

impl Verdict {
    fn from_row(row: &Row) -> Self {
        match row.accepted {
            Some(true) => Self::Accepted,
            Some(false) => Self::Refused,
            None => Self::Open,
        }
    }

    fn words(self) -> &'static str {
        match self {
            Self::Accepted => "accepted",
            Self::Refused => "not accepted",
            Self::Open => "not judged",
        }
    }

    /// Draws a circle, diamond or square, filled by a class.
    fn draw(self, x: f64, y: f64, fill: &str, title: &str, svg: &mut String) {
        let title = if title.is_empty() { String::new() } else { format!("<title>{}</title>", escape(title)) };
        let (class, form) = match self {
            Self::Accepted => ("accepted", format!("M{:.1} {y:.1}a4.2 4.2 0 1 1 0 .01z", x - 4.2)),
            Self::Refused => ("refused", format!("M{x:.1} {:.1}l5 5l-5 5l-5 -5z", y - 5.0)),
            Self::Open => ("open", format!("M{:.1} {:.1}h6v6h-6z", x - 3.0, y - 3.0)),
        };
        let _ = write!(svg, "<path class=\"case {class} {fill}\" d=\"{form}\">{title}</path>");
    }
}

/// Draws the key of the verdicts that occur, with their counts, at a position.
pub fn key<'r>(rows: impl IntoIterator<Item = &'r Row>, mut x: f64, y: f64, svg: &mut String) {
    let verdicts: Vec<Verdict> = rows.into_iter().map(Verdict::from_row).collect();
    for verdict in ALL {
        let count = verdicts.iter().filter(|found| **found == verdict).count();
        if count > 0 {
            let text = format!("{} ({count})", verdict.words());
            verdict.draw(x + 5.0, y - 4.0, "plain", "", svg);
            let _ = write!(svg, "<text class=\"scale\" x=\"{}\" y=\"{y}\">{text}</text>", x + 15.0);
            x += 32.0 + LETTER * text.chars().count() as f64;
        }
    }
}

/// Draws a case as a point at a position, with its description.
pub fn point(facts: &Facts<'_>, row: &Row, x: f64, y: f64, fill: &str, svg: &mut String) {
    Verdict::from_row(row).draw(x, y, fill, &words(facts, row), svg);
}

/// Returns the description of a case, without its parameters, which the axes show.
fn words(facts: &Facts<'_>, row: &Row) -> String {
    let value = facts.value(row).map_or("no value".to_owned(), few);
    format!("case {}: {value}; {}", row.case, row.verdict)
}

/// Draws all cases over two axes.
pub fn scatter(facts: &Facts<'_>, axes: [usize; 2], shades: Option<&Shades>) -> Picture {
    let spreads = axes.map(|axis| &facts.spreads[axis]);
    let mut frame = Frame { width: WIDTH, height: HEIGHT, top: TOP + ABOVE, left: LEFT, right: SCALE };
    let up = spreads[1].axis(frame.plot_height(), false);
    let longest = up.ticks.iter().map(|(_, label)| label.chars().count()).max().unwrap_or(0).min(LABEL);
    frame.left = LEFT.max(longest as f64 * LETTER + 32.0);
    let across = spreads[0].axis(frame.plot_width(), true);
    let title = format!("cases: {} over {}", spreads[1].name, spreads[0].name);
    let mut svg = frame.open(&title);
    let _ = write!(svg, "<text x=\"{}\" y=\"{TOP}\">{}</text>", frame.left, escape(&facts.metric_name()));
    key(&facts.table.rows, frame.left, TOP + 19.0, &mut svg);
    frame.axes(&across, &up, &mut svg);
    let mut swatches = Vec::new();
    // Cases that were not accepted are drawn above the accepted ones.
    let mut rows: Vec<&Row> = facts.table.rows.iter().collect();
    rows.sort_by_key(|row| (row.accepted == Some(false), row.case));
    for row in rows {
        let places = [0, 1].map(|n| row.parameters.get(axes[n]).and_then(|value| spreads[n].place(value)));
        let [Some(x), Some(y)] = places else { continue };
        let (x, y) = (frame.left + x * frame.plot_width(), frame.foot() - y * frame.plot_height());
        let fill = match (facts.value(row), shades) {
            (Some(value), Some(shades)) if value.is_finite() => format!("shade{}", shades.index(value)),
            (Some(_), _) => "gone".to_owned(),
            (None, _) => "void".to_owned(),
        };
        match fill.as_str() {
            "gone" => swatches.push(("gone", "body lost")),
            "void" => swatches.push(("void", "no value")),
            _ => {}
        }
        point(facts, row, x, y, &fill, &mut svg);
    }
    swatches.sort_unstable();
    swatches.dedup();
    if let Some(shades) = shades {
        shades.scale(&frame, facts.limit, &swatches, &mut svg);
    }
    svg.push_str("</svg>");
    Picture { svg, narrow: None, title, legend: Vec::new() }
}

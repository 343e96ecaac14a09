//! Cases as points over two axes: the verdict is a point's form and edge, the metric its shade. And points over one axis.
//!
//! Must not leave out a case silently: of more cases than can be told apart there are maps instead.

use super::facts::Facts;
use super::number::few;
use super::shades::Shades;
use crate::campaign::Row;
use crate::report::chart::Picture;
use crate::report::frame::{Frame, LEFT, TOP, WIDTH};
use crate::report::html::escape;
use std::fmt::Write;

/// So many cases can be told apart as points.
pub const POINTS: usize = 1000;
const HEIGHT: f64 = 430.0;
const SCALE: f64 = 104.0;
const ABOVE: f64 = 32.0;
/// The width of a letter of the key.
const LETTER: f64 = 6.9;
/// The most letters of a label beside an axis.
const LABEL: usize = 14;
const ALL: [Verdict; 3] = [Verdict::Accepted, Verdict::Refused, Verdict::Open];

/// What was said of a case.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Verdict {
    Accepted,
    Refused,
    Open,
}

impl Verdict {
    fn of(row: &Row) -> Self {
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

    /// A circle, a diamond, a square, filled by a class.
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

/// A row of the forms that occur, with how many there are, from a place on.
pub fn key<'r>(rows: impl IntoIterator<Item = &'r Row>, mut x: f64, y: f64, svg: &mut String) {
    let verdicts: Vec<Verdict> = rows.into_iter().map(Verdict::of).collect();
    for verdict in ALL {
        let count = verdicts.iter().filter(|one| **one == verdict).count();
        if count > 0 {
            let text = format!("{} ({count})", verdict.words());
            verdict.draw(x + 5.0, y - 4.0, "plain", "", svg);
            let _ = write!(svg, "<text class=\"scale\" x=\"{}\" y=\"{y}\">{text}</text>", x + 15.0);
            x += 32.0 + LETTER * text.chars().count() as f64;
        }
    }
}

/// A case as a point at a place, told in words.
pub fn point(facts: &Facts<'_>, row: &Row, x: f64, y: f64, fill: &str, svg: &mut String) {
    Verdict::of(row).draw(x, y, fill, &words(facts, row), svg);
}

/// What a case is; its values are on the axes.
fn words(facts: &Facts<'_>, row: &Row) -> String {
    let value = facts.value(row).map_or("no value".to_owned(), few);
    format!("case {}: {value}; {}", row.case, row.verdict)
}

/// All cases over two axes.
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
    let mut others = Vec::new();
    // What failed lies on what did not.
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
            "gone" => others.push(("gone", "body lost")),
            "void" => others.push(("void", "no value")),
            _ => {}
        }
        point(facts, row, x, y, &fill, &mut svg);
    }
    others.sort_unstable();
    others.dedup();
    if let Some(shades) = shades {
        shades.scale(&frame, facts.limit, &others, &mut svg);
    }
    svg.push_str("</svg>");
    Picture { svg, narrow: None, title, legend: Vec::new() }
}

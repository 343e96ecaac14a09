//! Maps of two axes: the decisive metric in shades, with the border of acceptance and that of the certificate's claim.
//!
//! A border lies between two cells, never within one. Must not smooth or fill in: a cell without a case is empty.

use super::facts::{Facts, claimed_share, share};
use super::number::few;
use super::shades::Shades;
use super::spread::{Cells, Spread};
use crate::campaign::Row;
use crate::report::axis::Axis;
use crate::report::chart::Picture;
use crate::report::frame::{Frame, LEFT, TOP, WIDE, WIDTH};
use crate::report::html::escape;
use crate::telemetry::quantile;
use std::fmt::Write;

/// The height of a map, and of each of several.
const HEIGHT: f64 = 430.0;
const PANEL: f64 = 250.0;
/// Room for the scale at the right, and for what is written above a map.
const SCALE: f64 = 104.0;
const ABOVE: f64 = 16.0;
/// So many maps are beside each other.
const COLUMNS: usize = 3;
/// The most letters of a label beside an axis, each so wide.
const LABEL: usize = 14;
const LETTER: f64 = 6.9;
/// Half of the cases of a cell: the border.
const HALF: f64 = 0.5;
/// The border of the claim is drawn beside the cells' edge, on the side that is claimed.
const ASIDE: f64 = 3.5;

/// Classes and names of the borders.
const ACCEPTANCE: (&str, &str) = ("k bold", "border of acceptance");
const CLAIM: (&str, &str) = ("b d1 bold", "border of the certificate’s claim");

/// What a map's shades tell.
#[derive(Debug, Clone, Copy)]
pub enum Paint<'a> {
    /// The decisive metric.
    Metric(&'a Shades),
    /// Which part of the cases was accepted.
    Share(&'a Shades),
}

/// What the cases of a cell have in common.
#[derive(Debug, Default)]
struct Cell {
    rows: u64,
    /// The median of the metric; none if no case has a value.
    value: Option<f64>,
    judged: u64,
    accepted: u64,
    share: Option<f64>,
    claimed: Option<f64>,
    /// The case with the largest value.
    worst: u64,
}

/// A map of two axes.
pub struct Map<'a> {
    facts: &'a Facts<'a>,
    spreads: [&'a Spread; 2],
    cells: [Cells<'a>; 2],
    /// Row by row, from the foot.
    grid: Vec<Cell>,
}

impl<'a> Map<'a> {
    /// A map of some of the cases, with at most so many cells in each direction.
    pub fn of<'r>(
        facts: &'a Facts<'a>,
        axes: [usize; 2],
        most: usize,
        rows: impl IntoIterator<Item = &'r Row>,
    ) -> Self {
        let spreads = axes.map(|axis| &facts.spreads[axis]);
        let cells = spreads.map(|spread| spread.cells(most));
        let mut sorted: Vec<Vec<&Row>> = vec![Vec::new(); cells[0].count * cells[1].count];
        for row in rows {
            let [x, y] = [0, 1].map(|n| row.parameters.get(axes[n]).and_then(|value| cells[n].of(value)));
            if let (Some(x), Some(y)) = (x, y) {
                sorted[y * cells[0].count + x].push(row);
            }
        }
        let grid = sorted.iter().map(|rows| Cell::of(facts, rows)).collect();
        Self { facts, spreads, cells, grid }
    }

    /// The values of all cells.
    pub fn values(&self) -> impl Iterator<Item = f64> {
        self.grid.iter().filter_map(|cell| cell.value)
    }

    /// The most cases of a cell.
    pub fn most(&self) -> u64 {
        self.grid.iter().map(|cell| cell.rows).max().unwrap_or(0)
    }

    /// Whether there is anything in it.
    pub fn is_empty(&self) -> bool {
        self.most() == 0
    }

    fn at(&self, x: usize, y: usize) -> Option<&Cell> {
        self.grid.get(y * self.cells[0].count + x).filter(|_| x < self.cells[0].count)
    }

    /// The edges between cells on whose sides a share lies on different sides of a half: from the one that has more.
    fn border(&self, of: impl Fn(&Cell) -> Option<f64>) -> Vec<([f64; 2], [f64; 2], [f64; 2])> {
        let [across, up] = self.cells;
        let mut edges = Vec::new();
        for (x, y) in (0..up.count).flat_map(|y| (0..across.count).map(move |x| (x, y))) {
            let share = |x, y| self.at(x, y).and_then(&of).map(|share| share >= HALF);
            let ((left, right), (low, high)) = (across.edges(x), up.edges(y));
            let Some(own) = share(x, y) else { continue };
            if share(x + 1, y).is_some_and(|other| other != own) {
                edges.push(([right, low], [right, high], [if own { -1.0 } else { 1.0 }, 0.0]));
            }
            if share(x, y + 1).is_some_and(|other| other != own) {
                edges.push(([left, high], [right, high], [0.0, if own { 1.0 } else { -1.0 }]));
            }
        }
        edges
    }

    /// Where the axes lie.
    fn axes(&self, frame: &Frame) -> [Axis; 2] {
        [self.spreads[0].axis(frame.plot_width(), true), self.spreads[1].axis(frame.plot_height(), false)]
    }

    /// The margin that the labels of the upright axis need.
    fn left(&self, height: f64) -> f64 {
        let axis = self.spreads[1].axis(height, false);
        let longest = axis.ticks.iter().map(|(_, label)| label.chars().count()).max().unwrap_or(0).min(LABEL);
        LEFT.max(longest as f64 * LETTER + 32.0)
    }

    /// Draws cells, axes and borders, and tells which borders there are.
    fn draw(&self, frame: &Frame, paint: Paint<'_>, svg: &mut String) -> [bool; 2] {
        let [x_axis, y_axis] = self.axes(frame);
        frame.axes(&x_axis, &y_axis, svg);
        let (width, height, foot) = (frame.plot_width(), frame.plot_height(), frame.foot());
        for (place, cell) in self.grid.iter().enumerate().filter(|(_, cell)| cell.rows > 0) {
            let (x, y) = (place % self.cells[0].count, place / self.cells[0].count);
            let ((from, to), (low, high)) = (self.cells[0].edges(x), self.cells[1].edges(y));
            let class = cell.class(paint);
            let (left, top, title) = (frame.left + from * width, foot - high * height, escape(&self.words(x, y, cell)));
            let _ = write!(
                svg,
                "<rect class=\"cell {class}\" x=\"{left:.1}\" y=\"{top:.1}\" width=\"{:.1}\" height=\"{:.1}\">\
                 <title>{title}</title></rect>",
                (to - from) * width,
                (high - low) * height
            );
        }
        let borders = [self.border(|cell| cell.share), self.border(|cell| cell.claimed)];
        for ((edges, (class, label)), aside) in borders.iter().zip([ACCEPTANCE, CLAIM]).zip([0.0, ASIDE]) {
            let mut path = String::new();
            for (from, to, side) in edges {
                let [dx, dy] = side.map(|side| side * aside);
                let at = |point: &[f64; 2]| (frame.left + point[0] * width + dx, foot - point[1] * height + dy);
                let ((x0, y0), (x1, y1)) = (at(from), at(to));
                let _ = write!(path, "M{x0:.1} {y0:.1}L{x1:.1} {y1:.1}");
            }
            if !path.is_empty() {
                let label = escape(label);
                let _ = write!(
                    svg,
                    "<path class=\"line halo\" d=\"{path}\"/><path class=\"line {class}\" data-label=\"{label}\" d=\"{path}\"/>"
                );
            }
        }
        frame.frame(svg);
        borders.map(|edges| !edges.is_empty())
    }

    /// What a cell says.
    fn words(&self, x: usize, y: usize, cell: &Cell) -> String {
        let [across, up] = [self.cells[0].name(x), self.cells[1].name(y)];
        let value = match cell.value {
            Some(value) if value.is_infinite() => "a body was lost".to_owned(),
            Some(value) => few(value),
            None => "no value".to_owned(),
        };
        let value = if cell.rows > 1 { format!("{value}, median of {}", cell.rows) } else { value };
        let verdict = match (cell.judged, cell.accepted) {
            (0, _) => "not judged".to_owned(),
            (1, accepted) => if accepted == 1 { "accepted" } else { "not accepted" }.to_owned(),
            (judged, accepted) => format!("{accepted} of {judged} accepted"),
        };
        let claim = match cell.claimed.filter(|_| self.facts.predicted) {
            Some(share) if share >= HALF => "; a rate is claimed",
            Some(_) => "; no rate is claimed",
            None => "",
        };
        let case = if cell.rows > 1 { "worst is case" } else { "case" };
        format!(
            "{} = {across}, {} = {up}: {value}; {verdict}{claim}; {case} {}",
            self.spreads[0].name, self.spreads[1].name, cell.worst
        )
    }

    /// Swatches for cells that have no shade.
    fn others(&self, paint: Paint<'_>) -> Vec<(&'static str, &'static str)> {
        let has = |class: &str| self.grid.iter().any(|cell| cell.rows > 0 && cell.class(paint) == class);
        let void = if matches!(paint, Paint::Metric(_)) { "no value" } else { "not judged" };
        [("gone", "body lost"), ("void", void)].into_iter().filter(|(class, _)| has(class)).collect()
    }

    /// What its shades are, above it.
    fn heading(&self, paint: Paint<'_>, most: u64) -> String {
        match paint {
            Paint::Metric(_) if most > 1 => format!("median of the cases of a cell: {}", self.facts.metric_name()),
            Paint::Metric(_) => self.facts.metric_name(),
            Paint::Share(_) => "part of the cases of a cell that were accepted".to_owned(),
        }
    }

    /// The map as a picture.
    pub fn picture(&self, paint: Paint<'_>) -> Picture {
        let frame = Frame { width: WIDTH, height: HEIGHT, top: TOP + ABOVE, left: self.left(HEIGHT), right: SCALE };
        let what = if matches!(paint, Paint::Metric(_)) { "map" } else { "part accepted" };
        let title = format!("{what}: {} over {}", self.spreads[1].name, self.spreads[0].name);
        let mut svg = frame.open(&title);
        let _ =
            write!(svg, "<text x=\"{}\" y=\"{TOP}\">{}</text>", frame.left, escape(&self.heading(paint, self.most())));
        let borders = self.draw(&frame, paint, &mut svg);
        paint.scale(&frame, self.facts.limit, &self.others(paint), &mut svg);
        svg.push_str("</svg>");
        Picture { svg, narrow: None, title, legend: legend(borders) }
    }
}

/// Several maps of the same axes beside each other, each with what it is of.
pub fn panels(maps: &[(String, Map<'_>)], shades: &Shades) -> Option<Picture> {
    let (_, first) = maps.first()?;
    let paint = Paint::Metric(shades);
    let columns = maps.len().min(COLUMNS);
    let (width, rows) = ((WIDE - SCALE) / columns as f64, maps.len().div_ceil(columns));
    let height = PANEL * rows as f64 + 2.0 * ABOVE;
    let title = format!("maps: {} over {}, apart", first.spreads[1].name, first.spreads[0].name);
    let whole = Frame { width: WIDE, height, top: TOP + 2.0 * ABOVE, left: first.left(PANEL), right: SCALE };
    let mut svg = whole.open(&title);
    let most = maps.iter().map(|(_, map)| map.most()).max().unwrap_or(0);
    let _ = write!(svg, "<text x=\"{}\" y=\"{TOP}\">{}</text>", whole.left, escape(&first.heading(paint, most)));
    let (mut borders, mut others) = ([false; 2], Vec::new());
    for (place, (name, map)) in maps.iter().enumerate() {
        let (x, y) = ((place % columns) as f64 * width, (place / columns) as f64 * PANEL + ABOVE);
        let frame = Frame { width, height: PANEL, top: TOP + ABOVE, left: whole.left, right: 14.0 };
        let (beside, name) = (frame.left, escape(name));
        let _ = write!(
            svg,
            "<g transform=\"translate({x:.1} {y:.1})\"><text class=\"name\" x=\"{beside}\" y=\"{}\">{name}</text>",
            TOP + ABOVE - 5.0
        );
        let drawn = map.draw(&frame, paint, &mut svg);
        borders = [borders[0] || drawn[0], borders[1] || drawn[1]];
        others.extend(map.others(paint));
        svg.push_str("</g>");
    }
    others.sort_unstable();
    others.dedup();
    paint.scale(&whole, first.facts.limit, &others, &mut svg);
    svg.push_str("</svg>");
    Some(Picture { svg, narrow: None, title, legend: legend(borders) })
}

fn legend(borders: [bool; 2]) -> Vec<(&'static str, String)> {
    let named = [ACCEPTANCE, CLAIM].into_iter().zip(borders).filter(|(_, drawn)| *drawn);
    named.map(|((class, label), _)| (class, label.to_owned())).collect()
}

impl Paint<'_> {
    fn scale(self, frame: &Frame, limit: Option<f64>, others: &[(&str, &str)], svg: &mut String) {
        match self {
            Self::Metric(shades) => shades.scale(frame, limit, others, svg),
            Self::Share(shades) => shades.scale(frame, Some(HALF), others, svg),
        }
    }
}

impl Cell {
    fn of(facts: &Facts<'_>, rows: &[&Row]) -> Self {
        let rows = || rows.iter().copied();
        let judged = || rows().filter_map(|row| row.accepted);
        let size = |row: &Row| facts.value(row).unwrap_or(f64::NEG_INFINITY);
        let refused = |row: &Row| row.accepted == Some(false);
        // Of equal ones the first.
        let worst = rows().max_by(|one, other| {
            let larger = size(one).total_cmp(&size(other));
            larger.then(refused(one).cmp(&refused(other))).then(other.case.cmp(&one.case))
        });
        Self {
            rows: rows().count() as u64,
            value: quantile(&facts.sorted(rows()), HALF),
            judged: judged().count() as u64,
            accepted: judged().filter(|accepted| *accepted).count() as u64,
            share: share(rows()),
            claimed: claimed_share(rows()).filter(|_| facts.predicted),
            worst: worst.map_or(0, |row| row.case),
        }
    }

    /// The class of its colour.
    fn class(&self, paint: Paint<'_>) -> &'static str {
        const SHADE: [&str; 8] = ["shade0", "shade1", "shade2", "shade3", "shade4", "shade5", "shade6", "shade7"];
        let (shades, value) = match paint {
            Paint::Metric(shades) => (shades, self.value),
            Paint::Share(shades) => (shades, self.share),
        };
        match value {
            None => "void",
            Some(value) if value.is_infinite() => "gone",
            Some(value) => SHADE[shades.index(value)],
        }
    }
}

//! Maps over two axes: the decisive metric as shades, with the borders of acceptance and of the certificate's claim.
//!
//! A border runs between cells, never through one. Must not interpolate: a cell without a case is empty.

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
/// The width of the scale on the right, and the height of the heading.
const SCALE: f64 = 104.0;
const ABOVE: f64 = 16.0;
/// The largest number of maps in a row.
const COLUMNS: usize = 3;
/// The largest number of letters of a label beside an axis, and the width of a letter.
const LABEL: usize = 14;
const LETTER: f64 = 6.9;
/// The fraction of cases at which a border lies.
const HALF: f64 = 0.5;
/// The distance of the claim's border from the edge of the cells, on the side with a claimed rate.
const ASIDE: f64 = 3.5;

/// The classes and names of the borders.
const ACCEPTANCE: (&str, &str) = ("k bold", "border of acceptance");
const CLAIM: (&str, &str) = ("b d1 bold", "border of the certificate’s claim");

/// The quantity of a map's shades.
#[derive(Debug, Clone, Copy)]
pub enum Paint<'a> {
    /// The decisive metric.
    Metric(&'a Shades),
    /// The fraction of accepted cases.
    Share(&'a Shades),
}

/// The results of the cases in a cell.
#[derive(Debug, Default)]
struct Cell {
    rows: u64,
    /// The median of the metric; `None` if no case has a value.
    value: Option<f64>,
    judged: u64,
    accepted: u64,
    share: Option<f64>,
    claimed: Option<f64>,
    /// The case with the largest value.
    worst: u64,
}

/// A map over two axes.
pub struct Map<'a> {
    facts: &'a Facts<'a>,
    spreads: [&'a Spread; 2],
    cells: [Cells<'a>; 2],
    /// The cells, row by row from the bottom.
    grid: Vec<Cell>,
}

impl<'a> Map<'a> {
    /// Returns a map of the given cases, with at most `most` cells in each direction.
    pub fn new<'r>(
        facts: &'a Facts<'a>,
        axes: [usize; 2],
        most: usize,
        rows: impl IntoIterator<Item = &'r Row>,
    ) -> Self {
        let spreads = axes.map(|axis| &facts.spreads[axis]);
        let cells = spreads.map(|spread| spread.cells(most));
        let mut sorted: Vec<Vec<&Row>> = vec![Vec::new(); cells[0].count * cells[1].count];
        for row in rows {
            let [x, y] = [0, 1].map(|n| row.parameters.get(axes[n]).and_then(|value| cells[n].index_of(value)));
            if let (Some(x), Some(y)) = (x, y) {
                sorted[y * cells[0].count + x].push(row);
            }
        }
        let grid = sorted.iter().map(|rows| Cell::new(facts, rows)).collect();
        Self { facts, spreads, cells, grid }
    }

    /// Returns the values of all cells.
    pub fn values(&self) -> impl Iterator<Item = f64> {
        self.grid.iter().filter_map(|cell| cell.value)
    }

    /// Returns the largest number of cases in a cell.
    pub fn most(&self) -> u64 {
        self.grid.iter().map(|cell| cell.rows).max().unwrap_or(0)
    }

    /// Returns true if the map has no case.
    pub fn is_empty(&self) -> bool {
        self.most() == 0
    }

    fn at(&self, x: usize, y: usize) -> Option<&Cell> {
        self.grid.get(y * self.cells[0].count + x).filter(|_| x < self.cells[0].count)
    }

    /// Returns the edges between cells at which a fraction crosses one half, with the direction towards the larger side.
    fn border(&self, fraction: impl Fn(&Cell) -> Option<f64>) -> Vec<([f64; 2], [f64; 2], [f64; 2])> {
        let [across, up] = self.cells;
        let mut edges = Vec::new();
        for (x, y) in (0..up.count).flat_map(|y| (0..across.count).map(move |x| (x, y))) {
            let share = |x, y| self.at(x, y).and_then(&fraction).map(|share| share >= HALF);
            let ((left, right), (low, high)) = (across.edges(x), up.edges(y));
            let Some(own) = share(x, y) else { continue };
            if share(x + 1, y).is_some_and(|neighbour| neighbour != own) {
                edges.push(([right, low], [right, high], [if own { -1.0 } else { 1.0 }, 0.0]));
            }
            if share(x, y + 1).is_some_and(|neighbour| neighbour != own) {
                edges.push(([left, high], [right, high], [0.0, if own { 1.0 } else { -1.0 }]));
            }
        }
        edges
    }

    /// Returns the axes of a map.
    fn axes(&self, frame: &Frame) -> [Axis; 2] {
        [self.spreads[0].axis(frame.plot_width(), true), self.spreads[1].axis(frame.plot_height(), false)]
    }

    /// Returns the left margin that the labels of the y axis need.
    fn left(&self, height: f64) -> f64 {
        let axis = self.spreads[1].axis(height, false);
        let longest = axis.ticks.iter().map(|(_, label)| label.chars().count()).max().unwrap_or(0).min(LABEL);
        LEFT.max(longest as f64 * LETTER + 32.0)
    }

    /// Draws cells, axes and borders; returns which borders were drawn.
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

    /// Returns the description of a cell.
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

    /// Returns the swatches of cells without a shade.
    fn swatches(&self, paint: Paint<'_>) -> Vec<(&'static str, &'static str)> {
        let has = |class: &str| self.grid.iter().any(|cell| cell.rows > 0 && cell.class(paint) == class);
        let unknown = if matches!(paint, Paint::Metric(_)) { "no value" } else { "not judged" };
        [("gone", "body lost"), ("void", unknown)].into_iter().filter(|(class, _)| has(class)).collect()
    }

    /// Returns the heading, which names the quantity of the shades.
    fn heading(&self, paint: Paint<'_>, most: u64) -> String {
        match paint {
            Paint::Metric(_) if most > 1 => format!("median per cell: {}", self.facts.metric_name()),
            Paint::Metric(_) => self.facts.metric_name(),
            Paint::Share(_) => "accepted cases per cell".to_owned(),
        }
    }

    /// Draws the map.
    pub fn picture(&self, paint: Paint<'_>) -> Picture {
        let frame = Frame { width: WIDTH, height: HEIGHT, top: TOP + ABOVE, left: self.left(HEIGHT), right: SCALE };
        let quantity = if matches!(paint, Paint::Metric(_)) { "map" } else { "acceptance" };
        let title = format!("{quantity}: {} over {}", self.spreads[1].name, self.spreads[0].name);
        let mut svg = frame.open(&title);
        let _ =
            write!(svg, "<text x=\"{}\" y=\"{TOP}\">{}</text>", frame.left, escape(&self.heading(paint, self.most())));
        let borders = self.draw(&frame, paint, &mut svg);
        paint.scale(&frame, self.facts.limit, &self.swatches(paint), &mut svg);
        svg.push_str("</svg>");
        Picture { svg, narrow: None, title, legend: legend(borders) }
    }
}

/// Draws several maps of the same axes, each with its name.
pub fn panels(maps: &[(String, Map<'_>)], shades: &Shades) -> Option<Picture> {
    let (_, first) = maps.first()?;
    let paint = Paint::Metric(shades);
    let columns = maps.len().min(COLUMNS);
    let (width, rows) = ((WIDE - SCALE) / columns as f64, maps.len().div_ceil(columns));
    let height = PANEL * rows as f64 + 2.0 * ABOVE;
    let title = format!("maps: {} over {}, separate", first.spreads[1].name, first.spreads[0].name);
    let whole = Frame { width: WIDE, height, top: TOP + 2.0 * ABOVE, left: first.left(PANEL), right: SCALE };
    let mut svg = whole.open(&title);
    let most = maps.iter().map(|(_, map)| map.most()).max().unwrap_or(0);
    let _ = write!(svg, "<text x=\"{}\" y=\"{TOP}\">{}</text>", whole.left, escape(&first.heading(paint, most)));
    let (mut borders, mut swatches) = ([false; 2], Vec::new());
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
        swatches.extend(map.swatches(paint));
        svg.push_str("</g>");
    }
    swatches.sort_unstable();
    swatches.dedup();
    paint.scale(&whole, first.facts.limit, &swatches, &mut svg);
    svg.push_str("</svg>");
    Some(Picture { svg, narrow: None, title, legend: legend(borders) })
}

fn legend(borders: [bool; 2]) -> Vec<(&'static str, String)> {
    let named = [ACCEPTANCE, CLAIM].into_iter().zip(borders).filter(|(_, drawn)| *drawn);
    named.map(|((class, label), _)| (class, label.to_owned())).collect()
}

impl Paint<'_> {
    fn scale(self, frame: &Frame, limit: Option<f64>, swatches: &[(&str, &str)], svg: &mut String) {
        match self {
            Self::Metric(shades) => shades.scale(frame, limit, swatches, svg),
            Self::Share(shades) => shades.scale(frame, Some(HALF), swatches, svg),
        }
    }
}

impl Cell {
    fn new(facts: &Facts<'_>, rows: &[&Row]) -> Self {
        let rows = || rows.iter().copied();
        let judged = || rows().filter_map(|row| row.accepted);
        let size = |row: &Row| facts.value(row).unwrap_or(f64::NEG_INFINITY);
        let refused = |row: &Row| row.accepted == Some(false);
        // Of equal cases the first one wins.
        let worst = rows().max_by(|a, b| {
            let larger = size(a).total_cmp(&size(b));
            larger.then(refused(a).cmp(&refused(b))).then(b.case.cmp(&a.case))
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

    /// Returns the class of the cell's colour.
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

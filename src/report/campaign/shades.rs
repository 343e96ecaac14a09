//! Maps values to shades: a few classes with round edges, and their scale.
//!
//! Must not interpolate between classes: a shade stands for a range that the scale shows.

use super::number::few;
use crate::report::axis::power_of_ten;
use crate::report::chart::SHADES;
use crate::report::frame::Frame;
use crate::report::html::escape;
use std::fmt::Write;

/// The ratio of the largest to the smallest value from which classes are logarithmic.
const SPAN: f64 = 30.0;
/// The width of a shade in the scale.
const WIDTH: f64 = 16.0;
/// The distance of the scale from the plot.
const BESIDE: f64 = 18.0;

/// Returns true if the range of values calls for a logarithmic scale.
pub fn by_factors(low: f64, high: f64) -> bool {
    low > 0.0 && high >= SPAN * low
}

/// Returns the smallest and largest finite value; of positive values only if `positive`.
pub fn range(values: impl IntoIterator<Item = f64>, positive: bool) -> Option<(f64, f64)> {
    let taken = values.into_iter().filter(|value| value.is_finite() && (!positive || *value > 0.0));
    taken.fold(None, |range, value| {
        let (low, high) = range.unwrap_or((value, value));
        Some((f64::min(low, value), f64::max(high, value)))
    })
}

/// Classes of values, each with its shade.
#[derive(Debug, Clone, PartialEq)]
pub struct Shades {
    /// The edges of the classes, rising.
    edges: Vec<f64>,
    labels: Vec<String>,
    /// True if the largest class has the lightest shade.
    reversed: bool,
}

impl Shades {
    /// Returns classes for the given values; `None` if no value is finite.
    pub fn for_values(values: &[f64]) -> Option<Self> {
        let (least, high) = range(values.iter().copied(), false)?;
        let positive = range(values.iter().copied(), true).filter(|_| least >= 0.0);
        let (edges, labels) = match positive {
            Some((low, high)) if by_factors(low, high) => {
                let edges = factors(low, high);
                let mut labels: Vec<String> = edges.iter().map(|edge| factor_label(*edge)).collect();
                // Zeros belong to the first class.
                if least == 0.0 {
                    labels[0] = "0".to_owned();
                }
                (edges, labels)
            }
            _ if least < high => {
                let edges = steps(least, high);
                let labels = edges.iter().map(|edge| step_label(*edge, edges[1] - edges[0])).collect();
                (edges, labels)
            }
            _ => (vec![least, high], vec![few(least)]),
        };
        Some(Self { edges, labels, reversed: false })
    }

    /// Returns the classes of fractions, labelled in percent.
    pub fn for_fractions() -> Self {
        let edges: Vec<f64> = (0..=SHADES).map(|n| n as f64 / SHADES as f64).collect();
        let labels = (0..=SHADES).map(|n| if n % 2 == 0 { format!("{} %", 100 * n / SHADES) } else { String::new() });
        Self { labels: labels.collect(), edges, reversed: true }
    }

    fn count(&self) -> usize {
        self.edges.len() - 1
    }

    /// Returns the shade of a class.
    fn shade(&self, class: usize) -> usize {
        let class = if self.reversed { self.count() - 1 - class } else { class };
        if self.count() == 1 { SHADES / 2 } else { class * (SHADES - 1) / (self.count() - 1) }
    }

    /// Returns the shade of a value.
    pub fn index(&self, value: f64) -> usize {
        let class = self.edges[1..self.count()].iter().filter(|edge| value >= **edge).count();
        self.shade(class)
    }

    /// Draws the scale beside a plot, with a bar at the limit, and with swatches below.
    pub fn scale(&self, frame: &Frame, limit: Option<f64>, swatches: &[(&str, &str)], svg: &mut String) {
        let (x, top) = (frame.width - frame.right + BESIDE, frame.top);
        let foot = frame.foot() - 20.0 * swatches.len() as f64;
        let each = (foot - top) / self.count() as f64;
        let place = |edge: f64| foot - edge * each;
        for class in 0..self.count() {
            let (y, shade) = (place((class + 1) as f64), self.shade(class));
            let _ = write!(
                svg,
                "<rect class=\"cell shade{shade}\" x=\"{x}\" y=\"{y:.1}\" width=\"{WIDTH}\" height=\"{each:.1}\"/>"
            );
        }
        for (edge, label) in self.labels.iter().enumerate() {
            let (beside, below, label) = (x + WIDTH + 5.0, place(edge as f64) + 4.0, escape(label));
            let _ = write!(svg, "<text class=\"scale\" x=\"{beside}\" y=\"{below:.1}\">{label}</text>");
        }
        if let Some(at) = limit.and_then(|limit| self.position(limit)) {
            let (from, y) = (x - 5.0, place(at));
            let _ = write!(svg, "<path class=\"line k bold\" d=\"M{from} {y:.1}h{}\"/>", WIDTH + 8.0);
        }
        for (row, (class, label)) in swatches.iter().enumerate() {
            let y = foot + 8.0 + 20.0 * row as f64;
            let (beside, below, label) = (x + WIDTH + 5.0, y + 10.0, escape(label));
            let _ = write!(
                svg,
                "<rect class=\"cell {class}\" x=\"{x}\" y=\"{y:.1}\" width=\"{WIDTH}\" height=\"12\"/>\
                 <text class=\"scale\" x=\"{beside}\" y=\"{below:.1}\">{label}</text>"
            );
        }
    }

    /// Returns the position of a value on the scale, in classes; `None` if it is outside.
    fn position(&self, value: f64) -> Option<f64> {
        let class = self.edges.windows(2).position(|edge| edge[0] <= value && value <= edge[1])?;
        let (from, to) = (self.edges[class], self.edges[class + 1]);
        let part = if from > 0.0 && by_factors(self.edges[0], self.edges[self.count()]) {
            (value / from).ln() / (to / from).ln()
        } else {
            (value - from) / (to - from)
        };
        Some(class as f64 + if part.is_finite() { part } else { 0.0 })
    }
}

/// Returns edges at round factors, as many as there are shades for.
fn factors(low: f64, high: f64) -> Vec<f64> {
    let (first, last) = (low.log10().floor() as i32 - 1, high.log10().ceil() as i32 + 1);
    let within = |edges: Vec<f64>| {
        let from = edges.iter().rposition(|edge| *edge <= low * (1.0 + 1e-9)).unwrap_or(0);
        let to = edges.iter().position(|edge| *edge >= high * (1.0 - 1e-9)).unwrap_or(edges.len() - 1);
        edges[from..=to].to_vec()
    };
    for multiples in [&[1.0, 2.0, 5.0][..], &[1.0, 3.0], &[1.0]] {
        let decade = |exponent: i32| multiples.iter().map(move |multiple| multiple * 10_f64.powi(exponent));
        let edges = within((first..=last).flat_map(decade).collect());
        if edges.len() <= SHADES + 1 {
            return edges;
        }
    }
    let decades = |stride: i32| {
        let exponents = (first.div_euclid(stride)..=last.div_euclid(stride) + 1).map(|n| n * stride);
        within(exponents.map(|exponent| 10_f64.powi(exponent)).collect())
    };
    (2..).map(decades).find(|edges| edges.len() <= SHADES + 1).unwrap_or_default()
}

/// Returns edges at round steps.
fn steps(low: f64, high: f64) -> Vec<f64> {
    let raw = (high - low) / SHADES as f64;
    let decade = 10_f64.powf(raw.log10().floor());
    for multiple in [1.0, 2.0, 2.5, 5.0, 10.0, 20.0] {
        let step = multiple * decade;
        let (from, to) = ((low / step + 1e-9).floor(), (high / step - 1e-9).ceil());
        if step >= raw && to - from <= SHADES as f64 && to > from {
            return (0..=(to - from) as usize).map(|n| (from + n as f64) * step).collect();
        }
    }
    vec![low, high]
}

/// Formats a logarithmic edge in few letters.
fn factor_label(edge: f64) -> String {
    if (1e-3..1e5).contains(&edge) {
        return few(edge);
    }
    let exponent = (edge.log10() + 1e-9).floor() as i32;
    let (mantissa, power) = (edge / 10_f64.powi(exponent), power_of_ten(exponent));
    if (mantissa - 1.0).abs() < 1e-6 { power } else { format!("{}·{power}", few(mantissa)) }
}

/// Formats a linear edge with the digits that distinguish it from the next.
fn step_label(edge: f64, step: f64) -> String {
    let place = |value: f64| (value.abs() * 1.001).log10().floor();
    let trimmed = |text: String| match text.contains('.') {
        true => text.trim_end_matches('0').trim_end_matches('.').to_owned(),
        false => text,
    };
    let text = if edge.abs() < 1e-9 * step {
        "0".to_owned()
    } else if edge.abs() < 1e5 && (step >= 1e-4 || edge.abs() >= 1e-2) {
        trimmed(format!("{edge:.*}", (1.0 - place(step)).clamp(0.0, 9.0) as usize))
    } else {
        let exponent = place(edge) as i32;
        let decimals = (1.0 + place(edge) - place(step)).clamp(0.0, 6.0) as usize;
        let mantissa = trimmed(format!("{:.decimals$}", edge / 10_f64.powi(exponent)));
        format!("{mantissa}·{}", power_of_ten(exponent))
    };
    text.replace('-', "−")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn classes_have_round_edges_and_contain_all_values() {
        let edges = |low, high| Shades::for_values(&[low, high]).unwrap().labels.join(" ");
        assert_eq!(edges(0.0, 0.9), "0 0.2 0.4 0.6 0.8 1");
        assert_eq!(edges(1.5e-9, 0.3), "10⁻¹⁰ 10⁻⁸ 10⁻⁶ 10⁻⁴ 0.01 1");
        assert_eq!(edges(0.2, 30.0), "0.2 0.5 1 2 5 10 20 50");
        assert_eq!(edges(3.0, 3.0), "3");
        assert_eq!(Shades::for_values(&[0.0, 0.2, 30.0]).unwrap().labels[..2], ["0", "0.5"]);
        assert_eq!(edges(-1e-14, 3e-14), "−1·10⁻¹⁴ −5·10⁻¹⁵ 0 5·10⁻¹⁵ 1·10⁻¹⁴ 1.5·10⁻¹⁴ 2·10⁻¹⁴ 2.5·10⁻¹⁴ 3·10⁻¹⁴");
        assert_eq!(edges(1000.2, 1000.3), "1000.2 1000.22 1000.24 1000.26 1000.28 1000.3");
        let values = [1e-300, 1e-17, 1e-9, 0.0, 1.0, 1.0000001, 29.0, 31.0, 5e7, 1e300, -1.0, -1e9];
        for low in values {
            for high in values.into_iter().filter(|high| *high >= low) {
                let shades = Shades::for_values(&[low, high, f64::INFINITY]).unwrap();
                assert!((1..=SHADES).contains(&shades.count()), "{low} {high}: {shades:?}");
                let [first, last] = [shades.edges[0], shades.edges[shades.count()]];
                let slack = 1e-6 * low.abs().max(high.abs());
                assert!((first <= low + slack || low == 0.0) && high <= last + slack, "{low} {high}: {shades:?}");
                assert!(shades.index(low) < SHADES && shades.index(low) <= shades.index(high));
                assert!(shades.labels.iter().all(|label| label.chars().count() <= 12), "{shades:?}");
            }
        }
        assert_eq!(Shades::for_values(&[f64::INFINITY]), None);
        let shares = Shades::for_fractions();
        assert_eq!([0.0, 0.1, 0.5, 1.0].map(|share| shares.index(share)), [7, 7, 3, 0]);
    }
}

//! Latency distributions as curves over 1/(1 − p), read from HdrHistogram's text format, and their charts.

use super::axis::Axis;
use super::chart::{Picture, plain};
use super::frame::Line;
use crate::config::RunId;

/// The stages in the order of the page, each with its definition.
const STAGES: [(&str, &str); 7] = [
    (
        "lateness",
        "wake − due of a plant's tick; the baseline is the wake lateness of the idle core, measured without the loop",
    ),
    ("hop", "received − sent"),
    ("step", "time to compute one estimate, one command or one tick of motion"),
    (
        "age",
        "use − due of a tick at the leader: until the sample is sent; at a follower, until the command acts (one period by design)",
    ),
    ("serial", "request sent − answer received"),
    ("outage", "from the detection of a failure until the successor runs"),
    ("recovery", "from the last tick of a failed role until all limits hold again"),
];
/// The stage that is drawn as a reference in the chart of the lateness.
const BASELINE: &str = "baseline";
/// The classes of colour and dash pattern of the roles.
const CLASSES: [&str; 6] = ["k d0", "o d1", "b d2", "g d3", "p d4", "y d1"];

/// The latency distribution of a role's stage.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    /// The role.
    pub role: String,
    /// The stage.
    pub stage: String,
    /// The run that measured it.
    pub run: Option<RunId>,
    /// Points of 1/(1 − p) and latency in µs, rising. The last point is the largest value, at the number of values.
    pub points: Vec<(f64, f64)>,
}

/// Reads a percentile distribution. The error names the invalid line.
pub fn read_curve(text: &str) -> Result<Vec<(f64, f64)>, String> {
    let mut points: Vec<(f64, f64)> = Vec::new();
    let rows = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty() && !line.starts_with('#'));
    for (index, line) in rows.skip(1) {
        let broken = || format!("line {}: `{}` is not a row of value, percentile and count", index + 1, line.trim());
        let numbers = line.split_whitespace().map(str::parse).collect::<Result<Vec<f64>, _>>().map_err(|_| broken())?;
        let (value, x) = match numbers[..] {
            [value, quantile, _, inverse] if quantile < 1.0 => (value, inverse),
            [value, _, count] => (value, count),
            _ => return Err(broken()),
        };
        if !value.is_finite() || !x.is_finite() {
            return Err(broken());
        }
        let least = points.last().map_or(1.0, |point| point.0);
        points.push((x.max(least), value));
    }
    if points.is_empty() { Err("it has no rows".to_owned()) } else { Ok(points) }
}

/// Draws a chart for each stage: name, definition and chart.
pub fn pictures(curves: &[Curve]) -> Vec<(String, String, Picture)> {
    // A role has the same colour in every chart.
    let mut roles: Vec<&str> = Vec::new();
    for curve in curves.iter().filter(|curve| curve.stage != BASELINE) {
        if !roles.contains(&curve.role.as_str()) {
            roles.push(&curve.role);
        }
    }
    let shown = STAGES.iter().filter_map(|(stage, definition)| {
        let with = |curve: &&Curve| curve.stage == *stage || (*stage == "lateness" && curve.stage == BASELINE);
        let curves: Vec<&Curve> = curves.iter().filter(with).collect();
        (!curves.is_empty()).then(|| ((*stage).to_owned(), (*definition).to_owned(), picture(stage, &curves, &roles)))
    });
    shown.collect()
}

fn picture(stage: &str, curves: &[&Curve], roles: &[&str]) -> Picture {
    let points = || curves.iter().flat_map(|curve| &curve.points);
    let greatest = points().map(|point| point.0).fold(1.0, f64::max);
    let low = points().map(|point| point.1).filter(|us| *us > 0.0).fold(f64::INFINITY, f64::min);
    let high = points().map(|point| point.1).fold(0.0, f64::max);
    let (x, y) = (Axis::percentiles(greatest), Axis::decades("latency, µs", (low, high)));
    let line = |curve: &&Curve| {
        if curve.stage == BASELINE {
            return Line::through("grey d2", &format!("{}: baseline", curve.role), curve.points.clone());
        }
        let place = roles.iter().position(|role| *role == curve.role).unwrap_or(0);
        Line::through(CLASSES[place % CLASSES.len()], &curve.role, curve.points.clone())
    };
    let lines: Vec<Line> = curves.iter().map(line).collect();
    plain(&format!("latency percentiles of the stage {stage}"), &x, &y, &lines)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::{Latency, write_hgrm};

    #[test]
    fn a_written_distribution_is_read_back() {
        let mut latency = Latency::default();
        (1..=1000).for_each(|us| latency.record(0, us * 1000));
        let mut text = Vec::new();
        write_hgrm(&latency, None, &mut text).unwrap();
        let points = read_curve(&String::from_utf8(text).unwrap()).unwrap();
        let (first, last) = (points[0], *points.last().unwrap());
        assert!(first.0 == 1.0 && (first.1 - 1.0).abs() < 0.01, "{first:?}");
        assert!((1000.0..1025.0).contains(&last.0) && (last.1 - 1000.0).abs() < 1.0, "{last:?}");
        let median = points.iter().find(|point| point.0 >= 2.0).unwrap();
        assert!((median.1 - 500.0).abs() < 1.0, "{median:?}");
        assert!(points.windows(2).all(|pair| pair[0].0 <= pair[1].0 && pair[0].1 <= pair[1].1));
    }

    #[test]
    fn an_invalid_distribution_is_refused_with_its_line() {
        assert!(read_curve("").is_err() && read_curve("Value Percentile\n").is_err());
        for row in ["1 2", "x 0.5 3 2", "inf 0.5 3 2", "1 0.5 3 nan"] {
            let error = read_curve(&format!("Value\n\n1.0 0.0 1 1.0\n{row}\n")).unwrap_err();
            assert!(error.starts_with("line 4: "), "{error}");
        }
    }
}

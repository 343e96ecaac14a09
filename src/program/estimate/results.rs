//! What an estimate came to, as text and as JSON.

use super::super::data::{AXES, log_json, write_log};
use super::super::output::Failure;
use crate::data::{Estimation, Request};
use crate::estimate::{FilterKind, SegmentScore};
use serde_json::{Value, json};
use std::fmt::Write;

/// The largest number of segments that are listed individually.
const LISTED: usize = 12;

/// The error as a part of the rate from which a body does not fit.
const MISFIT: f64 = 0.5;
const TOO_LONG: &str = "the steps are too long for the motion, which turns by more than half a turn in one, or does not fit the \
                        body; log faster, and check the units";

/// Returns the reason why no sample has a usable estimate.
pub fn useless(estimation: &Estimation) -> Option<Failure> {
    let [samples, unobserved, too_long] = totals(&estimation.segments);
    let steps = samples.saturating_sub(estimation.segments.len() as u64);
    if 10 * estimation.diverged > samples {
        let reason = "the estimate diverged: the body or its damping is another one, or a unit; see the numbers above";
        return Some(Failure::new("diverged", reason));
    }
    if unobserved < steps || steps == 0 {
        return None;
    }
    Some(match 2 * too_long > unobserved {
        true => Failure::new("steps-too-long", format!("no estimate: {TOO_LONG}")),
        false => {
            let floor = estimation.floor_rad_s;
            let remedy = "give --floor, otherwise ten times the noise of the log's start, or take out outliers there";
            let reason =
                format!("no estimate: both measured rates are below {floor:.2e} rad/s at every sample; {remedy}");
            Failure::new("never-observed", reason)
        }
    })
}

/// Returns the numbers of samples, of unobservable steps, and of those that were too long.
fn totals(segments: &[(String, SegmentScore)]) -> [u64; 3] {
    segments.iter().fold([0; 3], |[samples, unobserved, too_long], (_, score)| {
        [samples + score.samples, unobserved + score.unobserved, too_long + score.too_long]
    })
}

/// Returns a number with four decimals, or in powers of ten if it is large.
fn figure(value: f64) -> String {
    if value.abs() < 1e6 { format!("{value:.4}") } else { format!("{value:.3e}") }
}

/// Returns median and 90th percentile of the finite values; `None` without any.
fn percentiles(values: impl Iterator<Item = f64>) -> Option<[f64; 2]> {
    let mut sorted: Vec<f64> = values.filter(|value| value.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().checked_sub(1)?;
    // Linear interpolation between neighbours.
    let at = |part: f64| {
        let place = part * last as f64;
        let (low, rest) = (place as usize, place.fract());
        sorted[low] + rest * (sorted[(low + 1).min(last)] - sorted[low])
    };
    Some([at(0.5), at(0.9)])
}

/// Statistics over all segments.
struct Overall {
    error_rad_s: [f64; 2],
    measured_rad_s: f64,
    part: [f64; 2],
    scored: usize,
}

fn overall(segments: &[(String, SegmentScore)]) -> Option<Overall> {
    let scored: Vec<&SegmentScore> = segments.iter().map(|(_, score)| score).filter(|score| score.scored > 0).collect();
    Some(Overall {
        error_rad_s: percentiles(scored.iter().map(|score| score.error_rad_s))?,
        measured_rad_s: percentiles(scored.iter().map(|score| score.measured_rad_s))?[0],
        part: percentiles(scored.iter().map(|score| score.error_rad_s / score.measured_rad_s))?,
        scored: scored.len(),
    })
}

/// Returns a part as per cent.
fn percent(part: f64) -> String {
    if part < 1e4 { format!("{:.2}", 100.0 * part) } else { format!("{:.2e}", 100.0 * part) }
}

/// Returns a part of the text without its indents, one sentence per line; a deeper indent continues a sentence.
pub fn paragraph(part: &str) -> String {
    part.trim().replace("\n    ", " ").replace("\n  ", "\n")
}

/// Writes the results as paragraphs.
pub fn write_results(request: &Request, estimation: &Estimation, text: &mut String) -> std::fmt::Result {
    write_log(&estimation.log, text)?;
    write_filter(request, estimation, text)?;
    write_gaps(estimation, text)?;
    write_score(request, estimation, text)
}

/// Writes the body and the filter.
fn write_filter(request: &Request, estimation: &Estimation, text: &mut String) -> std::fmt::Result {
    let [a1, a2, a3] = request.coefficients.into();
    let hidden = AXES[request.axis - 1];
    writeln!(text, "\nestimate of the rate about {hidden}, for a body with a = ({a1:.4}, {a2:.4}, {a3:.4})")?;
    if request.damping_per_s != 0.0 {
        writeln!(text, "  damping {:.4} 1/s", request.damping_per_s)?;
    }
    if let Some(wheel) = request.wheel {
        let [x, y, z] = wheel.momentum.into();
        writeln!(text, "  wheel of ({x:.3e}, {y:.3e}, {z:.3e}) N m s")?;
    }
    if request.axes.is_some() {
        writeln!(text, "  the principal axes are rotated against the sensor's")?;
    }
    match estimation.filter {
        FilterKind::First { decay_per_s } => writeln!(text, "  first-order filter, decay {decay_per_s:.2} 1/s")?,
        FilterKind::Second { bandwidth_rad_s } => {
            writeln!(text, "  second-order filter, bandwidth {bandwidth_rad_s:.2} rad/s")?;
        }
        FilterKind::Kalman { noise_rad_s, density, .. } => {
            writeln!(text, "  Kalman filter, noise {noise_rad_s:.2e} rad/s, density {density:.2e} rad2/s3")?;
        }
    }
    if let (true, Some(choice)) = (estimation.chosen, &estimation.choice) {
        writeln!(
            text,
            "  chosen decay: noise ({:.1e} rad/s) and model errors balance at {:.2} 1/s; segments of {:.2} s need {:.2} 1/s\n    \
             to forget their first estimate; change it with --decay",
            choice.noise_rad_s, choice.balance_per_s, choice.segment_s, choice.forgetting_per_s
        )?;
    }
    Ok(())
}

/// Writes the samples without an estimate that can be used.
fn write_gaps(estimation: &Estimation, text: &mut String) -> std::fmt::Result {
    let [samples, unobserved, too_long] = totals(&estimation.segments);
    let blind = unobserved - too_long;
    let share = 100.0 * blind as f64 / samples.max(1) as f64;
    let floor = estimation.floor_rad_s;
    writeln!(
        text,
        "  not observable at {blind} of {samples} samples ({share:.1} %): both measured rates below {floor:.2e} rad/s"
    )?;
    if too_long > 0 {
        writeln!(text, "  ambiguous at {too_long} of {samples} samples: {TOO_LONG}")?;
    }
    if estimation.diverged > 0 {
        let diverged = estimation.diverged;
        writeln!(
            text,
            "  diverged at {diverged} of {samples} samples: the body or its damping is another one, or a unit"
        )?;
    }
    Ok(())
}

/// Writes the error against the measured rate.
fn write_score(request: &Request, estimation: &Estimation, text: &mut String) -> std::fmt::Result {
    let hidden = AXES[request.axis - 1];
    match overall(&estimation.segments) {
        Some(Overall { error_rad_s, measured_rad_s, part, scored }) => {
            let ([error, worst], [share, most]) = (error_rad_s.map(figure), part.map(percent));
            writeln!(
                text,
                "\nrms error over the second half of {scored} segments: median {error}, 90th percentile {worst} rad/s\n  \
                 relative to the rate, {measured_rad_s:.3} rad/s rms (median): median {share} %, 90th percentile {most} %"
            )?;
            if part[0] > MISFIT {
                text.push_str("note: the body does not fit this motion: its axes, its moments, its damping or a unit is another\n");
            }
            for (name, score) in estimation.segments.iter().filter(|_| estimation.segments.len() <= LISTED) {
                let (error, measured) = (score.error_rad_s, score.measured_rad_s);
                writeln!(text, "  {name}: {} of {measured:.3} rad/s, {} samples", figure(error), score.samples)?;
            }
            Ok(())
        }
        None if estimation.log.meaning.rates.0[request.axis - 1] == "-" => {
            writeln!(text, "\nno score: the log lacks the rate about {hidden}")
        }
        None => writeln!(text, "\nno score: no sample has both an estimate and a measured rate about {hidden}"),
    }
}

/// Returns the results as one object (corotate/estimate/v1).
pub fn to_json(request: &Request, estimation: &Estimation) -> Value {
    let filter = match estimation.filter {
        FilterKind::First { decay_per_s } => json!({ "order": "first", "decay_per_s": decay_per_s }),
        FilterKind::Second { bandwidth_rad_s } => json!({ "order": "second", "bandwidth_rad_s": bandwidth_rad_s }),
        FilterKind::Kalman { noise_rad_s, density, guess_deviation_rad_s } => json!({
            "order": "kalman", "noise_rad_s": noise_rad_s, "density_rad2_s3": density,
            "guess_deviation_rad_s": guess_deviation_rad_s,
        }),
    };
    json!({
        "schema": "corotate/estimate/v1",
        "log": log_json(&estimation.log),
        "hidden_axis": AXES[request.axis - 1],
        "coefficients": <[f64; 3]>::from(request.coefficients),
        "damping_per_s": request.damping_per_s,
        "wheel_n_m_s": request.wheel.map(|wheel| <[f64; 3]>::from(wheel.momentum)),
        "filter": filter,
        "floor_rad_s": estimation.floor_rad_s,
        "rate_chosen": estimation.chosen,
        "diverged": estimation.diverged,
        "choice": estimation.choice.map(|choice| json!({
            "decay_per_s": choice.decay_per_s, "balance_per_s": choice.balance_per_s,
            "forgetting_per_s": choice.forgetting_per_s, "noise_rad_s": choice.noise_rad_s,
            "drift_rad_s2": choice.drift_rad_s2, "segment_s": choice.segment_s, "interval_s": choice.interval_s,
        })),
        "score": overall(&estimation.segments).map(|overall| json!({
            "segments": overall.scored,
            "error_rad_s": { "median": overall.error_rad_s[0], "p90": overall.error_rad_s[1] },
            "measured_rad_s": { "median": overall.measured_rad_s },
            "part": { "median": overall.part[0], "p90": overall.part[1] },
        })),
        "segments": estimation.segments.iter().map(|(name, score)| json!({
            "name": name, "samples": score.samples, "scored": score.scored, "unobserved": score.unobserved,
            "too_long": score.too_long,
            "error_rad_s": score.error_rad_s, "measured_rad_s": score.measured_rad_s,
        })).collect::<Vec<_>>(),
    })
}

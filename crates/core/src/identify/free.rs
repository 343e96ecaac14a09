//! Finds the stretches of free motion of one body in a log that also has what happened between them.
//!
//! Short windows are taken as they come. A body that is fitted to one of them explains only the free ones among the others,
//! because the torques of a hand differ every time. So the body that explains the most windows is the one that was thrown,
//! and its windows are the free motion. Must not use a given body.

use super::Sample;
use super::motion::Sums;
use super::tensor::{Solution, solve};
use std::vec::Vec;

/// The turn of the fast body in a window, rad, and the number of samples in one.
const WINDOW_TURN_RAD: f64 = 4.0;
const WINDOW_SAMPLES: core::ops::RangeInclusive<usize> = 12..=400;
/// Windows begin at every such part of their length.
const STEPS: usize = 6;
/// A slower window, as a part of the fast rate, tells nothing.
const SLOW: f64 = 0.15;
/// The most windows that are compared, and of which a body is tried.
const WINDOWS: usize = 20_000;
const TRIED: usize = 240;
/// The part of a window's motion that a free body may leave unexplained.
const UNEXPLAINED: f64 = 0.01;
/// The part of a window by which both ends of a stretch are shortened.
const TRIM: usize = 16;
/// The rounds in which the body is fitted to its windows again.
const ROUNDS: usize = 4;

/// A short part of a segment.
struct Window {
    first: usize,
    last: usize,
    sums: Sums,
}

/// Returns the stretches of free motion in segments of rising times, as pairs of times, s.
pub fn free_stretches(segments: &[Vec<Sample>]) -> Vec<[f64; 2]> {
    let mut windows = Vec::new();
    let samples: Vec<Sample> = segments.iter().flatten().copied().collect();
    let (Some(fast_rad_s), Some(interval_s)) = (fast(&samples), interval(segments)) else { return Vec::new() };
    let length =
        ((WINDOW_TURN_RAD / (fast_rad_s * interval_s)) as usize).clamp(*WINDOW_SAMPLES.start(), *WINDOW_SAMPLES.end());
    let mut before = 0;
    for segment in segments {
        for first in (0..segment.len().saturating_sub(length - 1)).step_by((length / STEPS).max(1)) {
            let part = &segment[first..first + length];
            let speed = part.iter().map(|sample| sample.rate_rad_s.norm()).sum::<f64>() / length as f64;
            if speed > SLOW * fast_rad_s {
                windows.push(Window { first: before + first, last: before + first + length - 1, sums: sums(part) });
            }
        }
        before += segment.len();
    }
    // Of a long log, evenly.
    let kept = windows.len().div_ceil(WINDOWS).max(1);
    let compared: Vec<&Window> = windows.iter().step_by(kept).collect();
    let tried = compared.len().div_ceil(TRIED).max(1);
    let count = |body: &Solution| compared.iter().filter(|window| is_free(body, &window.sums)).count();
    let bodies = compared.iter().step_by(tried).filter_map(|window| solve(&window.sums, true, false));
    let counted = bodies.filter(is_body).map(|body| (count(&body), body));
    let Some((_, mut body)) = counted.max_by_key(|(count, _)| *count) else { return Vec::new() };
    for _ in 0..ROUNDS {
        let mut total = Sums::default();
        for window in compared.iter().filter(|window| is_free(&body, &window.sums)) {
            total.scatter += window.sums.scatter;
            total.samples += window.sums.samples;
        }
        match solve(&total, true, true).filter(is_body) {
            Some(better) => body = better,
            None => break,
        }
    }
    let mut stretches: Vec<[usize; 2]> = Vec::new();
    for window in windows.iter().filter(|window| is_free(&body, &window.sums)) {
        match stretches.last_mut() {
            Some([_, last]) if *last >= window.first => *last = window.last,
            _ => stretches.push([window.first, window.last]),
        }
    }
    // Their ends reach into what the hand did.
    let trim = length / TRIM;
    let trimmed = stretches.into_iter().map(|[first, last]| [first + trim, last - trim]);
    trimmed.map(|ends| ends.map(|index| samples[index].time_s)).collect()
}

/// Returns the sums of a window.
fn sums(part: &[Sample]) -> Sums {
    super::Motion::from_segments([part]).total()
}

/// Returns the rate that the fastest twentieth of the samples exceeds, rad/s.
fn fast(samples: &[Sample]) -> Option<f64> {
    let mut rates: Vec<f64> = samples.iter().map(|sample| sample.rate_rad_s.norm()).collect();
    rates.sort_by(f64::total_cmp);
    rates.get(rates.len() * 19 / 20).copied().filter(|rate| *rate > 0.0)
}

/// Returns the usual interval, s.
fn interval(segments: &[Vec<Sample>]) -> Option<f64> {
    let mut intervals: Vec<f64> =
        segments.iter().flat_map(|segment| segment.windows(2).map(|pair| pair[1].time_s - pair[0].time_s)).collect();
    intervals.sort_by(f64::total_cmp);
    intervals.get(intervals.len() / 2).copied()
}

/// Returns true if a body has these moments.
fn is_body(body: &Solution) -> bool {
    super::tensor::principal(&body.tensor).is_some_and(|(moments, _)| super::nearest_body(&moments).is_ok())
}

/// Returns true if the body explains the motion of a window.
fn is_free(body: &Solution, sums: &Sums) -> bool {
    super::tensor::left(sums, body).is_some_and(|left| {
        let whole: f64 = sums.scatter.diagonal().fixed_rows::<3>(0).sum();
        left.sum() < UNEXPLAINED * whole
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{Inertia, Noise, RigidBody};
    use nalgebra::Vector3;

    /// Returns throws of a body with hand motions between them at 100 Hz, and the times of the throws.
    fn log(throws: u64) -> (Vec<Sample>, Vec<[f64; 2]>) {
        let body = RigidBody::new(&Inertia::new([0.93, 0.08, 1.0]).unwrap());
        let (mut noise, mut draw) = (Noise::new(3, 0, [5e-3; 3], [0.0; 3]), Noise::new(4, 1, [6.0; 3], [0.0; 3]));
        let (mut samples, mut cuts) = (Vec::new(), Vec::new());
        let mut push = |rate_rad_s: Vector3<f64>| {
            let time_s = samples.len() as f64 * 0.01;
            samples.push(Sample { time_s, rate_rad_s: rate_rad_s + noise.sample() });
            time_s
        };
        for _ in 0..throws {
            // Waves of random frequency and phase, which end at the rate of the throw.
            let (mut rate, waves) = (draw.sample(), [draw.sample(), draw.sample(), draw.sample()]);
            for tick in 0..200 {
                let t = f64::from(tick) * 0.01;
                let wave = Vector3::from_fn(|axis, _| {
                    waves.iter().map(|wave| 2.0 * libm::sin(2.0 * wave[axis] * t + wave[(axis + 1) % 3])).sum()
                });
                let part = libm::pow(f64::from(tick) / 200.0, 8.0);
                push(wave * (1.0 - part) + rate * part);
            }
            let begin_s = push(rate);
            let mut end_s = begin_s;
            for _ in 0..70 {
                rate = body.flow(&rate, &Vector3::zeros(), 0.01);
                end_s = push(rate);
            }
            cuts.push([begin_s, end_s]);
        }
        (samples, cuts)
    }

    #[test]
    fn the_throws_between_hand_motions_are_found_and_nothing_else() {
        let (samples, cuts) = log(20);
        let found = free_stretches(&[samples]);
        let overlap =
            |cut: &[f64; 2]| found.iter().map(|own| (own[1].min(cut[1]) - own[0].max(cut[0])).max(0.0)).sum::<f64>();
        let hits = cuts.iter().filter(|cut| overlap(cut) > 0.3).count();
        let inside: f64 = cuts.iter().map(overlap).sum();
        let whole: f64 = found.iter().map(|own| own[1] - own[0]).sum();
        assert!(hits >= 18, "{hits}: {found:?} {cuts:?}");
        assert!(whole - inside < 0.05 * whole, "{inside} of {whole}: {found:?}");
    }

    #[test]
    fn nothing_is_found_in_hand_motions_or_at_rest() {
        let (samples, cuts) = log(20);
        let hand = |sample: &&Sample| !cuts.iter().any(|cut| (cut[0] - 0.3..=cut[1]).contains(&sample.time_s));
        let hand: Vec<Sample> = samples.iter().filter(hand).copied().collect();
        // One segment for each pause.
        let mut segments: Vec<Vec<Sample>> = Vec::new();
        for sample in hand {
            match segments.last_mut() {
                Some(last) if sample.time_s - last[last.len() - 1].time_s < 0.05 => last.push(sample),
                _ => segments.push(vec![sample]),
            }
        }
        let found: f64 = free_stretches(&segments).iter().map(|own| own[1] - own[0]).sum();
        assert!(found < 0.5, "{found}");
        let rest = |tick| Sample { time_s: f64::from(tick), rate_rad_s: Vector3::zeros() };
        assert!(free_stretches(&[(0..100).map(rest).collect()]).is_empty());
        assert!(free_stretches(&[]).is_empty() && free_stretches(&[vec![rest(0)]]).is_empty());
    }
}

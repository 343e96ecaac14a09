//! Finds the stretches of free motion of one body in a log that also has what happened between them.
//!
//! Short windows are taken as they come. An accelerometer at a fixed place r of a falling body shows ω̇ × r + ω × (ω × r) and no
//! gravity, so its windows of free motion are known. Without one, or if it shows none: a body that is fitted to one window
//! explains only the free ones among the others, because the torques of a hand differ every time. So the body that explains the
//! most windows is the one that was thrown, and its windows are the free motion. Must not use a given body.

use super::motion::Sample;
use super::motion::Sums;
use super::tensor::{Solution, solve};
use nalgebra::{Matrix3, Vector3};
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
/// The part of gravity that an accelerometer may show in free motion beyond that of its place.
const WEIGHT: f64 = 0.2;
/// The part of a window by which both ends of a stretch are shortened.
const TRIM: usize = 16;
/// The rounds in which the body is fitted to its windows again.
const ROUNDS: usize = 4;

/// A short part of a segment.
struct Window {
    first: usize,
    last: usize,
    sums: Sums,
    weightless: bool,
}

/// Returns the stretches of free motion in segments of rising times, as pairs of times, s, and true if the accelerometer shows some.
/// `forces` has its values at the samples, gravity included, in any unit; NaN without one.
pub fn free_stretches(segments: &[Vec<Sample>], forces: &[Vector3<f64>]) -> (Vec<[f64; 2]>, bool) {
    let mut windows = Vec::new();
    let samples: Vec<Sample> = segments.iter().flatten().copied().collect();
    let (Some(fast_rad_s), Some(interval_s)) = (fast(&samples), interval(segments)) else { return (Vec::new(), false) };
    let length =
        ((WINDOW_TURN_RAD / (fast_rad_s * interval_s)) as usize).clamp(*WINDOW_SAMPLES.start(), *WINDOW_SAMPLES.end());
    let slow = samples.iter().zip(forces).filter(|(sample, _)| sample.rate_rad_s.norm() < SLOW * fast_rad_s);
    let weight = quantile(slow.map(|(_, force)| force.norm()).filter(|force| force.is_finite()), 0.5);
    let mut before = 0;
    for segment in segments {
        for first in (0..segment.len().saturating_sub(length - 1)).step_by((length / STEPS).max(1)) {
            let part = &segment[first..first + length];
            let speed = part.iter().map(|sample| sample.rate_rad_s.norm()).sum::<f64>() / length as f64;
            if speed > SLOW * fast_rad_s {
                let (first, last) = (before + first, before + first + length - 1);
                let force = forces.get(first..=last).and_then(|forces| beside_place(part, forces));
                let weightless = weight.zip(force).is_some_and(|(weight, force)| force < WEIGHT * weight);
                windows.push(Window { first, last, sums: sums(part), weightless });
            }
        }
        before += segment.len();
    }
    // Of a long log, evenly.
    let kept = windows.len().div_ceil(WINDOWS).max(1);
    let compared: Vec<&Window> = windows.iter().step_by(kept).collect();
    let tried = compared.len().div_ceil(TRIED).max(1);
    let count = |body: &Solution| compared.iter().filter(|window| is_free(body, &window.sums)).count();
    let bodies =
        || compared.iter().step_by(tried).filter_map(|window| solve(&window.sums, true, false)).filter(is_body);
    let most = || bodies().map(|body| (count(&body), body)).max_by_key(|(count, _)| *count).map(|(_, body)| body);
    let weightless = windows.iter().any(|window| window.weightless);
    let mut body = if weightless { None } else { most() };
    let free = |body: Option<&Solution>, window: &Window| {
        window.weightless || body.is_some_and(|body| is_free(body, &window.sums))
    };
    for _ in 0..ROUNDS {
        let mut total = Sums::default();
        for window in compared.iter().filter(|window| free(body.as_ref(), window)) {
            total.scatter += window.sums.scatter;
            total.samples += window.sums.samples;
        }
        match solve(&total, true, true).filter(is_body) {
            Some(better) => body = Some(better),
            None => break,
        }
    }
    let mut stretches: Vec<[usize; 2]> = Vec::new();
    for window in windows.iter().filter(|window| free(body.as_ref(), window)) {
        match stretches.last_mut() {
            Some([_, last]) if *last >= window.first => *last = window.last,
            _ => stretches.push([window.first, window.last]),
        }
    }
    // Their ends reach into what the hand did.
    let trim = length / TRIM;
    let trimmed = stretches.into_iter().map(|[first, last]| [first + trim, last - trim]);
    (trimmed.map(|ends| ends.map(|index| samples[index].time_s)).collect(), weightless)
}

/// Returns the sums of a window.
fn sums(part: &[Sample]) -> Sums {
    super::Motion::from_segments([part]).total()
}

/// Returns the root mean square of what an accelerometer shows beyond ω̇ × r + ω × (ω × r) at the place r that leaves the least.
fn beside_place(samples: &[Sample], forces: &[Vector3<f64>]) -> Option<f64> {
    let (mut normal, mut right, mut square) = (Matrix3::zeros(), Vector3::zeros(), 0.0);
    for (around, force) in samples.windows(3).zip(&forces[1..]) {
        let change = (around[2].rate_rad_s - around[0].rate_rad_s) / (around[2].time_s - around[0].time_s);
        let rate = around[1].rate_rad_s.cross_matrix();
        let map = change.cross_matrix() + rate * rate;
        normal += map.transpose() * map;
        right += map.transpose() * force;
        square += force.norm_squared();
    }
    // Places along a single axis of rotation differ by nothing.
    let place = (normal + Matrix3::identity() * (1e-9 * normal.trace())).cholesky()?.solve(&right);
    let left = square - right.dot(&place);
    left.is_finite().then(|| libm::sqrt(left.max(0.0) / (samples.len() - 2) as f64))
}

/// Returns the rate that the fastest twentieth of the samples exceeds, rad/s.
fn fast(samples: &[Sample]) -> Option<f64> {
    quantile(samples.iter().map(|sample| sample.rate_rad_s.norm()), 0.95).filter(|rate| *rate > 0.0)
}

/// Returns the usual interval, s.
fn interval(segments: &[Vec<Sample>]) -> Option<f64> {
    let pairs = segments.iter().flat_map(|segment| segment.windows(2));
    quantile(pairs.map(|pair| pair[1].time_s - pair[0].time_s), 0.5)
}

/// Returns the value that a part of the values stay below.
fn quantile(values: impl Iterator<Item = f64>, part: f64) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values.get((values.len() as f64 * part) as usize).copied()
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
        let (found, _) = free_stretches(&[samples], &[]);
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
        let found: f64 = free_stretches(&segments, &[]).0.iter().map(|own| own[1] - own[0]).sum();
        assert!(found < 0.5, "{found}");
        let rest = |tick| Sample { time_s: f64::from(tick), rate_rad_s: Vector3::zeros() };
        for segments in [vec![(0..100).map(rest).collect()], vec![vec![rest(0)]], vec![]] {
            assert_eq!(free_stretches(&segments, &[]), (vec![], false));
        }
    }

    #[test]
    fn an_accelerometer_beside_the_centre_shows_the_throws_of_a_body_about_one_axis() {
        let place = Vector3::new(0.08, -0.03, 0.05);
        let (mut samples, mut forces, mut cuts) = (Vec::new(), Vec::new(), Vec::new());
        let mut noise = Noise::new(5, 0, [5e-3; 3], [0.0; 3]);
        for throw in 0..10 {
            // It lies still, swings with the hand, flies about one axis, and swings again.
            let begin_s = 2.9 * f64::from(throw);
            cuts.push([begin_s + 1.5, begin_s + 2.2]);
            let mut angle = 0.0;
            for tick in 0..290 {
                let speed = |tick: i32| {
                    9.0 * libm::fmin(f64::from(tick - 80) / 70.0, f64::from(290 - tick) / 40.0).clamp(0.0, 1.0)
                };
                let (rate, change) =
                    (Vector3::y() * speed(tick), Vector3::y() * ((speed(tick + 1) - speed(tick - 1)) / 0.02));
                let mut force = change.cross(&place) + rate.cross(&rate.cross(&place));
                angle -= rate.y * 0.01;
                if !(150..220).contains(&tick) {
                    force += Vector3::new(libm::sin(angle), 0.0, libm::cos(angle)) * 9.81;
                }
                let t = f64::from(tick) * 0.01;
                samples.push(Sample { time_s: begin_s + t, rate_rad_s: rate + noise.sample() });
                forces.push(force + noise.sample() * 10.0);
            }
        }
        for unit in [1.0, 1.0 / 9.81] {
            let forces: Vec<Vector3<f64>> = forces.iter().map(|force| force * unit).collect();
            let (found, shown) = free_stretches(&[samples.clone()], &forces);
            assert!(shown && found.len() == cuts.len(), "{found:?}");
            for (found, cut) in found.iter().zip(&cuts) {
                assert!((found[0] - cut[0]).abs() < 0.1 && (found[1] - cut[1]).abs() < 0.1, "{found:?} {cut:?}");
            }
        }
        // Without gravity it tells nothing.
        let linear = vec![Vector3::zeros(); samples.len()];
        assert_eq!(free_stretches(&[samples.clone()], &linear), free_stretches(&[samples], &[]));
    }
}

//! Checks the mathematics: Euler's equations against independent reference trajectories, the observer's floor, decay
//! and order against its derivation, and general properties with random bodies.
//!
//! Every run uses only the pure part of the library: no clock, no processes, measurements exact to rounding.

use crate::common::cases;
use corotate::control::{Certificate, Condition};
use corotate::model::{Inertia, InertiaError, RigidBody};
use corotate::observe::{Conic, HiddenRate, InvariantFilter, Observation, RateSample};
use nalgebra::{Vector1, Vector3};
use proptest::prelude::*;
use std::f64::consts::PI;

/// The level below which measured components carry no information, rad/s; no motion here comes near it.
const BLIND_RAD_S: f64 = 1e-6;

/// The designed −λ of the examples, 1/s.
const DECAY_PER_S: f64 = 5.0;

/// The time after which e^{λt} is below the rounding of the estimate, s.
const SETTLED_S: f64 = 8.0;

/// A body and its initial rates for every conic; the hidden axis is 3. The names are those that the conic prints.
const EXAMPLES: [(&str, [f64; 3], [f64; 3]); 4] = [
    ("Elliptic", [1.0, 2.0, 3.0], [0.6, -0.4, 0.8]),
    ("Hyperbolic", [1.0, 3.0, 2.0], [0.9, 0.3, 0.8]),
    ("ParabolicFirst", [2.0, 1.5, 2.0], [0.5, 0.4, 0.7]),
    ("ParabolicSecond", [1.5, 2.0, 2.0], [0.4, 0.5, 0.7]),
];

/// A body's motion as sampled by its sensors.
struct Motion {
    coefficients: Vector3<f64>,
    torque: Vector3<f64>,
    /// The time from each sample to the next, s.
    steps: Vec<f64>,
    /// The angular velocity at each sample, rad/s: one more than there are steps.
    rates: Vec<Vector3<f64>>,
}

impl Motion {
    /// Moves a body tick by tick, as the plant does, and samples it after each of the given numbers of ticks.
    fn new(
        moments: [f64; 3],
        start: Vector3<f64>,
        torque: Vector3<f64>,
        tick_s: f64,
        ticks_per_sample: impl IntoIterator<Item = u32>,
    ) -> Self {
        let body = RigidBody::new(&Inertia::new(moments).unwrap());
        let (mut rate, mut steps, mut rates) = (start, Vec::new(), vec![start]);
        for ticks in ticks_per_sample {
            for _ in 0..ticks {
                rate = body.flow(&rate, &torque, tick_s);
            }
            steps.push(f64::from(ticks) * tick_s);
            rates.push(rate);
        }
        Self { coefficients: *body.coefficients(), torque, steps, rates }
    }

    /// Returns a torque-free motion sampled at every tick.
    fn free(moments: [f64; 3], start: [f64; 3], tick_s: f64, duration_s: f64) -> Self {
        let ticks = (duration_s / tick_s).round() as usize;
        Self::new(moments, start.into(), Vector3::zeros(), tick_s, std::iter::repeat_n(1, ticks))
    }

    fn relation(&self, axis: usize) -> HiddenRate {
        HiddenRate::new(&self.coefficients, axis, BLIND_RAD_S).unwrap()
    }

    /// Returns the time of each sample, s.
    fn times(&self) -> impl Iterator<Item = f64> {
        std::iter::once(0.0).chain(self.steps.iter().scan(0.0, |time, step| {
            *time += step;
            Some(*time)
        }))
    }

    /// Returns ω_k − ω̂_k at each sample for the hidden axis k, from an initial guess. No step may count as
    /// unobservable.
    fn errors(&self, axis: usize, decay_per_s: f64, guess: f64) -> Vec<f64> {
        let relation = self.relation(axis);
        let mut filter = InvariantFilter::new(Vector1::new(decay_per_s), Vector1::new(guess));
        let mut errors = vec![self.rates[0][axis - 1] - guess];
        for (ends, &step) in self.rates.windows(2).zip(&self.steps) {
            let [from, to] = [ends[0], ends[1]].map(|rate| self.sample(rate, axis));
            match relation.observe(&relation.regressor(&from), &relation.regressor(&to), step, filter.estimate().x) {
                Observation::Seen(increment) => filter.step(&increment),
                Observation::Unobservable { .. } => panic!("unobservable between {} and {}", ends[0], ends[1]),
            }
            errors.push(ends[1][axis - 1] - filter.estimate().x);
        }
        errors
    }

    /// Returns the observer's input. The hidden component is NaN, so that any use of it would show.
    fn sample(&self, mut rate: Vector3<f64>, axis: usize) -> RateSample {
        rate[axis - 1] = f64::NAN;
        RateSample { rate_rad_s: rate, torque_rad_s2: self.torque }
    }

    /// Returns the largest error at or after a time.
    fn worst_after(&self, time_s: f64, errors: &[f64]) -> f64 {
        let late = self.times().zip(errors).filter(|(time, _)| *time >= time_s);
        greatest(late.map(|(_, error)| error.abs()))
    }

    /// Returns the largest |∂φ/∂ω_i| + |∂φ/∂ω_j| along the motion, s: the sensitivity of the relation to measurement
    /// errors.
    fn sensitivity(&self, axis: usize) -> f64 {
        let conic = self.relation(axis).conic();
        let (i, j) = (axis % 3, (axis + 1) % 3);
        let (ai, aj) = (self.coefficients[i].abs(), self.coefficients[j].abs());
        let quotient = |a: f64, top: f64, bottom: f64| (1.0 + top / bottom) / (a * bottom);
        let at = |rate: &Vector3<f64>| {
            let (wi, wj) = (rate[i].abs(), rate[j].abs());
            match conic {
                Conic::Elliptic { omega } => ai * (wi + wj) / ((omega * wi).powi(2) + (ai * wj).powi(2)),
                // The larger of |z₊| and |z₋| is the sum of the magnitudes.
                Conic::Hyperbolic { omega } => (omega + ai) / (omega * (omega * wi + ai * wj)),
                Conic::ParabolicFirst => quotient(ai, wi, wj),
                Conic::ParabolicSecond => quotient(aj, wj, wi),
            }
        };
        greatest(self.rates.iter().map(at))
    }

    /// Returns the largest component of the angular velocity along the motion, rad/s.
    fn fastest(&self) -> f64 {
        greatest(self.rates.iter().map(|rate| rate.amax()))
    }

    /// Returns the bound on the error apart from the decaying initial one.
    ///
    /// With M = max |ω_i|, α = max |a_i|, U = max |u_i| and ν = αM + U/M the components obey |ω̇| ≤ Mν, the n-th
    /// derivative of the drift is at most αM²(n+1)!νⁿ, and three things disturb a step of length h:
    ///
    /// - the drift, by h⁵(g⁗/720 + K g″/144), see [`the_error_is_of_fourth_order_in_the_tick`]; h⁵αM²ν⁴/4 at most;
    /// - the torque's share of Δφ, by Simpson's rule and the interpolated middle: φ changes its slope at the relative rate
    ///   μ = ν(1 + M|∇φ|), and Simpson's 1/120 and the middle's 1/24 of |∇φ|Uμ⁴h⁵ stay within an eighth;
    /// - rounding, of the measurements and of the body's own integration (steps of a few milliradians): a few ulps of M
    ///   each, |∇φ| times that in φ, taken as all of one sign.
    ///
    /// A constant disturbance d of the drift results in d/(1 − e^{λh}) + d/2, one of Δφ in d/h. A factor of two
    /// covers the remainders of higher order and the slack of the bounds.
    fn floor(&self, axis: usize, decay_per_s: f64) -> f64 {
        let (longest, shortest) =
            self.steps.iter().fold((0.0_f64, f64::INFINITY), |(most, least), &h| (most.max(h), least.min(h)));
        let (rate, a, torque) = (self.fastest(), self.coefficients.amax(), self.torque.amax());
        let gradient = self.sensitivity(axis);
        let change = a * rate + torque / rate;
        let bend = change * (1.0 + rate * gradient);
        let drift = a * rate.powi(2) * change.powi(4) * longest.powi(5) / 4.0;
        let drift = drift * (0.5 - 1.0 / (-decay_per_s * longest).exp_m1());
        let driven = gradient * torque * (bend * longest).powi(4) / 8.0;
        let roundings_per_s = 4.0 / shortest + 2000.0 * rate;
        let rounding = f64::EPSILON * rate * (gradient + 1.0 / decay_per_s) * roundings_per_s;
        2.0 * (drift + driven + rounding)
    }

    /// Returns true if the measured components stay away from the unobservable set: a relative disturbance of them
    /// must not be amplified in φ more than a hundredfold.
    fn well_conditioned(&self, axis: usize) -> bool {
        self.fastest() * self.sensitivity(axis) < 100.0
    }
}

/// Returns the largest of non-negative numbers; a NaN exceeds every bound.
fn greatest(numbers: impl Iterator<Item = f64>) -> f64 {
    numbers.map(|number| if number.is_nan() { f64::INFINITY } else { number }).fold(0.0, f64::max)
}

/// Returns the slope of ln|error| over time by least squares, for errors within `between`.
fn fitted_decay(motion: &Motion, errors: &[f64], between: std::ops::Range<f64>) -> f64 {
    let points: Vec<(f64, f64)> = motion
        .times()
        .zip(errors.iter().map(|error| error.abs()))
        .filter(|(_, error)| between.contains(error))
        .map(|(time, error)| (time, error.ln()))
        .collect();
    assert!(points.len() > 100, "only {} clean points", points.len());
    let n = points.len() as f64;
    let (time, log) = points.iter().fold((0.0, 0.0), |(t, l), point| (t + point.0 / n, l + point.1 / n));
    let (square, product) = points.iter().fold((0.0, 0.0), |(square, product), point| {
        (square + (point.0 - time).powi(2), product + (point.0 - time) * (point.1 - log))
    });
    product / square
}

/// Returns a reference trajectory: the instants, s, and the angular velocities at them, rad/s.
fn reference(name: &str) -> Vec<(f64, Vector3<f64>)> {
    let path = format!("{}{name}.csv", concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/"));
    let text = std::fs::read_to_string(path).unwrap();
    let row = |line: &str| {
        let cells: Vec<f64> = line.split(',').map(|cell| cell.trim().parse().unwrap()).collect();
        (cells[0], Vector3::from_column_slice(&cells[1..]))
    };
    text.lines().skip(1).map(row).collect()
}

/// Moments and initial rates are those of `FREE` in the script that created the data.
#[test]
fn free_motion_follows_the_reference_trajectories() {
    for (name, moments) in [
        ("free_elliptic_largest", [1.0, 2.0, 2.5]),
        ("free_elliptic_smallest", [2.0, 2.5, 1.0]),
        ("free_hyperbolic", [1.0, 2.5, 2.0]),
        ("free_parabolic", [2.0, 1.5, 2.0]),
        ("free_axisymmetric", [1.0, 1.0, 1.6]),
    ] {
        let rows = reference(name);
        assert_eq!((rows.len(), rows[200].0), (201, 20.0), "{name}");
        let motion = Motion::free(moments, rows[0].1.into(), 1e-3, 20.0);
        let deviation = |(row, (_, rate)): (usize, &(f64, Vector3<f64>))| (motion.rates[100 * row] - rate).norm();
        let worst = greatest(rows.iter().enumerate().map(deviation));
        println!("{name}: worst deviation {worst:.2e} rad/s");
        assert!(worst < 1e-10, "{name}: {worst:e}");
    }
}

#[test]
fn the_examples_cover_every_conic() {
    for (name, moments, start) in EXAMPLES {
        let conic = Motion::free(moments, start, 1.0, 0.0).relation(3).conic();
        assert!(format!("{conic:?} ").starts_with(&format!("{name} ")), "{name}: {conic:?}");
    }
}

#[test]
fn a_settled_estimate_is_the_truth_in_every_conic() {
    for (name, moments, start) in EXAMPLES {
        let [coarse, fine] = [1e-2, 1e-3].map(|tick_s| {
            let motion = Motion::free(moments, start, tick_s, 20.0);
            motion.worst_after(SETTLED_S, &motion.errors(3, DECAY_PER_S, 0.0))
        });
        println!("{name}: floor {coarse:.2e} rad/s at 100 Hz, {fine:.2e} rad/s at 1 kHz");
        assert!(fine <= 1e-11, "{name}: {fine:e}");
    }
}

#[test]
fn the_decay_is_the_designed_one() {
    for (name, moments, start) in EXAMPLES {
        for tick_s in [1e-2, 1e-3] {
            let motion = Motion::free(moments, start, tick_s, 4.0);
            let slope = fitted_decay(&motion, &motion.errors(3, DECAY_PER_S, 0.0), 1e-6..1.0);
            println!("{name}: decay {slope:.9} 1/s at a tick of {tick_s} s");
            assert!((slope / -DECAY_PER_S - 1.0).abs() < 1e-6, "{name} at {tick_s}: {slope}");
        }
    }
}

/// The order is four, although the error of one step is of fifth order. With K = ġ/ω_k, over one step of length h,
///
/// - the cubic Hermite polynomial of the drift g integrates to h⁵g⁗/720 of the true ∫g;
/// - its end slopes K ω_k use ω_k from a linear drift, wrong by ∓h³g″/24 at the two ends, which adds h⁵K g″/144;
/// - ω_k at the start, from ∫ω_k = Δφ, is wrong by half as much, and of that only 1 − e^{λh} is let in.
///
/// Δφ itself is exact. The drift's error acts uncorrected for 1/|λ|, that is for 1/(|λ|h) steps, which costs one
/// order: the error obeys ε̇ = λε + h⁴(g⁗/720 + K g″/144) + O(h⁵). A tick that is long against 1/|λ| would hide that
/// and show the fifth order; hence the slow λ.
#[test]
fn the_error_is_of_fourth_order_in_the_tick() {
    let ticks_s = [0.4, 0.2, 0.1, 0.05];
    for (name, moments, start) in EXAMPLES {
        let rms = ticks_s.map(|tick_s| {
            let motion = Motion::free(moments, start, tick_s, 80.0);
            let errors = motion.errors(3, 0.5, start[2]);
            // At the instants that all ticks share; otherwise the orders would compare different phases of the
            // motion.
            let shared = errors.iter().step_by((ticks_s[0] / tick_s).round() as usize).skip(25);
            (shared.clone().map(|error| error * error).sum::<f64>() / shared.count() as f64).sqrt()
        });
        let orders: Vec<f64> = rms.windows(2).map(|pair| (pair[0] / pair[1]).log2()).collect();
        let shown = rms.map(|error| format!("{error:.2e}")).join(", ");
        println!("{name}: rms errors {shown} rad/s at ticks of {ticks_s:?} s, orders {orders:.3?}");
        let order = orders[orders.len() - 1];
        assert!((order - 4.0).abs() < 0.1, "{name}: {orders:?}");
    }
}

/// Returns the number of changes of a property between neighbours in a sequence.
fn changes<T: PartialEq>(sequence: impl Iterator<Item = T> + Clone) -> usize {
    sequence.clone().zip(sequence.skip(1)).filter(|(before, after)| before != after).count()
}

#[test]
fn neither_a_branch_cut_nor_a_change_of_sign_disturbs_the_estimate() {
    for (name, moments, start) in &EXAMPLES[..2] {
        let motion = Motion::free(*moments, start.map(|rate| 3.0 * rate), 1e-3, 60.0);
        let worst = motion.worst_after(SETTLED_S, &motion.errors(3, DECAY_PER_S, 0.0));
        let settled = motion.rates.iter().skip((SETTLED_S / 1e-3) as usize);
        let flips = [0, 1, 2].map(|axis| changes(settled.clone().map(|rate| rate[axis] > 0.0)));
        let products = changes(settled.clone().map(|rate| rate.x * rate.y > 0.0));
        let (a, mut wraps) = (motion.coefficients, 0);
        if let Conic::Elliptic { omega } = motion.relation(3).conic() {
            let phases = settled.map(|rate| (omega * rate.x).atan2(a.x * rate.y));
            wraps = phases.clone().zip(phases.skip(1)).filter(|(before, after)| (after - before).abs() > PI).count();
            assert!(wraps > 10, "{name}: {wraps} wraps");
        }
        println!("{name}: {wraps} wraps, {flips:?} flips, {products} of ω1ω2, worst error {worst:.2e} rad/s");
        assert!(products > 10 && flips[0] + flips[1] > 10, "{name}: {flips:?}, {products}");
        assert!(worst < 1e-10, "{name}: {worst:e}");
    }
}

/// A random body, its hidden component, and its observer.
#[derive(Debug, Clone)]
struct Case {
    moments: [f64; 3],
    axis: usize,
    start: Vector3<f64>,
    decay_per_s: f64,
    tick_s: f64,
    guess: f64,
}

/// Returns the moments of inertia for the second moments of mass along the axes: possible if no mass is negative.
fn moments_of(spread: [f64; 3]) -> [f64; 3] {
    [spread[1] + spread[2], spread[2] + spread[0], spread[0] + spread[1]]
}

fn vector(bound: f64) -> impl Strategy<Value = Vector3<f64>> {
    prop::array::uniform3(-bound..bound).prop_map(Vector3::from)
}

/// Generates bodies of which a quarter is exactly axisymmetric, so that the parabolas occur too. The others stay away
/// from symmetry, where Ω vanishes and the accuracy is low.
fn body() -> impl Strategy<Value = [f64; 3]> {
    let spread = prop::array::uniform3(0.02..1.0_f64);
    let body = (spread, prop::option::weighted(0.25, 0..3_usize)).prop_map(|(mut spread, twin)| {
        if let Some(axis) = twin {
            spread[axis] = spread[(axis + 1) % 3];
        }
        moments_of(spread)
    });
    body.prop_filter("nearly symmetric", |moments| {
        let a = Inertia::new(*moments).unwrap().coefficients().abs();
        a.max() > 0.05 && a.iter().all(|a| *a == 0.0 || *a > 0.05)
    })
}

fn case() -> impl Strategy<Value = Case> {
    let observer = (0.5..20.0, (100.0_f64.ln()..2000.0_f64.ln()).prop_map(|log_hz| (-log_hz).exp()), -4.0..4.0);
    (body(), 1..=3_usize, vector(1.5), observer).prop_map(|(moments, axis, start, (decay_per_s, tick_s, guess))| Case {
        moments,
        axis,
        start,
        decay_per_s,
        tick_s,
        guess,
    })
}

impl Case {
    fn motion(&self, torque: Vector3<f64>, ticks_per_sample: impl IntoIterator<Item = u32>) -> Motion {
        Motion::new(self.moments, self.start, torque, self.tick_s, ticks_per_sample)
    }

    /// Returns a sample at every tick, until the initial error must have vanished or enough is sampled.
    fn every_tick(&self) -> impl Iterator<Item = u32> + use<> {
        let ticks = 30.0 / (self.decay_per_s * self.tick_s);
        std::iter::repeat_n(1, (ticks as usize).min(1000))
    }

    /// Checks that the error is e^{λt} times the initial one, including its sign, up to the floor: as an upper bound
    /// and, while far above the floor, as a lower bound.
    fn check_contraction(&self, motion: &Motion) -> Result<(), TestCaseError> {
        prop_assume!(motion.well_conditioned(self.axis));
        let floor = motion.floor(self.axis, self.decay_per_s);
        // A bound that permits everything would prove nothing.
        prop_assume!(floor < 1e-4);
        let errors = motion.errors(self.axis, self.decay_per_s, self.guess);
        for (time, error) in motion.times().zip(&errors) {
            let decayed = errors[0] * (-self.decay_per_s * time).exp();
            // The second term covers the rounding of a thousand products and of the time itself.
            let allowed = floor + 1e-10 * decayed.abs();
            prop_assert!((error - decayed).abs() <= allowed, "{error:e} for {decayed:e} ± {allowed:e} at {time} s");
        }
        Ok(())
    }
}

proptest! {
    #![proptest_config(cases(192))]

    #[test]
    fn the_error_of_any_body_contracts_as_designed(case in case()) {
        case.check_contraction(&case.motion(Vector3::zeros(), case.every_tick()))?;
    }

    #[test]
    fn a_known_torque_does_not_change_the_contraction(case in case(), torque in vector(0.2)) {
        case.check_contraction(&case.motion(torque, case.every_tick()))?;
    }

    #[test]
    fn missed_ticks_only_lengthen_a_step(case in case(), gaps in prop::collection::vec(1..=7_u32, 200)) {
        case.check_contraction(&case.motion(Vector3::zeros(), gaps))?;
    }

    /// Exact to the last bit, because the three axes use the same arithmetic.
    #[test]
    fn the_numbering_of_the_axes_does_not_matter(case in case(), torque in vector(0.2)) {
        let turned = Case {
            moments: [case.moments[2], case.moments[0], case.moments[1]],
            axis: case.axis % 3 + 1,
            start: case.start.zxy(),
            ..case.clone()
        };
        let motion = case.motion(torque, case.every_tick().take(200));
        let turned_motion = turned.motion(torque.zxy(), turned.every_tick().take(200));
        prop_assume!(motion.well_conditioned(case.axis));
        let errors = motion.errors(case.axis, case.decay_per_s, case.guess);
        prop_assert_eq!(errors, turned_motion.errors(turned.axis, turned.decay_per_s, turned.guess));
    }
}

/// Generates a positive number of any order of magnitude from 1e-9 to 1e3.
fn margin() -> impl Strategy<Value = f64> {
    (-9.0..3.0_f64).prop_map(|log10| 10.0_f64.powf(log10))
}

/// Generates invalid additions to a moment.
fn flaw() -> impl Strategy<Value = f64> {
    prop_oneof![Just(0.0), Just(-0.0), Just(-1.0), Just(f64::NAN), Just(f64::INFINITY), Just(f64::NEG_INFINITY)]
}

proptest! {
    #![proptest_config(cases(3000))]

    /// With |k_i| > |a_i| M the exact bound M²a_i²/(4|k_i|) + |k_k|/4 is below M|a_i|/4 + |k_k|/4: the paper requires
    /// at least twice the necessary rate.
    #[test]
    fn the_paper_s_condition_implies_the_exact_one(
        moments in body(), axis in 1..=3_usize, bound in margin(), over in prop::array::uniform3(margin()), last in margin()
    ) {
        let a = Inertia::new(moments).unwrap().coefficients();
        let [i, j, k] = [axis % 3, (axis + 1) % 3, axis - 1];
        let mut gain = Vector3::zeros();
        gain[i] = a[i].abs() * bound * (1.0 + over[0]) + f64::MIN_POSITIVE;
        gain[j] = a[j].abs() * bound * (1.0 + over[1]) + f64::MIN_POSITIVE;
        gain[k] = over[2];
        let decay = (gain[k] / 2.0 + (a[i].abs() + a[j].abs()) * bound) * (1.0 + last);
        let certificate = Certificate::new(&a, axis, &gain, decay, bound, 1e-3, 1);
        prop_assert!(certificate.paper.iter().all(Condition::holds), "the case must meet the paper's condition: {certificate:?}");
        prop_assert!(certificate.exact.holds(), "{certificate:?}");
        prop_assert!(certificate.exact.required <= certificate.paper[2].required / 2.0 * (1.0 + 1e-9), "{certificate:?}");
    }

    /// The criterion is the required mass: the moments are possible if no second moment of mass along an axis is
    /// negative and at most one is zero.
    #[test]
    fn an_inertia_is_accepted_if_some_distribution_of_mass_has_it(
        spread in prop::array::uniform3(prop_oneof![1 => Just(0.0), 6 => 1e-6..1.0_f64, 1 => -1.0..-1e-6_f64]),
        scale in margin(),
    ) {
        let moments = moments_of(spread.map(|mass| mass * scale));
        let physical = spread.iter().all(|mass| *mass >= 0.0) && moments.iter().all(|moment| *moment > 0.0);
        match Inertia::new(moments) {
            Ok(inertia) => {
                let a = inertia.coefficients();
                prop_assert!(physical, "{moments:?} accepted");
                prop_assert!(a.amax() <= 1.0 + 1e-9, "{a}");
                prop_assert!((a.sum() + a.product()).abs() <= 8.0 * f64::EPSILON, "{a}");
            }
            Err(InertiaError::Triangle { axis, .. }) => prop_assert!(spread[axis - 1] < 0.0, "{moments:?}: {axis}"),
            Err(InertiaError::NotPositive { axis, .. }) => prop_assert!(moments[axis - 1] <= 0.0, "{moments:?}: {axis}"),
        }
    }

    #[test]
    fn a_moment_that_is_not_positive_and_finite_is_refused(moments in body(), axis in 1..=3_usize, flaw in flaw()) {
        let mut moments = moments;
        moments[axis - 1] = flaw;
        let refusal = Inertia::new(moments);
        let named = matches!(refusal, Err(InertiaError::NotPositive { axis: at, .. }) if at == axis);
        prop_assert!(named, "{moments:?}: {refusal:?}");
    }
}

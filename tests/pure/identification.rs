//! Checks the identification of inertia: error floor, decay with excitation, changes of sign, torque, missed ticks,
//! and motions without information, which must not change the estimate.
//!
//! Every run uses only the pure part of the library, with measurements exact to rounding.

use crate::common::cases;
use corotate::model::{Inertia, RigidBody};
use corotate::observe::{
    AxisymmetricRelation, Hurwitz, HurwitzError, Identification, InertiaRatios, InertiaRelation, InvariantFilter,
    RateSample,
};
use nalgebra::{Matrix3, Rotation3, Vector1, Vector3};
use proptest::prelude::*;
use std::iter::repeat_n;

/// The mean of |ω1 ω2 ω3| below which a step does not excite, (rad/s)³.
const FLOOR_RAD3_S3: f64 = 1e-9;

/// The rate below which a component is at rest, rad/s.
const FLOOR_RAD_S: f64 = 1e-6;

/// Two bodies and a flat plate, tumbling: each changes the sign of ω1 ω2 ω3 dozens of times in [`RUN_S`].
const EXAMPLES: [([f64; 3], [f64; 3]); 3] =
    [([1.0, 2.0, 2.5], [1.2, -0.8, 1.6]), ([2.5, 1.2, 2.0], [0.9, 1.4, -0.7]), ([1.0, 2.0, 3.0], [1.2, -0.8, 1.6])];

/// The duration of the examples, s.
const RUN_S: f64 = 100.0;

/// The designed −λ of the identifier, s²/rad³.
const DECAY: f64 = 3.0;

/// A sampled motion.
struct Motion {
    coefficients: Vector3<f64>,
    torque: Vector3<f64>,
    steps: Vec<f64>,
    rates: Vec<Vector3<f64>>,
}

impl Motion {
    /// Moves a body tick by tick and samples it after each of the given numbers of ticks.
    fn new(
        moments: [f64; 3],
        start: Vector3<f64>,
        torque: Vector3<f64>,
        tick_s: f64,
        ticks_per_sample: impl IntoIterator<Item = u32>,
    ) -> Self {
        let body = RigidBody::new(&Inertia::new(moments).unwrap());
        let (mut steps, mut rates) = (Vec::new(), vec![start]);
        for ticks in ticks_per_sample {
            let step = f64::from(ticks) * tick_s;
            rates.push(body.flow(&rates[rates.len() - 1], &torque, step));
            steps.push(step);
        }
        Self { coefficients: *body.coefficients(), torque, steps, rates }
    }

    fn free(moments: [f64; 3], start: [f64; 3], tick_s: f64, duration_s: f64) -> Self {
        let ticks = (duration_s / tick_s).round() as usize;
        Self::new(moments, start.into(), Vector3::zeros(), tick_s, repeat_n(1, ticks))
    }

    /// Returns every step as the relation receives it.
    fn samples(&self) -> impl Iterator<Item = (RateSample, RateSample, f64)> {
        let sample = |rate_rad_s| RateSample { rate_rad_s, torque_rad_s2: self.torque };
        self.rates.windows(2).zip(&self.steps).map(move |(ends, step)| (sample(ends[0]), sample(ends[1]), *step))
    }

    /// Returns the number of steps that change the sign of ω1 ω2 ω3.
    fn flips(&self) -> usize {
        self.rates.windows(2).filter(|ends| ends[0].product() * ends[1].product() < 0.0).count()
    }

    fn identify(&self, mut filter: InvariantFilter<3>) -> Identified {
        let relation = InertiaRelation::new(FLOOR_RAD3_S3);
        let mut run = Identified { errors: vec![self.coefficients - filter.estimate()], ..Identified::default() };
        run.excitation.push(0.0);
        for (from, to, step) in self.samples() {
            let seen = relation.observe(&from, &to, step, filter.estimate());
            match seen {
                Identification::Excited(increment) => filter.step(&increment),
                Identification::Unexcited => run.unexcited += 1,
                Identification::Ambiguous => run.ambiguous += 1,
            }
            run.errors.push(self.coefficients - filter.estimate());
            run.excitation.push(run.excitation[run.excitation.len() - 1] + seen.excitation());
        }
        run.estimate = *filter.estimate();
        run
    }

    fn identify_diagonal(&self, decay: f64, guess: Vector3<f64>) -> Identified {
        self.identify(InvariantFilter::new(Vector3::repeat(decay), guess))
    }
}

/// The result of an identification.
#[derive(Default)]
struct Identified {
    estimate: Vector3<f64>,
    /// a − â at every sample.
    errors: Vec<Vector3<f64>>,
    /// The excitation ∫|ω1 ω2 ω3|dt of the used steps at every sample, rad³/s².
    excitation: Vec<f64>,
    unexcited: usize,
    ambiguous: usize,
}

impl Identified {
    /// Returns the largest error after the excitation has reduced the initial one below rounding.
    fn floor(&self, decay: f64) -> f64 {
        let settled: Vec<f64> = self
            .errors
            .iter()
            .zip(&self.excitation)
            .filter(|(_, excitation)| decay * **excitation > 40.0)
            .map(|(error, _)| size(error))
            .collect();
        assert!(settled.len() > 100, "only {} settled samples", settled.len());
        settled.into_iter().fold(0.0, f64::max)
    }
}

/// Returns the length of a vector; a NaN exceeds every bound.
fn size(error: &Vector3<f64>) -> f64 {
    let norm = error.norm();
    if norm.is_nan() { f64::INFINITY } else { norm }
}

#[test]
fn changes_of_sign_leave_the_error_floor_at_rounding() {
    for (moments, start) in EXAMPLES {
        for (tick_s, bound) in [(1e-2, 1e-8), (1e-3, 1e-9)] {
            let motion = Motion::free(moments, start, tick_s, RUN_S);
            let run = motion.identify_diagonal(DECAY, Vector3::zeros());
            let (floor, flips) = (run.floor(DECAY), motion.flips());
            println!(
                "I {moments:?}, tick {tick_s} s: floor {floor:.2e}, {flips} flips, {} ambiguous, {} unexcited, ∫ρ = {:.2}",
                run.ambiguous,
                run.unexcited,
                run.excitation[run.excitation.len() - 1]
            );
            assert!(flips > 24, "{flips} flips");
            assert!(floor <= bound, "I {moments:?}, tick {tick_s}: {floor:e}");
            let ratios = InertiaRatios::new(&run.estimate).unwrap();
            let wrong =
                (ratios.second - moments[1] / moments[0]).abs() + (ratios.third - moments[2] / moments[0]).abs();
            println!("    I2/I1 and I3/I1 wrong by {wrong:.2e}, closure {:.2e}", ratios.closure);
            assert!(wrong <= 10.0 * bound && ratios.closure.abs() <= 10.0 * bound, "{ratios:?}");
        }
    }
}

/// Returns ∫|ω1 ω2 ω3|dt of a motion, with steps so short that changes of sign do not matter.
fn true_excitation(moments: [f64; 3], start: [f64; 3], duration_s: f64) -> f64 {
    let motion = Motion::free(moments, start, 1e-4, duration_s);
    motion.rates.windows(2).map(|ends| 0.5e-4 * (ends[0].product().abs() + ends[1].product().abs())).sum()
}

#[test]
fn the_reported_excitation_is_the_true_one_except_for_unused_steps() {
    for (moments, start) in EXAMPLES {
        let run = Motion::free(moments, start, 1e-2, 20.0).identify_diagonal(DECAY, Vector3::zeros());
        let reported = run.excitation[run.excitation.len() - 1];
        let truth = true_excitation(moments, start, 20.0);
        println!("I {moments:?}: reported {reported:.9}, true {truth:.9} rad³/s²");
        assert!((reported / truth - 1.0).abs() < 1e-4, "{reported} {truth}");
    }
}

/// Returns the slope of ln|error| over the excitation by least squares, while the error is within `between`.
fn fitted_decay(run: &Identified, component: usize, between: std::ops::Range<f64>) -> f64 {
    let points: Vec<(f64, f64)> = run
        .excitation
        .iter()
        .zip(&run.errors)
        .map(|(excitation, error)| (*excitation, error[component].abs()))
        .filter(|(_, error)| between.contains(error))
        .map(|(excitation, error)| (excitation, error.ln()))
        .collect();
    assert!(points.len() > 100, "only {} clean points", points.len());
    let n = points.len() as f64;
    let (x, y) = points.iter().fold((0.0, 0.0), |(x, y), point| (x + point.0 / n, y + point.1 / n));
    let (square, product) = points.iter().fold((0.0, 0.0), |(square, product), point| {
        (square + (point.0 - x).powi(2), product + (point.0 - x) * (point.1 - y))
    });
    product / square
}

#[test]
fn each_error_decays_with_the_excitation_at_its_own_rate() {
    let rates = Vector3::new(2.0, 3.0, 5.0);
    for (moments, start) in EXAMPLES {
        for tick_s in [1e-2, 1e-3] {
            let run =
                Motion::free(moments, start, tick_s, 50.0).identify(InvariantFilter::new(rates, Vector3::zeros()));
            // While the estimate is wrong by δ, the weight of a step is wrong by about h²δ, which limits a fast
            // component until the slowest has settled.
            let clean = 10.0 * tick_s * tick_s;
            let slopes: [f64; 3] = std::array::from_fn(|component| fitted_decay(&run, component, clean..1.0));
            println!("I {moments:?}, tick {tick_s} s: decay {slopes:.6?} for {:?}", rates.as_slice());
            for (slope, rate) in slopes.iter().zip(&rates) {
                assert!((slope / -rate - 1.0).abs() < 1e-3, "{slope} for {rate}");
            }
        }
    }
}

/// Computes e^{𝒜W}δ in 100 000 Runge-Kutta steps, independently of the library's exponential.
fn decayed(matrix: &Matrix3<f64>, weight: f64, mut error: Vector3<f64>) -> Vector3<f64> {
    let h = weight / 1e5;
    for _ in 0..100_000 {
        let k1 = matrix * error;
        let k2 = matrix * (error + k1 * (h / 2.0));
        let k3 = matrix * (error + k2 * (h / 2.0));
        let k4 = matrix * (error + k3 * h);
        error += (k1 + (k2 + k3) * 2.0 + k4) * (h / 6.0);
    }
    error
}

/// Returns a rotating, a defective and a far from normal matrix, none of them with a zero element.
fn matrices() -> [Matrix3<f64>; 3] {
    let turn = Rotation3::from_euler_angles(0.3, -1.1, 2.0).into_inner();
    [
        Matrix3::new(-1.0, 4.0, 0.5, -4.0, -1.0, 0.0, 0.0, 0.0, -2.0),
        Matrix3::new(-2.0, 1.0, 0.0, 0.0, -2.0, 1.0, 0.0, 0.0, -2.0),
        Matrix3::new(-1.0, 30.0, 0.0, 0.0, -2.0, 30.0, 0.0, 0.0, -3.0),
    ]
    .map(|matrix| turn * matrix * turn.transpose())
}

#[test]
fn a_general_matrix_reduces_the_error_by_its_exponential() {
    let (moments, start) = EXAMPLES[0];
    for matrix in matrices() {
        let hurwitz = Hurwitz::new(matrix).unwrap();
        let guess = Vector3::new(0.3, -0.2, 0.1);
        let motion = Motion::free(moments, start, 1e-3, 40.0);
        let run = motion.identify(InvariantFilter::with_matrix(hurwitz, guess));
        let mut worst = 0.0_f64;
        for sample in [1000, 4000, 10_000, 20_000, 40_000] {
            let expected = decayed(&matrix, run.excitation[sample], run.errors[0]);
            worst = worst.max(size(&(run.errors[sample] - expected)) / matrix.norm());
        }
        println!("eigenvalues {}: {worst:.2e} beside e^{{AW}}δ, {} flips", hurwitz.eigenvalues(), motion.flips());
        assert!(worst < 1e-5, "{worst:e}");
    }
}

#[test]
fn a_general_matrix_reaches_the_same_floor() {
    for (moments, start) in EXAMPLES {
        let motion = Motion::free(moments, start, 1e-3, RUN_S);
        for matrix in &matrices()[..2] {
            let hurwitz = Hurwitz::new(*matrix).unwrap();
            let run = motion.identify(InvariantFilter::with_matrix(hurwitz, Vector3::zeros()));
            let floor = run.floor(-hurwitz.abscissa());
            println!("I {moments:?}, eigenvalues {}: floor {floor:.2e}", hurwitz.eigenvalues());
            assert!(floor <= 1e-9, "{floor:e}");
        }
    }
}

#[test]
fn a_matrix_without_decay_is_refused_with_its_eigenvalues() {
    let matrix = Matrix3::new(-1.0, 0.0, 0.0, 0.0, 0.5, 2.0, 0.0, -2.0, 0.5);
    let refusal = Hurwitz::new(matrix).unwrap_err();
    println!("{refusal}");
    let HurwitzError::NotHurwitz { eigenvalues, .. } = refusal else { panic!("{refusal}") };
    for (re, im) in [(-1.0, 0.0), (0.5, 2.0), (0.5, -2.0)] {
        let is_found = eigenvalues.0.iter().any(|value| (value.re - re).abs() < 1e-9 && (value.im - im).abs() < 1e-9);
        assert!(is_found, "{re} + {im}i: {eigenvalues}");
    }
    assert!(refusal.to_string().contains(&eigenvalues.to_string()), "{refusal}");
}

#[test]
fn every_guess_converges_to_the_truth() {
    let (moments, start) = EXAMPLES[0];
    let motion = Motion::free(moments, start, 1e-2, RUN_S);
    for guess in [[0.0; 3], [1.0, -1.0, 1.0], [-0.9, -0.9, 0.9], [5.0, 5.0, -5.0], [1e3, -1e4, 1e2]] {
        let run = motion.identify_diagonal(DECAY, guess.into());
        let error = size(&run.errors[run.errors.len() - 1]);
        println!("from {guess:?}: {error:.2e}, {} steps left out", run.ambiguous);
        assert!(error < 1e-8, "{guess:?}: {error:e}");
    }
}

#[test]
fn missed_ticks_only_lengthen_a_step() {
    for (moments, start) in EXAMPLES {
        // Every tick for most steps, sometimes up to 40 in one step.
        let gaps = (0..20_000_u32).map(|k| match k % 50 {
            0 => 40,
            n if n % 7 == 0 => n % 5 + 1,
            _ => 1,
        });
        let motion = Motion::new(moments, start.into(), Vector3::zeros(), 1e-3, gaps);
        let (run, span) = (motion.identify_diagonal(DECAY, Vector3::zeros()), motion.steps.iter().sum::<f64>());
        let floor = run.floor(DECAY);
        println!(
            "I {moments:?}: floor {floor:.2e} over {span} s, {} flips, {} left out",
            motion.flips(),
            run.ambiguous
        );
        // The error is that of a tick as long as the longest step, see the order below.
        assert!(floor < 5e-6, "{floor:e}");
    }
}

/// The error of one step is of fifth order and accumulates over one time constant, that is over 1/h steps.
#[test]
fn the_settled_error_is_of_fourth_order_in_the_tick() {
    for (moments, start) in EXAMPLES {
        let floors = [0.08, 0.04, 0.02].map(|tick_s| {
            let motion = Motion::free(moments, start, tick_s, RUN_S);
            let run = motion.identify_diagonal(DECAY, motion.coefficients);
            (run.errors.iter().map(|error| error.norm_squared()).sum::<f64>() / run.errors.len() as f64).sqrt()
        });
        let orders: Vec<f64> = floors.windows(2).map(|pair| (pair[0] / pair[1]).log2()).collect();
        let shown = floors.map(|error| format!("{error:.2e}")).join(", ");
        println!("I {moments:?}: rms errors {shown}, orders {orders:.2?}");
        assert!(orders[1] > 3.5, "{orders:?}");
    }
}

#[test]
fn a_known_torque_does_not_raise_the_error_floor() {
    for (moments, start) in EXAMPLES {
        for (tick_s, bound) in [(1e-2, 1e-7), (1e-3, 1e-9)] {
            let torque = Vector3::new(0.02, -0.015, 0.01);
            let ticks = (60.0 / tick_s) as usize;
            let motion = Motion::new(moments, start.into(), torque, tick_s, repeat_n(1, ticks));
            let floor = motion.identify_diagonal(DECAY, Vector3::zeros()).floor(DECAY);
            println!("I {moments:?}, tick {tick_s} s: floor {floor:.2e} under torque, {} flips", motion.flips());
            assert!(floor < bound, "{floor:e}");
        }
    }
}

#[test]
fn an_unexciting_motion_is_flagged_and_does_not_change_the_estimate() {
    let guess = Vector3::new(0.3, -0.2, 0.1);
    for start in [[0.0, 0.7, 0.0], [0.0, 0.0, -0.9], [0.7, 0.0, 0.0], [0.0; 3]] {
        let motion = Motion::free([1.0, 2.0, 2.5], start, 1e-2, 5.0);
        let run = motion.identify_diagonal(DECAY, guess);
        assert_eq!((run.unexcited, run.ambiguous), (500, 0), "{start:?}");
        assert_eq!(run.estimate, guess, "{start:?}");
        assert_eq!(run.excitation[500], 0.0);
    }
}

/// Returns normally distributed numbers of variance 1 (sums of twelve uniform ones), the same in every run.
fn noise() -> impl FnMut() -> f64 {
    let mut state = 0x9e37_79b9_7f4a_7c15_u64;
    move || {
        let mut uniform = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1_u64 << 53) as f64
        };
        (0..12).map(|_| uniform()).sum::<f64>() - 6.0
    }
}

/// Noise makes the sign of a component flicker while it passes through zero. This must not disturb the estimate by
/// more than noise does elsewhere: the filter passes it with the gain λ ω_i.
#[test]
fn flickering_signs_of_noisy_components_do_not_disturb_the_estimate() {
    let (sigma, decay) = (1e-3, 0.3);
    let mut noise = noise();
    for (moments, start) in EXAMPLES {
        let mut motion = Motion::free(moments, start, 1e-3, RUN_S);
        let flips = motion.flips();
        for rate in &mut motion.rates {
            *rate += Vector3::from_fn(|_, _| sigma * noise());
        }
        let run = motion.identify_diagonal(decay, motion.coefficients);
        let worst = run.errors.iter().map(size).fold(0.0, f64::max);
        println!(
            "I {moments:?}, σ = {sigma} rad/s: worst error {worst:.2e}, {flips} flips seen as {}, {} left out",
            motion.flips(),
            run.ambiguous
        );
        assert!(worst < 20.0 * decay * sigma, "{worst:e}");
    }
}

/// A body with two equal moments and a spin: a3 = 0 is as identifiable as any other coefficient.
#[test]
fn the_general_relation_identifies_an_axisymmetric_body_too() {
    let motion = Motion::free([1.0, 1.0, 1.6], [1.2, -0.8, 1.1], 1e-3, RUN_S);
    let floor = motion.identify_diagonal(DECAY, Vector3::repeat(0.4)).floor(DECAY);
    println!("axisymmetric body: floor {floor:.2e}, {} flips", motion.flips());
    assert!(floor <= 1e-9, "{floor:e}");
}

/// Returns the largest error of the axisymmetric estimate after a spin of 40/λ, and the fitted decay per radian of
/// spin.
fn identify_axisymmetric(motion: &Motion, axis: usize, decay: f64, guess: f64, a: f64) -> (f64, f64) {
    let relation = AxisymmetricRelation::new(axis, FLOOR_RAD_S).unwrap();
    let mut filter = InvariantFilter::new(Vector1::new(decay), Vector1::new(guess));
    let (mut spun, mut floor, mut mid) = (0.0, 0.0_f64, None);
    for (from, to, step) in motion.samples() {
        let seen = relation.observe(&from, &to, step);
        let Identification::Excited(increment) = seen else { panic!("{seen:?}") };
        filter.step(&increment);
        spun += seen.excitation();
        let error = a - filter.estimate().x;
        if decay * spun > 40.0 {
            floor = floor.max(if error.is_nan() { f64::INFINITY } else { error.abs() });
        } else if decay * spun > 10.0 && mid.is_none() {
            mid = Some((error / (a - guess)).ln() / spun);
        }
    }
    assert!(decay * spun > 40.0, "only {spun} rad");
    (floor, mid.unwrap())
}

#[test]
fn the_axisymmetric_coefficient_is_found_for_either_sign_of_the_spin() {
    for axis in 1..=3 {
        for (axial, spin) in [(1.6, 0.8), (1.6, -0.8), (0.4, 0.8), (0.4, -0.8)] {
            for torque in [Vector3::zeros(), Vector3::new(0.004, 0.003, 0.002) * spin] {
                let (mut moments, mut start) = ([1.0; 3], Vector3::new(0.5, 0.4, 0.6));
                (moments[axis - 1], start[axis - 1]) = (axial, spin);
                let motion = Motion::new(moments, start, torque, 1e-2, repeat_n(1, 2000));
                let (floor, decay) = identify_axisymmetric(&motion, axis, 4.0, 0.9, 1.0 - axial);
                let driven = if torque == Vector3::zeros() { "" } else { ", torque" };
                println!("axis {axis}, I {axial}, spin {spin}{driven}: floor {floor:.2e}, decay {decay:.9}/rad");
                assert!(floor < 1e-10, "{floor:e}");
                assert!((decay / -4.0 - 1.0).abs() < 1e-6, "{decay}");
            }
        }
    }
}

#[test]
fn a_body_that_does_not_spin_about_its_axis_of_symmetry_is_refused() {
    let relation = AxisymmetricRelation::new(3, FLOOR_RAD_S).unwrap();
    for spin in [0.0, 1e-7, -1e-7] {
        let motion = Motion::free([1.0, 1.0, 1.6], [0.5, 0.4, spin], 1e-2, 1.0);
        for (from, to, step) in motion.samples() {
            assert_eq!(relation.observe(&from, &to, step), Identification::Unexcited);
        }
    }
}

/// Generates the moments of a physically possible body.
fn body() -> impl Strategy<Value = [f64; 3]> {
    prop::array::uniform3(0.05..1.0_f64).prop_map(|[x, y, z]| [y + z, z + x, x + y])
}

fn vector(bound: f64) -> impl Strategy<Value = Vector3<f64>> {
    prop::array::uniform3(-bound..bound).prop_map(Vector3::from)
}

proptest! {
    #![proptest_config(cases(96))]

    /// From the truth, no motion, torque or missed tick leads away by more than the error of a step permits.
    #[test]
    fn a_true_estimate_stays_true(
        moments in body(), start in vector(1.5), torque in vector(0.05), gaps in prop::collection::vec(1..=5_u32, 400)
    ) {
        let motion = Motion::new(moments, start, torque, 2e-3, gaps);
        let run = motion.identify_diagonal(DECAY, motion.coefficients);
        let worst = run.errors.iter().map(size).fold(0.0, f64::max);
        prop_assert!(worst < 1e-7, "{worst:e} with {} flips", motion.flips());
    }

    /// The error never grows by more than the error of a step, for any physically possible guess.
    #[test]
    fn the_error_of_every_coefficient_contracts(
        moments in body(), start in vector(1.5), guess in vector(1.0), gaps in prop::collection::vec(1..=5_u32, 400)
    ) {
        let motion = Motion::new(moments, start, Vector3::zeros(), 2e-3, gaps);
        let run = motion.identify_diagonal(DECAY, guess);
        let last = run.errors.len() - 1;
        let expected = run.errors[0] * (-DECAY * run.excitation[last]).exp();
        let off = size(&(run.errors[last] - expected));
        prop_assert!(off < 1e-3 * size(&run.errors[0]) + 1e-7, "{off:e} with {} flips", motion.flips());
    }

    /// Changing the signs of two components rotates the axes and nothing else.
    #[test]
    fn rotating_the_axes_by_half_a_turn_changes_no_bit(moments in body(), start in vector(1.5), guess in vector(1.0)) {
        let motion = Motion::free(moments, start.into(), 1e-2, 4.0);
        let turned = Motion::free(moments, [-start.x, start.y, -start.z], 1e-2, 4.0);
        let [original, rotated] = [&motion, &turned].map(|motion| motion.identify_diagonal(DECAY, guess));
        prop_assert!(original.errors == rotated.errors, "differ with {} flips", motion.flips());
    }

    #[test]
    fn ratios_invert_the_coefficients(moments in body()) {
        let ratios = InertiaRatios::new(&Inertia::new(moments).unwrap().coefficients()).unwrap();
        let wrong = (ratios.second * moments[0] - moments[1]).abs() + (ratios.third * moments[0] - moments[2]).abs();
        prop_assert!(wrong < 1e-13 && ratios.closure.abs() < 1e-14, "{ratios:?}");
    }

    /// e^{𝒜(V+W)} = e^{𝒜V} e^{𝒜W}, and nothing grows in the long run.
    #[test]
    fn powers_of_a_decay_multiply(
        elements in prop::array::uniform9(-3.0..3.0_f64), first in 0.0..2.0_f64, second in 0.0..2.0_f64
    ) {
        let matrix = Matrix3::from_column_slice(&elements) - Matrix3::identity() * 3.0;
        match Hurwitz::new(matrix) {
            Ok(hurwitz) => {
                let difference = hurwitz.exp(first + second) - hurwitz.exp(first) * hurwitz.exp(second);
                let scale = hurwitz.exp(first).norm() * hurwitz.exp(second).norm();
                prop_assert!(difference.norm() <= 1e-13 * scale, "{difference}");
                let late = hurwitz.exp(800.0 / -hurwitz.abscissa()).norm();
                prop_assert!(late < 1e-200, "{late:e}");
            }
            Err(HurwitzError::NotHurwitz { eigenvalues, tolerance }) => {
                let trace: f64 = eigenvalues.0.iter().map(|value| value.re).sum();
                prop_assert!((trace - matrix.trace()).abs() < 1e-12, "{eigenvalues}");
                prop_assert!(eigenvalues.0.iter().any(|value| value.re >= -tolerance), "{eigenvalues}");
            }
            Err(error) => prop_assert!(false, "{error}"),
        }
    }

    #[test]
    fn an_axisymmetric_step_yields_its_coefficient(
        axis in 1..=3_usize, axial in 0.05..1.95_f64, start in vector(2.0), step in 1e-3..0.5_f64
    ) {
        let mut moments = [1.0; 3];
        moments[axis - 1] = axial;
        let motion = Motion::free(moments, start.into(), step, step);
        let (from, to, _) = motion.samples().next().unwrap();
        if let Identification::Excited(increment) = AxisymmetricRelation::new(axis, 1e-3).unwrap().observe(&from, &to, step) {
            let error = increment.potential.x - (1.0 - axial) * increment.weight;
            prop_assert!(error.abs() < 1e-12 , "{error:e}");
        } else {
            let (spin, across) = (start[axis - 1].abs(), start.norm_squared() - start[axis - 1].powi(2));
            prop_assert!(spin < 1.1e-3 || across < 1.1e-6, "{start}");
        }
    }
}

use super::*;
use crate::model::{Noise, RigidBody};
use nalgebra::{Matrix3, Rotation3};

/// A tumbling body measured by a turned sensor: segments of `samples` samples at an interval, with damping and noise.
struct Tumble {
    moments: [f64; 3],
    damping_per_s: f64,
    turn: Rotation3<f64>,
    noise_rad_s: f64,
    segments: u64,
    samples: u32,
    interval_s: f64,
    speed_rad_s: f64,
}

impl Default for Tumble {
    fn default() -> Self {
        Self {
            moments: [0.93, 0.08, 1.0],
            damping_per_s: 0.0,
            turn: Rotation3::identity(),
            noise_rad_s: 0.0,
            segments: 40,
            samples: 90,
            interval_s: 0.01,
            speed_rad_s: 6.0,
        }
    }
}

impl Tumble {
    fn motion(&self) -> Motion {
        self.motion_at(1.0)
    }

    /// Returns the motion with all rates times a factor.
    fn motion_at(&self, scale: f64) -> Motion {
        let body = RigidBody::new(&Inertia::new(self.moments).unwrap());
        let mut noise = Noise::new(7, 0, [self.noise_rad_s; 3], [0.0; 3]);
        let mut start = Noise::new(3, 1, [self.speed_rad_s; 3], [0.0; 3]);
        let mut motion = Motion::default();
        for _ in 0..self.segments {
            let mut rate = start.sample();
            for tick in 0..self.samples {
                let time_s = f64::from(tick) * self.interval_s;
                motion.push(&Sample { time_s, rate_rad_s: (self.turn * rate + noise.sample()) * scale });
                let (interval_s, growth) = undamped(self.interval_s, self.damping_per_s);
                rate = body.flow(&rate, &Vector3::zeros(), interval_s) / growth;
            }
            motion.end_segment();
        }
        motion
    }

    fn coefficients(&self) -> Vector3<f64> {
        Inertia::new(self.moments).unwrap().coefficients()
    }
}

#[test]
fn known_axes_are_fitted_within_their_own_deviations() {
    for (damping_per_s, noise_rad_s) in [(0.0, 0.0), (0.2, 0.0), (0.2, 0.05)] {
        let tumble = Tumble { damping_per_s, noise_rad_s, ..Tumble::default() };
        let fit = tumble.motion().about_known_axes(true).unwrap();
        let deviation = fit.deviation.unwrap();
        for axis in 0..3 {
            let error = (fit.coefficients[axis] - tumble.coefficients()[axis]).abs();
            assert!(error < 4.0 * deviation[axis] + 1e-3, "{damping_per_s} {noise_rad_s}: {fit:?}");
            assert!((fit.damping_per_s[axis] - damping_per_s).abs() < 0.02, "{fit:?}");
        }
        assert!(deviation.max() < 0.01 && fit.r_squared.min() > 0.99 && fit.closure().abs() < 0.01, "{fit:?}");
    }
}

#[test]
fn the_whole_tensor_is_found_at_any_orientation() {
    for angles in [[0.0, 0.0, 0.0], [0.02, -0.01, 0.015], [0.7, -0.4, 2.5], [3.0, 1.2, -2.0]] {
        // The last orientation is turned about all axes, the others about one.
        let all = [(0.0, 0.0), (0.2, 0.0), (0.2, 0.05)];
        for (damping_per_s, noise_rad_s) in all.into_iter().skip(if angles[0] == 0.7 { 0 } else { 2 }) {
            let turn = Rotation3::from_euler_angles(angles[0], angles[1], angles[2]);
            let tumble = Tumble { turn, damping_per_s, noise_rad_s, ..Tumble::default() };
            let fit = tumble.motion().about_unknown_axes(true).unwrap();
            let mut found: [f64; 3] = fit.moments.into();
            found.sort_by(f64::total_cmp);
            for (found, expected) in found.into_iter().zip([0.08, 0.93, 1.0]) {
                assert!((found - expected).abs() < 5e-3, "{angles:?} {damping_per_s} {noise_rad_s}: {fit:?}");
            }
            assert!((fit.damping_per_s - damping_per_s).abs() < 5e-3, "{fit:?}");
            assert!((fit.axes.determinant() - 1.0).abs() < 1e-9 && fit.distinction > 10.0, "{fit:?}");
            // Compares the tensor itself, which does not depend on the order and the signs of its axes.
            let rebuilt = fit.axes * Matrix3::from_diagonal(&fit.moments) * fit.axes.transpose();
            let truth = turn * Matrix3::from_diagonal(&Vector3::from(tumble.moments)) * turn.transpose();
            assert!((rebuilt - truth).amax() < 1e-2, "{angles:?}: {rebuilt} {truth}");
        }
    }
}

#[test]
fn moments_about_known_axes_belong_to_one_body() {
    let tumble = Tumble { damping_per_s: 0.1, noise_rad_s: 0.02, ..Tumble::default() };
    let fit = tumble.motion().moments_about_known_axes(true).unwrap();
    assert!((fit.moments - Vector3::from(tumble.moments)).amax() < 3e-3, "{fit:?}");
    assert_eq!(fit.axes, Matrix3::identity());
    assert!(fit.deviation.unwrap().max() < 3e-3);
}

#[test]
fn noise_does_not_bias_the_tensor_towards_a_sphere() {
    let tumble = Tumble { moments: [0.6, 0.8, 1.0], noise_rad_s: 0.5, segments: 400, ..Tumble::default() };
    let fit = tumble.motion().about_unknown_axes(false).unwrap();
    assert!((fit.moments - Vector3::from(tumble.moments)).amax() < 0.02, "{fit:?}");
}

/// Returns the findings about every fit.
fn all_findings(motion: &Motion) -> Vec<Finding> {
    let (axes, body) = (motion.about_known_axes(true), motion.moments_about_known_axes(true));
    findings(motion, axes.as_ref(), body.as_ref(), motion.about_unknown_axes(true).as_ref())
}

#[test]
fn the_limits_of_a_log_are_reported() {
    let found = |tumble: &Tumble| {
        let motion = tumble.motion();
        all_findings(&motion)
    };
    let noisy = Tumble { noise_rad_s: 0.02, ..Tumble::default() };
    assert_eq!(found(&noisy), [Finding::Scale]);
    let has = |tumble: &Tumble, wanted: fn(&Finding) -> bool| {
        let found = found(tumble);
        assert!(found.iter().any(wanted), "{found:?}");
        found.iter().for_each(|finding| assert!(!finding.to_string().is_empty()));
    };
    has(&Tumble { moments: [1.0; 3], noise_rad_s: 0.02, ..Tumble::default() }, |f| matches!(f, Finding::Sphere));
    let symmetric = Tumble { moments: [1.0, 1.0, 0.5], noise_rad_s: 0.02, ..Tumble::default() };
    has(&symmetric, |f| matches!(f, Finding::Symmetric { axis: 2 }));
    has(&Tumble { damping_per_s: 0.2, ..noisy }, |f| matches!(f, Finding::Damped { .. }));
    has(&Tumble { damping_per_s: -0.2, noise_rad_s: 0.02, ..Tumble::default() }, |f| {
        matches!(f, Finding::Driven { .. })
    });
    let turned = Rotation3::from_euler_angles(0.2, 0.0, 0.0);
    has(&Tumble { turn: turned, noise_rad_s: 0.02, ..Tumble::default() }, |f| matches!(f, Finding::Tilted { .. }));
    has(&Tumble { segments: 1, ..Tumble::default() }, |f| matches!(f, Finding::FewPieces { .. }));
    has(&Tumble { segments: 1, samples: 8, ..Tumble::default() }, |f| matches!(f, Finding::Short { samples: 8 }));
    let still = Tumble { speed_rad_s: 1e-6, noise_rad_s: 1e-3, ..Tumble::default() };
    has(&still, |f| matches!(f, Finding::Unexcited { .. }));
    has(&still, |f| matches!(f, Finding::Still { .. }));
    has(&still, Finding::forbids_axes);
    has(&still, Finding::forbids_tensor);
}

#[test]
fn a_spin_about_one_axis_does_not_excite_the_others() {
    let mut motion = Motion::default();
    let mut noise = Noise::new(7, 0, [1e-3; 3], [0.0; 3]);
    for segment in 0..10 {
        for tick in 0..100 {
            let spin = Vector3::new(0.0, 0.0, 3.0 + 0.1 * f64::from(segment));
            motion.push(&Sample { time_s: f64::from(tick) * 0.01, rate_rad_s: spin + noise.sample() });
        }
        motion.end_segment();
    }
    let found = all_findings(&motion);
    assert!(found.iter().any(|f| matches!(f, Finding::OneAxis { direction } if direction.z.abs() > 0.99)), "{found:?}");
    assert!(found.iter().any(Finding::forbids_axes) && found.iter().any(Finding::forbids_tensor));
}

#[test]
fn rates_at_another_scale_are_found_by_the_identity() {
    let scaled = |moments: [f64; 3], scale: f64, noise_rad_s: f64| {
        Tumble { moments, noise_rad_s, ..Tumble::default() }.motion_at(scale)
    };
    for (moments, factor) in [([0.4, 0.8, 1.0], 0.5), ([0.4, 0.8, 1.0], 17.0), ([0.5, 0.7, 1.0], 0.2)] {
        for noise_rad_s in [0.0, 0.01] {
            let motion = scaled(moments, 1.0 / factor, noise_rad_s);
            let parts = [1.0, factor].map(|factor| motion.total().unexplained(false, factor));
            let found = wrong_scale(&motion).unwrap_or(f64::NAN);
            assert!((found / factor - 1.0).abs() < 0.05, "{factor}: {found}, left {parts:?}");
        }
    }
    // A unit and a counter's interval that differ by 5 %.
    for factor in [0.1, core::f64::consts::TAU / 60.0] {
        for noise_rad_s in [0.0, 0.01] {
            assert_eq!(wrong_scale(&scaled([0.4, 0.8, 1.0], 1.0 / factor, noise_rad_s)), Some(factor), "{noise_rad_s}");
        }
    }
    for moments in [[0.4, 0.8, 1.0], [0.93, 0.08, 1.0], [0.97, 0.98, 1.0], [0.5, 0.5, 1.0]] {
        assert_eq!(wrong_scale(&scaled(moments, 1.0, 0.01)), None, "{moments:?}");
    }
    // In deg/s, a piece is too short to rise above the noise.
    for (turn, noise_rad_s) in [([0.0; 3], 2e-3), ([0.3, -0.2, 0.25], 2e-3), ([0.0; 3], 0.0)] {
        let turn = Rotation3::from_euler_angles(turn[0], turn[1], turn[2]);
        let slow = Tumble { moments: [0.4, 0.8, 1.0], interval_s: 0.1, speed_rad_s: 0.08, ..Tumble::default() };
        let slow = Tumble { segments: 3, samples: 600, noise_rad_s, turn, ..slow };
        let factor = core::f64::consts::PI / 180.0;
        assert_eq!(wrong_scale(&slow.motion_at(1.0 / factor)), Some(factor), "{noise_rad_s}");
        assert_eq!(wrong_scale(&slow.motion()), None, "{noise_rad_s}");
    }
    assert!(has_no_scale(&scaled([0.99, 0.99, 1.0], 1.0, 0.01)) && !has_no_scale(&scaled([0.4, 0.8, 1.0], 1.0, 0.01)));
}

/// Returns segments of a body with a wheel, by Runge-Kutta steps, measured by a turned sensor.
fn gyrostat(wheel: Vector3<f64>, turn: Rotation3<f64>, damping_per_s: f64, noise_rad_s: f64) -> Motion {
    let moments = Vector3::new(0.03, 0.042, 0.05);
    let slope = |rate: Vector3<f64>| -> Vector3<f64> {
        -rate.cross(&(moments.component_mul(&rate) + wheel)).component_div(&moments) - damping_per_s * rate
    };
    let (mut noise, mut start) = (Noise::new(7, 0, [noise_rad_s; 3], [0.0; 3]), Noise::new(3, 1, [0.5; 3], [0.0; 3]));
    let mut motion = Motion::with_wheel(turn * wheel);
    for _ in 0..12 {
        let mut rate = start.sample();
        for tick in 0..300 {
            motion.push(&Sample { time_s: f64::from(tick) * 0.05, rate_rad_s: turn * rate + noise.sample() });
            for h in [0.025; 2] {
                let first = slope(rate);
                let second = slope(rate + first * (h / 2.0));
                let third = slope(rate + second * (h / 2.0));
                rate += (first + second * 2.0 + third * 2.0 + slope(rate + third * h)) * (h / 6.0);
            }
        }
        motion.end_segment();
    }
    motion
}

#[test]
fn a_wheel_gives_the_moments_their_scale() {
    let wheel = Vector3::new(0.004, -0.006, 0.012);
    for turn in [Rotation3::identity(), Rotation3::from_euler_angles(0.3, -0.2, 0.25)] {
        for (damping_per_s, noise_rad_s) in [(0.0, 0.0), (0.03, 0.0), (0.03, 2e-3)] {
            let motion = gyrostat(wheel, turn, damping_per_s, noise_rad_s);
            let fit = motion.about_unknown_axes(true).unwrap();
            let (largest, deviation) = fit.largest.unwrap();
            let moments = fit.moments * largest;
            assert!(
                (moments - Vector3::new(0.03, 0.042, 0.05)).amax() < 2e-4,
                "{damping_per_s} {noise_rad_s}: {fit:?}"
            );
            assert!((largest - 0.05).abs() < 4.0 * deviation.unwrap() + 1e-5, "{fit:?}");
            assert!((fit.damping_per_s - damping_per_s).abs() < 2e-3, "{fit:?}");
            let found = all_findings(&motion);
            assert!(!found.iter().any(Finding::forbids_tensor) && !found.contains(&Finding::Scale), "{found:?}");
            let turned = turn != Rotation3::identity();
            assert_eq!(found.iter().any(Finding::forbids_axes), turned, "{found:?}");
            assert_eq!(wrong_scale(&motion), None);
        }
    }
    // One that turns the other way.
    let mut reversed = gyrostat(wheel, Rotation3::identity(), 0.0, 0.0);
    reversed.wheel = -wheel;
    let found = all_findings(&reversed);
    assert!(found.iter().any(|finding| matches!(finding, Finding::Wheel { whole: false, .. })), "{found:?}");
    assert!(found.iter().any(Finding::forbids_tensor), "{found:?}");
}

#[test]
fn an_empty_log_has_no_result() {
    let empty = Motion::default();
    assert!(empty.about_known_axes(true).is_none() && empty.about_unknown_axes(true).is_none());
    let rest =
        [Sample { time_s: 0.0, rate_rad_s: Vector3::zeros() }, Sample { time_s: 1.0, rate_rad_s: Vector3::zeros() }];
    let motion = Motion::from_segments([&rest[..]; 8]);
    assert!(motion.about_known_axes(true).is_none() && motion.about_unknown_axes(true).is_none());
}

#[test]
fn slightly_impossible_moments_are_corrected_and_others_refused() {
    let (inertia, flattened) = nearest_body(&Vector3::new(0.93, 0.08, 1.0)).unwrap();
    assert_eq!((inertia.moments_kg_m2(), flattened), (Vector3::new(0.93, 0.08, 1.0), false));
    assert!(nearest_body(&Vector3::new(0.9, 0.08, 1.0)).unwrap().1);
    assert!(matches!(nearest_body(&Vector3::new(0.5, 0.08, 1.0)), Err(InertiaError::Triangle { axis: 3, .. })));
    assert!(matches!(nearest_body(&Vector3::new(0.5, -0.1, 1.0)), Err(InertiaError::NotPositive { axis: 2, .. })));
}

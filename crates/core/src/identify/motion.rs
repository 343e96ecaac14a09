//! A log as sums: all data for least squares with any model, independent of the log's length.
//!
//! Integrated over time, Euler's equations need no derivative of a measured rate (the *weak form*). Each sample
//! contributes only its angular velocity ω, the integrals of its products ω_i ω_j, and the integral of ω. Within a
//! *piece*, a stretch of one free motion, their covariance about the mean contains all information, because the
//! constants of integration are unknown. This module must not store a sample longer than its two neighbours, nor join
//! a motion across a gap.

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

/// The number of features: ω, the integrals of ω_x², ω_y², ω_z², ω_y ω_z, ω_z ω_x, ω_x ω_y, and the integral of ω.
pub(super) const FEATURES: usize = 12;
/// The indices of the first product and the first angle among the features.
pub(super) const PRODUCTS: usize = 3;
pub(super) const TURNS: usize = 9;
/// The number of integrals.
const INTEGRALS: usize = 9;

/// The number of groups of pieces; each is left out once to estimate the uncertainty of a result.
pub(super) const GROUPS: usize = 20;

/// The angle by which the body rotates in a piece, rad; a longer piece would accumulate errors that no model
/// describes.
const PIECE_TURN_RAD: f64 = 8.0 * core::f64::consts::PI;
/// The least number of samples in a piece, because its constants of integration are unknown.
const PIECE_SAMPLES: u64 = 4;

/// The maximum number of sweeps of the eigenvalue solver.
pub(super) const SWEEPS: usize = 200;

/// The part of white noise in differences of third order.
#[cfg(feature = "std")]
const THIRD_POWER: f64 = 20.0;

/// A sample of a log.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// The time, s.
    pub time_s: f64,
    /// The angular velocity, rad/s; finite.
    pub rate_rad_s: Vector3<f64>,
}

/// Sums over pieces.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sums {
    /// Σ (z − z̄)(z − z̄)ᵀ of the features z, about the mean of each piece.
    pub scatter: SMatrix<f64, FEATURES, FEATURES>,
    pub samples: u64,
    pub pieces: u64,
    /// The momentum of the wheel, see [`Motion::with_wheel`].
    pub wheel: Vector3<f64>,
}

impl Default for Sums {
    fn default() -> Self {
        Self { scatter: SMatrix::zeros(), samples: 0, pieces: 0, wheel: Vector3::zeros() }
    }
}

impl Sums {
    /// Adds a piece; returns false if it is too short.
    fn add(&mut self, piece: &Piece) -> bool {
        let is_long = piece.samples >= PIECE_SAMPLES;
        if is_long {
            self.scatter += piece.scatter;
            self.samples += piece.samples;
            self.pieces += 1;
        }
        is_long
    }
}

/// The motion in a log, as sums of constant size.
///
/// ```
/// # extern crate corotate_core as corotate;
/// use corotate::identify::{Motion, Sample};
/// use corotate::model::{Inertia, RigidBody};
/// use corotate::nalgebra::Vector3;
///
/// let body = RigidBody::new(&Inertia::new([1.0, 2.0, 2.5]).unwrap());
/// let (mut rate, mut motion) = (Vector3::new(3.0, 2.0, -2.5), Motion::default());
/// for tick in 0..2000 {
///     motion.push(&Sample { time_s: f64::from(tick) * 0.01, rate_rad_s: rate });
///     rate = body.flow(&rate, &Vector3::zeros(), 0.01);
/// }
/// motion.end_segment();
/// let fit = motion.about_known_axes(false).unwrap();
/// assert!((fit.coefficients - body.coefficients()).amax() < 1e-4);
/// assert!(fit.closure().abs() < 1e-4);
/// ```
#[derive(Debug, Clone)]
pub struct Motion {
    pub(super) groups: [Sums; GROUPS],
    integral: Integral,
    piece: Piece,
    /// The sums over whole segments: in a unit that is too small, pieces are too short to rise above noise.
    pub(super) whole: Sums,
    segment: Piece,
    summary: MotionSummary,
    /// The newest rate with its differences up to the third, and the number of samples since the segment began.
    differences: [Vector3<f64>; 4],
    in_row: usize,
    /// The sum of the squares of the third ones, and their number.
    third: (Vector3<f64>, u64),
    /// Σ ω ωᵀ.
    square: Matrix3<f64>,
    pub(super) wheel: Vector3<f64>,
}

/// A summary of a log.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct MotionSummary {
    /// The number of samples used.
    pub samples: u64,
    /// The number of pieces, for resampling.
    pub pieces: u64,
    /// The number of segments.
    pub segments: u64,
    /// The total duration of all segments, s.
    pub duration_s: f64,
    /// The total angle by which the body rotated, rad.
    pub turn_rad: f64,
    /// The fastest rate, rad/s.
    pub fastest_rad_s: f64,
}

impl Default for Motion {
    fn default() -> Self {
        Self {
            groups: [Sums::default(); GROUPS],
            integral: Integral::default(),
            piece: Piece::default(),
            whole: Sums::default(),
            segment: Piece::default(),
            summary: MotionSummary::default(),
            differences: [Vector3::zeros(); 4],
            in_row: 0,
            third: (Vector3::zeros(), 0),
            square: Matrix3::zeros(),
            wheel: Vector3::zeros(),
        }
    }
}

impl Motion {
    /// Creates the motion of a body with a wheel of constant momentum relative to it, in the sensor's axes. The moments of inertia
    /// then have a scale: kg m² for N m s.
    pub fn with_wheel(momentum: Vector3<f64>) -> Self {
        Self { wheel: momentum, ..Self::default() }
    }

    /// Returns true if the body has a wheel.
    pub fn has_wheel(&self) -> bool {
        self.wheel != Vector3::zeros()
    }

    /// Creates the motion of these segments, each of samples with increasing times.
    pub fn from_segments<'a>(segments: impl IntoIterator<Item = &'a [Sample]>) -> Self {
        let mut motion = Self::default();
        for segment in segments {
            segment.iter().for_each(|sample| motion.push(sample));
            motion.end_segment();
        }
        motion
    }

    /// Adds the next sample of a segment; its time is after that of the last one.
    #[inline]
    pub fn push(&mut self, sample: &Sample) {
        if let Some(last) = self.integral.newest() {
            let interval_s = sample.time_s - last.sample.time_s;
            let turn = 0.5 * (last.sample.rate_rad_s.norm() + sample.rate_rad_s.norm()) * interval_s;
            self.summary.duration_s += interval_s;
            self.summary.turn_rad += turn;
            self.piece.turn_rad += turn;
        }
        self.summary.fastest_rad_s = self.summary.fastest_rad_s.max(sample.rate_rad_s.norm());
        self.summary.samples += 1;
        self.square += sample.rate_rad_s * sample.rate_rad_s.transpose();
        let mut value = sample.rate_rad_s;
        for difference in &mut self.differences {
            value -= core::mem::replace(difference, value);
        }
        self.in_row += 1;
        // By then those of the previous segment are gone.
        if self.in_row > 3 {
            self.third.0 += self.differences[3].component_mul(&self.differences[3]);
            self.third.1 += 1;
        }
        if let Some(features) = self.integral.push(sample) {
            self.add(&features);
        }
    }

    /// Ends a segment: the next sample begins another motion.
    pub fn end_segment(&mut self) {
        let ended = self.integral.end();
        self.in_row = 0;
        self.summary.segments += u64::from(ended.is_some());
        if let Some(features) = ended {
            self.add(&features);
        }
        self.end_piece();
        self.whole.add(&core::mem::take(&mut self.segment));
    }

    /// Returns the summary.
    pub fn summary(&self) -> &MotionSummary {
        &self.summary
    }

    /// Returns the variance of white noise in each rate, (rad/s)²: what differences of third order leave of the motion.
    #[cfg(feature = "std")]
    pub(super) fn noise(&self) -> Vector3<f64> {
        self.third.0 / (THIRD_POWER * self.third.1.max(1) as f64)
    }

    /// Returns the mean square of the rate about the axis with the most, then the next, (rad/s)², with the direction of the first.
    #[cfg(feature = "std")]
    pub(super) fn turns(&self) -> Option<([f64; 2], Vector3<f64>)> {
        let mean = self.square / self.summary.samples.max(1) as f64;
        if !mean.iter().all(|entry| entry.is_finite()) {
            return None;
        }
        let nalgebra::SymmetricEigen { eigenvalues, eigenvectors } =
            nalgebra::SymmetricEigen::try_new(mean, f64::EPSILON, SWEEPS)?;
        let most = eigenvalues.imax();
        let next = (0..3).filter(|axis| *axis != most).map(|axis| eigenvalues[axis]).fold(0.0, f64::max);
        Some(([eigenvalues[most], next], eigenvectors.column(most).into_owned()))
    }

    /// Returns the sums over all pieces.
    pub(super) fn total(&self) -> Sums {
        let mut total = Sums { wheel: self.wheel, ..Sums::default() };
        for group in &self.groups {
            total.scatter += group.scatter;
            total.samples += group.samples;
            total.pieces += group.pieces;
        }
        total
    }

    #[inline]
    fn add(&mut self, features: &SVector<f64, FEATURES>) {
        self.segment.add(features);
        self.piece.add(features);
        if self.piece.turn_rad > PIECE_TURN_RAD {
            self.end_piece();
            // The last sample of a piece is also the first of the next.
            self.piece.add(features);
        }
    }

    fn end_piece(&mut self) {
        let group = &mut self.groups[(self.summary.pieces % GROUPS as u64) as usize];
        self.summary.pieces += u64::from(group.add(&core::mem::take(&mut self.piece)));
    }
}

/// A stretch of one motion, by Welford's sums: a large mean costs no digits.
#[derive(Debug, Clone)]
struct Piece {
    samples: u64,
    turn_rad: f64,
    mean: SVector<f64, FEATURES>,
    scatter: SMatrix<f64, FEATURES, FEATURES>,
}

impl Default for Piece {
    fn default() -> Self {
        Self { samples: 0, turn_rad: 0.0, mean: SVector::zeros(), scatter: SMatrix::zeros() }
    }
}

impl Piece {
    #[inline]
    fn add(&mut self, features: &SVector<f64, FEATURES>) {
        self.samples += 1;
        let share = 1.0 / self.samples as f64;
        let apart = features - self.mean;
        self.mean += apart * share;
        let weighted = apart * (1.0 - share);
        for column in 0..FEATURES {
            // The upper triangle only; the scatter is symmetric.
            for row in 0..=column {
                self.scatter[(row, column)] += weighted[row] * apart[column];
            }
        }
    }
}

/// An integrand at one sample.
#[derive(Debug, Clone, Copy)]
struct Point {
    sample: Sample,
    value: SVector<f64, INTEGRALS>,
}

impl Point {
    #[inline]
    fn new(sample: &Sample) -> Self {
        let [x, y, z] = sample.rate_rad_s.into();
        Self { sample: *sample, value: SVector::from([x * x, y * y, z * z, y * z, z * x, x * y, x, y, z]) }
    }

    /// Returns the features of the sample with the integrals `integral`.
    #[inline]
    fn features(&self, integral: &SVector<f64, INTEGRALS>) -> SVector<f64, FEATURES> {
        let mut features = SVector::<f64, FEATURES>::zeros();
        features.fixed_rows_mut::<3>(0).copy_from(&self.sample.rate_rad_s);
        features.fixed_rows_mut::<INTEGRALS>(PRODUCTS).copy_from(integral);
        features
    }
}

/// Integrals over a segment by Hermite's rule, with the slopes of parabolas through three samples: of fourth order in
/// the interval, for intervals of any length. A sample is integrated when the next one is known.
#[derive(Debug, Clone, Copy, Default)]
struct Integral {
    /// The last two samples.
    last: Option<Point>,
    next: Option<Step>,
    value: SVector<f64, INTEGRALS>,
}

/// The newest sample, and the step to it.
#[derive(Debug, Clone, Copy)]
struct Step {
    point: Point,
    interval_s: f64,
    /// The mean slope from the previous sample, and the slope there if it is known.
    mean: SVector<f64, INTEGRALS>,
    start: Option<SVector<f64, INTEGRALS>>,
}

impl Integral {
    /// Returns the last sample.
    #[inline]
    fn newest(&self) -> Option<&Point> {
        self.next.as_ref().map(|step| &step.point).or(self.last.as_ref())
    }

    /// Adds a sample. Returns the features of the previous one; for the first sample of a segment its own.
    #[inline]
    fn push(&mut self, sample: &Sample) -> Option<SVector<f64, FEATURES>> {
        let point = Point::new(sample);
        let Some(last) = self.last else {
            *self = Self { last: Some(point), next: None, value: SVector::zeros() };
            return Some(point.features(&self.value));
        };
        let from = self.next.as_ref().map_or(&last, |step| &step.point);
        let interval_s = sample.time_s - from.sample.time_s;
        let mean = (point.value - from.value) / interval_s;
        let Some(step) = self.next else {
            self.next = Some(Step { point, interval_s, mean, start: None });
            return None;
        };
        let (h, k) = (step.interval_s, interval_s);
        let slope = (step.mean * k + mean * h) / (h + k);
        let features = self.move_to(&step, &last, slope);
        self.last = Some(step.point);
        self.next = Some(Step { point, interval_s, mean, start: Some(slope) });
        Some(features)
    }

    /// Returns the features of the segment's last sample, if it has more than one, and resets the integrals.
    fn end(&mut self) -> Option<SVector<f64, FEATURES>> {
        let (last, step) = (self.last.take()?, self.next.take()?);
        // A parabola, or a line for two samples.
        let slope = step.start.map_or(step.mean, |start| step.mean * 2.0 - start);
        Some(self.move_to(&step, &last, slope))
    }

    /// Integrates over a step that ends with the given slope.
    #[inline]
    fn move_to(&mut self, step: &Step, last: &Point, slope: SVector<f64, INTEGRALS>) -> SVector<f64, FEATURES> {
        let h = step.interval_s;
        let start = step.start.unwrap_or(step.mean * 2.0 - slope);
        self.value += (last.value + step.point.value) * (0.5 * h) + (start - slope) * (h * h / 12.0);
        step.point.features(&self.value)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn samples(
        count: u32,
        interval_s: impl Fn(u32) -> f64,
        rate: impl Fn(f64) -> [f64; 3],
    ) -> impl Iterator<Item = Sample> {
        let mut time_s = 0.0;
        (0..count).map(move |tick| {
            time_s += interval_s(tick);
            Sample { time_s, rate_rad_s: rate(time_s).into() }
        })
    }

    /// Returns the last integrals of a segment.
    fn integrals(samples: impl Iterator<Item = Sample>) -> SVector<f64, FEATURES> {
        let mut integral = Integral::default();
        samples.for_each(|sample| _ = integral.push(&sample));
        integral.end().unwrap()
    }

    #[test]
    fn integrals_are_of_fourth_order_at_intervals_of_any_length() {
        let error = |scale: f64| {
            let jitter = move |tick: u32| scale * (1.0 + 0.3 * f64::from(tick % 3));
            let count = (2.0 / (1.3 * scale)) as u32;
            let rates = |t: f64| [libm::sin(3.0 * t), libm::cos(2.0 * t), 1.0];
            let path: Vec<Sample> = samples(count, jitter, rates).collect();
            let (from, to) = (path[0].time_s, path[path.len() - 1].time_s);
            let exact = (libm::sin(2.0 * to) - libm::sin(2.0 * from)) / 2.0;
            (integrals(path.into_iter())[PRODUCTS + 3] - exact).abs()
        };
        let (coarse, fine) = (error(0.04), error(0.02));
        assert!(coarse < 1e-4 && fine < coarse / 7.0, "{coarse:e} {fine:e}");
    }

    #[test]
    fn two_samples_are_joined_by_a_line_and_one_is_ignored() {
        let path = samples(2, |_| 0.5, |t| [t, 0.0, 1.0]);
        let features = integrals(path);
        assert!((features[TURNS] - 0.375).abs() < 1e-15 && (features[TURNS + 2] - 0.5).abs() < 1e-15, "{features}");
        let mut motion = Motion::default();
        motion.push(&Sample { time_s: 0.0, rate_rad_s: Vector3::x() });
        motion.end_segment();
        assert_eq!((motion.summary().samples, motion.summary().segments, motion.total().samples), (1, 0, 0));
    }

    #[test]
    fn sums_are_about_the_mean_of_each_piece() {
        let path: Vec<Sample> = samples(400, |_| 0.01, |t| [6.0 + libm::sin(t), 1e-3 * t, 5.0]).collect();
        let motion = Motion::from_segments([&path[..], &path[..]]);
        let account = motion.summary();
        assert_eq!((account.samples, account.segments, account.pieces), (800, 2, 4));
        assert!((account.duration_s - 2.0 * 3.99).abs() < 1e-12);
        let total = motion.total();
        // The sample at which a piece ends is also in the next one.
        assert_eq!(total.samples, 802);
        let (first, second) = (motion.groups[0].scatter, motion.groups[2].scatter);
        assert!((first - second).amax() < 1e-9 * first.amax(), "the same motion twice");
        let cut = motion.groups[0].samples as usize;
        let mean = path[..cut].iter().map(|sample| sample.rate_rad_s.x).sum::<f64>() / cut as f64;
        let direct: f64 =
            path[..cut].iter().map(|sample| (sample.rate_rad_s.x - mean) * (sample.rate_rad_s.x - mean)).sum();
        assert!((first[(0, 0)] - direct).abs() < 1e-12 * direct.max(1.0), "{} {direct}", first[(0, 0)]);
    }
}

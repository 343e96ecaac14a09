//! The hidden component, sample by sample: segments, initial guesses and damping around the relation and its filters.

use super::wheel::Wheel;
use crate::identify::{Sample, undamped};
use crate::observe::{
    Filter, HiddenRate, HiddenRateError, Increment, Interval, InvariantFilter, KalmanFilter, Observation, RateSample,
    Regressor, SecondOrderFilter,
};
use nalgebra::{Vector1, Vector3};

/// The damping ratio of the second-order filter.
const DAMPING_RATIO: f64 = core::f64::consts::FRAC_1_SQRT_2;

/// The filter and its parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FilterKind {
    /// The papers' filter: the error decays as e^{−decay·t}.
    First {
        /// The decay rate, positive, 1/s.
        decay_per_s: f64,
    },
    /// Two poles of the given bandwidth with the damping ratio 1/√2.
    Second {
        /// The bandwidth, positive, rad/s.
        bandwidth_rad_s: f64,
    },
    /// The Kalman filter's gains.
    Kalman {
        /// The standard deviation of one measured rate, rad/s.
        noise_rad_s: f64,
        /// The density of the unknown drift, (rad/s)²/s.
        density: f64,
        /// The standard deviation of the guess, rad/s.
        guess_deviation_rad_s: f64,
    },
}

/// The known properties of the body, and the parameters of the reconstruction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Setup {
    /// The coefficients a of \[D\](2).
    pub coefficients: Vector3<f64>,
    /// The hidden axis, 1 to 3.
    pub axis: usize,
    /// The damping by a torque −c I ω, 1/s; not negative for air.
    pub damping_per_s: f64,
    /// A wheel in the body.
    pub wheel: Option<Wheel>,
    /// The filter.
    pub filter: FilterKind,
    /// The initial estimate of every segment, rad/s; if absent, the reconstruction of the first observable step.
    pub guess_rad_s: Option<f64>,
    /// The level below which the measured rates carry no information, rad/s.
    pub floor_rad_s: f64,
}

/// The reason why a reconstruction is impossible.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum ReconstructionError {
    /// The axis cannot be observed.
    #[error(transparent)]
    Relation(#[from] HiddenRateError),
    /// The wheel acts on an axis whose moment equals that of the hidden one.
    #[error(
        "the wheel turns about axis {axis}, whose moment is that of the hidden axis: such a body is not estimated; hide another axis"
    )]
    Wheel {
        /// The axis, 1 to 3.
        axis: usize,
    },
    /// A number is invalid.
    #[error("{name} = {value}: give a finite number{}", if *.positive { " above 0" } else { "" })]
    Number {
        /// The name of the parameter.
        name: &'static str,
        /// The given value.
        value: f64,
        /// True if the value must be above zero.
        positive: bool,
    },
}

/// The estimate at one sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reconstructed {
    /// The hidden rate, rad/s; NaN before the first observable step.
    pub rate_rad_s: f64,
    /// True if the step to this sample was observable. Otherwise the model advanced the estimate.
    pub observed: bool,
    /// True if the step was too long for the motion, or the estimate is far off.
    pub too_long: bool,
    /// The filter's standard deviation, rad/s, if it computes one.
    pub deviation_rad_s: Option<f64>,
}

/// The reconstruction of one hidden component along a log.
///
/// ```
/// # extern crate corotate_core as corotate;
/// use corotate::estimate::{FilterKind, Reconstruction, Setup};
/// use corotate::identify::Sample;
/// use corotate::model::{Inertia, RigidBody};
/// use corotate::nalgebra::Vector3;
///
/// let inertia = Inertia::new([1.0, 2.0, 2.5]).unwrap();
/// let mut reconstruction = Reconstruction::new(&Setup {
///     coefficients: inertia.coefficients(),
///     axis: 3,
///     damping_per_s: 0.0,
///     wheel: None,
///     filter: FilterKind::First { decay_per_s: 8.0 },
///     guess_rad_s: None,
///     floor_rad_s: 1e-6,
/// })
/// .unwrap();
/// let (body, mut rate) = (RigidBody::new(&inertia), Vector3::new(0.6, -0.4, 0.8));
/// for tick in 0..1000 {
///     // The hidden component is not used.
///     let measured = Vector3::new(rate.x, rate.y, f64::NAN);
///     let estimate = reconstruction.push(&Sample { time_s: f64::from(tick) * 1e-2, rate_rad_s: measured });
///     assert!(tick < 1 || (estimate.rate_rad_s - rate.z).abs() < 1e-6);
///     rate = body.flow(&rate, &Vector3::zeros(), 1e-2);
/// }
/// ```
#[derive(Debug, Clone)]
pub struct Reconstruction {
    relation: HiddenRate,
    guess: Filter<1>,
    guess_rad_s: Option<f64>,
    damping_per_s: f64,
    wheel: Option<Wheel>,
    filter: Filter<1>,
    /// The last sample, and its terms in the relation.
    last: Option<(Sample, Regressor)>,
    /// True if the filter has an estimate.
    begun: bool,
    /// The last step's length with the quantities derived from it; most steps are equal.
    interval: Interval,
    interval_s: f64,
    growth: f64,
}

impl Reconstruction {
    /// Creates a reconstruction without samples.
    ///
    /// # Errors
    /// [`ReconstructionError`] if a parameter is invalid or the axis is not observable.
    pub fn new(setup: &Setup) -> Result<Self, ReconstructionError> {
        let positive = |name, value: f64| number(name, value, value > 0.0, true);
        for coefficient in &setup.coefficients {
            number("coefficient", *coefficient, true, false)?;
        }
        number("damping, 1/s", setup.damping_per_s, true, false)?;
        number("guess, rad/s", setup.guess_rad_s.unwrap_or(0.0), true, false)?;
        positive("floor, rad/s", setup.floor_rad_s)?;
        let relation = HiddenRate::new(&setup.coefficients, setup.axis, setup.floor_rad_s)?;
        if let Some(axis) = setup.wheel.and_then(|wheel| wheel.singular(setup.axis)) {
            return Err(ReconstructionError::Wheel { axis });
        }
        let first = Vector1::new(setup.guess_rad_s.unwrap_or(0.0));
        let (relation, guess) = match setup.filter {
            FilterKind::First { decay_per_s } => {
                positive("decay, 1/s", decay_per_s)?;
                (relation, Filter::First(InvariantFilter::new(Vector1::new(decay_per_s), first)))
            }
            FilterKind::Second { bandwidth_rad_s } => {
                positive("bandwidth, rad/s", bandwidth_rad_s)?;
                let bandwidth = Vector1::new(bandwidth_rad_s);
                (relation, Filter::Second(SecondOrderFilter::new(bandwidth, DAMPING_RATIO, first)))
            }
            FilterKind::Kalman { noise_rad_s, density, guess_deviation_rad_s } => {
                positive("noise, rad/s", noise_rad_s)?;
                number("density, rad2/s3", density, density >= 0.0, false)?;
                positive("deviation of the guess, rad/s", guess_deviation_rad_s)?;
                let deviation = Vector1::new(guess_deviation_rad_s);
                let filter = KalmanFilter::new(Vector1::new(density), first, deviation);
                (relation.with_noise(&Vector3::repeat(noise_rad_s)), Filter::Kalman(filter))
            }
        };
        Ok(Self {
            relation,
            guess,
            guess_rad_s: setup.guess_rad_s,
            damping_per_s: setup.damping_per_s,
            wheel: setup.wheel,
            filter: guess,
            last: None,
            begun: false,
            interval: 1.0.into(),
            interval_s: 0.0,
            growth: 1.0,
        })
    }

    /// Ends a segment: the next sample begins another motion, with its own initial guess.
    pub fn end_segment(&mut self) {
        self.last = None;
    }

    /// Adds the next sample of a segment, whose time is after that of the last one and whose measured components are
    /// finite. Returns the hidden component at it.
    #[inline]
    pub fn push(&mut self, sample: &Sample) -> Reconstructed {
        let Some((last, mut from)) = self.last else { return self.begin(sample) };
        let interval_s = sample.time_s - last.time_s;
        if interval_s != self.interval_s {
            let (undamped_s, growth) = undamped(interval_s, self.damping_per_s);
            (self.interval, self.interval_s, self.growth) = (undamped_s.into(), interval_s, growth);
        }
        // On the clock and with the rates of a motion without damping, see `undamped`.
        let to = self.free(&(sample.rate_rad_s * self.growth), self.growth);
        if self.wheel.is_some() {
            // The wheel's torque changes over the step; the relation takes its mean.
            let mut start = self.free(&last.rate_rad_s, 1.0);
            start.torque_rad_s2 = (start.torque_rad_s2 + to.torque_rad_s2) * 0.5;
            from = self.relation.regressor(&start);
        }
        let to = self.relation.regressor(&to);
        let (observed, too_long) = match self.relation.observe(&from, &to, self.interval, self.filter.estimate().x) {
            Observation::Seen(increment) => {
                self.apply(&increment);
                (true, false)
            }
            Observation::Unobservable { drift } => {
                self.filter.predict(&drift, self.interval.length());
                (false, self.relation.is_too_long(&from, &to))
            }
        };
        if self.growth == 1.0 {
            self.last = Some((*sample, to));
        } else {
            self.last = Some((*sample, self.relation.regressor(&self.free(&sample.rate_rad_s, 1.0))));
            self.filter = self.filter.with_guess(self.filter.estimate() / self.growth);
        }
        Reconstructed { too_long, ..self.result(observed) }
    }

    /// Begins a segment. Its first sample carries no information about the hidden component.
    #[cold]
    fn begin(&mut self, sample: &Sample) -> Reconstructed {
        self.last = Some((*sample, self.relation.regressor(&self.free(&sample.rate_rad_s, 1.0))));
        (self.filter, self.begun) = (self.guess, self.guess_rad_s.is_some());
        self.result(false)
    }

    #[inline]
    fn apply(&mut self, increment: &Increment<1>) {
        // The Kalman filter weighs its guess itself.
        if !self.begun && !matches!(self.filter, Filter::Kalman(_)) {
            self.filter = self.filter.with_guess(increment.reconstruction() - increment.drift);
        }
        self.begun = true;
        self.filter.step(increment);
    }

    /// Returns the sample of a body without a wheel that moves alike. All rates, and so the wheel's momentum, are `growth` times as
    /// large.
    #[inline]
    fn free(&self, rate_rad_s: &Vector3<f64>, growth: f64) -> RateSample {
        match &self.wheel {
            None => RateSample { rate_rad_s: *rate_rad_s, torque_rad_s2: Vector3::zeros() },
            Some(wheel) => wheel.as_torque(rate_rad_s, self.relation.hidden() + 1, growth, self.damping_per_s),
        }
    }

    #[inline]
    fn result(&self, observed: bool) -> Reconstructed {
        let rate_rad_s = if self.begun { self.filter.estimate().x } else { f64::NAN };
        Reconstructed {
            rate_rad_s,
            observed,
            too_long: false,
            deviation_rad_s: self.filter.deviation().map(|deviation| deviation.x),
        }
    }
}

/// Checks a parameter.
fn number(name: &'static str, value: f64, possible: bool, positive: bool) -> Result<(), ReconstructionError> {
    if value.is_finite() && possible { Ok(()) } else { Err(ReconstructionError::Number { name, value, positive }) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{Inertia, Noise, RigidBody};

    fn setup(moments: [f64; 3], axis: usize, filter: FilterKind) -> Setup {
        let coefficients = Inertia::new(moments).unwrap().coefficients();
        Setup { coefficients, axis, damping_per_s: 0.0, wheel: None, filter, guess_rad_s: None, floor_rad_s: 1e-6 }
    }

    /// Returns the largest error over the last half of 4 s of tumbling at 100 Hz, and the number of samples not
    /// observed.
    fn worst(setup: &Setup, noise_rad_s: f64) -> (f64, u32) {
        let body = RigidBody::with_coefficients(setup.coefficients);
        let mut noise = Noise::new(5, 0, [noise_rad_s; 3], [0.0; 3]);
        let mut reconstruction = Reconstruction::new(setup).unwrap();
        let (mut rate, mut worst, mut blind) = (Vector3::new(2.0, -3.0, 2.5), 0.0_f64, 0);
        for tick in 0..400 {
            let mut measured = rate + noise.sample();
            measured[setup.axis - 1] = f64::NAN;
            let estimate = reconstruction.push(&Sample { time_s: f64::from(tick) * 0.01, rate_rad_s: measured });
            blind += u32::from(!estimate.observed);
            if tick >= 200 {
                worst = worst.max((estimate.rate_rad_s - rate[setup.axis - 1]).abs());
            }
            let (interval_s, growth) = undamped(0.01, setup.damping_per_s);
            rate = body.flow(&rate, &Vector3::zeros(), interval_s) / growth;
        }
        (worst, blind)
    }

    const FILTERS: [FilterKind; 3] = [
        FilterKind::First { decay_per_s: 10.0 },
        FilterKind::Second { bandwidth_rad_s: 10.0 },
        FilterKind::Kalman { noise_rad_s: 1e-3, density: 1e-2, guess_deviation_rad_s: 10.0 },
    ];

    #[test]
    fn every_filter_finds_every_axis_of_a_damped_body() {
        for filter in FILTERS {
            for axis in 1..=3 {
                for damping_per_s in [0.0, 0.3] {
                    let setup = Setup { damping_per_s, ..setup([1.0, 2.0, 2.5], axis, filter) };
                    let (error, blind) = worst(&setup, 0.0);
                    assert!(error < 1e-5 && blind == 1, "{setup:?}: {error:e} {blind}");
                    let (error, _) = worst(&setup, 1e-3);
                    assert!(error < 0.1, "{setup:?}: {error:e}");
                }
            }
        }
    }

    #[test]
    fn every_axis_of_a_damped_body_with_a_wheel_is_found() {
        let (moments, momentum) = (Vector3::new(0.03, 0.042, 0.05), Vector3::new(0.004, -0.006, 0.012));
        for (axis, damping_per_s) in [(1, 0.0), (2, 0.0), (3, 0.0), (1, 0.05), (2, 0.05), (3, 0.05)] {
            let slope = |rate: Vector3<f64>| -> Vector3<f64> {
                -rate.cross(&(moments.component_mul(&rate) + momentum)).component_div(&moments) - damping_per_s * rate
            };
            let wheel = Some(Wheel { momentum, moments });
            let setup = Setup { wheel, damping_per_s, ..setup(moments.into(), axis, FILTERS[0]) };
            let mut reconstruction = Reconstruction::new(&setup).unwrap();
            let (mut rate, mut worst) = (Vector3::new(0.5, -0.35, 0.25), 0.0_f64);
            for tick in 0..1000 {
                let mut measured = rate;
                measured[axis - 1] = f64::NAN;
                let estimate = reconstruction.push(&Sample { time_s: f64::from(tick) * 0.02, rate_rad_s: measured });
                if tick > 100 {
                    worst = worst.max((estimate.rate_rad_s - rate[axis - 1]).abs());
                }
                let first = slope(rate);
                let second = slope(rate + first * 0.01);
                let third = slope(rate + second * 0.01);
                rate += (first + second * 2.0 + third * 2.0 + slope(rate + third * 0.02)) * (0.02 / 6.0);
            }
            assert!(worst < 1e-4, "{axis} {damping_per_s}: {worst:e}");
        }
        let alike = Wheel { momentum, moments: Vector3::new(0.03, 0.05, 0.05) };
        let refused = Reconstruction::new(&Setup { wheel: Some(alike), ..setup([0.03, 0.05, 0.05], 3, FILTERS[0]) });
        assert!(matches!(refused, Err(ReconstructionError::Wheel { axis: 2 })));
    }

    #[test]
    fn an_unknown_damping_causes_an_error_of_its_size() {
        let known = Setup { damping_per_s: 0.3, ..setup([1.0, 2.5, 2.0], 3, FILTERS[0]) };
        let body = RigidBody::with_coefficients(known.coefficients);
        let mut unaware = Reconstruction::new(&Setup { damping_per_s: 0.0, ..known }).unwrap();
        let (mut rate, mut worst) = (Vector3::new(2.0, -3.0, 2.5), 0.0_f64);
        for tick in 0..400 {
            let estimate = unaware.push(&Sample { time_s: f64::from(tick) * 0.01, rate_rad_s: rate });
            if tick >= 200 {
                worst = worst.max((estimate.rate_rad_s - rate.z).abs());
            }
            let (interval_s, growth) = undamped(0.01, 0.3);
            rate = body.flow(&rate, &Vector3::zeros(), interval_s) / growth;
        }
        assert!(worst > 0.05, "{worst:e}");
    }

    #[test]
    fn each_segment_begins_without_an_observed_sample() {
        let mut reconstruction = Reconstruction::new(&setup([1.0, 2.0, 2.5], 3, FILTERS[0])).unwrap();
        let sample = |time_s| Sample { time_s, rate_rad_s: Vector3::new(1.0, 1.0, f64::NAN) };
        assert!(reconstruction.push(&sample(0.0)).rate_rad_s.is_nan());
        assert!(reconstruction.push(&sample(0.1)).rate_rad_s.is_finite());
        reconstruction.end_segment();
        let first = reconstruction.push(&sample(0.0));
        assert!(first.rate_rad_s.is_nan() && !first.observed);
        let guessed = Setup { guess_rad_s: Some(0.7), ..setup([1.0, 2.0, 2.5], 3, FILTERS[0]) };
        let mut reconstruction = Reconstruction::new(&guessed).unwrap();
        assert_eq!(reconstruction.push(&sample(0.0)).rate_rad_s, 0.7);
    }

    #[test]
    fn invalid_parameters_are_refused() {
        let good = setup([1.0, 2.0, 2.5], 3, FILTERS[0]);
        let refused = |setup: Setup| Reconstruction::new(&setup).unwrap_err().to_string();
        assert!(refused(Setup { axis: 4, ..good }).contains("axis 4 does not exist"));
        assert!(refused(Setup { coefficients: Vector3::zeros(), ..good }).contains("turns like a sphere"));
        assert!(refused(Setup { damping_per_s: f64::NAN, ..good }).contains("give a finite number"));
        assert!(refused(Setup { filter: FilterKind::First { decay_per_s: 0.0 }, ..good }).contains("above 0"));
        assert!(refused(Setup { floor_rad_s: -1.0, ..good }).contains("above 0"));
    }
}

//! The hidden component, sample by sample: segments, first guesses and damping around the relation and its filters.

use crate::identify::{Sample, freed};
use crate::observe::{
    Filter, HiddenRate, HiddenRateError, Increment, Interval, InvariantFilter, KalmanFilter, Observation, RateSample,
    Regressor, SecondOrderFilter,
};
use nalgebra::{Vector1, Vector3};

/// The damping ratio of the filter of second order.
const DAMPING_RATIO: f64 = core::f64::consts::FRAC_1_SQRT_2;

/// Which filter weighs the steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FilterKind {
    /// The paper's: the error falls as e^{−decay·t}.
    First {
        /// Positive, 1/s.
        decay_per_s: f64,
    },
    /// Two poles of the given bandwidth, damped by 1/√2.
    Second {
        /// Positive, rad/s.
        bandwidth_rad_s: f64,
    },
    /// The gains of the Kalman filter.
    Kalman {
        /// Standard deviation of one measured rate, rad/s.
        noise_rad_s: f64,
        /// Density of what the model does not know, (rad/s)²/s.
        density: f64,
        /// Standard deviation of the guess, rad/s.
        guess_deviation_rad_s: f64,
    },
}

/// What is known of the body, and what is asked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Setup {
    /// The coefficients a of \[D\](2).
    pub coefficients: Vector3<f64>,
    /// The hidden axis, 1 to 3.
    pub axis: usize,
    /// Damping by a torque −c I ω, 1/s; not negative for air.
    pub damping_per_s: f64,
    /// The filter.
    pub filter: FilterKind,
    /// The first estimate of every segment, rad/s; without one it is what the first step that tells says.
    pub guess_rad_s: Option<f64>,
    /// Below this the measured rates carry no information, rad/s.
    pub floor_rad_s: f64,
}

/// Why there can be no reconstruction.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum ReconstructionError {
    /// The axis cannot be observed.
    #[error(transparent)]
    Relation(#[from] HiddenRateError),
    /// A number is impossible.
    #[error("{name} = {value}: give a finite number{}", if *.positive { " above 0" } else { "" })]
    Number {
        /// What it is.
        name: &'static str,
        /// What was given.
        value: f64,
        /// Whether it must be above zero.
        positive: bool,
    },
}

/// What one sample gave.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reconstructed {
    /// The hidden rate, rad/s; not a number as long as nothing has told of it.
    pub rate_rad_s: f64,
    /// Whether the step to this sample told something of it. If not, the model went on alone.
    pub observed: bool,
    /// Its standard deviation by the filter, where it knows one, rad/s.
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
///     filter: FilterKind::First { decay_per_s: 8.0 },
///     guess_rad_s: None,
///     floor_rad_s: 1e-6,
/// })
/// .unwrap();
/// let (body, mut rate) = (RigidBody::new(&inertia), Vector3::new(0.6, -0.4, 0.8));
/// for tick in 0..1000 {
///     // What is in the place of the hidden component is not read.
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
    filter: Filter<1>,
    /// The last sample's time and what the relation sees in it.
    last: Option<(f64, Regressor)>,
    /// Whether the filter has an estimate.
    begun: bool,
    /// The last step's length with what follows from it: most are equal.
    interval: Interval,
    interval_s: f64,
    growth: f64,
}

impl Reconstruction {
    /// A reconstruction that has seen nothing yet.
    ///
    /// # Errors
    /// [`ReconstructionError`].
    pub fn new(setup: &Setup) -> Result<Self, ReconstructionError> {
        let positive = |name, value: f64| number(name, value, value > 0.0, true);
        for coefficient in &setup.coefficients {
            number("coefficient", *coefficient, true, false)?;
        }
        number("damping, 1/s", setup.damping_per_s, true, false)?;
        number("guess, rad/s", setup.guess_rad_s.unwrap_or(0.0), true, false)?;
        positive("floor, rad/s", setup.floor_rad_s)?;
        let relation = HiddenRate::new(&setup.coefficients, setup.axis, setup.floor_rad_s)?;
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
            filter: guess,
            last: None,
            begun: false,
            interval: 1.0.into(),
            interval_s: 0.0,
            growth: 1.0,
        })
    }

    /// Ends a segment: the next sample begins another motion, with a first guess of its own.
    pub fn end_segment(&mut self) {
        self.last = None;
    }

    /// Takes in the next sample of a segment, its time after the last one's and its measured components finite; gives the
    /// hidden component at it.
    #[inline]
    pub fn push(&mut self, sample: &Sample) -> Reconstructed {
        let Some((last_s, from)) = self.last else { return self.begin(sample) };
        let interval_s = sample.time_s - last_s;
        if interval_s != self.interval_s {
            let (freed_s, growth) = freed(interval_s, self.damping_per_s);
            (self.interval, self.interval_s, self.growth) = (freed_s.into(), interval_s, growth);
        }
        // By the clock and the rates of a motion without damping, see `freed`.
        let to = self.regressor(&(sample.rate_rad_s * self.growth));
        let observed = match self.relation.observe(&from, &to, self.interval, self.filter.estimate().x) {
            Observation::Seen(increment) => {
                self.take(&increment);
                true
            }
            Observation::Unobservable { drift } => {
                self.filter.predict(&drift, self.interval.length());
                false
            }
        };
        if self.growth == 1.0 {
            self.last = Some((sample.time_s, to));
        } else {
            self.last = Some((sample.time_s, self.regressor(&sample.rate_rad_s)));
            self.filter = self.filter.with_guess(self.filter.estimate() / self.growth);
        }
        self.told(observed)
    }

    /// The first sample of a segment tells nothing of the hidden component.
    #[cold]
    fn begin(&mut self, sample: &Sample) -> Reconstructed {
        self.last = Some((sample.time_s, self.regressor(&sample.rate_rad_s)));
        (self.filter, self.begun) = (self.guess, self.guess_rad_s.is_some());
        self.told(false)
    }

    #[inline]
    fn take(&mut self, increment: &Increment<1>) {
        // The Kalman filter weighs its guess itself.
        if !self.begun && !matches!(self.filter, Filter::Kalman(_)) {
            self.filter = self.filter.with_guess(increment.reconstruction() - increment.drift);
        }
        self.begun = true;
        self.filter.step(increment);
    }

    #[inline]
    fn regressor(&self, rate_rad_s: &Vector3<f64>) -> Regressor {
        self.relation.regressor(&RateSample { rate_rad_s: *rate_rad_s, torque_rad_s2: Vector3::zeros() })
    }

    #[inline]
    fn told(&self, observed: bool) -> Reconstructed {
        let rate_rad_s = if self.begun { self.filter.estimate().x } else { f64::NAN };
        Reconstructed { rate_rad_s, observed, deviation_rad_s: self.filter.deviation().map(|deviation| deviation.x) }
    }
}

/// Checks a number.
fn number(name: &'static str, value: f64, possible: bool, positive: bool) -> Result<(), ReconstructionError> {
    if value.is_finite() && possible { Ok(()) } else { Err(ReconstructionError::Number { name, value, positive }) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{Inertia, Noise, RigidBody};

    fn setup(moments: [f64; 3], axis: usize, filter: FilterKind) -> Setup {
        let coefficients = Inertia::new(moments).unwrap().coefficients();
        Setup { coefficients, axis, damping_per_s: 0.0, filter, guess_rad_s: None, floor_rad_s: 1e-6 }
    }

    /// The worst error over the last half of 4 s of tumbling at 100 Hz, and how many samples were not observed.
    fn worst(setup: &Setup, noise_rad_s: f64) -> (f64, u32) {
        let body = RigidBody::with_coefficients(setup.coefficients);
        let mut noise = Noise::new(5, 0, [noise_rad_s; 3], [0.0; 3]);
        let mut reconstruction = Reconstruction::new(setup).unwrap();
        let (mut rate, mut worst, mut blind) = (Vector3::new(2.0, -3.0, 2.5), 0.0_f64, 0);
        for tick in 0..400 {
            let mut measured = rate + noise.sample();
            measured[setup.axis - 1] = f64::NAN;
            let told = reconstruction.push(&Sample { time_s: f64::from(tick) * 0.01, rate_rad_s: measured });
            blind += u32::from(!told.observed);
            if tick >= 200 {
                worst = worst.max((told.rate_rad_s - rate[setup.axis - 1]).abs());
            }
            let (interval_s, growth) = freed(0.01, setup.damping_per_s);
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
    fn a_damping_that_is_not_known_is_an_error_of_its_size() {
        let known = Setup { damping_per_s: 0.3, ..setup([1.0, 2.5, 2.0], 3, FILTERS[0]) };
        let body = RigidBody::with_coefficients(known.coefficients);
        let mut unaware = Reconstruction::new(&Setup { damping_per_s: 0.0, ..known }).unwrap();
        let (mut rate, mut worst) = (Vector3::new(2.0, -3.0, 2.5), 0.0_f64);
        for tick in 0..400 {
            let told = unaware.push(&Sample { time_s: f64::from(tick) * 0.01, rate_rad_s: rate });
            if tick >= 200 {
                worst = worst.max((told.rate_rad_s - rate.z).abs());
            }
            let (interval_s, growth) = freed(0.01, 0.3);
            rate = body.flow(&rate, &Vector3::zeros(), interval_s) / growth;
        }
        assert!(worst > 0.05, "{worst:e}");
    }

    #[test]
    fn segments_begin_anew_and_say_so() {
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
    fn what_cannot_be_is_refused() {
        let good = setup([1.0, 2.0, 2.5], 3, FILTERS[0]);
        let refused = |setup: Setup| Reconstruction::new(&setup).unwrap_err().to_string();
        assert!(refused(Setup { axis: 4, ..good }).contains("axis 4 does not exist"));
        assert!(refused(Setup { coefficients: Vector3::zeros(), ..good }).contains("turns like a sphere"));
        assert!(refused(Setup { damping_per_s: f64::NAN, ..good }).contains("give a finite number"));
        assert!(refused(Setup { filter: FilterKind::First { decay_per_s: 0.0 }, ..good }).contains("above 0"));
        assert!(refused(Setup { floor_rad_s: -1.0, ..good }).contains("above 0"));
    }
}

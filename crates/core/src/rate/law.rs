//! The synchronising law of one follower, which also computes its certificate at every tick.

use super::port;
use crate::control::{Certificate, InFlightCommands, InertiaAdaptation, Synchronizer, limited};
use crate::role::{Law, LawInputs};
use crate::sample::{RateCommand, RateEstimate, RateMeasurement};
use crate::state::persist_fields;
use core::hint::black_box;
use nalgebra::Vector3;

/// The parameters of a follower's law.
#[derive(Debug, Clone)]
pub struct RateLawDesign {
    /// The law itself.
    pub law: Synchronizer,
    /// The adaptation gain for a follower of another inertia; 0 disables the adaptation.
    pub adaptation_gain: f64,
    /// The certificate. Absent if the observer is not the papers' filter; V is then published as 0.
    pub certificate: Option<Certificate>,
    /// The component supplied by the observer, 0 to 2.
    pub supplied: usize,
    /// True if the law uses the coefficients that the observer has learned.
    pub learned: bool,
    /// The limit of each command component, rad/s²; the actuators reject more.
    pub acceleration_max_rad_s2: f64,
    /// The time between two commands, s.
    pub period_s: f64,
    /// The number of ticks over which a predicting law predicts: from a measurement to the tick at which its command
    /// acts.
    pub predicted_ticks: u64,
}

/// The synchronising law of one follower.
#[derive(Debug)]
pub struct RateLaw {
    law: Synchronizer,
    adaptation: InertiaAdaptation,
    certificate: Option<Certificate>,
    /// 1 for the component supplied by the observer, 0 for the others.
    supplied: Vector3<f64>,
    learned: bool,
    acceleration_max_rad_s2: f64,
    period_s: f64,
    /// The commands of a predicting law that were sent and do not act yet, rad/s².
    in_flight: InFlightCommands<[f64; 3]>,
}

impl RateLaw {
    /// Creates a law that has learned and sent nothing.
    pub fn new(design: &RateLawDesign) -> Self {
        let RateLawDesign {
            adaptation_gain, certificate, supplied, learned, acceleration_max_rad_s2, period_s, ..
        } = *design;
        Self {
            law: design.law,
            adaptation: InertiaAdaptation::new(adaptation_gain),
            certificate,
            supplied: Vector3::from_fn(|row, _| f64::from(u8::from(row == supplied))),
            learned,
            acceleration_max_rad_s2,
            period_s,
            in_flight: InFlightCommands::new(design.predicted_ticks, || [0.0; 3]),
        }
    }

    /// Predicts reference and follower, tick by tick, under the commands that do not act yet.
    #[inline(never)]
    fn predict_in_flight(
        &self,
        (mut w, mut p): (Vector3<f64>, Vector3<f64>),
        measurement: &RateMeasurement,
    ) -> (Vector3<f64>, Vector3<f64>) {
        for input in self.in_flight.after(measurement.stamp.tick) {
            (w, p) = self.law.ahead(w, p, input.unwrap_or(&measurement.applied_rad_s2));
        }
        (w, p)
    }
}

// Learned coefficients are not state: every estimate carries them.
persist_fields!(RateLaw, adaptation, in_flight);

impl Law for RateLaw {
    type Estimate = RateEstimate;
    type Measurement = RateMeasurement;
    type Command = RateCommand;

    #[inline(always)]
    fn command(&mut self, inputs: &LawInputs<'_, Self>, out: &mut RateCommand) {
        let LawInputs { estimate, measurement, .. } = inputs;
        // Read one by one, not as pairs: this core may just have stored them one by one, and a load of two would wait
        // until both have left the store buffer.
        let [x, y, z] = estimate.omega_rad_s;
        let (reference, follower) = (Vector3::new(x, black_box(y), z), Vector3::from(measurement.omega_rad_s));
        if self.learned {
            self.law.learn(estimate.coefficients.into());
        }
        let (mut w, mut p) = self.law.ahead(reference, follower, &measurement.applied_rad_s2);
        if !self.in_flight.is_empty() {
            (w, p) = self.predict_in_flight((w, p), measurement);
        }
        let mut asked = self.law.command(&w, &p);
        if self.adaptation.acts() {
            asked += self.adaptation.correction(&w, &p, self.period_s);
        }
        out.acceleration_rad_s2 = limited(asked, self.acceleration_max_rad_s2).into();
        if let Some(sent) = self.in_flight.sent(measurement.stamp.tick) {
            *sent = out.acceleration_rad_s2;
        }
        // e = p − ω with ω = ω̂ + ε; the observer knows ε from its last step.
        let error = follower - reference - self.law.offset() - self.supplied * estimate.innovation_rad_s;
        (out.lyapunov_rad2_s2, out.lyapunov_rate_bound_rad2_s3) =
            self.certificate.map_or((0.0, 0.0), |certificate| certificate.lyapunov(&error, estimate.innovation_rad_s));
    }

    fn set_input(&mut self, port: usize, values: &[f64]) {
        let vector = || Vector3::from_iterator(values.iter().copied());
        let (mut gain_per_s, mut decay_rate_per_s) = (None, None);
        match (port, values) {
            (port::GAIN, [_, _, _]) => {
                self.law.set_gain(vector());
                gain_per_s = Some(vector());
            }
            (port::OFFSET, [_, _, _]) => self.law.set_offset(vector()),
            (port::DECAY, [rate]) => decay_rate_per_s = Some(*rate),
            _ => {}
        }
        if let Some(certificate) = &mut self.certificate {
            *certificate = certificate.with_rates(gain_per_s, decay_rate_per_s);
        }
    }
}

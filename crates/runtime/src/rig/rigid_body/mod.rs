//! The rig `rigid-body`: a leader with one component of its angular velocity unmeasured or lost, and followers that turn as
//! it does.
//!
//! This module holds parameters and the conversion between samples and vectors. The mathematics is in `model`, `observe` and
//! `control`.

mod config;
mod design;
mod fleet;
mod inputs;
mod limits;
mod plant;
mod playback;
mod resolve;

pub use crate::rate::{HiddenObserver, KalmanObserver, Learner, RateLaw, RateObserver};
pub use design::RigidBodyRig;
pub use fleet::RateFleet;
pub use limits::{CommandGuard, EstimateGuard, MeasurementGuard};
pub use plant::RatePlant;

use super::BodyInfo;
use super::contract::pair;
use super::contract::{CertificateReport, ConditionReport, Context, Figure, Monitor, Rig, Start, Watched};
use super::filter::{FilterDesign, UNKNOWN_DEVIATION};
use super::pictures::{Graph, Inputs, Lyapunov, Picture, Plane};
use crate::bus::Signal;
use crate::config::{Checks, ConfigError, Document, InputInfo};
use crate::control::{Certificate, Synchronizer};
use crate::model::{Inertia, Noise, RigidBody};
use crate::observe::RateNoise;
use crate::rate::{ALL, RateLawDesign};
use crate::sample::{FleetTruth, RateCommand, RateEstimate, RateTruth, status};
use design::{ControllerDesign, ObserverDesign};
use fleet::farthest;
use limits::{MAX_TURN_RAD, Sensed};
use nalgebra::{Vector1, Vector3};

impl RigidBodyRig {
    /// Returns the component that the observer supplies, 0 to 2. If it supplies none, any component serves.
    #[inline]
    fn supplied(&self) -> usize {
        self.supplied_axis.unwrap_or(3) - 1
    }

    /// Returns bounds on the leader's |a|. Coefficients that an observer must learn are not used by the guards either.
    fn leader_coefficients(&self) -> Vector3<f64> {
        match &self.observer {
            ObserverDesign::Hidden { .. } => self.inertia.coefficients().abs(),
            ObserverDesign::Learner(_) => Vector3::repeat(1.0),
        }
    }

    fn rate_bound_rad_s(&self) -> f64 {
        match &self.playback {
            Some(playback) => playback.bounds().0,
            None => self.inertia.rate_bound_rad_s(&self.initial_rates[0]),
        }
    }

    fn check_tick(&self, checks: &mut Checks<'_>) {
        let (m, tick_s) = (self.rate_bound_rad_s(), self.tick_s);
        let limit_rad_s = MAX_TURN_RAD / tick_s;
        checks.require(m < limit_rad_s, "tick_hz", "ambiguous-phase", || {
            format!(
                "the leader may turn at {m:.3} rad/s, so its phase is ambiguous from one tick of {tick_s} s to the next; \
                 raise tick_hz above {:.3}",
                m / MAX_TURN_RAD
            )
        });
        for (index, (rate, spread)) in self.initial_rates.iter().zip(&self.spreads).skip(1).enumerate() {
            let rate_rad_s = (rate.abs() + spread).norm();
            checks.require(rate_rad_s < limit_rad_s, &format!("follower[{index}].initial_rate_rad_s"), "turns-too-far", || {
                format!(
                    "at {rate_rad_s:.3} rad/s it turns too far from one tick of {tick_s} s to the next to be driven; lower \
                     it or raise tick_hz above {:.3}",
                    rate_rad_s / MAX_TURN_RAD
                )
            });
        }
        if let ObserverDesign::Hidden { relation, guess_rad_s, .. } = &self.observer {
            checks.require(guess_rad_s.abs() < limit_rad_s, "observer.initial_guess_rad_s", "ambiguous-phase", || {
                format!("at {guess_rad_s} rad/s the phase would be ambiguous from tick to tick; guess nearer to 0")
            });
            // A leader at rest needs no observer and passes this check.
            let floor_rad_s = relation.floor_rad_s();
            checks.require(m == 0.0 || floor_rad_s < m, "observer.observability_floor_rad_s", "never-observed", || {
                format!(
                    "{floor_rad_s} is not below the {m:.3} rad/s that the leader may turn at, so it is never observed; \
                     lower it"
                )
            });
        }
        // A slower controller is judged by the loop that runs.
        if let Some(controller) = self.controller.filter(|_| self.rates.controller_ticks == 1) {
            let step = Certificate::gain_step(&controller.gain_per_s, tick_s, self.unpredicted_ticks(&controller));
            checks.require(step.holds(), "controller.gain_per_s", "unstable-loop", || {
                format!(
                    "the largest gain times the tick is {:.3}, and the sampled loop is unstable from {} on; lower the gain \
                     or raise tick_hz",
                    step.required, step.value
                )
            });
        }
    }

    /// Returns a body's dynamics with its own inertia.
    fn moved(&self, index: usize) -> RigidBody {
        let own = self.inertia.moments_kg_m2().component_mul(&self.inertia_factors[index]);
        Inertia::new(own.into()).map_or(RigidBody::new(&self.inertia), |own| RigidBody::new(&own))
    }

    /// Returns the properties that a body's measurements show.
    fn sensed(&self, index: usize) -> Sensed {
        Sensed {
            // A follower may have another inertia.
            coefficients: if index == 0 { self.leader_coefficients() } else { Vector3::repeat(1.0) },
            factor: self.inertia_factors[index],
            driven: self.bodies[index].driven.then(|| self.moved(index)),
            deviation: self.deviations_rad_s[index],
            bias: self.biases_rad_s[index],
            recorded_rad_s2: self.playback.as_ref().filter(|_| index == 0).map(|playback| playback.bounds().1),
        }
    }

    /// Returns the law of a follower, and its parameters.
    fn synchronizer(&self, index: usize) -> (Synchronizer, ControllerDesign) {
        let Some(controller) = self.controller else {
            unreachable!("a scenario with a follower has a controller: checked when it was resolved")
        };
        let lead_s = if controller.predict { self.tick_s } else { 0.0 };
        let mut law = Synchronizer::new(RigidBody::new(&self.inertia), controller.gain_per_s, lead_s);
        law.set_offset(self.offsets_rad_s[index]);
        (law, controller)
    }

    /// Returns the delay that the law does not predict, ticks.
    fn unpredicted_ticks(&self, controller: &ControllerDesign) -> u64 {
        if controller.predict { 0 } else { self.actuation_delay_ticks }
    }

    /// Returns the number of ticks that the law predicts, if it predicts.
    fn predicted_ticks(&self, controller: &ControllerDesign) -> u64 {
        if controller.predict { self.actuation_delay_ticks } else { 1 }
    }

    fn certify(&self) -> Option<Certificate> {
        let controller = self.controller?;
        // The certificate applies to leaders that move freely, and to roles that compute at every tick.
        if self.playback.is_some() || self.rates.pattern_ticks() > 1 {
            return None;
        }
        // The papers' conditions apply to the papers' filter.
        let decay_rate_per_s = match &self.observer {
            ObserverDesign::Hidden { filter: FilterDesign::First([decay]), .. } => *decay,
            ObserverDesign::Hidden { .. } => return None,
            ObserverDesign::Learner(parts) => parts.decay_rate_per_s,
        };
        Some(Certificate::new(
            &self.inertia.coefficients(),
            self.supplied() + 1,
            &controller.gain_per_s,
            decay_rate_per_s,
            self.rate_bound_rad_s(),
            self.tick_s,
            self.unpredicted_ticks(&controller),
        ))
    }
}

impl RigidBodyRig {
    /// Returns the range of the metrics that apply, as first and end index. Without a follower only the inertia is scored.
    fn scored(&self) -> (usize, usize) {
        match (&self.observer, self.controller) {
            (ObserverDesign::Hidden { .. }, _) => (0, 2),
            (_, Some(_)) => (0, 3),
            (_, None) => (2, 3),
        }
    }

    /// Returns the reason why nothing can be watched, if there is one.
    fn uncontrolled(&self) -> Option<&'static str> {
        self.controller.is_none().then_some("is watched by the controller, and this scenario has none")
    }
}

/// The quantities that the controller can watch. Energy and momentum are divided by I1: a free motion reveals only ratios of the
/// moments of inertia.
const MONITORS: [Monitor<RigidBodyRig>; 4] = [
    Monitor {
        name: "energy_drift",
        watched: Watched::Constant(|_, estimate: &RateEstimate| {
            0.5 * Vector3::from(estimate.omega_rad_s).dot(&momentum(estimate))
        }),
        absent: RigidBodyRig::uncontrolled,
    },
    Monitor {
        name: "momentum_drift",
        watched: Watched::Constant(|_, estimate| momentum(estimate).norm()),
        absent: RigidBodyRig::uncontrolled,
    },
    Monitor {
        name: "innovation_rad_s",
        watched: Watched::Small(|_, estimate: &RateEstimate| estimate.innovation_rad_s),
        absent: |rig| {
            let kalman = matches!(rig.observer, ObserverDesign::Hidden { filter: FilterDesign::Kalman(_), .. });
            rig.uncontrolled().or(kalman.then_some("is not published by the Kalman filter"))
        },
    },
    Monitor {
        name: "lyapunov_rad2_s2",
        watched: Watched::Commanded(|command| RigidBodyRig::lyapunov(command).map(|(v, _)| v)),
        absent: |rig| {
            let fleets = rig.bodies[1..].iter().all(|body| body.fleet.is_some());
            let second = rig.certificate.is_none().then_some("is published with the first-order filter only");
            rig.uncontrolled().or(second).or(fleets.then_some("is not published for a fleet"))
        },
    },
];

/// Returns the estimated angular momentum divided by I1, in the body's axes.
fn momentum(estimate: &RateEstimate) -> Vector3<f64> {
    let [second, third] = estimate.inertia_ratios;
    Vector3::from(estimate.omega_rad_s).component_mul(&Vector3::new(1.0, second, third))
}

impl Rig for RigidBodyRig {
    type Body = RatePlant;
    type Estimator = RateObserver;
    type Law = RateLaw;
    type MeasurementGuard = MeasurementGuard;
    type EstimateGuard = EstimateGuard;
    type CommandGuard = CommandGuard;
    type Fleet = RateFleet;
    const AXES: usize = 3;
    const NAMES: &'static [&'static str] = &["rigid-body"];
    const LISTS: &'static [&'static str] = &["follower"];

    fn controlled() -> Vec<&'static str> {
        vec!["omega_rad_s", "coefficients"]
    }

    fn tables() -> Vec<&'static str> {
        vec!["leader", "observer", "controller", "limits"]
    }

    fn resolve(
        _name: &str,
        sections: &Document,
        context: Context,
        checks: &mut Checks<'_>,
    ) -> Result<(Option<Self>, toml::Table), ConfigError> {
        resolve::resolve(sections, context, checks)
    }

    fn bodies(&self) -> &[BodyInfo] {
        &self.bodies
    }

    fn body(&self, index: usize) -> RatePlant {
        RatePlant {
            body: self.moved(index),
            rate: self.initial_rates[index],
            asked: Vector3::zeros(),
            inertia_factor: self.inertia_factors[index],
            measured: if index == 0 { self.measured } else { ALL },
            noise: self.noise[index].clone(),
            outages: if index == 0 { self.outages.clone() } else { Vec::new() },
            playback: self.playback.clone().filter(|_| index == 0),
            played_s: 0.0,
            resistance_rad_s2: plant::resistance(&self.disturbances_rad_s2[index]),
        }
    }

    fn estimator(&self) -> RateObserver {
        match &self.observer {
            ObserverDesign::Hidden { relation, filter: FilterDesign::Kalman(density), guess_rad_s } => {
                let noise = RateNoise {
                    sensor_deviation_rad_s: self.deviations_rad_s[0],
                    density: *density,
                    guess_deviation_rad_s: UNKNOWN_DEVIATION,
                };
                let (coefficients, floor_rad_s) = (self.inertia.coefficients(), relation.floor_rad_s());
                RateObserver::Kalman(KalmanObserver::new(
                    coefficients,
                    noise,
                    self.supplied(),
                    floor_rad_s,
                    *guess_rad_s,
                ))
            }
            ObserverDesign::Hidden { relation, filter, guess_rad_s } => {
                let begun = filter.filter(Vector1::new(*guess_rad_s));
                RateObserver::Hidden(HiddenObserver::new(*relation, self.inertia.coefficients(), begun))
            }
            ObserverDesign::Learner(parts) => RateObserver::Learner(Learner::new(parts.clone())),
        }
    }

    fn law(&self, index: usize) -> RateLaw {
        let (law, controller) = self.synchronizer(index);
        RateLaw::new(&RateLawDesign {
            law,
            adaptation_gain: controller.adaptation_gain,
            certificate: self.certificate,
            supplied: self.supplied(),
            learned: controller.learned,
            acceleration_max_rad_s2: self.limits.acceleration_rad_s2,
            period_s: self.tick_s * self.rates.controller_ticks as f64,
            predicted_ticks: self.predicted_ticks(&controller),
        })
    }

    /// A law needs all components. An observer checks itself which components it needs.
    fn measurement_guard(&self, index: usize, acts: bool) -> MeasurementGuard {
        self.limits.measurement(&self.sensed(index), self.tick_s, if acts { ALL } else { 0 })
    }

    fn estimate_guard(&self) -> EstimateGuard {
        self.limits.estimate(&self.leader_coefficients(), self.tick_s, self.rates.update_ticks())
    }

    fn command_guard(&self, _index: usize) -> CommandGuard {
        self.limits.command()
    }

    fn fleet(&self, index: usize) -> Option<RateFleet> {
        let count = self.bodies[index].fleet?;
        Some(RateFleet::new(self, index, count))
    }

    fn limits(&self) -> Vec<Figure> {
        self.limits.figures()
    }

    fn inputs(&self) -> Vec<InputInfo> {
        inputs::inputs(self)
    }

    fn set_input(&mut self, port: usize, values: &[f64]) {
        inputs::set(self, port, values);
    }

    fn monitors() -> &'static [Monitor<Self>] {
        &MONITORS
    }

    fn metrics(&self) -> Vec<&'static str> {
        let (first, end) = self.scored();
        ["sync_error_rad_s", "estimate_error_rad_s", "coefficient_error"][first..end].to_vec()
    }

    /// Writes |p − ω| of the worst follower, all bodies of fleets included, |ω̂ − ω| and |â − a|, as [`metrics`](Rig::metrics) lists
    /// them.
    #[inline]
    fn score<'a>(
        &self,
        truth: impl Fn(usize) -> Option<&'a RateTruth>,
        fleet: impl Fn(usize) -> Option<&'a FleetTruth>,
        estimate: impl Fn(usize) -> Option<&'a RateEstimate>,
        _reference: &[f64],
        out: &mut [f64],
    ) {
        let rate = |index| truth(index).map(|truth| Vector3::from(truth.omega_rad_s));
        let distance = |from: Option<Vector3<f64>>, to: Option<Vector3<f64>>| match (from, to) {
            (Some(from), Some(to)) => (from - to).norm(),
            _ => f64::NAN,
        };
        let (leader, estimate) = (rate(0), estimate(0));
        let follower = |index: usize| {
            let reference = leader.map(|leader| leader + self.offsets_rad_s[index]);
            match (self.bodies[index].fleet, reference) {
                (None, _) => distance(rate(index), reference),
                (Some(_), Some(reference)) => {
                    fleet(index).map_or(f64::NAN, |truth| farthest(truth.vector(0), &reference))
                }
                (Some(_), None) => f64::NAN,
            }
        };
        let worst = |worst: f64, error: f64| if error > worst || error.is_nan() { error } else { worst };
        let (first, end) = self.scored();
        if first == 0 {
            out[0] = (1..self.bodies.len()).map(follower).fold(0.0, worst);
            out[1] = distance(estimate.map(|estimate| estimate.omega_rad_s.into()), leader);
        }
        if end == 3 {
            let learned = estimate.map(|estimate| estimate.coefficients.into());
            out[2 - first] = distance(learned, Some(self.inertia.coefficients()));
        }
    }

    fn isolated(&self, index: usize, start: Start, noisy: bool) -> Option<Self> {
        // Certificate and loop analysis apply to a leader that moves freely.
        if self.playback.is_some() {
            return None;
        }
        let mut rig = Self {
            bodies: pair(&self.bodies, index),
            initial_rates: pair(&self.initial_rates, index),
            spreads: pair(&self.spreads, index),
            inertia_factors: pair(&self.inertia_factors, index),
            noise: pair(&self.noise, index),
            deviations_rad_s: pair(&self.deviations_rad_s, index),
            biases_rad_s: pair(&self.biases_rad_s, index),
            // The rate of convergence depends on neither.
            offsets_rad_s: vec![Vector3::zeros(); 2],
            disturbances_rad_s2: vec![Vector3::zeros(); 2],
            ..self.clone()
        };
        rig.bodies.iter_mut().for_each(|body| body.fleet = None);
        if !noisy {
            rig.noise.fill(Noise::new(self.seed, 0, [0.0; 3], [0.0; 3]));
        }
        if start != Start::Given {
            let off = if let Start::Off(off) = start { off } else { 0.0 };
            let leader = self.initial_rates[0];
            rig.initial_rates[1..].fill(leader + Vector3::new(1.0, -0.7, 1.3) * off);
            match &mut rig.observer {
                ObserverDesign::Hidden { guess_rad_s, .. } => *guess_rad_s = leader[self.supplied()] + off,
                ObserverDesign::Learner(parts) => {
                    // Coefficients are at most 1; the displacement is scaled by the size of the leader's rates.
                    let off = off / leader.norm().max(f64::MIN_POSITIVE);
                    let begun = self.inertia.coefficients() + Vector3::new(1.0, -0.6, 0.8) * off;
                    parts.identifier = parts.identifier.clone().with_guess(&begun);
                }
            }
        }
        Some(rig)
    }

    fn pictures() -> Vec<Picture> {
        let plane = |title, axes, point| {
            let caption = "Angular velocity in a plane. A dot marks the start of a path.";
            Picture::Plane(Plane { title, axes, caption, point, centred: false, compared: None })
        };
        let graph = |axis: usize| {
            Picture::Graph(Graph {
                title: format!("angular velocity about axis {axis} over time"),
                field: "omega_rad_s",
                element: axis - 1,
                axis: format!("ω{axis}, rad/s"),
                caption: format!("Angular velocity ω{axis} in the body's axes."),
            })
        };
        let coefficient = |axis: usize| {
            Picture::Graph(Graph {
                title: format!("coefficient a{axis} over time"),
                field: "coefficients",
                element: axis - 1,
                axis: format!("a{axis}"),
                caption: format!("The coefficient a{axis} of [D](2) as the observer learns it."),
            })
        };
        let inputs = Inputs {
            field: "acceleration_rad_s2",
            applied: (Signal::Truth, "applied_rad_s2"),
            axis: "control acceleration, rad/s²".to_owned(),
            components: ["u1", "u2", "u3"].map(str::to_owned).to_vec(),
        };
        vec![
            plane("angular velocities in the plane ω1 ω2", ["ω1, rad/s", "ω2, rad/s"], |element| {
                Some([element("omega_rad_s", 0)?, element("omega_rad_s", 1)?])
            }),
            plane("angular velocities in the plane ω2 ω3", ["ω2, rad/s", "ω3, rad/s"], |element| {
                Some([element("omega_rad_s", 1)?, element("omega_rad_s", 2)?])
            }),
            graph(1),
            graph(2),
            graph(3),
            coefficient(1),
            coefficient(2),
            coefficient(3),
            Picture::Inputs(inputs),
            Picture::Lyapunov(Lyapunov {
                field: "lyapunov_rad2_s2",
                axes: ["V, rad²/s²", "−dV/dt, rad²/s³"],
                function: "V = ½(|e|² + ε²) of [D](15)",
                bound: "the bound of [D](18)",
            }),
            Picture::Onset,
        ]
    }

    fn notes(&self) -> Vec<String> {
        self.notes.clone()
    }

    #[inline]
    fn undisturbed(truth: &RateTruth) -> bool {
        truth.status & (status::HOLDING | status::SAFE) == 0
    }

    #[inline]
    fn true_lyapunov(
        &self,
        _index: usize,
        leader: &RateTruth,
        follower: &RateTruth,
        estimate: &RateEstimate,
    ) -> Option<(f64, f64)> {
        let (rate, own) = (Vector3::from(leader.omega_rad_s), Vector3::from(follower.omega_rad_s));
        let hidden_error = rate[self.supplied()] - estimate.omega_rad_s[self.supplied()];
        Some(self.certificate?.lyapunov(&(own - rate), hidden_error))
    }

    fn bound_applies(&self, index: usize) -> bool {
        // The bound covers neither disturbances nor, in the sampled loop, a follower that is held off the leader's motion.
        let disturbed = [0, index].iter().any(|body| self.disturbances_rad_s2[*body] != Vector3::zeros());
        !disturbed && self.offsets_rad_s[index] == Vector3::zeros()
    }

    fn lyapunov(command: &RateCommand) -> Option<(f64, f64)> {
        let (v, bound) = (command.lyapunov_rad2_s2, command.lyapunov_rate_bound_rad2_s3);
        (v > 0.0).then_some((v, bound))
    }

    fn certificates(&self) -> Vec<CertificateReport> {
        let Some(certificate) = self.certificate else { return Vec::new() };
        let axis = self.supplied() + 1;
        let condition = |name: &str, condition: crate::control::Condition| ConditionReport {
            name: name.to_owned(),
            value: condition.value,
            required: condition.required,
            holds: condition.holds(),
        };
        let (i, j) = (axis % 3 + 1, (axis + 1) % 3 + 1);
        let conditions = vec![
            condition(&format!("|k{i}| > |a{i}| M, 1/s"), certificate.paper[0]),
            condition(&format!("|k{j}| > |a{j}| M, 1/s"), certificate.paper[1]),
            condition("decay rate > |ai| M + |aj| M + |kk|/2, 1/s", certificate.paper[2]),
            condition("exact (Schur) decay rate, 1/s", certificate.exact),
            condition("sampled axis: stability limit > |k| h", certificate.gain_step),
        ];
        let mut warnings = Vec::new();
        if certificate.coarse_tick() {
            warnings.push(format!(
                "|k| h = {:.3} is above 0.25: the sampled loop will be visibly slower than designed; raise tick_hz",
                certificate.gain_step.required
            ));
        }
        if !certificate.exact.holds() {
            warnings.push(
                "V of the continuous law is not proven to fall everywhere; raise observer.decay_rate_per_s or the gains"
                    .to_owned(),
            );
        }
        let report = |body: &BodyInfo| CertificateReport {
            body: body.name.to_string(),
            conditions: conditions.clone(),
            continuous_rate_per_s: Some(certificate.rate_per_s),
            bounds: vec![Figure { name: "M >= |omega|, rad/s".to_owned(), value: certificate.rate_bound_rad_s }],
            warnings: warnings.clone(),
        };
        self.bodies.iter().filter(|body| body.driven).map(report).collect()
    }
}

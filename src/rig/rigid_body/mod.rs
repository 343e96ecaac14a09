//! The rig `rigid-body`: a leader with a component of its angular velocity unmeasured or lost, and followers that turn as
//! it does.
//!
//! Parameters, and the glue between samples and vectors; the mathematics is in `model`, `observe` and `control`.

mod config;
mod identifier;
mod law;
mod learner;
mod limits;
mod observer;
mod plant;

pub use law::RateLaw;
pub use learner::Learner;
pub(in crate::rig) use limits::SURE_DEVIATIONS;
pub use limits::{CommandGuard, EstimateGuard, MeasurementGuard};
pub use observer::{HiddenObserver, KalmanObserver, RateObserver};
pub use plant::RatePlant;

use super::{BodyInfo, CertificateReport, ConditionReport, Figure, FilterDesign, Frame, Rig, UNKNOWN_DEVIATION};
use crate::config::{Checks, ConfigError, Document};
use crate::control::{Certificate, InertiaAdaptation, Synchronizer, Watched};
use crate::model::{Inertia, Noise, RigidBody};
use crate::observe::{Axisymmetric, Filter, HiddenRate, Hurwitz, InertiaRelation, InvariantFilter, RateNoise};
use crate::sample::{RateCommand, RateEstimate, RateTruth, status};
use config::{Coefficients, IdentifierDecay, Kind, Raw, RawLeader, RawObserver};
use identifier::Identifier;
use limits::{Limits, Sensed};
use nalgebra::{Matrix3, Vector1, Vector3};
use observer::ALL;
use plant::Outage;

/// The farthest that a body may turn in one tick, rad: at half a turn nobody can tell it from its complement.
const MAX_TURN_RAD: f64 = 3.0;

/// A leader, its observer, and the followers with their laws.
#[derive(Debug, Clone)]
pub struct RigidBodyRig {
    bodies: Vec<BodyInfo>,
    inertia: Inertia,
    /// Per body: initial rate, and inertia over the nominal one.
    initial_rates: Vec<Vector3<f64>>,
    inertia_factors: Vec<Vector3<f64>>,
    /// Bit i set: the leader's component i has a gyro.
    measured: u64,
    outages: Vec<Outage>,
    /// The component that the observer supplies, 1 to 3.
    supplied_axis: Option<usize>,
    observer: ObserverDesign,
    controller: Option<ControllerDesign>,
    /// Per body, what its gyros add, and of which standard deviation and bias that is.
    noise: Vec<Noise<3>>,
    deviations_rad_s: Vec<Vector3<f64>>,
    biases_rad_s: Vec<Vector3<f64>>,
    limits: Limits,
    notes: Vec<String>,
    tick_s: f64,
}

/// The observer's parameters.
#[derive(Debug, Clone)]
enum ObserverDesign {
    Hidden { relation: HiddenRate, filter: FilterDesign<1>, guess_rad_s: f64 },
    Learner(learner::Parts),
}

/// The controller's parameters.
#[derive(Debug, Clone, Copy)]
struct ControllerDesign {
    gain_per_s: Vector3<f64>,
    predict: bool,
    learned: bool,
    adaptation_gain: f64,
}

/// Reads and checks the sections of this rig.
pub(super) fn resolve(
    sections: &Document,
    frame: Frame,
    checks: &mut Checks<'_>,
) -> Result<(Option<RigidBodyRig>, toml::Table), ConfigError> {
    let raw: Raw = sections.read_into()?;
    let table = toml::Table::try_from(&raw).expect("a scenario of plain values is TOML");
    config::check(&raw, checks);
    let supplied_axis = config::hidden_axis(&raw, checks);
    let outages = resolve_outages(&raw, frame.tick_s, checks);
    let inertia = checks.accept("leader.inertia_kg_m2", Inertia::new(raw.leader.inertia_kg_m2));
    let Some(inertia) = inertia else { return Ok((None, table)) };
    let mut notes = Vec::new();
    let observer = design_observer(&raw, &inertia, supplied_axis, &mut notes, checks);
    let Some(observer) = observer else { return Ok((None, table)) };
    let mut rig = RigidBodyRig {
        bodies: vec![BodyInfo { name: "leader".to_owned(), driven: false }],
        inertia,
        initial_rates: vec![raw.leader.initial_rate_rad_s.into()],
        inertia_factors: vec![Vector3::repeat(1.0)],
        measured: (0..3).filter(|i| raw.leader.measured_axes.contains(&(i + 1))).fold(0, |bits, i| bits | 1 << i),
        outages,
        supplied_axis,
        observer,
        controller: raw.controller.as_ref().map(ControllerDesign::from),
        noise: vec![noise(frame, 0, raw.leader.noise_rad_s, raw.leader.bias_rad_s)],
        deviations_rad_s: vec![raw.leader.noise_rad_s.into()],
        biases_rad_s: vec![raw.leader.bias_rad_s.into()],
        limits: design_limits(&raw, &inertia, checks),
        notes,
        tick_s: frame.tick_s,
    };
    for (index, follower) in raw.follower.into_iter().enumerate() {
        let factor = Vector3::from(follower.inertia_factor);
        let own = inertia.moments_kg_m2().component_mul(&factor);
        checks.accept(&format!("follower[{index}].inertia_factor"), Inertia::new(own.into()));
        rig.bodies.push(BodyInfo { name: follower.name, driven: true });
        rig.initial_rates.push(follower.initial_rate_rad_s.into());
        rig.inertia_factors.push(factor);
        rig.noise.push(noise(frame, index as u64 + 1, follower.noise_rad_s, follower.bias_rad_s));
        rig.deviations_rad_s.push(follower.noise_rad_s.into());
        rig.biases_rad_s.push(follower.bias_rad_s.into());
    }
    rig.check_tick(checks);
    Ok((Some(rig), table))
}

fn noise(frame: Frame, stream: u64, deviation: [f64; 3], bias: [f64; 3]) -> Noise<3> {
    Noise::new(frame.seed, stream, deviation, bias)
}

impl From<&config::RawController> for ControllerDesign {
    fn from(raw: &config::RawController) -> Self {
        Self {
            gain_per_s: raw.gain_per_s.into(),
            predict: raw.predict,
            learned: raw.coefficients == Coefficients::Learned,
            adaptation_gain: raw.adaptation_gain,
        }
    }
}

fn resolve_outages(raw: &Raw, tick_s: f64, checks: &mut Checks<'_>) -> Vec<Outage> {
    let mut outages = Vec::new();
    for (index, outage) in raw.leader.outage.iter().enumerate() {
        let key = |name: &str| format!("leader.outage[{index}].{name}");
        let known = raw.leader.measured_axes.contains(&outage.axis) && (1..=3).contains(&outage.axis);
        checks.require(known, &key("axis"), || {
            format!("axis {} has no gyro to fail; name one of leader.measured_axes", outage.axis)
        });
        checks.require(outage.from_s >= 0.0, &key("from_s"), || {
            format!("{} is before the start; give 0 or more", outage.from_s)
        });
        let until_s = outage.until_s.unwrap_or(f64::INFINITY);
        checks.require(until_s > outage.from_s, &key("until_s"), || format!("{until_s} is not after from_s; raise it"));
        let tick = |time_s: f64| (time_s / tick_s).round() as u64;
        if known {
            outages.push(Outage {
                component: outage.axis - 1,
                from_tick: tick(outage.from_s),
                until_tick: tick(until_s),
            });
        }
    }
    outages
}

fn design_limits(raw: &Raw, inertia: &Inertia, checks: &mut Checks<'_>) -> Limits {
    let fastest =
        |rates: &mut dyn Iterator<Item = [f64; 3]>| rates.map(|rate| Vector3::from(rate).norm()).fold(0.0, f64::max);
    let noisy = raw.leader.noise_rad_s != [0.0; 3] || raw.observer.decay_rate_per_s.is_none();
    let gain_per_s = raw.controller.as_ref().map_or(0.0, |controller| Vector3::from(controller.gain_per_s).amax());
    let about = limits::Circumstances {
        leader_rad_s: inertia.rate_bound_rad_s(&raw.leader.initial_rate_rad_s.into()),
        follower_rad_s: fastest(&mut raw.follower.iter().map(|follower| follower.initial_rate_rad_s)),
        transient_rad_s: raw.observer.initial_guess_rad_s.abs()
            + if noisy { limits::SURE_DEVIATIONS * UNKNOWN_DEVIATION } else { 0.0 },
        // The reconstruction that the filter follows divides noise by the tick; without noise it is the truth.
        correction_per_s: match raw.observer.decay_rate_per_s {
            Some(decay) if !noisy && raw.observer.kind == Kind::HiddenRate => decay,
            _ => f64::INFINITY,
        },
        gain_per_s,
    };
    Limits::resolve(&raw.limits, &about, checks)
}

fn design_observer(
    raw: &Raw,
    inertia: &Inertia,
    supplied_axis: Option<usize>,
    notes: &mut Vec<String>,
    checks: &mut Checks<'_>,
) -> Option<ObserverDesign> {
    let (observer, coefficients) = (&raw.observer, inertia.coefficients());
    let floor_rad_s = observer.observability_floor_rad_s;
    if let Some(axis) = supplied_axis {
        // Whether it can be observed at all is a matter of the true body, also where the observer has to learn it.
        checks.accept("leader.inertia_kg_m2", HiddenRate::new(&coefficients, axis, floor_rad_s))?;
    }
    let filter = FilterDesign::resolve(
        checks,
        observer.decay_rate_per_s.map(|rate| [rate]),
        observer.bandwidth_rad_s.map(|bandwidth| [bandwidth]),
        ("process_noise_rad2_s3", observer.process_noise_rad2_s3),
    )?;
    if let FilterDesign::Kalman(_) = filter {
        let noisy = |axis: &usize| raw.leader.noise_rad_s.get(axis.wrapping_sub(1)).is_some_and(|noise| *noise > 0.0);
        checks.require(raw.leader.measured_axes.iter().all(noisy), "observer.process_noise_rad2_s3", || {
            "weighs noise, and leader.noise_rad_s has none on a measured axis; give it, or choose another filter"
                .to_owned()
        });
    }
    match observer.kind {
        Kind::HiddenRate => Some(ObserverDesign::Hidden {
            relation: HiddenRate::new(&coefficients, supplied_axis?, floor_rad_s).ok()?,
            filter,
            guess_rad_s: observer.initial_guess_rad_s,
        }),
        Kind::Inertia | Kind::AxisymmetricInertia => {
            let FilterDesign::First([decay_rate_per_s]) = filter else {
                checks.refuse(
                    "observer.kind",
                    "learns with a filter of first order; give observer.decay_rate_per_s instead",
                );
                return None;
            };
            let identifier = design_identifier(&raw.leader, observer, inertia, notes, checks)?;
            Some(ObserverDesign::Learner(learner::Parts { identifier, decay_rate_per_s, floor_rad_s }))
        }
    }
}

fn design_identifier(
    leader: &RawLeader,
    observer: &RawObserver,
    inertia: &Inertia,
    notes: &mut Vec<String>,
    checks: &mut Checks<'_>,
) -> Option<Identifier> {
    let floor_rad_s = observer.observability_floor_rad_s;
    let guess = observer.initial_coefficients;
    if observer.kind == Kind::AxisymmetricInertia {
        let axis = observer.symmetry_axis?;
        check_symmetry(leader, inertia, axis, floor_rad_s, checks);
        let relation = checks.accept("observer.symmetry_axis", Axisymmetric::new(axis, floor_rad_s))?;
        let design = match (&observer.identifier_decay, observer.identifier_bandwidth) {
            (Some(IdentifierDecay::Rates(rates)), _) => FilterDesign::First([rates[0]]),
            (_, Some(bandwidth)) => FilterDesign::Second([bandwidth[0]]),
            _ => {
                let key = "observer.identifier_decay";
                checks.refuse(key, "is a matrix, but there is one unknown; give three equal rates");
                return None;
            }
        };
        let [slowest] = design.decay_rates()?;
        let filter = design.filter(Vector1::new(guess[axis % 3]));
        return Some(Identifier::axisymmetric(relation, axis, filter, slowest));
    }
    let (filter, slowest) = match (&observer.identifier_decay, observer.identifier_bandwidth) {
        (Some(decay), _) => {
            let matrix = match decay {
                IdentifierDecay::Rates(rates) => Matrix3::from_diagonal(&-Vector3::from(*rates)),
                IdentifierDecay::Matrix(rows) => Matrix3::from_fn(|row, column| rows[row][column]),
            };
            let matrix = checks.accept("observer.identifier_decay", Hurwitz::new(matrix))?;
            notes.push(format!("observer.identifier_decay: eigenvalues {}", matrix.eigenvalues()));
            (Filter::First(InvariantFilter::with_matrix(matrix, guess.into())), -matrix.abscissa())
        }
        (None, bandwidth) => {
            let design = FilterDesign::Second(bandwidth?);
            let slowest = design.decay_rates()?.into_iter().fold(f64::INFINITY, f64::min);
            (design.filter(guess.into()), slowest)
        }
    };
    let relation = InertiaRelation::new(floor_rad_s * floor_rad_s * floor_rad_s);
    Some(Identifier::asymmetric(relation, filter, slowest))
}

/// A body that is said to be axisymmetric is, and spins.
fn check_symmetry(leader: &RawLeader, inertia: &Inertia, axis: usize, floor_rad_s: f64, checks: &mut Checks<'_>) {
    if !(1..=3).contains(&axis) {
        return;
    }
    let (spin_rad_s, moments) = (leader.initial_rate_rad_s[axis - 1], inertia.moments_kg_m2());
    checks.require(spin_rad_s.abs() > floor_rad_s, "leader.initial_rate_rad_s", || {
        format!(
            "the body does not spin about its symmetry axis {axis} ({spin_rad_s} rad/s, for ever), so its motion tells \
             nothing of its inertia; give component {axis} a rate"
        )
    });
    checks.require(moments[axis % 3] == moments[(axis + 1) % 3], "leader.inertia_kg_m2", || {
        format!("the moments about the axes other than {axis} differ; use observer.kind = \"inertia\" for this body")
    });
}

impl RigidBodyRig {
    /// The component that the observer supplies, 0 to 2; where there is none, any serves.
    fn supplied(&self) -> usize {
        self.supplied_axis.unwrap_or(3) - 1
    }

    /// Bounds on the leader's |a|: what an observer has to learn is not used in guarding it either.
    fn leader_coefficients(&self) -> Vector3<f64> {
        match &self.observer {
            ObserverDesign::Hidden { .. } => self.inertia.coefficients().abs(),
            ObserverDesign::Learner(_) => Vector3::repeat(1.0),
        }
    }

    fn rate_bound_rad_s(&self) -> f64 {
        self.inertia.rate_bound_rad_s(&self.initial_rates[0])
    }

    fn check_tick(&self, checks: &mut Checks<'_>) {
        let (m, tick_s) = (self.rate_bound_rad_s(), self.tick_s);
        let limit_rad_s = MAX_TURN_RAD / tick_s;
        checks.require(m < limit_rad_s, "tick_hz", || {
            format!(
                "the leader may turn at {m:.3} rad/s, so its phase is ambiguous from one tick of {tick_s} s to the next; \
                 raise tick_hz above {:.3}",
                m / MAX_TURN_RAD
            )
        });
        for (index, rate) in self.initial_rates[1..].iter().enumerate() {
            let rate_rad_s = rate.norm();
            checks.require(rate_rad_s < limit_rad_s, &format!("follower[{index}].initial_rate_rad_s"), || {
                format!(
                    "at {rate_rad_s:.3} rad/s it turns too far from one tick of {tick_s} s to the next to be driven; lower \
                     it or raise tick_hz above {:.3}",
                    rate_rad_s / MAX_TURN_RAD
                )
            });
        }
        if let ObserverDesign::Hidden { relation, guess_rad_s, .. } = &self.observer {
            checks.require(guess_rad_s.abs() < limit_rad_s, "observer.initial_guess_rad_s", || {
                format!("at {guess_rad_s} rad/s the phase would be ambiguous from tick to tick; guess nearer to 0")
            });
            // A leader at rest needs no observer and passes.
            let floor_rad_s = relation.floor_rad_s();
            checks.require(m == 0.0 || floor_rad_s < m, "observer.observability_floor_rad_s", || {
                format!(
                    "{floor_rad_s} is not below the {m:.3} rad/s that the leader may turn at, so it is never observed; \
                     lower it"
                )
            });
        }
        if let Some(controller) = self.controller {
            let step = Certificate::gain_step(&controller.gain_per_s, tick_s, controller.predict);
            checks.require(step.holds(), "controller.gain_per_s", || {
                format!(
                    "the largest gain times the tick is {:.3}, and the sampled loop is unstable from {} on; lower the gain \
                     or raise tick_hz",
                    step.required, step.value
                )
            });
        }
    }

    /// The certificate of any follower: they differ in nothing that it knows of.
    fn certificate(&self) -> Option<Certificate> {
        let controller = self.controller?;
        // The papers' conditions are about the papers' filter.
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
            controller.predict,
        ))
    }
}

impl Rig for RigidBodyRig {
    type Body = RatePlant;
    type Estimator = RateObserver;
    type Law = RateLaw;
    type MeasurementGuard = MeasurementGuard;
    type EstimateGuard = EstimateGuard;
    type CommandGuard = CommandGuard;
    const AXES: usize = 3;

    fn bodies(&self) -> &[BodyInfo] {
        &self.bodies
    }

    fn body(&self, index: usize) -> RatePlant {
        let factor = self.inertia_factors[index];
        let own = self.inertia.moments_kg_m2().component_mul(&factor);
        RatePlant {
            body: Inertia::new(own.into()).map_or(RigidBody::new(&self.inertia), |own| RigidBody::new(&own)),
            rate: self.initial_rates[index],
            asked: Vector3::zeros(),
            inertia_factor: factor,
            measured: if index == 0 { self.measured } else { ALL },
            noise: self.noise[index].clone(),
            outages: if index == 0 { self.outages.clone() } else { Vec::new() },
            tick: 0,
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
                RateObserver::Hidden(HiddenObserver::new(
                    *relation,
                    self.inertia.coefficients(),
                    begun,
                    self.supplied(),
                ))
            }
            ObserverDesign::Learner(parts) => RateObserver::Learner(Learner::new(parts.clone())),
        }
    }

    fn law(&self, _index: usize) -> RateLaw {
        let Some(controller) = self.controller else {
            unreachable!("a scenario with a follower has a controller: checked when it was resolved")
        };
        let lead_s = if controller.predict { self.tick_s } else { 0.0 };
        RateLaw {
            law: Synchronizer::new(RigidBody::new(&self.inertia), controller.gain_per_s, lead_s),
            adaptation: InertiaAdaptation::new(controller.adaptation_gain),
            certificate: self.certificate(),
            supplied: self.supplied(),
            learned: controller.learned,
            acceleration_max_rad_s2: self.limits.acceleration_rad_s2,
            tick_s: self.tick_s,
        }
    }

    /// A law acts on all components; an observer says itself which it needs.
    fn measurement_guard(&self, index: usize, acts: bool) -> MeasurementGuard {
        let body = Sensed {
            // A follower may have another inertia.
            coefficients: if index == 0 { self.leader_coefficients() } else { Vector3::repeat(1.0) },
            factor: self.inertia_factors[index],
            driven: self.bodies[index].driven,
            deviation: self.deviations_rad_s[index],
            bias: self.biases_rad_s[index],
        };
        self.limits.measurement(&body, self.tick_s, if acts { ALL } else { 0 })
    }

    fn estimate_guard(&self) -> EstimateGuard {
        self.limits.estimate(&self.leader_coefficients(), self.tick_s)
    }

    fn command_guard(&self, _index: usize) -> CommandGuard {
        self.limits.command()
    }

    fn limits(&self) -> Vec<Figure> {
        self.limits.figures()
    }

    /// Both per I1, which is what a free motion tells of the inertia: [kinetic energy, rad²/s²; momentum, rad/s].
    fn invariants(&self, estimate: &RateEstimate) -> Option<[f64; 2]> {
        let ([second, third], rate) = (estimate.inertia_ratios, Vector3::from(estimate.omega_rad_s));
        let momentum = rate.component_mul(&Vector3::new(1.0, second, third));
        Some([0.5 * rate.dot(&momentum), momentum.norm()])
    }

    fn innovation(estimate: &RateEstimate) -> f64 {
        estimate.innovation_rad_s
    }

    fn unwatched(&self, watched: Watched) -> Option<&'static str> {
        let silent = match &self.observer {
            ObserverDesign::Hidden { filter: FilterDesign::Kalman(_), .. } => watched == Watched::Innovation,
            _ => false,
        };
        if self.controller.is_none() {
            Some("is watched by the controller, and this scenario has none")
        } else if silent {
            Some("is not published by the Kalman filter")
        } else if watched == Watched::Lyapunov && self.certificate().is_none() {
            Some("is published with the first-order filter only")
        } else {
            None
        }
    }

    fn metrics(&self) -> &'static [&'static str] {
        match (&self.observer, self.controller) {
            (ObserverDesign::Hidden { .. }, _) => &["sync_error_rad_s", "estimate_error_rad_s"],
            (_, Some(_)) => &["sync_error_rad_s", "estimate_error_rad_s", "coefficient_error"],
            (_, None) => &["coefficient_error"],
        }
    }

    /// |p − ω| of the worst follower, |ω̂ − ω|, |â − a|; as [`metrics`](Rig::metrics) lists them.
    fn score<'a>(
        &self,
        truth: impl Fn(usize) -> Option<&'a RateTruth>,
        estimate: Option<&RateEstimate>,
        out: &mut [f64],
    ) {
        let rate = |index| truth(index).map(|truth| Vector3::from(truth.omega_rad_s));
        let distance = |from: Option<Vector3<f64>>, to: Option<Vector3<f64>>| match (from, to) {
            (Some(from), Some(to)) => (from - to).norm(),
            _ => f64::NAN,
        };
        let leader = rate(0);
        let followers = (1..self.bodies.len()).map(|index| distance(rate(index), leader));
        let worst =
            followers.fold(0.0, |worst: f64, error| if error > worst || error.is_nan() { error } else { worst });
        let estimate_error = distance(estimate.map(|estimate| estimate.omega_rad_s.into()), leader);
        let coefficients = estimate.map(|estimate| Vector3::from(estimate.coefficients));
        for (value, metric) in out.iter_mut().zip(self.metrics()) {
            *value = match *metric {
                "sync_error_rad_s" => worst,
                "estimate_error_rad_s" => estimate_error,
                _ => distance(coefficients, Some(self.inertia.coefficients())),
            };
        }
    }

    fn notes(&self) -> Vec<String> {
        self.notes.clone()
    }

    fn undisturbed(truth: &RateTruth) -> bool {
        truth.status & (status::HOLDING | status::SAFE) == 0
    }

    fn lyapunov(command: &RateCommand) -> Option<(f64, f64)> {
        let (v, bound) = (command.lyapunov_rad2_s2, command.lyapunov_rate_bound_rad2_s3);
        (v > 0.0).then_some((v, bound))
    }

    fn certificates(&self) -> Vec<CertificateReport> {
        let Some(certificate) = self.certificate() else { return Vec::new() };
        let axis = self.supplied() + 1;
        let condition = |name: &str, condition: crate::control::Condition| ConditionReport {
            name: name.to_owned(),
            value: condition.value,
            required: condition.required,
            holds: condition.holds(),
        };
        let (i, j) = (axis % 3 + 1, (axis + 1) % 3 + 1);
        let conditions = vec![
            condition(&format!("[D](19) |k{i}| > |a{i}| M, 1/s"), certificate.paper[0]),
            condition(&format!("[D](19) |k{j}| > |a{j}| M, 1/s"), certificate.paper[1]),
            condition("[D](19) decay rate > |ai| M + |aj| M + |kk|/2, 1/s", certificate.paper[2]),
            condition("exact (Schur) decay rate, 1/s", certificate.exact),
            condition("sampled: limit > |k| h", certificate.gain_step),
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
                "V is not proven to fall everywhere (the error still converges, at the rate below); raise \
                 observer.decay_rate_per_s or the gains"
                    .to_owned(),
            );
        }
        let report = |body: &BodyInfo| CertificateReport {
            body: body.name.clone(),
            conditions: conditions.clone(),
            rate_per_s: certificate.rate_per_s,
            bounds: vec![Figure { name: "M >= |omega|, rad/s".to_owned(), value: certificate.rate_bound_rad_s }],
            warnings: warnings.clone(),
        };
        self.bodies.iter().filter(|body| body.driven).map(report).collect()
    }
}

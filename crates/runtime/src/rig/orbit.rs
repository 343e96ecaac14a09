//! The rigs `orbit-hold` and `orbit-rendezvous`: bodies around a point mass. The first body's velocity is not measured.
//!
//! In `orbit-hold` the first body, the spacecraft, is itself driven to a circular orbit, \[S\]. In `orbit-rendezvous` it is a
//! free leader, and any followers are driven to move as it does. This file holds parameters and scores. `roles` connects samples
//! and vectors, `resolve` reads a scenario; the mathematics is in `model`, `observe` and `control`.

mod design;
mod inputs;
mod limits;
mod resolve;
mod roles;

pub use design::OrbitRig;
pub use limits::{CommandGuard, EstimateGuard, MeasurementGuard};
pub use roles::{OrbitLaw, OrbitObserver, OrbitPlant};

use super::BodyInfo;
use super::contract::pair;
use super::contract::{CertificateReport, ConditionReport, Context, Figure, FleetTruth, Monitor, Rig, Start, Watched};
use super::fleet::NoFleet;
use super::pictures::{Graph, Inputs, Picture, Plane};
use crate::bus::Signal;
use crate::config::{Checks, ConfigError, Document, InputInfo};
use crate::control::{Condition, OrbitCertificate, OrbitHold};
use crate::model::{Noise, OrbitFault, OrbitState};
use crate::observe::OrbitVelocity;
use crate::sample::{OrbitEstimate, OrbitTruth, status};
use design::{ControllerDesign, Sensors};
use nalgebra::Vector2;
use roles::{Aim, POSITION, VELOCITY};

impl OrbitRig {
    /// Returns the radius (du) of the circular orbit about which the loop is linearised: the target's, or the leader's pericentre,
    /// where the motion is fastest. If the pericentre lies outside the region, it is the leader's present radius.
    fn certified_radius(&self) -> f64 {
        match self.aim {
            Aim::Circle { radius, .. } => radius,
            Aim::Leader => {
                let pericentre = self.field.pericentre(&self.initial[0]);
                if self.field.holds(pericentre) { pericentre } else { self.initial[0].r }
            }
        }
    }

    fn certificate(&self, controller: &ControllerDesign) -> Result<OrbitCertificate, OrbitFault> {
        // Full-state feedback does not depend on the observer; a varying gain has no constant rate to certify.
        let full_state = matches!(self.aim, Aim::Circle { full_state: true, .. });
        let rates = self.filter.decay_rates().filter(|_| !full_state);
        let decay = rates.map_or(Vector2::repeat(f64::INFINITY), Vector2::from);
        let ControllerDesign { gains, law, delay_ticks, .. } = controller;
        OrbitCertificate::new(&self.field, law, gains, &decay, self.certified_radius(), self.tick_s, *delay_ticks)
    }

    /// Returns the state that a driven body must reach, for the given state of the leader.
    fn reference(&self, leader: OrbitState) -> OrbitState {
        match self.aim {
            Aim::Circle { radius, .. } => self.field.circular(radius),
            Aim::Leader => leader,
        }
    }

    /// Returns a driven body's reference and its own state as its law sees them at the first tick: measured with bias but without
    /// noise, and guessed where a velocity is not measured.
    fn first_seen(&self, index: usize) -> (OrbitState, OrbitState) {
        let measured = |index: usize| {
            let (state, [r, theta, vr, vtheta]) = (self.initial[index], self.sensors[index].bias);
            OrbitState { r: state.r + r, vr: state.vr + vr, theta: state.theta + theta, vtheta: state.vtheta + vtheta }
        };
        let guessed = OrbitState { vr: self.initial_guess.x, vtheta: self.initial_guess.y, ..measured(0) };
        match self.aim {
            Aim::Circle { full_state: true, .. } => (self.reference(guessed), measured(index)),
            Aim::Circle { full_state: false, .. } => (self.reference(guessed), guessed),
            Aim::Leader => (guessed, measured(index)),
        }
    }

    fn driven(&self) -> impl Iterator<Item = usize> {
        (0..self.bodies.len()).filter(|index| self.bodies[*index].driven)
    }

    fn report(&self, index: usize, law: &OrbitHold, certificate: &OrbitCertificate) -> CertificateReport {
        let condition = |name: &str, condition: Condition| ConditionReport {
            name: name.to_owned(),
            value: condition.value,
            required: condition.required,
            holds: condition.holds(),
        };
        let figure = |name: &str, value: f64| Figure { name: name.to_owned(), value };
        let (reference, body) = self.first_seen(index);
        let margin = law.margin(&reference, &body);
        CertificateReport {
            body: self.bodies[index].name.to_string(),
            conditions: vec![
                condition("sampled loop: stability limit > |z| of the slowest mode", certificate.sampled),
                condition("thrust limit > thrust asked for at the start, as the law sees it, du/s^2", margin),
            ],
            continuous_rate_per_s: self.constant_rate().then_some(certificate.rate_per_s),
            bounds: vec![figure("radius of the circular orbit it is linearised about, du", self.certified_radius())],
            warnings: self.warnings(&margin),
        }
    }

    /// Returns true if the loop's rate does not depend on an observer with a varying gain.
    fn constant_rate(&self) -> bool {
        self.filter.decay_rates().is_some() || matches!(self.aim, Aim::Circle { full_state: true, .. })
    }

    fn warnings(&self, margin: &Condition) -> Vec<String> {
        let mut warnings = Vec::new();
        if !margin.holds() {
            warnings.push(
                "the thrust limit acts at first: the rate holds from when the law asks for less; watch the radius until then, \
                 or give observer.initial_guess_du_s nearer to the truth"
                    .to_owned(),
            );
        }
        if self.aim == Aim::Leader && !self.leader_stays() {
            warnings.push(
                "the leader's free orbit leaves the region or meets the central body; a run that gets there ends in a fault"
                    .to_owned(),
            );
        }
        warnings
    }

    /// Returns true if the leader's free orbit stays between the central body and the escape radius.
    fn leader_stays(&self) -> bool {
        let leader = &self.initial[0];
        let (energy, pericentre) = (self.field.energy(leader), self.field.pericentre(leader));
        let apocentre = -self.field.mu() / energy - pericentre;
        energy < 0.0 && self.field.holds(pericentre) && self.field.holds(apocentre)
    }
}

/// The quantities that the controller can watch: a free leader's orbital energy per mass, du²/s², and angular momentum per mass,
/// du²/s.
const MONITORS: [Monitor<OrbitRig>; 2] = [
    Monitor {
        name: "energy_drift",
        watched: Watched::Constant(|rig, estimate| rig.field.energy(&estimated(estimate))),
        absent: OrbitRig::no_constant,
    },
    Monitor {
        name: "momentum_drift",
        watched: Watched::Constant(|_, estimate| estimated(estimate).momentum()),
        absent: OrbitRig::no_constant,
    },
];

fn estimated(estimate: &OrbitEstimate) -> OrbitState {
    let [vr, vtheta] = estimate.velocity_du_s;
    OrbitState { r: estimate.radius_du, vr, theta: estimate.angle_rad, vtheta }
}

impl OrbitRig {
    /// Returns the reason why energy and momentum cannot be watched, if there is one.
    fn no_constant(&self) -> Option<&'static str> {
        let absent = self.controller.is_none().then_some("is watched by the controller, and this scenario has none");
        absent.or(self.bodies[0]
            .driven
            .then_some("is not constant: thrust changes the energy and the momentum of the observed body"))
    }
}

impl Rig for OrbitRig {
    type Body = OrbitPlant;
    type Estimator = OrbitObserver;
    type Law = OrbitLaw;
    type MeasurementGuard = MeasurementGuard;
    type EstimateGuard = EstimateGuard;
    type CommandGuard = CommandGuard;
    type Fleet = NoFleet;
    const AXES: usize = 4;
    const NAMES: &'static [&'static str] = &["orbit-hold", "orbit-rendezvous"];
    const LISTS: &'static [&'static str] = &["follower"];
    const FREE: Option<&'static str> = Some("angle_rad");

    fn controlled() -> Vec<&'static str> {
        vec!["radius_du", "velocity_du_s"]
    }

    fn tables() -> Vec<&'static str> {
        vec!["central_body", "leader", "spacecraft", "observer", "controller", "limits"]
    }

    fn resolve(
        name: &str,
        sections: &Document,
        context: Context,
        checks: &mut Checks<'_>,
    ) -> Result<(Option<Self>, toml::Table), ConfigError> {
        if name == "orbit-hold" {
            resolve::hold(sections, context, checks)
        } else {
            resolve::rendezvous(sections, context, checks)
        }
    }

    fn bodies(&self) -> &[BodyInfo] {
        &self.bodies
    }

    /// A follower measures its own velocity; the observed body does so only with full-state feedback.
    fn body(&self, index: usize) -> OrbitPlant {
        let velocity_measured = index != 0 || matches!(self.aim, Aim::Circle { full_state: true, .. });
        let noise = self.sensors[index].noise.clone();
        let plant = OrbitPlant::new(self.field, self.initial[index], velocity_measured, noise);
        plant.disturbed(&self.disturbances_du_s2[index])
    }

    fn estimator(&self) -> OrbitObserver {
        let [r, theta, ..] = self.sensors[0].deviation;
        let relation = OrbitVelocity::new(self.field.mu()).with_variance(r * r, theta * theta);
        OrbitObserver::new(relation, self.field, self.filter, self.initial_guess)
    }

    /// A law needs the position, and also the velocity if it takes that from the body's own sensors. An observer checks itself
    /// which components it needs.
    fn measurement_guard(&self, index: usize, acts: bool) -> MeasurementGuard {
        let Sensors { deviation, bias, .. } = self.sensors[index];
        let own_velocity = !matches!(self.aim, Aim::Circle { full_state: false, .. });
        let needed = if own_velocity { POSITION | VELOCITY } else { POSITION };
        self.limits.measurement(deviation, bias, if acts { needed } else { 0 })
    }

    fn estimate_guard(&self) -> EstimateGuard {
        let Sensors { deviation, bias, .. } = self.sensors[0];
        self.limits.estimate(deviation, bias)
    }

    fn command_guard(&self, _index: usize) -> CommandGuard {
        self.limits.command()
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

    fn law(&self, _index: usize) -> OrbitLaw {
        let Some(controller) = self.controller else {
            unreachable!("a scenario with a driven body has a controller: checked when it was resolved")
        };
        let predicted_ticks = if controller.predict { controller.delay_ticks } else { 1 };
        OrbitLaw::new(controller.law, self.aim, predicted_ticks)
    }

    fn metrics(&self) -> Vec<&'static str> {
        match self.controller {
            Some(_) => vec!["radius_error_du", "velocity_error_du_s", "estimate_error_du_s"],
            None => vec!["estimate_error_du_s"],
        }
    }

    /// Writes |r − R| and |(Vr, Vθ) − (V_R, V_Θ)| of the worst driven body, if there is one, and the magnitude of the velocity
    /// estimate's error. All are +inf once any body is lost.
    fn score<'a>(
        &self,
        truth: impl Fn(usize) -> Option<&'a OrbitTruth>,
        _fleet: impl Fn(usize) -> Option<&'a FleetTruth<Self>>,
        estimate: impl Fn(usize) -> Option<&'a OrbitEstimate>,
        _reference: &[f64],
        out: &mut [f64],
    ) {
        let lost = |index| truth(index).is_some_and(|truth| truth.status & status::FAULT != 0);
        if (0..self.bodies.len()).any(lost) {
            out.fill(f64::INFINITY);
            return;
        }
        let state = |index| truth(index).map(state);
        let first = state(0);
        let reference = first.map(|leader| self.reference(leader));
        let errors = self.driven().map(|index| errors(state(index), reference));
        let worst = errors.reduce(|a, b| [worse(a[0], b[0]), worse(a[1], b[1])]);
        let estimated = estimate(0).map(|estimate| Vector2::from(estimate.velocity_du_s));
        let estimate_error = match (estimated, first) {
            (Some(estimated), Some(first)) => (estimated - Vector2::new(first.vr, first.vtheta)).norm(),
            _ => f64::NAN,
        };
        if let Some((last, followed)) = out.split_last_mut() {
            *last = estimate_error;
            followed.copy_from_slice(&worst.unwrap_or([f64::NAN; 2])[..followed.len()]);
        }
    }

    /// A frozen body meets its end again if its last step is repeated, which tells the cause.
    fn loss(&self, truth: &OrbitTruth) -> Option<&'static str> {
        let thrust = truth.applied_du_s2.into();
        let end = || self.field.flow(&state(truth), &thrust, self.tick_s).err();
        (truth.status & status::FAULT != 0).then(|| match end() {
            Some(OrbitFault::Collision { .. }) => "meets the central body",
            Some(OrbitFault::Escape { .. }) => "leaves the region",
            Some(OrbitFault::Unresolved { .. }) | None => "moves faster than a tick resolves",
        })
    }

    fn certificates(&self) -> Vec<CertificateReport> {
        // The certificate is that of roles that compute at every tick.
        let Some(controller) = self.controller.as_ref().filter(|_| self.rates.pattern_ticks() == 1) else {
            return Vec::new();
        };
        // A scenario whose loop cannot be certified was refused.
        self.certificate(controller).map_or(Vec::new(), |certificate| {
            self.driven().map(|index| self.report(index, &controller.law, &certificate)).collect()
        })
    }

    fn isolated(&self, index: usize, start: Start, noisy: bool) -> Option<Self> {
        let mut rig = Self {
            bodies: pair(&self.bodies, index),
            initial: pair(&self.initial, index),
            sensors: pair(&self.sensors, index),
            disturbances_du_s2: vec![Vector2::zeros(); 2],
            ..self.clone()
        };
        if !noisy {
            rig.sensors.iter_mut().for_each(|sensors| sensors.noise = Noise::new(0, 0, [0.0; 4], [0.0; 4]));
        }
        if start != Start::Given {
            let settled = OrbitState { theta: self.initial[0].theta, ..self.reference(self.initial[0]) };
            let (off, shift) = match start {
                Start::Off(off) => (off, 0.0),
                Start::Shifted(shift) => (0.0, shift),
                Start::Given | Start::Settled => (0.0, 0.0),
            };
            let OrbitState { r, vr, theta, vtheta } = settled;
            let driven =
                OrbitState { r: r + off, vr: vr - 0.7 * off, theta: theta + shift, vtheta: vtheta + 1.3 * off };
            rig.initial = if index == 0 { vec![driven] } else { vec![self.initial[0], driven] };
            rig.initial_guess = Vector2::new(vr + 0.6 * off, vtheta - 0.9 * off);
        }
        Some(rig)
    }

    /// \[S\] Fig. 1, the motion in the plane, and Fig. 2, states and controls over time.
    fn pictures() -> Vec<Picture> {
        let graph = |field, element, axis: &str, caption: &str| {
            let (title, axis, caption) = (format!("{axis} over time"), axis.to_owned(), caption.to_owned());
            Picture::Graph(Graph { title, field, element, axis, caption })
        };
        vec![
            Picture::Plane(Plane {
                title: "motion in the plane",
                axes: ["x, du", "y, du"],
                caption: "Paths in the plane. The cross is the central body; a dot marks the start of a path.",
                point: |element| {
                    let (r, angle) = (element("radius_du", 0)?, element("angle_rad", 0)?);
                    Some([r * angle.cos(), r * angle.sin()])
                },
                centred: true,
                compared: Some(
                    "Motion in the plane, as Fig. 1 of [S]: with full state in black, computed for this report from the same \
                     scenario; with the observer in blue, as recorded. The cross is the central body.",
                ),
            }),
            Picture::Plane(Plane {
                title: "velocities in the plane Vr Vθ",
                axes: ["Vr, du/s", "Vθ, du/s"],
                caption: "True and estimated velocity. The estimate starts at the observer's guess.",
                point: |element| Some([element("velocity_du_s", 0)?, element("velocity_du_s", 1)?]),
                centred: false,
                compared: None,
            }),
            graph("radius_du", 0, "r, du", "Distance from the centre."),
            graph("velocity_du_s", 0, "Vr, du/s", "Radial velocity."),
            graph("velocity_du_s", 1, "Vθ, du/s", "Transverse velocity."),
            graph("angle_rad", 0, "θ, rad", "Angle, counted on over full turns."),
            graph("applied_du_s2", 0, "Ur, du/s²", "Radial thrust per mass, as applied."),
            graph("applied_du_s2", 1, "Uθ, du/s²", "Transverse thrust per mass, as applied."),
            Picture::Inputs(Inputs {
                field: "thrust_du_s2",
                applied: (Signal::Truth, "applied_du_s2"),
                axis: "thrust per mass, du/s²".to_owned(),
                components: ["Ur", "Uθ"].map(str::to_owned).to_vec(),
            }),
            Picture::Onset,
        ]
    }

    /// The overrides of the run to compare with: the law with the true velocity, \[S\] Fig. 1.
    fn counterpart(&self) -> &'static [&'static str] {
        let estimate = self.controller.is_some() && matches!(self.aim, Aim::Circle { full_state: false, .. });
        if estimate { &["controller.feedback=full-state"] } else { &[] }
    }

    fn notes(&self) -> Vec<String> {
        match self.aim {
            Aim::Circle { full_state: true, .. } => vec![format!(
                "controller.feedback = \"full-state\": {} measures its own velocity and the law uses it; the estimate is \
                 scored and not used",
                self.bodies[0].name
            )],
            _ => Vec::new(),
        }
    }
}

fn state(truth: &OrbitTruth) -> OrbitState {
    let [vr, vtheta] = truth.velocity_du_s;
    OrbitState { r: truth.radius_du, vr, theta: truth.angle_rad, vtheta }
}

/// |r − R| and |(Vr, Vθ) − (V_R, V_Θ)|; NaN where a sample is missing.
fn errors(body: Option<OrbitState>, reference: Option<OrbitState>) -> [f64; 2] {
    match (body, reference) {
        (Some(body), Some(reference)) => {
            let velocity = Vector2::new(body.vr - reference.vr, body.vtheta - reference.vtheta);
            [(body.r - reference.r).abs(), velocity.norm()]
        }
        _ => [f64::NAN; 2],
    }
}

/// Returns the larger value; NaN if either is NaN.
fn worse(a: f64, b: f64) -> f64 {
    if b > a || b.is_nan() { b } else { a }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SHIPPED;
    use crate::role::{Body, Controller, Estimator, Guard};
    use crate::sample::{OrbitCommand, OrbitMeasurement, Stamp};
    use crate::scenario::Scenario;

    fn rig(name: &str, overrides: &[&str]) -> OrbitRig {
        let text = SHIPPED.iter().find(|(shipped, _)| *shipped == name).unwrap().1;
        let overrides: Vec<String> = overrides.iter().map(|text| (*text).to_owned()).collect();
        Scenario::parse(text, "test", &overrides).unwrap().rig.downcast_ref::<OrbitRig>().unwrap().clone()
    }

    /// Returns the largest thrust component that the roles command at the first tick, du/s².
    fn first_thrust(rig: &OrbitRig, index: usize) -> f64 {
        let measured = |index: usize| {
            let mut measurement = OrbitMeasurement::default();
            rig.body(index).measure(0, 0, &mut measurement);
            measurement
        };
        let (mut observer, mut estimate, mut command) =
            (rig.estimator(), OrbitEstimate::default(), OrbitCommand::default());
        observer.start(&measured(0));
        observer.write(0, &mut estimate);
        Controller::new(rig.law(index), 0.01).step(&estimate, None, &measured(index), &mut command);
        Vector2::from(command.thrust_du_s2).amax()
    }

    /// A satellite in a low orbit that is observed and not followed, in metres.
    const LOW_ORBIT: &str = r#"
        name = "low-orbit"
        rig = "orbit-rendezvous"
        clock = "in-process"
        tick_hz = 10.0
        duration_s = 60.0
        [central_body]
        gravitational_parameter_du3_s2 = 3.986004418e14
        radius_du = 6.378137e6
        escape_radius_du = 4.2e7
        [leader]
        initial_radius_du = 7.0e6
        initial_velocity_du_s = [10.0, 7.6e3]
        [observer]
        decay_rate_per_s = [1.0, 1.0]
        [accept]
        settled_by_s = 40.0
        estimate_error_du_s_max = 1e-5
    "#;

    #[test]
    fn a_free_orbit_without_a_follower_is_observed_in_any_unit() {
        let scenario = Scenario::parse(LOW_ORBIT, "test", &[]).unwrap();
        assert_eq!(scenario.roles(), ["leader", "observer"]);
        let rig = scenario.rig.downcast_ref::<OrbitRig>().unwrap();
        assert_eq!((rig.metrics(), rig.certificates().len()), (vec!["estimate_error_du_s"], 0));
        let (mut body, mut observer, mut guard) = (rig.body(0), rig.estimator(), rig.measurement_guard(0, false));
        let (mut measurement, mut truth, mut estimate) = Default::default();
        let mut errors = [0.0];
        for tick in 0..=600 {
            measurement = OrbitMeasurement { stamp: Stamp { tick, generation: 1, ..Stamp::default() }, ..measurement };
            body.measure(tick, 0, &mut measurement);
            assert!(guard.accepts(&measurement), "{measurement:?}");
            if tick == 0 {
                observer.start(&measurement)
            } else {
                observer.update(&measurement, rig.tick_s)
            }
            body.truth(0, &mut truth);
            observer.write(0, &mut estimate);
            assert!(rig.estimate_guard().accepts(&estimate), "{estimate:?}");
            rig.score(|_| Some(&truth), |_| None, |_| Some(&estimate), &[], &mut errors);
            body.flow(rig.tick_s);
        }
        assert!(errors[0] < 1e-6, "an error of {} of 7600 du/s is left", errors[0]);
    }

    #[test]
    fn followers_and_a_controller_go_together() {
        let gain = "controller.gain={radius_per_s2=1.0, radial_per_s=2.0, transverse_per_s=1.0}";
        let refusal = |text: &str, overrides: &[&str]| {
            let overrides: Vec<String> = overrides.iter().map(|text| (*text).to_owned()).collect();
            Scenario::parse(text, "test", &overrides).unwrap_err().to_string()
        };
        let idle = refusal(LOW_ORBIT, &[gain, "controller.thrust_max_du_s2=1.0"]);
        assert!(idle.contains("controller: has no follower to drive"), "{idle}");
        let text = SHIPPED.iter().find(|(shipped, _)| *shipped == "orbit-rendezvous").unwrap().1;
        let (before, rest) = text.split_once("[controller]").unwrap();
        let after = rest.split_once("[accept]").unwrap().1;
        let loose = refusal(&format!("{before}[accept]{after}"), &[]);
        assert!(loose.contains("controller: is missing; followers need"), "{loose}");
    }

    #[test]
    fn the_certificate_has_the_thrust_that_the_law_commands_first() {
        for (name, index, overrides) in [
            ("orbit-hold", 0, &[][..]),
            ("orbit-hold", 0, &["observer.initial_guess_du_s=[0.3, 0.7]"]),
            ("orbit-hold", 0, &["controller.feedback=full-state", "spacecraft.bias.velocity_du_s=[0.1, 0.0]"]),
            ("orbit-hold", 0, &["controller.predict=true", "tick_hz=20.0"]),
            ("orbit-rendezvous", 1, &["observer.initial_guess_du_s=[0.0, 0.5]", "follower.0.bias.radius_du=0.1"]),
        ] {
            let rig = rig(name, &[overrides, &["controller.thrust_max_du_s2=100.0"]].concat());
            let certified = rig.certificates()[0].conditions[1].required;
            let asked = first_thrust(&rig, index);
            assert!((certified - asked).abs() < 1e-12, "{name} {overrides:?}: {certified} {asked}");
        }
        assert!(
            !rig("orbit-hold", &[]).certificates()[0].warnings.is_empty(),
            "the guess of 0 demands more than the limit"
        );
    }
}

//! A fleet of rigid bodies: many followers with the leader's inertia, simulated, driven and guarded as one.
//!
//! The results of each body are bit-identical to those of a single follower. All bodies are treated alike: a sample that is
//! missing, late or impossible for one body is rejected for all.

use super::RigidBodyRig;
use super::limits::Motion;
use crate::control::{FleetLaw, InFlightCommands};
use crate::model::{RigidBody, flow_all, uniform};
use crate::rate::port;
use crate::rig::fleet::Fleet;
use crate::role::{Body, Bounds, Guard, Law, LawInputs, MotionCheck, Refusal};
use crate::sample::{
    CommandLayout, FleetCommand, FleetMeasurement, FleetTruth, MeasurementLayout, Message, RateEstimate, TruthLayout,
};
use crate::state::{Persist, Words, persist_fields};
use nalgebra::Vector3;

/// The indices of the vectors in their samples.
const OMEGA: usize = 0;
const APPLIED: usize = 1;
const ACCELERATION: usize = 0;
/// The longest gap in ticks after which the next sample is compared only with the last accepted one. After a longer gap it must
/// also continue the sample before it, as for a single body.
const SHORT_GAP_TICKS: u64 = 2;
/// The offset of the fleets' random streams from those of the sensors.
const STREAMS: u64 = 1 << 32;

/// One number per body, for each component.
type Arrays = [Vec<f64>; 3];

fn zeros(count: usize) -> Arrays {
    [(); 3].map(|()| vec![0.0; count])
}

fn all(arrays: &Arrays) -> [&[f64]; 3] {
    arrays.each_ref().map(|array| &**array)
}

fn all_mut(arrays: &mut Arrays) -> [&mut [f64]; 3] {
    arrays.each_mut().map(|array| &mut **array)
}

fn assign(to: [&mut [f64]; 3], from: [&[f64]; 3]) {
    to.into_iter().zip(from).for_each(|(to, from)| to.copy_from_slice(from));
}

/// Returns the largest |rate − reference| of all bodies, rad/s; NaN if one of them is NaN.
pub(super) fn farthest(rates: [&[f64]; 3], reference: &Vector3<f64>) -> f64 {
    let [r1, r2, r3] = rates;
    let errors = r1.iter().zip(r2).zip(r3).map(|((r1, r2), r3)| (Vector3::new(*r1, *r2, *r3) - reference).norm());
    errors.fold(0.0, |worst: f64, error| if error > worst || error.is_nan() { error } else { worst })
}

/// The definition of a fleet in a scenario.
#[derive(Debug)]
pub struct RateFleet {
    body: RigidBody,
    initial: Arrays,
    law: FleetLaw,
    learned: bool,
    /// The number of ticks that the law predicts, if it predicts.
    delay_ticks: u64,
    bounds: Bounds<3>,
    motion: Option<Motion>,
    acceleration_max_rad_s2: f64,
}

impl RateFleet {
    /// Creates the fleet of `count` bodies that takes the place of the body with this index.
    pub(super) fn new(rig: &RigidBodyRig, index: usize, count: usize) -> Self {
        let (law, controller) = rig.synchronizer(index);
        let acceleration_max_rad_s2 = rig.limits.acceleration_rad_s2;
        let mut draw = uniform(rig.seed, STREAMS | index as u64);
        let (centre, spread) = (rig.initial_rates[index], rig.spreads[index]);
        let mut initial = zeros(count);
        // Body by body, so that a larger fleet starts with the bodies of a smaller one.
        let [r1, r2, r3] = &mut initial;
        for ((r1, r2), r3) in r1.iter_mut().zip(r2).zip(r3) {
            [*r1, *r2, *r3] = (centre + spread.map(|spread| spread * (2.0 * draw() - 1.0))).into();
        }
        Self {
            body: RigidBody::new(&rig.inertia),
            initial,
            law: FleetLaw::new(law, acceleration_max_rad_s2),
            learned: controller.learned,
            delay_ticks: rig.predicted_ticks(&controller),
            bounds: rig.limits.bounds(&rig.sensed(index), rig.tick_s),
            motion: rig.sensed(index).motion(rig.tick_s),
            acceleration_max_rad_s2,
        }
    }

    fn count(&self) -> usize {
        self.initial[0].len()
    }
}

impl Fleet<RateEstimate> for RateFleet {
    type Truth = TruthLayout;
    type Measurement = MeasurementLayout;
    type Command = CommandLayout;
    type Body = FleetPlant;
    type Law = FleetRateLaw;
    type MeasurementGuard = FleetMeasurementGuard;
    type CommandGuard = FleetCommandGuard;

    fn body(&self) -> FleetPlant {
        FleetPlant { body: self.body, rates: self.initial.clone(), asked: zeros(self.count()) }
    }

    fn law(&self) -> FleetRateLaw {
        let ahead = if self.law.predicts() { zeros(self.count()) } else { Arrays::default() };
        let in_flight = InFlightCommands::new(self.delay_ticks, || zeros(self.count()));
        FleetRateLaw { law: self.law, learned: self.learned, ahead, in_flight }
    }

    fn measurement_guard(&self) -> FleetMeasurementGuard {
        FleetMeasurementGuard {
            bounds: self.bounds,
            motion: self.motion,
            pursuits: vec![MotionCheck::default(); self.count()],
            pursuing: false,
            acceleration_max_rad_s2: self.acceleration_max_rad_s2,
            accepted: zeros(self.count()),
            accepted_tick: None,
            suspect: zeros(self.count()),
            suspect_tick: None,
        }
    }

    fn command_guard(&self) -> FleetCommandGuard {
        FleetCommandGuard { count: self.count() as u64, acceleration_max_rad_s2: self.acceleration_max_rad_s2 }
    }
}

/// Many rigid bodies with perfect rate gyros and torquers.
#[derive(Debug)]
pub struct FleetPlant {
    body: RigidBody,
    rates: Arrays,
    asked: Arrays,
}

impl Body for FleetPlant {
    type Truth = FleetTruth;
    type Measurement = FleetMeasurement;
    type Command = FleetCommand;

    fn apply(&mut self, command: &FleetCommand) -> bool {
        let asked = command.vector(ACCELERATION);
        let usable = asked.into_iter().all(|asked| within(asked, f64::MAX));
        if usable {
            assign(all_mut(&mut self.asked), asked);
        }
        usable
    }

    fn apply_safe(&mut self) {
        self.asked.iter_mut().for_each(|asked| asked.fill(0.0));
    }

    fn truth(&self, status: u64, out: &mut FleetTruth) {
        out.set_status(status);
        assign(out.vector_mut(OMEGA), all(&self.rates));
        assign(out.vector_mut(APPLIED), all(&self.asked));
    }

    fn measure(&mut self, _tick: u64, status: u64, out: &mut FleetMeasurement) {
        out.set_status(status);
        assign(out.vector_mut(OMEGA), all(&self.rates));
        assign(out.vector_mut(APPLIED), all(&self.asked));
    }

    fn flow(&mut self, dt_s: f64) {
        flow_all(&self.body, all_mut(&mut self.rates), all(&self.asked), dt_s);
    }
}

impl Persist for FleetPlant {
    fn persist<W: Words>(&mut self, words: &mut W) {
        persist_arrays(&mut self.rates, words);
        persist_arrays(&mut self.asked, words);
    }
}

fn persist_arrays<W: Words>(arrays: &mut Arrays, words: &mut W) {
    all_mut(arrays).into_iter().for_each(|array| array.persist(words));
}

/// The synchronising law of all followers of a fleet. It publishes no V.
#[derive(Debug)]
pub struct FleetRateLaw {
    law: FleetLaw,
    /// True if the law uses the coefficients that the observer has learned.
    learned: bool,
    /// Buffers of the predicted rates, if the law predicts.
    ahead: Arrays,
    /// The commands that were sent and do not act yet, rad/s², if the law predicts.
    in_flight: InFlightCommands<Arrays>,
}

impl Persist for FleetRateLaw {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.in_flight.persist_by(words, persist_arrays);
    }
}

impl Law for FleetRateLaw {
    type Estimate = RateEstimate;
    type Measurement = FleetMeasurement;
    type Command = FleetCommand;

    fn command(&mut self, inputs: &LawInputs<'_, Self>, out: &mut FleetCommand) {
        let LawInputs { estimate, measurement, .. } = inputs;
        if self.learned {
            self.law.learn(estimate.coefficients.into());
        }
        let reference = Vector3::from(estimate.omega_rad_s);
        let rates = measurement.vector(OMEGA);
        out.set_status(0);
        if self.law.predicts() {
            assign(all_mut(&mut self.ahead), rates);
            let applied = measurement.vector(APPLIED);
            let tick = measurement.stamp().tick;
            let mut reference = self.law.ahead(&reference, all_mut(&mut self.ahead), applied);
            for input in self.in_flight.after(tick) {
                let input = input.map_or(applied, all);
                reference = self.law.ahead(&reference, all_mut(&mut self.ahead), input);
            }
            self.law.command(&reference, all(&self.ahead), out.vector_mut(ACCELERATION));
            if let Some(sent) = self.in_flight.sent(tick) {
                assign(all_mut(sent), out.vector(ACCELERATION));
            }
        } else {
            self.law.command(&reference, rates, out.vector_mut(ACCELERATION));
        }
    }

    fn set_input(&mut self, port: usize, values: &[f64]) {
        let law = self.law.synchronizer_mut();
        match (port, values) {
            (port::GAIN, &[x, y, z]) => law.set_gain(Vector3::new(x, y, z)),
            (port::OFFSET, &[x, y, z]) => law.set_offset(Vector3::new(x, y, z)),
            _ => {}
        }
    }
}

/// A guard of a fleet's measurements, as [`MeasurementGuard`](super::MeasurementGuard) is of a single body's. It accepts or
/// rejects a sample for all bodies.
#[derive(Debug)]
pub struct FleetMeasurementGuard {
    bounds: Bounds<3>,
    motion: Option<Motion>,
    /// One check per body. All are active if `pursuing`; otherwise none is.
    pursuits: Vec<MotionCheck<3>>,
    pursuing: bool,
    acceleration_max_rad_s2: f64,
    /// The last accepted rates, and their tick.
    accepted: Arrays,
    accepted_tick: Option<u64>,
    /// The rates of the previous sample if it was rejected, and its tick.
    suspect: Arrays,
    suspect_tick: Option<u64>,
}

impl FleetMeasurementGuard {
    /// Returns true if all rates can have changed from `from` to these since tick `since`.
    fn reached(&self, rates: [&[f64]; 3], from: &Arrays, since: u64, tick: u64) -> bool {
        let ticks = tick.saturating_sub(since).max(1) as f64;
        (0..3).all(|axis| {
            let change = self.bounds.allowance[axis] + self.bounds.slew_per_tick[axis] * ticks;
            near(rates[axis], &from[axis], change)
        })
    }

    fn in_range(&self, rates: [&[f64]; 3]) -> bool {
        rates.into_iter().zip(self.bounds.magnitude).all(|(rates, limit)| within(rates, limit))
    }

    /// Checks a sample that is out of range, or follows such a sample: every body must move by its equations of motion.
    #[cold]
    fn follows(&mut self, sample: &FleetMeasurement) -> bool {
        let (Some(motion), [r1, r2, r3], [a1, a2, a3]) = (self.motion, sample.vector(OMEGA), sample.vector(APPLIED))
        else {
            return false;
        };
        let tick = sample.stamp().tick;
        let (mut all, mut active) = (true, true);
        for (i, pursuit) in self.pursuits.iter_mut().enumerate() {
            all &= motion.follows(pursuit, tick, &[r1[i], r2[i], r3[i]], &[a1[i], a2[i], a3[i]], &self.bounds);
            active &= pursuit.active();
        }
        self.pursuing = true;
        if !active {
            self.stop();
        }
        all
    }

    fn stop(&mut self) {
        self.pursuits.iter_mut().for_each(MotionCheck::stop);
        self.pursuing = false;
    }

    fn possible(&self, rates: [&[f64]; 3], tick: u64) -> bool {
        let in_range = self.in_range(rates);
        let Some(since) = self.accepted_tick.filter(|_| in_range) else { return in_range };
        let smooth = match self.suspect_tick {
            Some(suspect) if tick.saturating_sub(since) > SHORT_GAP_TICKS => {
                self.reached(rates, &self.suspect, suspect, tick)
            }
            _ => true,
        };
        smooth && self.reached(rates, &self.accepted, since, tick)
    }
}

impl Persist for FleetMeasurementGuard {
    fn persist<W: Words>(&mut self, words: &mut W) {
        persist_arrays(&mut self.accepted, words);
        self.accepted_tick.persist(words);
        persist_arrays(&mut self.suspect, words);
        self.suspect_tick.persist(words);
        self.pursuits.persist(words);
        self.pursuing.persist(words);
    }
}

impl Guard<FleetMeasurement> for FleetMeasurementGuard {
    fn accepts(&mut self, sample: &FleetMeasurement) -> bool {
        let limit = self.acceleration_max_rad_s2;
        let whole = sample.declared_bodies() == self.accepted[0].len() as u64;
        if !(whole && sample.vector(APPLIED).into_iter().all(|applied| within(applied, limit))) {
            return false;
        }
        let stamp = sample.stamp();
        let rates = sample.vector(OMEGA);
        let usual = self.possible(rates, stamp.tick);
        if usual && self.pursuing {
            self.stop();
        }
        let accepted = usual || ((self.pursuing || !self.in_range(rates)) && self.follows(sample));
        if accepted {
            assign(all_mut(&mut self.accepted), rates);
            (self.accepted_tick, self.suspect_tick) = (Some(stamp.tick), None);
        } else {
            assign(all_mut(&mut self.suspect), rates);
            self.suspect_tick = Some(stamp.tick);
        }
        accepted
    }

    fn refusal(&self, sample: &FleetMeasurement) -> Refusal {
        let (rates, applied) = (sample.vector(OMEGA), sample.vector(APPLIED));
        if sample.declared_bodies() != self.accepted[0].len() as u64 {
            Refusal::Incomplete
        } else if !applied.into_iter().all(|applied| within(applied, self.acceleration_max_rad_s2)) {
            of_vectors(applied)
        } else if !self.in_range(rates) {
            of_vectors(rates)
        } else {
            Refusal::TooFast
        }
    }
}

/// A guard of a fleet's commands: the actuators can apply what is commanded.
#[derive(Debug)]
pub struct FleetCommandGuard {
    count: u64,
    acceleration_max_rad_s2: f64,
}

persist_fields!(FleetCommandGuard,);

impl Guard<FleetCommand> for FleetCommandGuard {
    fn accepts(&mut self, sample: &FleetCommand) -> bool {
        let asked = sample.vector(ACCELERATION);
        sample.declared_bodies() == self.count
            && asked.into_iter().all(|asked| within(asked, self.acceleration_max_rad_s2))
    }

    fn refusal(&self, sample: &FleetCommand) -> Refusal {
        if sample.declared_bodies() == self.count {
            of_vectors(sample.vector(ACCELERATION))
        } else {
            Refusal::Incomplete
        }
    }
}

/// Returns the reason why the vectors of all bodies fail a bound on their magnitude.
fn of_vectors(vectors: [&[f64]; 3]) -> Refusal {
    let finite = |values: &&[f64]| Refusal::of_values(values) != Refusal::NotFinite;
    if vectors.iter().all(finite) { Refusal::OutOfRange } else { Refusal::NotFinite }
}

/// Returns true if all values are at most `limit` in magnitude. NaN is not.
#[multiversion::multiversion(targets = "simd")]
#[allow(unsafe_code, reason = "the macro calls what it has found the machine to have")]
fn within(values: &[f64], limit: f64) -> bool {
    // Bits instead of branches: they combine in any order, so the compiler can vectorise.
    values.iter().fold(1, |all, value| all & u64::from(value.abs() <= limit)) == 1
}

/// Returns true if all values differ from those in `from` by at most `change`. NaN does not.
#[multiversion::multiversion(targets = "simd")]
#[allow(unsafe_code, reason = "the macro calls what it has found the machine to have")]
fn near(values: &[f64], from: &[f64], change: f64) -> bool {
    values.iter().zip(from).fold(1, |all, (value, from)| all & u64::from((value - from).abs() <= change)) == 1
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::FleetBuffer;
    use crate::config::SHIPPED;
    use crate::rig::Rig;
    use crate::sample::{RateMeasurement, Stamp};
    use crate::scenario::Scenario;

    fn rig(overrides: &[&str]) -> RigidBodyRig {
        let overrides: Vec<String> = overrides.iter().map(|text| (*text).to_owned()).collect();
        let scenario = Scenario::parse(SHIPPED[0].1, "test", &overrides).unwrap();
        scenario.rig.downcast_ref::<RigidBodyRig>().unwrap().clone()
    }

    /// Compares both guards over steady motion, jumps, gaps, NaN and infinity, and restarts of the sender.
    #[test]
    fn a_fleet_s_guard_agrees_with_that_of_a_single_body() {
        let mut single = rig(&[]).measurement_guard(1, true);
        let mut many = rig(&["follower.0.count=5"]).fleet(1).unwrap().measurement_guard();
        let (mut draw, mut sample) = (uniform(3, 0), FleetBuffer::<MeasurementLayout>::new(5));
        let (mut rate, mut stamp, mut verdicts) = ([0.0; 3], Stamp { generation: 1, ..Stamp::default() }, [0, 0]);
        for _ in 0..20_000 {
            let event = (draw() * 100.0) as u64;
            stamp.tick += if event < 3 { 1 + (draw() * 60.0) as u64 } else { 1 };
            stamp.generation += u64::from(event == 4);
            let reach = if (5..8).contains(&event) { 1.0 } else { 2e-3 };
            rate = rate.map(|rate| (rate + reach * (draw() - 0.5)).clamp(-2.5, 2.5));
            let (mut measured, mut applied) = (rate, [0.1; 3]);
            match event {
                10 => measured[1] = f64::NAN,
                11 => measured[2] = f64::INFINITY,
                12 => applied[0] = f64::NAN,
                13 => measured[0] = 1e3,
                _ => {}
            }
            let single_sample = RateMeasurement {
                stamp,
                omega_rad_s: measured,
                applied_rad_s2: applied,
                valid: 7,
                ..Default::default()
            };
            let all = sample.sample_mut();
            all.set_status(0);
            *all.stamp_mut() = stamp;
            for axis in 0..3 {
                // The other bodies stay where they are, which is always possible.
                all.vector_mut(OMEGA)[axis][3] = measured[axis];
                all.vector_mut(APPLIED)[axis][3] = applied[axis];
            }
            let accepted = single.accepts(&single_sample);
            assert_eq!(accepted, many.accepts(sample.sample()), "{single_sample:?}");
            verdicts[usize::from(accepted)] += 1;
        }
        assert!(verdicts.iter().all(|count| *count > 1000), "{verdicts:?}");
    }

    #[test]
    fn a_sample_for_another_number_of_bodies_is_rejected() {
        let fleet = rig(&["follower.0.count=5"]).fleet(1).unwrap();
        let (mut measurement, mut command) =
            (FleetBuffer::<MeasurementLayout>::new(5), FleetBuffer::<CommandLayout>::new(5));
        assert!(!fleet.measurement_guard().accepts(measurement.sample()), "it declares no bodies");
        assert!(!fleet.command_guard().accepts(command.sample()));
        measurement.sample_mut().set_status(0);
        command.sample_mut().set_status(0);
        assert!(fleet.measurement_guard().accepts(measurement.sample()));
        assert!(fleet.command_guard().accepts(command.sample()));
        command.sample_mut().vector_mut(ACCELERATION)[2][4] = f64::NAN;
        assert!(!fleet.command_guard().accepts(command.sample()));
    }

    #[test]
    fn initial_rates_follow_from_the_seed_and_stay_within_their_spread() {
        let initial = |count: usize, seed: u64| {
            let overrides = [
                format!("follower.0.count={count}"),
                format!("seed={seed}"),
                "follower.0.initial_rate_rad_s=[0.5, 0.0, -1.0]".to_owned(),
                "follower.0.initial_rate_spread_rad_s=[0.25, 0.0, 2.0]".to_owned(),
            ];
            rig(&overrides.each_ref().map(|text| &**text)).fleet(1).unwrap().initial
        };
        let (few, many, reseeded) = (initial(10, 1), initial(1000, 1), initial(10, 2));
        assert!(
            few[0] == many[0][..10] && few[0] != reseeded[0],
            "a larger fleet starts with the bodies of a smaller one"
        );
        assert!(many[0].iter().all(|rate| (rate - 0.5).abs() <= 0.25) && many[1].iter().all(|rate| *rate == 0.0));
        let mean = many[2].iter().sum::<f64>() / 1000.0;
        assert!(many[2].iter().all(|rate| (rate + 1.0).abs() <= 2.0) && (mean + 1.0).abs() < 0.1, "{mean}");
    }
}

//! The estimate-and-control step, compared with the same law in C, an extended Kalman filter, and the bare copy of
//! the samples.
//!
//! Every contestant is called through a pointer, once per sample, on the same second of measurements, and writes
//! complete samples. The clock is read before and after that second, never in between. This file must not depend on
//! the contents of a step.

use super::compiled::{Compiled, NATIVE, PORTABLE};
use super::ekf::Ekf;
use super::product::{KINDS, Ours, SAMPLES, driven, measurements, pass, scenario, timed};
use super::recording::{CASES, Recording};
use corotate::bench::{Bench, BenchError, Board};
use corotate::config::SHIPPED;
use corotate::model::Inertia;
use corotate::observe::{
    Filter, GuardedKalman, HiddenRate, Interval, InvariantFilter, KalmanFilter, Observation, RateNoise,
    SecondOrderFilter,
};
use corotate::rig::{Command, Estimate, Figure, Measurement, RateLaw, Rig, RigidBodyRig};
use corotate::role::{Controller, Guard};
use corotate::sample::{FieldKind, RateCommand, RateEstimate, RateMeasurement, Sample, status};
use corotate::scenario::Scenario;
use corotate::with_shipped_rig;
use nalgebra::{Vector1, Vector3};
use std::hint::black_box;

/// The hand-written step.
const REFERENCE: &str = include_str!("reference.c");
/// The assumed noise of the sensors for filters that use it: standard deviation, rad/s, and density of the hidden
/// component's disturbance, (rad/s)²/s.
const DEVIATION: f64 = 2e-3;
const DENSITY: f64 = 1e-8;

/// A contestant: its name, its floor, and a pass over all samples that returns the nanoseconds per step.
struct Contestant<'a> {
    name: String,
    floor: Option<String>,
    pass: Box<dyn FnMut() -> f64 + 'a>,
}

impl<'a> Contestant<'a> {
    fn new(name: impl Into<String>, pass: impl FnMut() -> f64 + 'a) -> Self {
        Self { name: name.into(), floor: None, pass: Box::new(pass) }
    }

    fn beside(self, floor: impl Into<String>) -> Self {
        Self { floor: Some(floor.into()), ..self }
    }
}

/// The same step in C.
struct InC<'a> {
    state: Vec<f64>,
    parameters: Vec<f64>,
    start: unsafe extern "C" fn(*mut f64, *const f64),
    step: StepInC,
    /// The functions, valid while the library is loaded.
    _library: &'a Compiled,
}

type StepInC = unsafe extern "C" fn(*mut f64, *const u8, *const u8, *mut u8, *mut u8) -> i32;

impl<'a> InC<'a> {
    /// Loads the functions of one kind.
    #[allow(unsafe_code)]
    fn new(library: &'a Compiled, prefix: &str, parameters: Vec<f64>) -> Result<Self, String> {
        // SAFETY: the names and types are those of reference.c, and the library outlives the functions.
        let (size, start, step) = unsafe {
            (
                library.function::<unsafe extern "C" fn() -> u64>(&format!("{prefix}_size"))?,
                library.function(&format!("{prefix}_start"))?,
                library.function::<StepInC>(&format!("{prefix}_step"))?,
            )
        };
        // SAFETY: the function takes no arguments and returns the size of its state.
        let words = unsafe { size() }.div_ceil(8) as usize;
        Ok(Self { state: vec![0.0; words], parameters, start, step, _library: library })
    }

    /// Restarts at the guess.
    #[allow(unsafe_code)]
    fn restart(&mut self) {
        // SAFETY: the state has the size that C requires, and the parameters are in the order of its struct.
        unsafe { (self.start)(self.state.as_mut_ptr(), self.parameters.as_ptr()) }
    }

    /// Takes one step; returns true if it was an ordinary one.
    #[allow(unsafe_code)]
    #[inline]
    fn step<R: Rig>(
        &mut self,
        observed: &Measurement<R>,
        own: &Measurement<R>,
        estimate: &mut Estimate<R>,
        command: &mut Command<R>,
    ) -> bool {
        let (observed, own) = (bytemuck::bytes_of(observed).as_ptr(), bytemuck::bytes_of(own).as_ptr());
        let estimate = bytemuck::bytes_of_mut(estimate).as_mut_ptr();
        let command = bytemuck::bytes_of_mut(command).as_mut_ptr();
        // SAFETY: the samples have the layout that C declares: plain words in declared order, as `sample!` asserts.
        unsafe { (self.step)(self.state.as_mut_ptr(), observed, own, estimate, command) != 0 }
    }

    fn pass<R: Rig>(&mut self, samples: &[[Measurement<R>; 2]]) -> f64 {
        self.restart();
        self.step = black_box(self.step);
        let (mut estimate, mut command) = (Estimate::<R>::default(), Command::<R>::default());
        timed(|| {
            let mut ordinary = true;
            for [observed, own] in samples {
                ordinary &= self.step::<R>(observed, own, &mut estimate, &mut command);
            }
            assert!(black_box(ordinary), "the samples of a shipped scenario are ordinary");
            black_box((&estimate, &command));
        })
    }
}

/// Returns the parameters of a kind's C code from the resolved scenario, in the order of its struct.
fn parameters(kind: &str, scenario: &Scenario) -> (&'static str, Vec<f64>) {
    let table: toml::Table = scenario.to_toml().parse().expect("a resolved scenario is TOML");
    let tick_s = scenario.tick_s();
    let get = |path: &str| numbers(&table, path);
    let all = |paths: &[&str]| paths.iter().flat_map(|path| get(path)).collect::<Vec<_>>();
    match kind {
        "identifier" => {
            let floor = get("observer.observability_floor_rad_s").first().map_or(0.0, |floor| floor.powi(3));
            ("identifier", [get("observer.identifier_decay"), vec![floor, tick_s]].concat())
        }
        "orbit" => {
            let paths = [
                "central_body.gravitational_parameter_du3_s2",
                "observer.decay_rate_per_s",
                "observer.initial_guess_du_s",
                "controller.target_radius_du",
                "controller.gain.radius_per_s2",
                "controller.gain.radial_per_s",
                "controller.gain.transverse_per_s",
                "controller.thrust_max_du_s2",
            ];
            ("orbit", [all(&paths), vec![tick_s]].concat())
        }
        _ => {
            let number = |path: &str| get(path).first().copied().unwrap_or(0.0);
            let filter = [number("observer.decay_rate_per_s"), number("observer.bandwidth_rad_s")];
            let figure = |figures: Vec<Figure>, word: &str| {
                figures.iter().find(|figure| figure.name.contains(word)).map_or(f64::MAX, |figure| figure.value)
            };
            let bound = scenario.rig.certificates().pop().map_or(0.0, |certificate| figure(certificate.bounds, "M"));
            let guess = all(&["observer.initial_guess_rad_s", "observer.observability_floor_rad_s"]);
            let rest = [figure(scenario.rig.limits(), "acceleration"), bound, tick_s];
            let body = all(&["leader.inertia_kg_m2", "controller.gain_per_s"]);
            ("hidden", [&body[..], &filter[..], &guess[..], &rest[..]].concat())
        }
    }
}

/// Returns every number at a path of a table, matrices row by row.
fn numbers(table: &toml::Table, path: &str) -> Vec<f64> {
    fn flat(value: &toml::Value, into: &mut Vec<f64>) {
        match value {
            toml::Value::Array(values) => values.iter().for_each(|value| flat(value, into)),
            toml::Value::Float(value) => into.push(*value),
            toml::Value::Integer(value) => into.push(*value as f64),
            _ => {}
        }
    }
    let mut words = path.split('.');
    let first = words.next().and_then(|word| table.get(word));
    let found = words.try_fold(first, |value, word| Some(value?.get(word))).flatten();
    let mut values = Vec::new();
    found.iter().for_each(|value| flat(value, &mut values));
    values
}

/// The agreement of the C code with the product on the same samples.
#[derive(Debug)]
pub struct Agreement {
    /// The kind of step.
    pub kind: &'static str,
    /// The largest difference of any number in an estimate or command, over the larger of 1 and its value.
    pub largest: f64,
    /// True if all integer words were equal: status, valid bits, stamps.
    pub words: bool,
}

/// Compares the C code with the product, sample by sample.
///
/// # Errors
/// The reason why the C code is missing.
pub fn agreements(library: &Result<Compiled, String>) -> Result<Vec<Agreement>, String> {
    let library = library.as_ref().map_err(Clone::clone)?;
    KINDS.iter().map(|(kind, name, overrides)| agreement(library, kind, &scenario(name, overrides))).collect()
}

fn agreement(library: &Compiled, kind: &'static str, scenario: &Scenario) -> Result<Agreement, String> {
    let (prefix, parameters) = parameters(kind, scenario);
    let mut in_c = InC::new(library, prefix, parameters)?;
    in_c.restart();
    with_shipped_rig!(scenario.rig, rig => {
        let mut ours = Ours::new(rig, scenario);
        Ok(agreement_of(kind, rig, scenario, &mut ours, &mut in_c))
    })
}

fn agreement_of<R: Rig>(
    kind: &'static str,
    rig: &R,
    scenario: &Scenario,
    ours: &mut Ours<R>,
    in_c: &mut InC<'_>,
) -> Agreement {
    let mut agreement = Agreement { kind, largest: 0.0, words: true };
    let (mut estimates, mut commands) = ([Estimate::<R>::default(); 2], [Command::<R>::default(); 2]);
    for [observed, own] in &measurements(rig, scenario) {
        ours.step(observed, own, &mut estimates[0], &mut commands[0]);
        agreement.words &= in_c.step::<R>(observed, own, &mut estimates[1], &mut commands[1]);
        agreement.compare(&estimates);
        agreement.compare(&commands);
    }
    agreement
}

impl Agreement {
    fn compare<S: Sample>(&mut self, [ours, theirs]: &[S; 2]) {
        self.words &= ours.stamp() == theirs.stamp();
        let words = |sample: &S| bytemuck::cast_slice::<u8, u64>(bytemuck::bytes_of(sample)).to_vec();
        let (ours, theirs) = (words(ours), words(theirs));
        for field in S::FIELDS {
            for index in field.offset / 8..field.offset / 8 + field.count {
                match field.kind {
                    FieldKind::U64 => self.words &= ours[index] == theirs[index],
                    FieldKind::F64 => {
                        let (ours, theirs) = (f64::from_bits(ours[index]), f64::from_bits(theirs[index]));
                        let difference = (ours - theirs).abs() / ours.abs().max(1.0);
                        // Covers NaN too.
                        self.largest = if difference <= self.largest { self.largest } else { difference };
                    }
                }
            }
        }
    }
}

/// Compiles the C code with these flags.
pub fn library(flags: &[&str]) -> Result<Compiled, String> {
    Compiled::new(REFERENCE, flags)
}

/// Returns the same step with the textbook's filter: measured rates in, command of the same law out.
fn by_ekf(scenario: &Scenario) -> Option<Contestant<'_>> {
    let rig = scenario.rig.downcast_ref::<RigidBodyRig>()?;
    let samples = measurements(rig, scenario);
    let inertia: [f64; 3] = numbers(&scenario.to_toml().parse().ok()?, "leader.inertia_kg_m2").try_into().ok()?;
    let coefficients = Inertia::new(inertia).ok()?.coefficients();
    let first = Vector3::from(samples[0][0].omega_rad_s);
    let begun = move || Ekf::new(&coefficients, 3, [DEVIATION, DENSITY], &first, [0.0, 1.0]);
    let law = driven(rig)?;
    let pass = move || {
        let (mut filter, mut controller) = (begun(), Controller::new(rig.law(law), scenario.tick_s()));
        let (mut estimate, mut command) = (RateEstimate::default(), Default::default());
        let step: fn(&mut Ekf, &mut Controller<_>, f64, &[RateMeasurement; 2], &mut _, &mut _) = black_box(ekf_step);
        timed(|| {
            for pair in &samples {
                step(&mut filter, &mut controller, scenario.tick_s(), pair, &mut estimate, &mut command);
            }
            black_box(&command);
        })
    };
    Some(Contestant::new("first order by an EKF", pass).beside("first order"))
}

#[inline(never)]
fn ekf_step(
    filter: &mut Ekf,
    controller: &mut Controller<RateLaw>,
    tick_s: f64,
    [observed, own]: &[RateMeasurement; 2],
    estimate: &mut RateEstimate,
    command: &mut RateCommand,
) {
    filter.step(tick_s, &Vector3::from(observed.omega_rad_s));
    estimate.stamp = observed.stamp;
    estimate.omega_rad_s = filter.state.into();
    (estimate.valid, estimate.status) = (7, 0);
    controller.step(estimate, None, own, command);
}

/// Returns a copy of the samples in and out: the floor of every step.
fn bare_copy(scenario: &Scenario) -> Option<Contestant<'_>> {
    let rig = scenario.rig.downcast_ref::<RigidBodyRig>()?;
    let samples = measurements(rig, scenario);
    Some(Contestant::new("bare copy of its samples", move || {
        let copy: fn(&_, &_, &mut _, &mut _) = black_box(copy_samples);
        let (mut estimate, mut command) = (RateEstimate::default(), Default::default());
        timed(|| {
            for [observed, own] in &samples {
                copy(observed, own, &mut estimate, &mut command);
            }
            black_box((&estimate, &command));
        })
    }))
}

#[inline(never)]
fn copy_samples(
    observed: &RateMeasurement,
    own: &RateMeasurement,
    estimate: &mut RateEstimate,
    command: &mut RateCommand,
) {
    (estimate.stamp, command.stamp) = (observed.stamp, own.stamp);
    (estimate.omega_rad_s, estimate.coefficients) = (observed.omega_rad_s, observed.applied_rad_s2);
    (estimate.valid, estimate.status) = (observed.valid, observed.status | status::INITIAL);
    (command.acceleration_rad_s2, command.lyapunov_rad2_s2) = (own.omega_rad_s, own.applied_rad_s2[0]);
}

/// Returns a kind's step, ours and in C.
fn kind<'a>(
    kind: &'static str,
    scenario: &'a Scenario,
    libraries: &'a [Result<Compiled, String>; 2],
    board: &mut Board,
) -> Vec<Contestant<'a>> {
    let floor = format!("{kind} in C");
    let mut contestants = vec![Contestant::new(kind, pass(scenario)).beside(&*floor)];
    let (prefix, parameters) = parameters(kind, scenario);
    for (library, suffix) in libraries.iter().zip(["", ", for any machine"]) {
        match library.as_ref().map_err(Clone::clone).and_then(|library| InC::new(library, prefix, parameters.clone())) {
            Ok(mut in_c) => contestants.push(with_shipped_rig!(scenario.rig, rig => {
                let samples = measurements(rig, scenario);
                Contestant::new(format!("{floor}{suffix}"), move || pass_in_c(rig, &mut in_c, &samples))
            })),
            Err(reason) => board.remark(format!("the step in C is missing: {reason}")),
        }
    }
    contestants
}

fn pass_in_c<R: Rig>(_: &R, in_c: &mut InC<'_>, samples: &[[Measurement<R>; 2]]) -> f64 {
    in_c.pass::<R>(samples)
}

/// Returns the guards that check the measurements of the observed and a driven body before a step.
fn guards<'a>(name: &str, scenario: &'a Scenario) -> Option<Contestant<'a>> {
    with_shipped_rig!(scenario.rig, rig => {
        let driven = driven(rig)?;
        let samples = measurements(rig, scenario);
        Some(Contestant::new(format!("guards of its two measurements, {name}"), move || {
            let mut guards = [rig.measurement_guard(0, false), rig.measurement_guard(driven, true)];
            timed(|| {
                for pair in &samples {
                    for (guard, measurement) in guards.iter_mut().zip(pair) {
                        assert!(guard.accepts(black_box(measurement)), "a shipped scenario's samples are possible");
                    }
                }
            })
        }))
    })
}

/// Returns the filters alone, with their relation, on noisy samples of every conic.
fn filters<'a>(recording: &'a Recording, name: &'static str, guess: f64) -> Vec<Contestant<'a>> {
    let start = Vector1::new(guess);
    let relation_filters = [
        ("first order", Filter::First(InvariantFilter::new(Vector1::new(5.0), start))),
        (
            "second order",
            Filter::Second(SecondOrderFilter::new(Vector1::new(0.7), std::f64::consts::FRAC_1_SQRT_2, start)),
        ),
        ("Kalman on phi", Filter::Kalman(KalmanFilter::new(Vector1::new(DENSITY), start, Vector1::new(1.0)))),
    ];
    let by_relation = relation_filters.into_iter().map(move |(filter_name, filter)| {
        let relation = match filter {
            Filter::Kalman(_) => recording.relation(),
            _ => HiddenRate::new(&recording.coefficients, 3, 1e-6).expect("the case has a relation"),
        };
        Contestant::new(format!("filter alone, {name}: {filter_name}"), move || {
            let mut filter = filter;
            timed(|| {
                let (mut from, interval) = (relation.regressor(&recording.sample(0)), Interval::from(recording.tick_s));
                for index in 1..recording.truth.len() {
                    let to = relation.regressor(&black_box(recording.sample(index)));
                    match relation.observe(&from, &to, interval, filter.estimate().x) {
                        Observation::Seen(increment) => filter.step(&increment),
                        Observation::Unobservable { drift } => filter.predict(&drift, recording.tick_s),
                    }
                    from = to;
                }
                black_box(&filter);
            })
        })
    });
    by_relation.chain(whole_body_filters(recording, name, guess)).collect()
}

/// Returns the filters of the whole state: ours and the textbook's.
fn whole_body_filters<'a>(recording: &'a Recording, name: &str, guess: f64) -> [Contestant<'a>; 2] {
    let noise = RateNoise { sensor_deviation_rad_s: recording.sensors(), density: DENSITY, guess_deviation_rad_s: 1.0 };
    let guarded = move || {
        let mut filter = GuardedKalman::new(&recording.coefficients, 3, 1e-6, noise, &recording.sample(0), guess)
            .expect("the case has a relation");
        timed(|| {
            for index in 1..recording.truth.len() {
                filter.step(&recording.sample(index - 1), &black_box(recording.sample(index)), recording.tick_s);
            }
            black_box(&filter);
        })
    };
    let extended = move || {
        let measured = &recording.measured;
        let mut peer = Ekf::new(&recording.coefficients, 3, [DEVIATION, DENSITY], &measured[0], [guess, 1.0]);
        timed(|| {
            for measured in &measured[1..] {
                peer.step(recording.tick_s, black_box(measured));
            }
            black_box(peer.state);
        })
    };
    [
        Contestant::new(format!("filter alone, {name}: guarded Kalman"), guarded),
        Contestant::new(format!("filter alone, {name}: extended Kalman"), extended),
    ]
}

/// Measures the row.
pub fn measure(bench: &mut Bench<'_>, board: &mut Board) -> Result<(), BenchError> {
    bench.next("step: checking the C code against ours")?;
    let libraries = [library(NATIVE), library(PORTABLE)];
    match agreements(&libraries[0]) {
        Ok(agreements) => agreements.iter().for_each(|agreement| {
            let Agreement { kind, largest, words } = agreement;
            let same = if *words { "same words" } else { "OTHER WORDS" };
            board.remark(format!(
                "the {kind} step in C agrees with ours to {largest:.1e} over {SAMPLES} samples, {same}"
            ));
        }),
        Err(reason) => board.remark(format!("the step in C is missing: {reason}")),
    }
    let kinds: Vec<_> = KINDS.iter().map(|(kind, name, overrides)| (*kind, scenario(name, overrides))).collect();
    let shipped: Vec<_> = SHIPPED.iter().map(|(name, _)| (*name, scenario(name, &[]))).collect();
    let recordings: Vec<_> =
        CASES[..3].iter().map(|case| (Recording::new(case, 1e-3, SAMPLES as f64 * 1e-3, DEVIATION, 1), case)).collect();
    let first = &kinds[0].1;
    let mut contestants: Vec<Contestant<'_>> =
        kinds.iter().flat_map(|(name, scenario)| kind(name, scenario, &libraries, board)).collect();
    contestants.extend(by_ekf(first).into_iter().chain(bare_copy(first)));
    // Samples in, command out, for every shipped scenario with commands.
    let with_law = shipped.iter().filter(|(_, scenario)| scenario.rig.bodies().iter().any(|body| body.driven));
    contestants
        .extend(with_law.clone().map(|(name, scenario)| Contestant::new(format!("step of {name}"), pass(scenario))));
    contestants.extend(with_law.filter_map(|(name, scenario)| guards(name, scenario)));
    contestants.extend(recordings.iter().flat_map(|(recording, case)| filters(recording, case.name, case.start[2])));
    bench.next("step: timing")?;
    take_turns(bench, board, &mut contestants)
}

/// Runs all contestants in turn, round after round.
fn take_turns(bench: &mut Bench<'_>, board: &mut Board, contestants: &mut [Contestant<'_>]) -> Result<(), BenchError> {
    let (rounds, passes) = (bench.size(41, 3), bench.size(20, 2));
    for round in 0..=rounds {
        bench.next(&format!("step: round {round} of {rounds}"))?;
        // In the leader's place, so that other work of the machine is not measured too.
        let values = bench.in_the_leaders_place(board, |_| {
            let mean = |contestant: &mut Contestant<'_>| {
                let total: f64 = (0..passes).map(|_| (contestant.pass)()).sum();
                total / f64::from(passes)
            };
            Ok(contestants.iter_mut().map(mean).collect::<Vec<_>>())
        })?;
        // The first round warms up caches and the clock.
        for (contestant, value) in contestants.iter().zip(values).filter(|_| round > 0) {
            board.add(&contestant.name, "ns", contestant.floor.as_deref(), value);
        }
    }
    Ok(())
}

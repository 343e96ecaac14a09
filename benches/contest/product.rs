//! The product's estimate-and-control step on a second of a shipped scenario's measurements, called through a pointer once per
//! sample. Clocks are read before and after all of them, never within.

use corotate::config::SHIPPED;
use corotate::rig::{Command, Estimate, Measurement, Rig};
use corotate::role::{Body, Controller, Observer};
use corotate::sample::Message;
use corotate::scenario::Scenario;
use corotate::with_shipped_rig;
use std::hint::black_box;
use std::time::Instant;

/// Samples of one pass: a second of them.
pub const SAMPLES: usize = 1000;
/// The four steps that are held against C: name, the shipped scenario, and what is changed in it.
pub const KINDS: [(&str, &str, &[&str]); 4] = [
    ("first order", "rigid-pair", &[]),
    (
        "second order",
        "rigid-pair",
        &["observer={ bandwidth_rad_s = 2.0, initial_guess_rad_s = 0.0, observability_floor_rad_s = 1e-6 }"],
    ),
    ("identifier", "inertia", &[]),
    ("orbit", "orbit-hold", &[]),
];

/// A shipped scenario with what is changed in it.
pub fn scenario(name: &str, overrides: &[&str]) -> Scenario {
    let (_, text) = SHIPPED.iter().find(|(known, _)| *known == name).expect("the scenario ships");
    // What is judged at the end of a run is of no concern here, and some overrides would leave nothing to judge.
    let overrides: Vec<String> = overrides.iter().chain(&["accept={}"]).map(|text| (*text).to_owned()).collect();
    Scenario::parse(text, "bench", &overrides).expect("shipped scenarios are valid")
}

/// A second of the observed body's measurements, and those of the first driven body: the same one where none is.
pub fn measurements<R: Rig>(rig: &R, scenario: &Scenario) -> Vec<[Measurement<R>; 2]> {
    let mut bodies = [rig.body(0), rig.body(driven(rig).unwrap_or(0))];
    let tick = |tick: usize| {
        let mut pair = [Measurement::<R>::default(); 2];
        for (body, measurement) in bodies.iter_mut().zip(&mut pair) {
            body.measure(0, 0, measurement);
            (measurement.stamp_mut().tick, measurement.stamp_mut().generation) = (tick as u64, 1);
            body.flow(scenario.tick_s());
        }
        pair
    };
    (0..SAMPLES).map(tick).collect()
}

/// The first driven body, if there is one.
pub fn driven<R: Rig>(rig: &R) -> Option<usize> {
    rig.bodies().iter().position(|body| body.driven)
}

/// Nanoseconds per step of a pass.
pub fn timed(pass: impl FnOnce()) -> f64 {
    let began = Instant::now();
    pass();
    began.elapsed().as_nanos() as f64 / SAMPLES as f64
}

type StepOf<R> = fn(&mut Ours<R>, &Measurement<R>, &Measurement<R>, &mut Estimate<R>, &mut Command<R>);

/// The product's step on one rig.
pub struct Ours<R: Rig> {
    observer: Observer<R::Estimator>,
    controller: Option<Controller<R::Law>>,
}

impl<R: Rig> Ours<R> {
    pub fn new(rig: &R, scenario: &Scenario) -> Self {
        Self {
            observer: Observer::new(rig.estimator(), scenario.tick_s()),
            controller: driven(rig).map(|index| Controller::new(rig.law(index))),
        }
    }

    /// Samples in, command out; without a driven body, the estimate.
    #[inline(never)]
    pub fn step(
        &mut self,
        observed: &Measurement<R>,
        own: &Measurement<R>,
        estimate: &mut Estimate<R>,
        command: &mut Command<R>,
    ) {
        self.observer.step(observed, estimate);
        if let Some(controller) = &mut self.controller {
            controller.step(estimate, own, command);
        }
    }

    fn pass(&mut self, samples: &[[Measurement<R>; 2]]) -> f64 {
        let step: StepOf<R> = black_box(Self::step);
        let (mut estimate, mut command) = (Estimate::<R>::default(), Command::<R>::default());
        timed(|| {
            for [observed, own] in samples {
                step(self, observed, own, &mut estimate, &mut command);
            }
            black_box((&estimate, &command));
        })
    }
}

/// A pass over the samples by the product's step, begun anew every time; tells nanoseconds per step.
pub fn pass(scenario: &Scenario) -> Box<dyn FnMut() -> f64 + '_> {
    with_shipped_rig!(scenario.rig, rig => {
        let samples = measurements(rig, scenario);
        Box::new(move || Ours::new(rig, scenario).pass(&samples))
    })
}

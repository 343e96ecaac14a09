//! The product's estimate-and-control step on a second of a shipped scenario's measurements, called through a pointer
//! once per sample. The clock is read before and after all of them, never in between.

use corotate::config::SHIPPED;
use corotate::rig::{Command, Estimate, Measurement, Rig};
use corotate::role::{Body, Controller, Observer};
use corotate::sample::Message;
use corotate::scenario::Scenario;
use corotate::with_shipped_rig;
use std::hint::black_box;
use std::time::Instant;

/// The number of samples in a pass: one second.
pub const SAMPLES: usize = 1000;
/// The four steps that are compared with C: name, shipped scenario, and overrides.
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

/// Returns a shipped scenario with overrides.
pub fn scenario(name: &str, overrides: &[&str]) -> Scenario {
    let (_, text) = SHIPPED.iter().find(|(known, _)| *known == name).expect("the scenario ships");
    // The criteria at the end of a run are not used here, and some overrides would leave them without data.
    let overrides: Vec<String> = overrides.iter().chain(&["accept={}"]).map(|text| (*text).to_owned()).collect();
    Scenario::parse(text, "bench", &overrides).expect("shipped scenarios are valid")
}

/// Returns a second of the observed body's measurements with those of the first driven body, or with themselves if no
/// body is driven.
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

/// Returns the first driven body, if there is one.
pub fn driven<R: Rig>(rig: &R) -> Option<usize> {
    rig.bodies().iter().position(|body| body.driven)
}

/// Returns the nanoseconds per step of a pass.
pub fn timed(pass: impl FnOnce()) -> f64 {
    let began = Instant::now();
    pass();
    began.elapsed().as_nanos() as f64 / SAMPLES as f64
}

type StepOf<R> = fn(&mut Ours<R>, &Measurement<R>, &Measurement<R>, &mut Estimate<R>, &mut Command<R>);

/// The product's step for one rig.
pub struct Ours<R: Rig> {
    observer: Observer<R::Estimator>,
    controller: Option<Controller<R::Law>>,
}

impl<R: Rig> Ours<R> {
    pub fn new(rig: &R, scenario: &Scenario) -> Self {
        Self {
            observer: Observer::new(rig.estimator(), scenario.tick_s()),
            controller: driven(rig).map(|index| Controller::new(rig.law(index), scenario.tick_s())),
        }
    }

    /// Computes the command from the samples; without a driven body, the estimate.
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
            controller.step(estimate, None, own, command);
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

/// Returns a pass over the samples by the product's step, restarted every time. A pass returns its nanoseconds per
/// step.
pub fn pass(scenario: &Scenario) -> Box<dyn FnMut() -> f64 + '_> {
    with_shipped_rig!(scenario.rig, rig => {
        let samples = measurements(rig, scenario);
        Box::new(move || Ours::new(rig, scenario).pass(&samples))
    })
}

//! Compares the claims of `corotate check` with runs of random scenarios.
//!
//! A claim is false if the loop does not converge, or converges at another rate or to another floor than printed. The
//! share of converging loops with a claim must be high, too: a check that claims nothing would always be right.
//!
//! `tests/claims-campaign N SEED FIRST` draws N scenarios from number FIRST on; the short form in the suite is the first 60
//! of seed 1.

use crate::common::Loop;
use corotate::analysis::Claim;
use corotate::bus::Signal;
use corotate::config::SHIPPED;
use corotate::rig::{Estimate, Rig, Truth};
use corotate::runtime::report;
use corotate::sample::{FieldKind, Sample};
use corotate::scenario::Scenario;
use corotate::scenario::claims;
use corotate::with_shipped_rig;
use rand_pcg::Pcg64;
use rand_pcg::rand_core::{Rng, SeedableRng};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

/// The longest run, ticks.
const TICKS_MAX: u64 = 200_000;
/// Largest relative error of the claimed rate, measured over [`DECADES`] of the error and whole periods of the motion.
const RATE: f64 = 0.05;
const DECADES: f64 = 3.0;
/// Largest factor between both rates if the error falls in less than a period of the leader's motion.
const LOCAL: f64 = 2.0;
/// Largest factor between the claimed and the observed floor.
const FLOOR: f64 = 10.0;
/// Fraction of the largest error below which the linearised loop describes the error.
const SMALL: f64 = 1e-2;
/// Fraction of the largest error below which a loop counts as converged.
const CONVERGED: f64 = 1e-3;

struct Draw(Pcg64);

impl Draw {
    fn uniform(&mut self, from: f64, to: f64) -> f64 {
        from + (to - from) * (self.0.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Draws a number whose logarithm is uniformly distributed.
    fn log(&mut self, from: f64, to: f64) -> f64 {
        self.uniform(from.ln(), to.ln()).exp()
    }

    fn chance(&mut self, part: f64) -> bool {
        self.uniform(0.0, 1.0) < part
    }

    fn below(&mut self, limit: u64) -> u64 {
        self.0.next_u64() % limit
    }

    fn sign(&mut self) -> f64 {
        if self.chance(0.5) { 1.0 } else { -1.0 }
    }

    fn direction(&mut self) -> [f64; 3] {
        loop {
            let v = [(); 3].map(|()| self.uniform(-1.0, 1.0));
            let norm = v.iter().map(|v| v * v).sum::<f64>().sqrt();
            if (0.1..1.0).contains(&norm) {
                return v.map(|v| v / norm);
            }
        }
    }

    fn inertia(&mut self, axisymmetric: bool) -> [f64; 3] {
        let scale = self.log(1e-6, 1e4);
        let (a, b) = (1.0, if axisymmetric { 1.0 } else { self.uniform(0.3, 1.0) });
        let c = match self.below(4) {
            // A plate, or nearly.
            0 => (a + b) * (1.0 - self.log(1e-6, 1e-1)),
            // Nearly a sphere.
            1 => b * (1.0 + self.log(1e-6, 1e-1)),
            _ => self.uniform(a - b + 0.05, a + b),
        };
        let mut moments = [a, b, c].map(|moment| moment * scale);
        if !axisymmetric {
            moments.rotate_left(self.below(3) as usize);
        }
        moments
    }

    /// Draws a leader's rate: arbitrary, on a separatrix, or exactly or nearly about a principal axis.
    fn rate(&mut self, inertia: [f64; 3]) -> [f64; 3] {
        let size = self.log(1e-3, 50.0);
        match self.below(10) {
            0 => {
                let mut order = [0, 1, 2];
                order.sort_by(|i, j| inertia[*i].total_cmp(&inertia[*j]));
                let [i, j, k] = order;
                let ratio = (inertia[i] * (inertia[j] - inertia[i]) / (inertia[k] * (inertia[k] - inertia[j]))).sqrt();
                let mut rate = [0.0; 3];
                (rate[i], rate[k]) = (size, if ratio.is_finite() { ratio * size } else { size });
                rate
            }
            1 => {
                let mut rate = [0.0; 3];
                rate[self.below(3) as usize] = size;
                if self.chance(0.5) {
                    rate[self.below(3) as usize] += size * self.log(1e-6, 1e-1);
                }
                rate
            }
            _ => self.direction().map(|v| v * size),
        }
    }

    /// Draws a scenario, which may be refused.
    fn scenario(&mut self) -> String {
        if self.chance(0.15) { self.orbit() } else { self.rigid_body() }
    }

    fn rigid_body(&mut self) -> String {
        let kind = self.below(20);
        let axisymmetric = kind == 0;
        let learner = kind < 3;
        let inertia = self.inertia(axisymmetric);
        let rate = self.rate(inertia);
        let size = rate.iter().map(|v| v * v).sum::<f64>().sqrt();
        let tick_hz = self.log(5.0, 1e4);
        let gain = self.log(1e-3, 1.99) * tick_hz;
        let decay = self.log(0.05, 1e3);
        let hidden = 1 + self.below(3);
        let measured: Vec<u64> = (1..=3).filter(|axis| learner || *axis != hidden).collect();
        let noise = if self.chance(0.15) || kind == 4 { self.log(1e-6, 1e-2) * size } else { 0.0 };
        let noises = [1, 2, 3].map(|axis| if measured.contains(&axis) { noise } else { 0.0 });
        let reach = self.log(0.1, 3.0);
        let own = self.direction().map(|v| v * size * reach);
        let guess = if learner { 0.0 } else { self.sign() * size * self.log(0.1, 50.0) };
        let filter = match kind {
            0 => format!(
                "kind = \"axisymmetric-inertia\"\nsymmetry_axis = 3\nidentifier_decay = [{decay:?}, {decay:?}, {decay:?}]\n\
                 decay_rate_per_s = {decay:?}"
            ),
            1 | 2 => format!(
                "kind = \"inertia\"\nidentifier_decay = [{decay:?}, {decay:?}, {decay:?}]\ndecay_rate_per_s = {decay:?}"
            ),
            3 => format!("bandwidth_rad_s = {decay:?}\ninitial_guess_rad_s = {guess:?}"),
            4 => format!(
                "process_noise_rad2_s3 = {:?}\ninitial_guess_rad_s = {guess:?}",
                self.log(1e-10, 1e-2) * size * size
            ),
            _ => format!("decay_rate_per_s = {decay:?}\ninitial_guess_rad_s = {guess:?}"),
        };
        let (predict, learned) = (self.chance(0.5), if learner { "learned" } else { "known" });
        let factor = if self.chance(0.1) { [(); 3].map(|()| self.uniform(0.97, 1.03)) } else { [1.0; 3] };
        format!(
            "name = \"random\"\nrig = \"rigid-body\"\nclock = \"in-process\"\ntick_hz = {tick_hz:?}\nduration_s = 1.0\n\
             [leader]\ninertia_kg_m2 = {inertia:?}\ninitial_rate_rad_s = {rate:?}\nmeasured_axes = {measured:?}\n\
             noise_rad_s = {noises:?}\n[[follower]]\nname = \"follower\"\ninitial_rate_rad_s = {own:?}\n\
             inertia_factor = {factor:?}\n[observer]\n{filter}\n[controller]\ngain_per_s = {:?}\npredict = {predict}\n\
             coefficients = \"{learned}\"\n",
            [gain; 3]
        )
    }

    fn orbit(&mut self) -> String {
        let tick_hz = self.log(5.0, 1e4);
        let decay = self.log(0.05, 1e3);
        let (radius, slow) = (self.uniform(0.5, 2.0), self.uniform(0.8, 1.1));
        let velocity = |radius: f64, slow: f64| slow / radius.sqrt();
        let guess = [(); 2].map(|()| self.uniform(-3.0, 3.0));
        let (damping, fast) = (self.uniform(0.3, 1.5), self.log(0.1, 10.0));
        let predict = self.chance(0.5);
        let thrust = self.log(0.3, 30.0);
        let noise = if self.chance(0.15) { self.log(1e-8, 1e-4) } else { 0.0 };
        let filter = match self.below(4) {
            0 => format!("bandwidth_rad_s = {:?}", [decay; 2]),
            1 if noise > 0.0 => format!("process_noise_du2_s3 = {:?}", self.log(1e-10, 1e-4)),
            _ => format!("decay_rate_per_s = {:?}", [decay; 2]),
        };
        let sensors = format!("noise = {{ radius_du = {noise:?}, angle_rad = {noise:?} }}");
        let common = format!(
            "[central_body]\ngravitational_parameter_du3_s2 = 1.0\nradius_du = 0.05\nescape_radius_du = 10.0\n[observer]\n\
             {filter}\ninitial_guess_du_s = {guess:?}\n[controller]\nthrust_max_du_s2 = {thrust:?}\npredict = {predict}\n\
             gain = {{ radius_per_s2 = {:?}, radial_per_s = {:?}, transverse_per_s = {:?} }}\n",
            fast * fast,
            2.0 * damping * fast,
            fast * self.uniform(0.5, 2.0)
        );
        let head = |rig: &str| {
            format!(
                "name = \"random\"\nrig = \"{rig}\"\nclock = \"in-process\"\ntick_hz = {tick_hz:?}\nduration_s = 1.0\n"
            )
        };
        let body = |name: &str, radius: f64, slow: f64, vr: f64| {
            format!(
                "{name}\ninitial_radius_du = {radius:?}\ninitial_velocity_du_s = {:?}\n",
                [vr, velocity(radius, slow)]
            )
        };
        let (vr, second_radius) = (self.uniform(-0.2, 0.2), radius * self.uniform(0.8, 1.2));
        if self.chance(0.5) {
            let spacecraft = body("[spacecraft]", radius, slow, vr);
            head("orbit-hold")
                + &common
                + &format!("target_radius_du = {second_radius:?}\n")
                + &spacecraft
                + &sensors
                + "\n"
        } else {
            let leader = body("[leader]", radius, slow, vr);
            let follower = body("[[follower]]\nname = \"follower\"", second_radius, self.uniform(0.9, 1.1), 0.0);
            head("orbit-rendezvous") + &common + &leader + &sensors + "\n" + &follower
        }
    }
}

/// The errors and the motion of a run.
struct Trace {
    tick_s: f64,
    /// The rig's metrics at each tick.
    errors: Vec<Vec<f64>>,
    /// The leader's state at each tick, without an angle that only grows.
    motion: Vec<Vec<f64>>,
    /// The number of samples rejected by a guard.
    rejected: u64,
}

fn run(scenario: &Scenario) -> Trace {
    fn typed<R: Rig>(rig: &R, scenario: &Scenario) -> Trace {
        let mut all = Loop::open(scenario);
        let bodies = rig.bodies();
        let mut truths: Vec<_> = bodies.iter().map(|body| all.input::<Truth<R>>(&body.name, Signal::Truth)).collect();
        let mut estimate = all.input::<Estimate<R>>(&bodies[0].name, Signal::Estimate);
        let numbers: Vec<_> = Truth::<R>::FIELDS
            .iter()
            .filter(|field| field.kind == FieldKind::F64 && R::controlled().contains(&field.name))
            .collect();
        let (mut errors, mut motion) = (Vec::new(), Vec::new());
        all.run(|_| {
            truths.iter_mut().for_each(|truth| assert!(truth.advance().unwrap()));
            estimate.advance().unwrap();
            let mut values = vec![0.0; rig.metrics().len()];
            rig.score(|index| truths[index].sample(), |_| None, |_| estimate.sample(), &[], &mut values);
            errors.push(values);
            let words = corotate::sample::Message::words(truths[0].sample().unwrap());
            let components = |field: &&corotate::sample::Field| words[field.offset / 8..][..field.count].to_vec();
            motion.push(numbers.iter().flat_map(components).map(f64::from_bits).collect());
        });
        let read =
            all.roles.iter().flat_map(|(role, ledger)| report(scenario, *role, ledger, Vec::new(), Vec::new()).read);
        let rejected = read.map(|link| link.rejected).sum();
        Trace { tick_s: scenario.tick_s(), errors, motion, rejected }
    }
    with_shipped_rig!(scenario.rig, rig => typed(rig, scenario))
}

fn norm(values: &[f64]) -> f64 {
    values.iter().map(|value| value * value).sum::<f64>().sqrt()
}

fn list(values: &[f64]) -> String {
    values.iter().map(|value| format!("{value:.1e}")).collect::<Vec<_>>().join(", ")
}

fn distance(a: &[f64], b: &[f64]) -> f64 {
    norm(&a.iter().zip(b).map(|(a, b)| a - b).collect::<Vec<_>>())
}

impl Trace {
    /// Returns the period of the leader's motion in ticks: 1 if it rests, `None` if it does not repeat.
    fn period(&self) -> Option<usize> {
        let (first, size) = (&self.motion[0], norm(&self.motion[0]));
        let away = |tick: usize| distance(&self.motion[tick], first);
        let left = (0..self.motion.len()).find(|tick| away(*tick) > 0.05 * size);
        let Some(left) = left else { return Some(1) };
        let near = |tick: &usize| away(*tick) <= away(tick - 1) && away(*tick) < away(tick + 1);
        // The nearest sample of a motion that repeats may differ by half a step.
        let step = |tick: usize| distance(&self.motion[tick], &self.motion[tick - 1]);
        (left + 1..self.motion.len() - 1).filter(near).find(|tick| away(*tick) <= 0.02 * size + step(*tick))
    }

    /// Returns the sum of the errors at each tick, each divided by its largest value, and these largest values.
    fn combined(&self) -> (Vec<f64>, Vec<f64>) {
        let metrics = self.errors[0].len();
        let largest: Vec<f64> =
            (0..metrics).map(|i| self.errors.iter().map(|row| row[i]).fold(f64::MIN_POSITIVE, f64::max)).collect();
        let all = self.errors.iter().map(|row| row.iter().zip(&largest).map(|(error, largest)| error / largest).sum());
        (all.collect(), largest)
    }

    /// Returns the largest value of each error over the last quarter of the run.
    fn tail(&self) -> Vec<f64> {
        let from = self.errors.len() * 3 / 4;
        let largest = |i: usize| {
            let errors = self.errors[from..].iter().map(|row| if row[i].is_nan() { f64::INFINITY } else { row[i] });
            errors.fold(0.0, f64::max)
        };
        (0..self.errors[0].len()).map(largest).collect()
    }

    /// Returns true if every error has become small relative to its largest value and to the leader's motion.
    fn converged(&self) -> bool {
        let (_, largest) = self.combined();
        let size = norm(&self.motion[0]).max(1e-300);
        let small = |(tail, largest): (&f64, &f64)| {
            tail.is_finite() && *tail <= CONVERGED * largest && *tail <= 0.05 * size.max(*largest)
        };
        self.tail().iter().zip(&largest).all(small)
    }

    /// Returns two estimates of the rate at which a small error falls, 1/s, and true if the fall lasted a whole period of
    /// the leader's motion (otherwise the rate is only local). The first is taken over the last decades above the floor
    /// and whole periods, the second is a least-squares line over all decades, where other modes and slow oscillations
    /// count least.
    ///
    /// # Errors
    /// The reason if the fall is too short.
    fn rates(&self, floors: &[f64]) -> Result<([f64; 2], bool), &'static str> {
        let period = self.period().unwrap_or(usize::MAX);
        let (all, largest) = self.combined();
        let floor: f64 = floors.iter().zip(&largest).map(|(floor, largest)| floor / largest).sum();
        let floor = floor.max(1e-14) * 2.0 * FLOOR;
        let end = all.iter().position(|error| *error <= floor).ok_or("the floor is not reached")?;
        let small = all[..end].iter().rposition(|error| *error >= SMALL).map_or(0, |tick| tick + 1);
        let high = all[end] * 10_f64.powf(DECADES);
        let begin = all[..end].iter().rposition(|error| *error >= high).ok_or("the floor is too high")?;
        if begin < small {
            return Err("the fall is too short");
        }
        let periods = (end - begin).div_ceil(period).checked_mul(period);
        let whole = periods.and_then(|ticks| end.checked_sub(ticks)).filter(|begin| *begin >= small);
        let begin = whole.unwrap_or(begin);
        let last = (all[begin] / all[end]).ln() / ((end - begin) as f64 * self.tick_s);
        let times = (small..end).map(|tick| tick as f64 * self.tick_s);
        let (count, logarithms) = ((end - small) as f64, all[small..end].iter().map(|error| error.ln()));
        let middle = 0.5 * (small + end - 1) as f64 * self.tick_s;
        let mean = logarithms.clone().sum::<f64>() / count;
        let moments = times.zip(logarithms).fold((0.0, 0.0), |(cross, square), (time, logarithm)| {
            (cross + (time - middle) * (logarithm - mean), square + (time - middle) * (time - middle))
        });
        Ok(([last, -moments.0 / moments.1], whole.is_some()))
    }
}

/// The result of a comparison.
#[derive(Debug)]
enum Verdict {
    /// The claim holds; with the fitted rate, or the reason why none could be fitted.
    Holds(Result<([f64; 2], bool), &'static str>),
    /// The claim is false.
    False(String),
    /// No claim, and the run does not converge.
    Silent,
    /// No claim, although the loop converges.
    Missed(String),
    /// Convergence takes longer than a run may.
    Slow,
}

/// Runs a scenario and compares it with its claim; `None` if the scenario is refused.
fn judge(text: &str, overrides: &[&str]) -> Option<(Claim, Verdict, Trace)> {
    let with = |duration_s: f64| {
        let duration = format!("duration_s={duration_s:?}");
        let overrides = overrides.iter().map(|text| (*text).to_owned()).chain([duration]).collect::<Vec<_>>();
        Scenario::parse(text, "random", &overrides)
    };
    // From the largest error to the rounding of a double, after a transient.
    let ticks = |rate_per_s: f64, tick_s: f64| 60.0 / (rate_per_s * tick_s) + 2_000.0;
    let mut scenario = with(1.0).ok()?;
    let (tick_s, mut claim) = (scenario.tick_s(), claims(&scenario).remove(0));
    loop {
        // A longer run may have another claimed rate.
        let rate = claim.loop_rate_per_s.or(claim.continuous_rate_per_s).unwrap_or(1.0);
        let needed = ticks(rate, tick_s).min(TICKS_MAX as f64);
        if needed <= 1.01 * scenario.last_tick as f64 {
            break;
        }
        scenario = with(needed * tick_s).ok()?;
        claim = claims(&scenario).remove(0);
    }
    let trace = run(&scenario);
    let Some(rate) = claim.loop_rate_per_s else {
        let reason = claim.reason.clone().unwrap_or_default();
        let verdict = if trace.converged() { Verdict::Missed(reason) } else { Verdict::Silent };
        return Some((claim, verdict, trace));
    };
    let whole = ticks(rate, tick_s) <= 1.01 * TICKS_MAX as f64;
    if !whole && !trace.converged() {
        return Some((claim, Verdict::Slow, trace));
    }
    let (tail, floors): (_, Vec<f64>) = (trace.tail(), claim.floors.iter().map(|floor| floor.value).collect());
    let rounding = 8.0 * f64::EPSILON * norm(&trace.motion[0]).max(1e-3);
    let within = |lower: &[f64], higher: &[f64]| {
        let mut pairs = lower.iter().zip(higher);
        !whole || pairs.all(|(lower, higher)| *lower <= FLOOR * higher.max(rounding))
    };
    let fitted = trace.rates(&floors);
    // An oscillation as long as the fall tilts the two lines to different sides.
    let off = |(fitted, whole): ([f64; 2], bool)| {
        let part = if whole { 1.0 + RATE } else { LOCAL };
        fitted.iter().all(|fitted| *fitted > rate * part) || fitted.iter().all(|fitted| *fitted < rate / part)
    };
    let verdict = if !within(&tail, &floors) {
        let what = format!("ends at {}, not at {}", list(&tail), list(&floors));
        Verdict::False(format!("{what}; {} samples rejected", trace.rejected))
    } else if !within(&floors, &tail) {
        Verdict::False(format!("ends at {}, far below {}", list(&tail), list(&floors)))
    } else if fitted.is_ok_and(off) {
        Verdict::False(format!("falls at {fitted:.4?} 1/s, not at {rate:.4}"))
    } else {
        Verdict::Holds(fitted)
    };
    Some((claim, verdict, trace))
}

/// Prints the table of docs/claims.md: loops whose rate differs from that of the continuous law, and shipped ones.
#[test]
fn claims_of_sampled_loops_agree_with_runs() {
    let fast = "observer.decay_rate_per_s=200.0";
    let gain = |gain: &str| format!("controller.gain_per_s=[{gain}, {gain}, {gain}]");
    let gains = ["50.0", "70.0", "90.0", "190.0"].map(gain);
    let [half, more, most, ahead] = gains.each_ref().map(|gain| &**gain);
    let turns =
        ["leader.inertia_kg_m2=[1.0, 1.1, 2.05]", "leader.initial_rate_rad_s=[16.0, -11.0, 22.0]", "tick_hz=20.0"];
    println!("| loop | continuous law, 1/s | claimed, 1/s | observed |\n|---|---|---|---|");
    for (name, scenario, overrides, claimed) in [
        ("gain times tick 0.5", "rigid-pair", &["tick_hz=100.0", fast, half][..], true),
        ("gain times tick 0.7", "rigid-pair", &["tick_hz=100.0", fast, more], true),
        ("gain times tick 0.9", "rigid-pair", &["tick_hz=100.0", fast, most], true),
        ("1.9, predicted", "rigid-pair", &["tick_hz=100.0", fast, ahead, "controller.predict=true"], true),
        ("28 rad/s at 20 Hz", "rigid-pair", &turns, false),
        ("about the hidden axis", "rigid-pair", &["leader.initial_rate_rad_s=[0.0, 0.0, 0.8]"], false),
        ("orbit-hold from (0, 0.6)", "orbit-hold", &["spacecraft.initial_velocity_du_s=[0.0, 0.6]"], true),
        ("orbit-hold", "orbit-hold", &[], true),
        ("orbit-rendezvous", "orbit-rendezvous", &[], true),
        ("orbit-rendezvous at 3 Hz", "orbit-rendezvous", &["tick_hz=3.0"], false),
        ("rigid-pair", "rigid-pair", &[], true),
        ("rigid-pair-hyperbolic", "rigid-pair-hyperbolic", &[], true),
    ] {
        let text = SHIPPED.iter().find(|(shipped, _)| *shipped == scenario).unwrap().1;
        let overrides = [&["clock=in-process", "accept={}"], overrides].concat();
        let (claim, verdict, trace) = judge(text, &overrides).unwrap();
        let shown = |rate: Option<f64>| rate.map_or("none".to_owned(), |rate| format!("{rate:.4}"));
        let observed = match verdict {
            Verdict::Holds(Ok(([last, _], _))) => format!("{last:.4} 1/s"),
            _ => format!("{} at the end", list(&trace.tail())),
        };
        println!("| {name} | {} | {} | {observed} |", shown(claim.continuous_rate_per_s), shown(claim.loop_rate_per_s));
        let holds = if claimed { matches!(verdict, Verdict::Holds(Ok(_))) } else { matches!(verdict, Verdict::Silent) };
        assert!(holds, "{name}: {verdict:?} of {claim:?}");
    }
}

/// Draws and compares a scenario; refused ones are counted and drawn again.
fn draw_and_judge(seed: u64, number: u64, refused: &AtomicU64) -> (String, Verdict) {
    let mut draw = Draw(Pcg64::seed_from_u64(seed ^ number.wrapping_mul(0x9e37_79b9_7f4a_7c15)));
    loop {
        let text = draw.scenario();
        if let Some((_, verdict, _)) = judge(&text, &[]) {
            return (text, verdict);
        }
        refused.fetch_add(1, Ordering::Relaxed);
    }
}

/// Scenarios of the campaign with seed 20261122 that had a false claim in an earlier version.
#[test]
fn earlier_false_claims_are_not_repeated() {
    for (number, why) in [
        (19, "a body beyond 3 rad per tick, whose guard rejects every sample"),
        (215, "the rounding floor depends on the start"),
        (493, "the fall ends before a period of the motion"),
        (539, "the analysis did not excite an orbit's slowest mode"),
        (935, "a slow oscillation of the error"),
        (1174, "a floor above every tick of the settled loop"),
        (1549, "two nearly equal modes: slower than either"),
        (1625, "two nearly equal modes: faster than the slower"),
        (1963, "the slowest mode appears only below the floor"),
    ] {
        let (text, verdict) = draw_and_judge(20_261_122, number, &AtomicU64::new(0));
        assert!(!matches!(verdict, Verdict::False(_)), "{number}, {why}: {verdict:?}\n{text}");
    }
}

#[test]
fn claims_of_random_scenarios_hold() {
    let setting = |name: &str, default: u64| std::env::var(name).map_or(default, |text| text.parse().unwrap());
    let (count, seed, first) =
        (setting("COROTATE_CLAIMS", 60), setting("COROTATE_SEED", 1), setting("COROTATE_FIRST", 0));
    let (next, refused) = (AtomicU64::new(first), AtomicU64::new(0));
    let counts = Mutex::new(BTreeMap::<&str, u64>::new());
    let unfitted = Mutex::new(BTreeMap::<&str, u64>::new());
    let (wrong, missed) = (Mutex::new(String::new()), Mutex::new(BTreeMap::<String, u64>::new()));
    std::thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                loop {
                    let number = next.fetch_add(1, Ordering::Relaxed);
                    if number >= first + count {
                        break;
                    }
                    let (text, verdict) = draw_and_judge(seed, number, &refused);
                    let name = match verdict {
                        Verdict::Holds(Ok((_, true))) => "holds, rate fitted over whole periods",
                        Verdict::Holds(Ok((_, false))) => "holds, rate fitted over less than a period",
                        Verdict::Holds(Err(why)) => {
                            *unfitted.lock().unwrap().entry(why).or_default() += 1;
                            "holds, rate not fitted"
                        }
                        Verdict::Silent => "no claim, does not converge",
                        Verdict::Slow => "converges too slowly to compare",
                        Verdict::Missed(reason) => {
                            println!("{number}: no claim: {reason}\n{text}");
                            *missed.lock().unwrap().entry(reason.chars().take(40).collect()).or_default() += 1;
                            "no claim, although it converges"
                        }
                        Verdict::False(what) => {
                            println!("{number}: false: {what}\n{text}");
                            writeln!(wrong.lock().unwrap(), "{number}: {what}\n{text}").unwrap();
                            "false claim"
                        }
                    };
                    *counts.lock().unwrap().entry(name).or_default() += 1;
                }
            });
        }
    });
    let (counts, wrong) = (counts.into_inner().unwrap(), wrong.into_inner().unwrap());
    println!("{count} scenarios with seed {seed}, {} more refused: {counts:#?}", refused.into_inner());
    println!("why no rate was fitted: {:#?}", unfitted.into_inner().unwrap());
    println!("why converging loops have no claim: {:#?}", missed.into_inner().unwrap());
    assert!(wrong.is_empty(), "false claims:\n{wrong}");
    let claimed: f64 =
        counts.iter().filter(|(name, _)| name.starts_with("holds")).map(|(_, count)| *count as f64).sum();
    let all = claimed + *counts.get("no claim, although it converges").unwrap_or(&0) as f64;
    assert!(claimed >= 0.8 * all, "only {claimed} of {all} converging loops have a claim");
}

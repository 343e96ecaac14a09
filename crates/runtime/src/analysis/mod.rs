//! Computes the convergence of the loop as it runs: the rate at which its error falls, the floor that it reaches, and whether
//! it gets there from the scenario's own start.
//!
//! The loop is sampled, held and delayed by at least one tick, so the theorems about continuous time do not give its rate. Here
//! the roles' own code runs in one thread (`chain.rs`): one loop is synchronised from the start, a second one is slightly off.
//! The logarithm of their distance gives the largest exponent, which is a Floquet exponent if the leader's motion is periodic.
//! The state is the one from which a killed role continues, so it is complete for every filter, law and delay. Must not derive
//! the rate from equations by hand.

mod chain;
mod digits;
mod disturbed;
mod exponent;
mod fall;
mod subject;

pub use digits::{apart, digits, to_tolerance};

use crate::config::Settings;
use crate::panics;
use crate::rig::{CertificateReport, ConditionReport, Figure, Rig, Start};
use chain::{Chain, Guards};
use fall::Fall;
use serde::{Deserialize, Serialize};
use subject::{Analysis, LOST, TICKS_MAX, TICKS_MIN, exceeds, norm};

/// The most examined ticks of a long scenario, unless the rate needs more.
const SCENARIO_TICKS_MAX: u64 = TICKS_MAX / 8;
/// The examined span in time constants of the error; it has settled after the first three quarters.
const SETTLED: f64 = 60.0;
/// From the scenario's own start the error must fall at the loop's rate to within this factor, if its fall is long enough.
const OWN: f64 = 1.048;
/// An error is small, so that the linearisation holds, below this fraction of the largest error.
const SMALL: f64 = 1e-2;
/// A loop does not synchronise if its floor exceeds this fraction of its output.
const USELESS: f64 = 0.05;
const USELESS_REASON: &str = "even from where it is settled the error comes to a floor that is no synchronisation: rounding, \
                              quadrature or noise outweigh what the motion tells; raise tick_hz, or choose another axis";
/// A loop has diverged if its output exceeds this multiple of its first value. Transients may be large, as after a wrong first
/// guess at a high gain.
const DIVERGED: f64 = 1e6;
/// A loop gets a warning if it keeps less than this fraction of the continuous rate.
const COMFORTABLE: f64 = 0.75;

/// The convergence claim for one driven body: of the law in continuous time, and of the loop as it runs.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Claim {
    /// The driven body.
    pub body: String,
    /// The slowest exponent of the continuous law's error, 1/s; `None` if the rig has no theorem for this scenario.
    pub continuous_rate_per_s: Option<f64>,
    /// The exponent at which the error of the sampled, held and delayed loop falls once it is small, 1/s; `None` if there is no
    /// uniform rate.
    pub loop_rate_per_s: Option<f64>,
    /// The time from the start over which the rate and the floors were computed, s; `None` without a rate.
    pub over_s: Option<f64>,
    /// The reason why there is no loop rate.
    pub reason: Option<String>,
    /// The first of `floors`.
    pub floor: Option<f64>,
    /// Per metric, the level below which its error does not stay, due to quadrature at this tick, rounding, sensor noise and bias,
    /// and differences between the bodies.
    pub floors: Vec<Figure>,
    /// The times at which the limits in `[accept]` are reached at that rate.
    pub reaches: Vec<Reach>,
    /// The conditions on the continuous law and on stability.
    pub conditions: Vec<ConditionReport>,
    /// The bounds on which the conditions rest.
    pub bounds: Vec<Figure>,
    /// Advice on settings to change.
    pub warnings: Vec<String>,
}

/// The time at which a metric reaches its limit.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Reach {
    /// The metric.
    pub metric: String,
    /// Its limit in `[accept]`.
    pub limit: f64,
    /// The value at the start.
    #[serde(deserialize_with = "crate::telemetry::number_or_nan")]
    pub from: f64,
    /// The time from the start to the limit at the loop's rate, s; `None` if the limit is below the floor.
    pub after_s: Option<f64>,
}

/// Computes the claims of a rig, one per driven body.
pub(crate) fn of_rig<R: Rig>(rig: &R, scenario: &Settings) -> Vec<Claim> {
    let driven = rig.bodies().iter().enumerate().filter(|(_, body)| body.driven);
    let certificates = rig.certificates();
    let certificate = |name: &str| certificates.iter().find(|certificate| certificate.body == name);
    driven.map(|(index, body)| Analysis::new(rig, index, scenario).claim(&body.name, certificate(&body.name))).collect()
}

impl<R: Rig> Analysis<'_, R> {
    fn claim(&self, body: &str, certificate: Option<&CertificateReport>) -> Claim {
        let pattern_ticks = self.scenario.rates.pattern_ticks();
        let (rate, floors) = match self.rig.isolated(self.index, Start::Settled, false) {
            _ if pattern_ticks > SCENARIO_TICKS_MAX => (
                Err(format!(
                    "roles and sensors repeat their pattern only after {pattern_ticks} ticks, more than the analysis \
                     examines; choose rates with a smaller common multiple"
                )),
                Vec::new(),
            ),
            None => panics::catch_quietly(|| self.rate_by_running()).unwrap_or_else(|panic| {
                (Err(format!("the analysis runs the rig's own code, and {panic}")), Vec::new())
            }),
            Some(settled) => {
                let exponent = self.exponent(&settled);
                match self.judge(&exponent) {
                    Err(reason) => (Err(reason), Vec::new()),
                    Ok(rate) => {
                        let mut floors = self.floors(self.ticks_to_settle(rate));
                        let useful = floors.iter().all(|floor| *floor <= USELESS * exponent.size);
                        let mut arrives = || self.arrives(rate, &mut floors).map(|()| rate);
                        let rate = if useful { arrives() } else { Err(USELESS_REASON.to_owned()) };
                        (rate, floors)
                    }
                }
            }
        };
        let loop_rate_per_s = rate.as_ref().ok().copied();
        let mut claim = Claim {
            body: body.to_owned(),
            continuous_rate_per_s: certificate.and_then(|certificate| certificate.continuous_rate_per_s),
            loop_rate_per_s,
            over_s: loop_rate_per_s.map(|rate| self.ticks_to_settle(rate) as f64 * self.tick_s),
            floor: floors.first().copied().filter(|floor| !floor.is_nan()),
            reaches: loop_rate_per_s.map_or(Vec::new(), |rate| self.reaches(rate, &floors)),
            floors: self.named(&floors),
            conditions: certificate.map_or(Vec::new(), |certificate| certificate.conditions.clone()),
            bounds: certificate.map_or(Vec::new(), |certificate| certificate.bounds.clone()),
            warnings: certificate.map_or(Vec::new(), |certificate| certificate.warnings.clone()),
            reason: rate.err(),
        };
        claim.warn();
        claim
    }

    fn named(&self, values: &[f64]) -> Vec<Figure> {
        // A metric of an estimate has no value if its body has no observer.
        let named = self.rig.metrics().into_iter().zip(values).filter(|(_, value)| !value.is_nan());
        named.map(|(name, value)| Figure { name: name.to_owned(), value: *value }).collect()
    }

    /// Computes when each limit of the scenario is reached, from the error at its start.
    fn reaches(&self, rate_per_s: f64, floors: &[f64]) -> Vec<Reach> {
        let mut start = vec![0.0; floors.len()];
        let mut chain = match self.rig.isolated(self.index, Start::Given, false) {
            Some(rig) => Chain::new(&rig, self.scenario),
            None => Chain::examine(self.rig, self.index, self.scenario),
        };
        chain.advance();
        chain.score(&mut start);
        let limits = &self.scenario.accept.metric_max;
        let limited = self.rig.metrics().into_iter().zip(start.iter().zip(floors));
        let reach = |(metric, (from, floor)): (&str, (&f64, &f64))| {
            let limit = *limits.get(metric).filter(|_| !floor.is_nan())?;
            let after_s = (limit > *floor).then(|| ((from / limit).ln() / rate_per_s).max(0.0));
            Some(Reach { metric: metric.to_owned(), limit, from: *from, after_s })
        };
        limited.filter_map(reach).collect()
    }

    /// Returns the ticks to examine, so that an error that falls at this rate has settled after three quarters of them; at least
    /// those of the scenario, up to [`SCENARIO_TICKS_MAX`].
    fn ticks_to_settle(&self, rate_per_s: f64) -> u64 {
        let ticks = SETTLED / (rate_per_s.max(0.0) * self.tick_s);
        (ticks.min(TICKS_MAX as f64) as u64)
            .clamp(self.scenario.last_tick.clamp(TICKS_MIN, SCENARIO_TICKS_MAX), TICKS_MAX)
    }

    /// Computes the largest error per metric of a loop that is synchronised from the start, with all disturbances.
    fn floors(&self, ticks: u64) -> Vec<f64> {
        let mut floors = vec![0.0; self.rig.metrics().len()];
        let mut values = floors.clone();
        if let Some(rig) = self.rig.isolated(self.index, Start::Settled, true) {
            let mut chain = Chain::new(&rig, self.scenario);
            let (mut output, mut size) = (Vec::new(), None);
            for tick in 0..ticks {
                chain.advance();
                chain.output(&mut output);
                if exceeds(norm(&output), LOST * *size.get_or_insert(norm(&output))) {
                    return vec![f64::INFINITY; floors.len()];
                }
                chain.score(&mut values);
                if tick >= ticks - ticks / 4 {
                    floors.iter_mut().zip(&values).for_each(|(floor, value)| *floor = value.max(*floor));
                }
            }
        }
        floors
    }

    /// Checks that the loop synchronises from the scenario's own start, at the given rate. If only rounding is left, it may reach
    /// another floor than the settled loop; `floors` then become its own.
    fn arrives(&self, rate_per_s: f64, floors: &mut [f64]) -> Result<(), String> {
        let Some(rig) = self.rig.isolated(self.index, Start::Given, true) else {
            return Ok(());
        };
        let (mut chain, mut guards) = (Chain::new(&rig, self.scenario), Guards::new(&rig));
        let (mut values, mut motion) = (vec![0.0; floors.len()], Vec::new());
        // The largest errors: over all ticks, in the second quarter, and in the last.
        let (mut largest, mut halfway, mut last) = (values.clone(), values.clone(), values.clone());
        let ticks = self.ticks_to_settle(rate_per_s);
        let part = ticks / 4;
        let (mut output, mut size) = (Vec::new(), None);
        let mut fall = Fall::default();
        for tick in 0..ticks {
            chain.advance();
            chain.output(&mut output);
            chain.score(&mut values);
            chain.observed(&mut motion);
            fall.push(&values, &motion);
            if let Some(loss) = chain.loss() {
                return Err(format!(
                    "from this start the loop fails: {loss} after {} s; raise tick_hz, lower the gains, or begin nearer to \
                     the reference",
                    digits(tick as f64 * self.tick_s)
                ));
            }
            let lost = exceeds(norm(&output), DIVERGED * *size.get_or_insert(norm(&output)));
            if lost || values.iter().any(|value| !value.is_finite()) {
                return Err("from this start the loop diverges".to_owned());
            }
            if let Some(what) = guards.refuse(&chain) {
                return Err(format!(
                    "from this start the guards refuse {what} at {} s and longer than they may; raise tick_hz or [limits], \
                     lower the gains, or begin nearer to the reference",
                    digits(tick as f64 * self.tick_s)
                ));
            }
            let maxima: &mut [f64] = match tick {
                tick if tick >= ticks - part => &mut last,
                tick if (ticks / 2 - part..ticks / 2).contains(&tick) => &mut halfway,
                _ => &mut [],
            };
            maxima.iter_mut().zip(&values).for_each(|(maximum, value)| *maximum = value.max(*maximum));
            largest.iter_mut().zip(&values).for_each(|(largest, value)| *largest = value.max(*largest));
        }
        // An error that falls beyond the examined ticks must already fall at this rate.
        let least = (-0.8 * rate_per_s * (ticks / 2) as f64 * self.tick_s).exp();
        let capped = SETTLED > rate_per_s * TICKS_MAX as f64 * self.tick_s;
        for (index, (last, floor)) in last.iter().zip(&mut *floors).enumerate() {
            let small = *last <= (SMALL * largest[index]).max(2.0 * *floor);
            if !(small || capped && least < 0.7 && *last <= least * halfway[index]) {
                return Err(format!(
                    "from this start the loop does not synchronise: {} is still {last:.1e} after {:.3} s",
                    self.rig.metrics()[index],
                    ticks as f64 * self.tick_s
                ));
            }
            if !capped {
                *floor = *last;
            }
        }
        // Of two modes with similar rates, the slower may not appear above the floor, or the error may be a product of both.
        match fall.rates(floors).map(|rates| rates.map(|per_tick| per_tick / self.tick_s)) {
            Some(rates)
                if rates.iter().all(|rate| *rate > OWN * rate_per_s)
                    || rates.iter().all(|rate| *rate * OWN < rate_per_s) =>
            {
                Err(format!(
                    "from this start the error falls at {} 1/s until it comes to its floor, not at the {} 1/s of the loop's \
                     slowest mode",
                    digits(rates[0]),
                    digits(rate_per_s)
                ))
            }
            _ => Ok(()),
        }
    }
}

impl Claim {
    /// Returns the loop's rate with the digits that are known, 1/s.
    pub fn loop_rate_text(&self) -> Option<String> {
        self.loop_rate_per_s.map(|rate| to_tolerance(rate, exponent::AGREEMENT * rate))
    }

    /// Adds the warnings that follow from rates and floors.
    fn warn(&mut self) {
        match (self.loop_rate_per_s, self.continuous_rate_per_s) {
            (None, _) => self.warnings.extend(self.reason.clone()),
            (Some(rate), Some(continuous)) if rate < COMFORTABLE * continuous => self.warnings.push(format!(
                "sampling, hold and delay leave {} of the continuous law's {} 1/s; raise tick_hz, lower the gains, or set \
                 controller.predict",
                self.loop_rate_text().unwrap_or_default(),
                digits(continuous)
            )),
            _ => {}
        }
        for reach in self.reaches.iter().filter(|reach| reach.after_s.is_none()) {
            self.warnings.push(format!(
                "accept.{}_max = {} is below the floor; raise it, or raise tick_hz or lower the noise",
                reach.metric,
                digits(reach.limit)
            ));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SHIPPED;
    use crate::scenario::{Scenario, claims};

    fn claim(overrides: &[&str]) -> Claim {
        let overrides: Vec<String> = overrides.iter().map(|text| (*text).to_owned()).collect();
        let text = SHIPPED.iter().find(|(name, _)| *name == "rigid-pair").unwrap().1;
        claims(&Scenario::parse(text, "test", &overrides).unwrap()).remove(0)
    }

    /// Rates from an independent program: the product of the one-tick transitions of (e, command on its way, ε), linearised
    /// about the leader's motion by its variational equation.
    #[test]
    fn the_rate_is_that_of_the_linearised_product_of_ticks() {
        for (scale, gain, decay, tick_hz, predict, expected) in [
            (1.0, 50.0, 200.0, 100.0, false, 34.5407),
            (1.0, 70.0, 200.0, 100.0, false, 17.8008),
            (1.0, 90.0, 200.0, 100.0, false, 5.1908),
            (1.0, 190.0, 200.0, 100.0, true, 10.495),
            (8.0, 4.0, 6.0, 100.0, false, 4.2754),
            (20.0, 4.0, 6.0, 20.0, false, 2.7616),
            (1.0, 4.0, 0.5, 1000.0, false, 0.4939),
            (1.0, 4.0, 6.0, 5.0, false, 0.5108),
            (1.0, 4.0, 6.0, 5.0, true, 6.0),
        ] {
            let rate = [0.6, -0.4, 0.8].map(|value| value * scale);
            let claim = claim(&[
                &format!("leader.initial_rate_rad_s={rate:?}"),
                &format!("controller.gain_per_s={:?}", [gain; 3]),
                &format!("controller.predict={predict}"),
                &format!("observer.decay_rate_per_s={decay:?}"),
                &format!("tick_hz={tick_hz:?}"),
            ]);
            let found = claim.loop_rate_per_s.unwrap_or(f64::NAN);
            println!("{scale} {gain} {decay} {tick_hz} {predict}: {found:.4}, expected {expected}; {:?}", claim.reason);
            assert!((found / expected - 1.0).abs() < 0.03, "{found} is not {expected}");
        }
    }

    /// A loop that does not converge, or whose observer gets no information, has no rate.
    #[test]
    fn diverging_and_unobservable_loops_have_no_rate() {
        for (overrides, reason) in [
            (
                // Fast, and sampled at 20 Hz: every continuous condition holds.
                &[
                    "leader.inertia_kg_m2=[1.0, 1.1, 2.05]",
                    "leader.initial_rate_rad_s=[16.0, -11.0, 22.0]",
                    "tick_hz=20.0",
                ][..],
                "raise tick_hz",
            ),
            (&["leader.initial_rate_rad_s=[0.0, 0.0, 0.8]"], "not observable"),
        ] {
            let claim = claim(overrides);
            println!("{overrides:?}: {claim:?}");
            assert!(claim.loop_rate_per_s.is_none() && claim.reason.unwrap().contains(reason));
            assert!(!claim.warnings.is_empty());
        }
    }

    #[test]
    fn a_start_that_loses_the_body_is_a_warning_with_its_cause() {
        let text = SHIPPED.iter().find(|(name, _)| *name == "orbit-rendezvous").unwrap().1;
        for (overrides, cause) in [
            (&["tick_hz=3.0"][..], "follower meets the central body after"),
            (
                &["tick_hz=50.0", "follower.0.initial_radius_du=9.9", "follower.0.initial_velocity_du_s=[2.0, 0.0]"],
                "follower leaves the region",
            ),
        ] {
            let overrides: Vec<String> = overrides.iter().map(|text| (*text).to_owned()).collect();
            let claim = claims(&Scenario::parse(text, "test", &overrides).unwrap()).remove(0);
            assert!(claim.loop_rate_per_s.is_none(), "{claim:?}");
            let warned = |part: &str| claim.warnings.iter().any(|warning| warning.contains(part));
            assert!(warned(cause) && warned("raise tick_hz"), "{claim:?}");
        }
    }
}

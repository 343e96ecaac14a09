//! Checks the keys of a `[[fault]]` for its occurrence and for the delay of a sample.
//!
//! Must refuse conflicting keys, and a fault that could never act as its author meant.

use super::FaultCheck;
use super::raw::{DistributionName, Kind, MAX_DELAY_TICKS, PatternName, RawChannel, RawFault, RawWeaklyHard};
use crate::fault::{Channel, Delay, Distribution, Occurrence, Pattern, WINDOW_MAX, WeaklyHard};

impl FaultCheck<'_, '_, '_> {
    /// Returns the fault's occurrence: the pattern of ticks at which it acts.
    pub(crate) fn occurrence(&mut self) -> Option<Occurrence> {
        let RawFault { every, gilbert_elliott, weakly_hard, probability, .. } = *self.raw;
        let patterns = [
            ("every", every.is_some()),
            ("gilbert_elliott", gilbert_elliott.is_some()),
            ("weakly_hard", weakly_hard.is_some()),
        ];
        let mut given = patterns.into_iter().filter(|(_, given)| *given);
        let (first, second) = (given.next(), given.next());
        if let (Some((first, _)), Some((second, _))) = (first, second) {
            self.require(false, second, "conflicting-keys", || {
                format!("cannot be combined with `{first}`; give one of them")
            })?;
        }
        self.require(probability > 0.0 && probability <= 1.0, "probability", "out-of-range", || {
            format!("{probability} is out of range; give a probability above 0, up to 1")
        })?;
        let draws = weakly_hard.is_none_or(|hard| hard.pattern == PatternName::Random);
        if let Some((first, _)) = first.filter(|(name, _)| *name != "weakly_hard" || !draws) {
            self.require(probability >= 1.0, "probability", "conflicting-keys", || {
                format!("cannot be combined with `{first}`; remove one of them")
            })?;
        }
        match (every, gilbert_elliott, weakly_hard) {
            (Some(n), ..) => self.every(n),
            (_, Some(channel), _) => self.channel(channel),
            (.., Some(hard)) => self.weakly_hard(hard),
            _ => Some(Occurrence::Independent(probability)),
        }
    }

    /// Requires that the fault lasts long enough for the key to have an effect.
    fn require_ticks(&mut self, name: &str, ticks: u64) -> Option<()> {
        self.require(self.raw.ticks >= ticks, "ticks", "out-of-range", || {
            format!("{} ticks are too few for `{name}`; give at least {ticks}", self.raw.ticks)
        })
    }

    fn every(&mut self, n: u64) -> Option<Occurrence> {
        self.require(n >= 2, "every", "out-of-range", || {
            format!("an interval of {n} is too short; give 2 or more, or remove it for every tick")
        })?;
        self.require_ticks("every", n.saturating_add(1))?;
        Some(Occurrence::Every(n))
    }

    fn channel(&mut self, raw: RawChannel) -> Option<Occurrence> {
        let RawChannel { good_to_bad, bad_to_good, when_good, when_bad } = raw;
        for (name, value, least) in [
            ("good_to_bad", good_to_bad, f64::MIN_POSITIVE),
            ("bad_to_good", bad_to_good, f64::MIN_POSITIVE),
            ("when_good", when_good, 0.0),
            ("when_bad", when_bad, 0.0),
        ] {
            self.require((least..=1.0).contains(&value), &format!("gilbert_elliott.{name}"), "out-of-range", || {
                let from = if least > 0.0 { "above 0" } else { "from 0" };
                format!("{value} is out of range; give a probability {from}, up to 1")
            })?;
        }
        self.require(when_good != when_bad, "gilbert_elliott.when_bad", "no-effect", || {
            "equals when_good, so the state of the channel has no effect; give `probability` instead".to_owned()
        })?;
        self.require_ticks("gilbert_elliott", 2)?;
        Some(Occurrence::GilbertElliott(Channel { good_to_bad, bad_to_good, when_good, when_bad }))
    }

    fn weakly_hard(&mut self, raw: RawWeaklyHard) -> Option<Occurrence> {
        let RawWeaklyHard { misses, window, pattern } = raw;
        let (longest, probability) = (u64::from(WINDOW_MAX), self.raw.probability);
        self.require((2..=longest).contains(&window), "weakly_hard.window", "out-of-range", || {
            format!("a window of {window} ticks is out of range; give 2 to {longest}")
        })?;
        self.require((1..window).contains(&misses), "weakly_hard.misses", "out-of-range", || {
            format!("{misses} misses of {window} ticks are out of range; give 1 to {}", window - 1)
        })?;
        self.require(pattern != PatternName::Random || probability < 1.0, "probability", "missing-key", || {
            "pattern = \"random\" needs a number below 1 (1 is \"burst\"); give one".to_owned()
        })?;
        self.require_ticks("weakly_hard", window)?;
        let pattern = match pattern {
            PatternName::Random => Pattern::Random(probability),
            PatternName::Burst => Pattern::Burst,
            PatternName::Even => Pattern::Even,
        };
        Some(Occurrence::WeaklyHard(WeaklyHard { misses: misses as u32, window: window as u32, pattern }))
    }

    /// Returns the delay of samples.
    pub(crate) fn delay(&mut self) -> Option<Delay> {
        // A command may arrive until it is due; any other sample, until its own tick ends.
        let commands = self.raw.role == "controller";
        let slack_ticks = if commands { self.setting.actuation_delay_ticks - 1 } else { 0 };
        let delay = Delay { slack_ticks, ..self.lateness()? };
        self.require(delay.bound() > slack_ticks, "delay_ticks", "no-effect", || {
            format!("no command would be late, because actuation_delay_ticks allows {slack_ticks} ticks; give more")
        })?;
        Some(delay)
    }

    fn lateness(&mut self) -> Option<Delay> {
        let RawFault { jitter_ticks, distribution, spread_ticks, .. } = *self.raw;
        let ticks = self.raw.delay_ticks?;
        let least = u64::from(jitter_ticks.is_none());
        self.require((least..=MAX_DELAY_TICKS).contains(&ticks), "delay_ticks", "out-of-range", || {
            format!("a delay of {ticks} ticks is out of range; give {least} to {MAX_DELAY_TICKS}, or drop the sample")
        })?;
        let Some(jitter_ticks) = jitter_ticks else {
            self.require(distribution.is_none(), "distribution", "unused-key", || {
                "has no effect without jitter_ticks; give that, or remove this".to_owned()
            })?;
            self.require(spread_ticks.is_none(), "spread_ticks", "unused-key", || {
                "has no effect without jitter_ticks; give that, or remove this".to_owned()
            })?;
            return Some(Delay::constant(ticks));
        };
        let most = MAX_DELAY_TICKS - ticks;
        self.require((1..=most).contains(&jitter_ticks), "jitter_ticks", "out-of-range", || {
            format!("a jitter of {jitter_ticks} ticks is out of range; give 1 to {most}: the longest delay is {MAX_DELAY_TICKS} ticks")
        })?;
        let distribution = distribution.unwrap_or(DistributionName::Uniform);
        if distribution == DistributionName::Uniform {
            self.require(spread_ticks.is_none(), "spread_ticks", "unused-key", || {
                "has no meaning for a uniform distribution; remove it, or give another distribution".to_owned()
            })?;
            return Some(Delay { jitter_ticks, ..Delay::constant(ticks) });
        }
        self.require(spread_ticks.is_some(), "spread_ticks", "missing-key", || {
            "is missing: the mean of the geometric distribution, or the standard deviation of the normal one; add it"
                .to_owned()
        })?;
        let spread = spread_ticks?;
        self.require(spread > 0.0 && spread <= jitter_ticks as f64, "spread_ticks", "out-of-range", || {
            format!(
                "{spread} does not fit into {jitter_ticks} ticks of jitter; give a number above 0, up to {jitter_ticks}"
            )
        })?;
        let distribution = match distribution {
            DistributionName::Normal => Distribution::Normal(spread),
            _ => Distribution::Geometric(spread),
        };
        Some(Delay { jitter_ticks, distribution, ..Delay::constant(ticks) })
    }

    /// Returns true if the fault affects the role itself.
    pub(crate) fn targets_role(&self) -> bool {
        matches!(self.raw.kind, Kind::Stall | Kind::Kill | Kind::Miss)
    }
}

//! A latency histogram that never allocates after its creation and never loses a value.

use hdrhistogram::Histogram;
use hdrhistogram::serialization::{Deserializer, Serializer, V2Serializer};

/// The longest latency that is resolved, ns. Longer ones count as this long, and as clipped.
pub const MAX_LATENCY_NS: u64 = 60_000_000_000;
/// Two significant digits resolve 1 %; three resolve 0.1 % and need 8 times the memory.
const SIGNIFICANT_DIGITS: u8 = 3;

/// The distribution of one stage's latencies, ns.
#[derive(Debug, Clone)]
pub struct Latency {
    histogram: Histogram<u32>,
    tallies: Tallies,
}

/// Counts kept beside the histogram.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(default)]
pub struct Tallies {
    /// Values beyond the histogram's range.
    pub clipped: u64,
    /// Values of ticks that were missed or lacked an input.
    pub missed: u64,
    /// Negative differences, which are not recorded as values.
    pub ahead: u64,
    /// The magnitude of the largest negative difference, ns.
    pub ahead_max_ns: u64,
}

/// The figures of one table row, µs.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Percentiles {
    /// The number of values.
    pub count: u64,
    /// The number of values beyond the histogram's range.
    pub clipped: u64,
    /// The number of values of ticks that were missed or lacked an input.
    #[serde(default)]
    pub missed: u64,
    /// The number of negative differences. If there are any, the two stamps come from different clocks, and all figures below
    /// are NaN (null in JSON).
    #[serde(default)]
    pub ahead: u64,
    /// The magnitude of the largest negative difference, µs.
    #[serde(default)]
    pub ahead_max_us: f64,
    /// The minimum.
    #[serde(deserialize_with = "number_or_nan")]
    pub min_us: f64,
    /// The median.
    #[serde(deserialize_with = "number_or_nan")]
    pub p50_us: f64,
    /// The 90th percentile.
    #[serde(deserialize_with = "number_or_nan")]
    pub p90_us: f64,
    /// The 99th percentile.
    #[serde(deserialize_with = "number_or_nan")]
    pub p99_us: f64,
    /// The 99.9th percentile.
    #[serde(deserialize_with = "number_or_nan")]
    pub p999_us: f64,
    /// The maximum.
    #[serde(deserialize_with = "number_or_nan")]
    pub max_us: f64,
    /// The mean.
    #[serde(deserialize_with = "number_or_nan")]
    pub mean_us: f64,
}

/// Reads a number. Null, which JSON writes for a number that is not finite, becomes NaN.
///
/// # Errors
/// Errors of the deserializer.
pub fn number_or_nan<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Ok(<Option<f64> as serde::Deserialize>::deserialize(deserializer)?.unwrap_or(f64::NAN))
}

impl Percentiles {
    /// Returns true if the figures are valid: no difference was negative.
    pub fn are_shown(&self) -> bool {
        self.ahead == 0
    }
}

impl Default for Latency {
    fn default() -> Self {
        let histogram = Histogram::new_with_bounds(1, MAX_LATENCY_NS, SIGNIFICANT_DIGITS)
            .expect("the bounds are constants that the histogram accepts");
        Self { histogram, tallies: Tallies::default() }
    }
}

impl Latency {
    /// Counts the latency from `from_ns` to `to_ns`.
    ///
    /// A monotonic clock never goes back, so a negative difference means that the stamps come from two clocks. It is counted
    /// apart and not recorded.
    #[inline]
    pub fn record(&mut self, from_ns: u64, to_ns: u64) {
        let Some(ns) = to_ns.checked_sub(from_ns) else { return self.count_ahead(from_ns - to_ns) };
        if ns > MAX_LATENCY_NS {
            self.tallies.clipped += 1;
        }
        self.histogram.saturating_record(ns);
    }

    #[cold]
    fn count_ahead(&mut self, ns: u64) {
        self.tallies.ahead += 1;
        self.tallies.ahead_max_ns = self.tallies.ahead_max_ns.max(ns);
    }

    /// Counts the latency of a tick that was missed or lacked an input. The result was absent for this time.
    #[inline]
    pub fn record_missed(&mut self, from_ns: u64, to_ns: u64) {
        self.tallies.missed += 1;
        self.record(from_ns, to_ns);
    }

    /// Adds all counts of another histogram.
    pub fn absorb(&mut self, counted: &Self) {
        // Both histograms have the same bounds.
        self.histogram.add(&counted.histogram).expect("histograms of equal bounds add up");
        self.tallies.clipped += counted.tallies.clipped;
        self.tallies.missed += counted.tallies.missed;
        self.tallies.ahead += counted.tallies.ahead;
        self.tallies.ahead_max_ns = self.tallies.ahead_max_ns.max(counted.tallies.ahead_max_ns);
    }

    /// Forgets all counts.
    pub fn clear(&mut self) {
        self.histogram.clear();
        self.tallies = Tallies::default();
    }

    /// Returns true if nothing was counted, including negative differences.
    pub fn is_empty(&self) -> bool {
        self.histogram.is_empty() && self.tallies.ahead == 0
    }

    /// Returns the histogram, ns.
    pub fn histogram(&self) -> &Histogram<u32> {
        &self.histogram
    }

    /// Returns the figures for a table.
    pub fn percentiles(&self) -> Percentiles {
        let us = |ns: u64| ns as f64 / 1e3;
        let shown = |us: f64| if self.tallies.ahead == 0 { us } else { f64::NAN };
        let at = |quantile: f64| shown(us(self.histogram.value_at_quantile(quantile)));
        Percentiles {
            count: self.histogram.len(),
            clipped: self.tallies.clipped,
            missed: self.tallies.missed,
            ahead: self.tallies.ahead,
            ahead_max_us: us(self.tallies.ahead_max_ns),
            min_us: shown(us(self.histogram.min())),
            p50_us: at(0.5),
            p90_us: at(0.9),
            p99_us: at(0.99),
            p999_us: at(0.999),
            max_us: shown(us(self.histogram.max())),
            mean_us: shown(self.histogram.mean() / 1e3),
        }
    }

    /// Encodes the histogram as HdrHistogram V2, with the counts beside it.
    pub fn encode(&self) -> (Vec<u8>, Tallies) {
        let mut bytes = Vec::new();
        V2Serializer::new().serialize(&self.histogram, &mut bytes).expect("memory takes every byte");
        (bytes, self.tallies)
    }

    /// Decodes what [`encode`](Self::encode) has encoded. Returns `None` if the bytes are not a histogram.
    pub fn decode(mut bytes: &[u8], tallies: Tallies) -> Option<Self> {
        let histogram = Deserializer::new().deserialize(&mut bytes).ok()?;
        Some(Self { histogram, tallies })
    }
}

/// Returns the values in rising order.
pub fn sorted(values: impl IntoIterator<Item = f64>) -> Vec<f64> {
    let mut sorted: Vec<f64> = values.into_iter().collect();
    sorted.sort_by(f64::total_cmp);
    sorted
}

/// Returns the nearest-rank quantile of sorted values, as HdrHistogram does: the least value that the part does not exceed.
pub fn quantile(sorted: &[f64], part: f64) -> Option<f64> {
    let rank = (part * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.clamp(1, sorted.len().max(1)) - 1).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keeps_every_value_and_counts_clipped_ones() {
        let mut latency = Latency::default();
        for (from, to) in [(0, 1_000), (5_000, 7_000), (9, 9), (0, 2 * MAX_LATENCY_NS)] {
            latency.record(from, to);
        }
        latency.record_missed(0, 5_000);
        let figures = latency.percentiles();
        assert_eq!((figures.count, figures.clipped, figures.missed, figures.min_us), (5, 1, 1, 0.0));
        assert!((figures.max_us / (MAX_LATENCY_NS as f64 / 1e3) - 1.0).abs() < 1e-3);
        let (bytes, tallies) = latency.encode();
        assert_eq!(Latency::decode(&bytes, tallies).unwrap().percentiles(), figures);
        assert!(Latency::decode(&bytes[1..], tallies).is_none());
    }

    /// A negative difference comes from two clocks; it must not pass as a short latency.
    #[test]
    fn a_negative_difference_is_counted_and_hides_the_figures() {
        let mut latency = Latency::default();
        latency.record(1_000_000, 0);
        assert!(!latency.is_empty(), "a negative difference counts although no value was recorded");
        latency.record(0, 3_000);
        latency.record(500, 0);
        let (bytes, tallies) = latency.encode();
        let mut pooled = Latency::default();
        pooled.absorb(&Latency::decode(&bytes, tallies).unwrap());
        let figures = pooled.percentiles();
        assert_eq!((figures.count, figures.ahead, figures.ahead_max_us), (1, 2, 1000.0));
        assert!(!figures.are_shown() && figures.p50_us.is_nan() && figures.max_us.is_nan());
        let json = serde_json::to_value(figures).unwrap();
        assert!(json["p99_us"].is_null() && json["ahead_max_us"] == 1000.0);
        let read: Percentiles = serde_json::from_value(json).unwrap();
        assert!(read.min_us.is_nan() && read.ahead == 2);
    }
}

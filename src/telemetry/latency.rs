//! A latency histogram that never allocates after it is made and never loses a value.

use hdrhistogram::Histogram;
use hdrhistogram::serialization::{Deserializer, Serializer, V2Serializer};

/// The largest latency that is kept apart, ns; longer ones count as this long, and are counted as clipped too.
pub const MAX_LATENCY_NS: u64 = 60_000_000_000;
/// Two significant digits cost one part in a hundred of resolution, three a thousandth and 8 times the memory.
const SIGNIFICANT_DIGITS: u8 = 3;

/// The distribution of one stage's latencies, ns.
#[derive(Debug, Clone)]
pub struct Latency {
    histogram: Histogram<u32>,
    clipped: u64,
}

/// The figures that a table shows, µs.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Percentiles {
    /// How many values.
    pub count: u64,
    /// How many of them were longer than the histogram holds.
    pub clipped: u64,
    /// The least.
    pub min_us: f64,
    /// The median.
    pub p50_us: f64,
    /// 90 % are at most this.
    pub p90_us: f64,
    /// 99 % are at most this.
    pub p99_us: f64,
    /// 99.9 % are at most this.
    pub p999_us: f64,
    /// The largest.
    pub max_us: f64,
    /// The mean.
    pub mean_us: f64,
}

impl Default for Latency {
    fn default() -> Self {
        let histogram = Histogram::new_with_bounds(1, MAX_LATENCY_NS, SIGNIFICANT_DIGITS)
            .expect("the bounds are constants that the histogram accepts");
        Self { histogram, clipped: 0 }
    }
}

impl Latency {
    /// Counts a latency from `from_ns` to `to_ns`; one that is negative by clock granularity counts as zero.
    #[inline]
    pub fn record(&mut self, from_ns: u64, to_ns: u64) {
        let ns = to_ns.saturating_sub(from_ns);
        if ns > MAX_LATENCY_NS {
            self.clipped += 1;
        }
        self.histogram.saturating_record(ns);
    }

    /// Counts everything that another one has counted.
    pub fn absorb(&mut self, other: &Self) {
        // Both have the same bounds.
        self.histogram.add(&other.histogram).expect("histograms of equal bounds add up");
        self.clipped += other.clipped;
    }

    /// Whether nothing was counted.
    pub fn is_empty(&self) -> bool {
        self.histogram.is_empty()
    }

    /// The histogram itself, ns.
    pub fn histogram(&self) -> &Histogram<u32> {
        &self.histogram
    }

    /// The figures for a table.
    pub fn percentiles(&self) -> Percentiles {
        let us = |ns: u64| ns as f64 / 1e3;
        let at = |quantile: f64| us(self.histogram.value_at_quantile(quantile));
        Percentiles {
            count: self.histogram.len(),
            clipped: self.clipped,
            min_us: us(self.histogram.min()),
            p50_us: at(0.5),
            p90_us: at(0.9),
            p99_us: at(0.99),
            p999_us: at(0.999),
            max_us: us(self.histogram.max()),
            mean_us: self.histogram.mean() / 1e3,
        }
    }

    /// The histogram in HdrHistogram's V2 encoding, and the count of clipped values.
    pub fn encode(&self) -> (Vec<u8>, u64) {
        let mut bytes = Vec::new();
        V2Serializer::new().serialize(&self.histogram, &mut bytes).expect("memory takes every byte");
        (bytes, self.clipped)
    }

    /// The inverse of [`encode`](Self::encode); `None` if the bytes are no histogram.
    pub fn decode(mut bytes: &[u8], clipped: u64) -> Option<Self> {
        let histogram = Deserializer::new().deserialize(&mut bytes).ok()?;
        Some(Self { histogram, clipped })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keeps_every_value_and_counts_what_it_cannot_resolve() {
        let mut latency = Latency::default();
        for (from, to) in [(0, 1_000), (5_000, 7_000), (9, 3), (0, 2 * MAX_LATENCY_NS)] {
            latency.record(from, to);
        }
        let figures = latency.percentiles();
        assert_eq!((figures.count, figures.clipped, figures.min_us), (4, 1, 0.0));
        assert!((figures.max_us / (MAX_LATENCY_NS as f64 / 1e3) - 1.0).abs() < 1e-3);
        let (bytes, clipped) = latency.encode();
        assert_eq!(Latency::decode(&bytes, clipped).unwrap().percentiles(), figures);
        assert!(Latency::decode(&bytes[1..], 0).is_none());
    }
}

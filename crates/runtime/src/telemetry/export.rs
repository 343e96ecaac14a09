//! Histograms as files that other tools read: percentile tables (`.hgrm`) and interval logs (`.hlog`).

use super::latency::Latency;
use hdrhistogram::serialization::V2DeflateSerializer;
use hdrhistogram::serialization::interval_log::{IntervalLogWriterBuilder, Tag};
use std::io::{self, Write};
use std::time::Duration;

/// Ticks per half distance to 100 %: HdrHistogram's own default resolution.
const TICKS_PER_HALF_DISTANCE: u32 = 5;

/// Writes a percentile distribution in µs as HdrHistogram text, which its plotter reads. The comment goes to the end.
///
/// # Errors
/// Errors of `out`.
pub fn write_hgrm(latency: &Latency, comment: Option<&str>, out: &mut impl Write) -> io::Result<()> {
    let histogram = latency.histogram();
    writeln!(out, "{:>12} {:>14} {:>10} {:>14}\n", "Value", "Percentile", "TotalCount", "1/(1-Percentile)")?;
    let mut total = 0;
    for value in histogram.iter_quantiles(TICKS_PER_HALF_DISTANCE) {
        total += value.count_since_last_iteration();
        let (us, quantile) = (value.value_iterated_to() as f64 / 1e3, value.quantile_iterated_to());
        if quantile < 1.0 {
            writeln!(out, "{us:12.3} {quantile:14.12} {total:10} {:14.2}", 1.0 / (1.0 - quantile))?;
        } else {
            writeln!(out, "{us:12.3} {quantile:14.12} {total:10}")?;
        }
    }
    let us = |ns: f64| ns / 1e3;
    writeln!(out, "#[Mean    = {:12.3}, StdDeviation   = {:12.3}]", us(histogram.mean()), us(histogram.stdev()))?;
    writeln!(out, "#[Max     = {:12.3}, Total count    = {:12}]", us(histogram.max() as f64), histogram.len())?;
    writeln!(out, "#[Buckets = {:12}, SubBuckets     = {:12}]", histogram.buckets(), histogram.distinct_values())?;
    comment.map_or(Ok(()), |comment| writeln!(out, "#[{comment}]"))
}

/// Writes an HdrHistogram log in ns, with one interval of `run_s` seconds per named histogram. The comment goes to the start.
///
/// # Errors
/// Errors of `out`.
pub fn write_hlog<'a>(
    stages: impl IntoIterator<Item = (&'a str, &'a Latency)>,
    run_s: f64,
    comment: Option<&str>,
    out: &mut impl Write,
) -> io::Result<()> {
    let failed = |error: &dyn std::fmt::Debug| io::Error::other(format!("{error:?}"));
    let mut serializer = V2DeflateSerializer::new();
    let mut builder = IntervalLogWriterBuilder::new();
    builder.add_comment("corotate: latencies in nanoseconds, one interval per role and stage");
    if let Some(comment) = comment {
        builder.add_comment(comment);
    }
    let mut log = builder.begin_log_with(out, &mut serializer).map_err(|error| failed(&error))?;
    for (name, latency) in stages {
        let tag = Tag::new(name).ok_or_else(|| io::Error::other(format!("`{name}` cannot be a tag")))?;
        log.write_histogram(latency.histogram(), Duration::ZERO, Duration::from_secs_f64(run_s), Some(tag))
            .map_err(|error| failed(&error))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use base64::{Engine, engine::general_purpose::STANDARD};
    use hdrhistogram::serialization::Deserializer;
    use hdrhistogram::serialization::interval_log::{IntervalLogIterator, LogEntry};

    fn latency() -> Latency {
        let mut latency = Latency::default();
        (1..=1000).for_each(|us| latency.record(0, us * 1000));
        latency
    }

    #[test]
    fn the_percentile_table_ends_at_the_maximum_and_counts_every_value() {
        let mut text = Vec::new();
        write_hgrm(&latency(), None, &mut text).unwrap();
        let text = String::from_utf8(text).unwrap();
        let rows: Vec<Vec<f64>> = text
            .lines()
            .skip(2)
            .filter(|line| !line.starts_with('#'))
            .map(|line| line.split_whitespace().map(|word| word.parse().unwrap()).collect())
            .collect();
        let last = rows.last().unwrap();
        assert!((last[0] - 1000.0).abs() < 1.0 && last[1] == 1.0 && last[2] == 1000.0, "{last:?}");
        let median = rows.iter().find(|row| row[1] >= 0.5).unwrap();
        assert!((median[0] - 500.0).abs() < 1.0, "{median:?}");
        assert!(rows.windows(2).all(|pair| pair[0][0] <= pair[1][0] && pair[0][2] <= pair[1][2]));
    }

    #[test]
    fn the_library_reads_the_log_back() {
        let latency = latency();
        let mut log = Vec::new();
        write_hlog([("leader.step", &latency)], 2.0, None, &mut log).unwrap();
        let mut found = 0;
        for entry in IntervalLogIterator::new(&log) {
            if let LogEntry::Interval(interval) = entry.unwrap() {
                assert_eq!(interval.tag().unwrap().as_str(), "leader.step");
                let bytes = STANDARD.decode(interval.encoded_histogram()).unwrap();
                let read: hdrhistogram::Histogram<u64> = Deserializer::new().deserialize(&mut &bytes[..]).unwrap();
                assert_eq!((read.len(), read.max()), (1000, latency.histogram().max()));
                found += 1;
            }
        }
        assert_eq!(found, 1);
    }
}

//! Measures the connection to a launching host before a run: clock offset, round trip and jitter.

use super::endpoint::Endpoint;
use super::net::{HubSession, NetError, connect_timeout};
use super::offset::{Exchange, OffsetEstimator};
use super::wire::{Message, Payload};
use crate::clock::{monotonic_ns, raw_ns, sleep_until};
use crate::telemetry::{Latency, Percentiles};
use serde::Serialize;

/// Pause between two time requests, ns.
const REQUEST_NS: u64 = 20_000_000;

/// Measurements of the connection to a host.
#[derive(Debug, Clone, Serialize)]
pub struct Probe {
    schema: &'static str,
    /// The host's address.
    pub address: String,
    /// Number of answered time requests.
    pub answered: u64,
    /// Number of time requests without an answer.
    pub unanswered: u64,
    /// The host's clock less this one's, ns; `None` after too few answers.
    pub offset_ns: Option<i64>,
    /// Rate of the host's clock relative to this one's, parts per million.
    pub drift_ppm: Option<f64>,
    /// Bound on the offset's error, µs.
    pub error_us: Option<f64>,
    /// Round trip of a request and its answer, which takes longer than that of samples.
    pub round_trip: Percentiles,
    /// The round trip's 99th percentile less its median, µs.
    pub jitter_us: f64,
}

/// Measures the connection to a host that waits for others to join, for the given time.
///
/// # Errors
/// [`NetError`] if the host does not answer.
pub fn probe(endpoint: &Endpoint, seconds: f64) -> Result<Probe, NetError> {
    let session = HubSession::open(endpoint, connect_timeout(endpoint))?;
    let (mut estimator, mut round_trip) = (OffsetEstimator::default(), Latency::default());
    let (mut answered, mut unanswered, mut failed) = (0, 0, None);
    let end_ns = raw_ns() + (seconds * 1e9) as u64;
    while raw_ns() < end_ns {
        let answer = session.request_time();
        let returned_ns = raw_ns();
        let pong = answer.as_deref().ok().and_then(Message::decode).map(|message| message.payload);
        if let Some(Payload::Pong { sent_ns, received_ns, answered_ns, .. }) = pong {
            let exchange = Exchange { sent_ns, received_ns, answered_ns, returned_ns };
            round_trip.record(0, exchange.round_trip_ns().unwrap_or(0));
            estimator.take(exchange);
            answered += 1;
        } else {
            unanswered += 1;
            failed = answer.err();
        }
        sleep_until(monotonic_ns() + REQUEST_NS);
    }
    if let Some(error) = failed.filter(|_| answered == 0) {
        return Err(error);
    }
    let (estimate, percentiles) = (estimator.at(raw_ns()), round_trip.percentiles());
    Ok(Probe {
        schema: "corotate/link/v1",
        address: endpoint.address.to_string(),
        answered,
        unanswered,
        offset_ns: estimate.map(|estimate| estimate.offset_ns),
        drift_ppm: estimate.map(|estimate| estimate.drift * 1e6),
        error_us: estimate.map(|estimate| estimate.error_ns / 1e3),
        round_trip: percentiles,
        jitter_us: percentiles.p99_us - percentiles.p50_us,
    })
}

impl std::fmt::Display for Probe {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Percentiles { min_us, p50_us, p99_us, max_us, .. } = self.round_trip;
        writeln!(f, "{}: {} time requests answered, {} not", self.address, self.answered, self.unanswered)?;
        writeln!(f, "round trip, us: min {min_us:.0}, p50 {p50_us:.0}, p99 {p99_us:.0}, max {max_us:.0}")?;
        writeln!(f, "jitter (p99 - p50), us: {:.0}", self.jitter_us)?;
        match (self.offset_ns, self.drift_ppm, self.error_us) {
            (Some(offset_ns), Some(drift_ppm), Some(error_us)) => {
                let offset_s = offset_ns as f64 / 1e9;
                writeln!(
                    f,
                    "its clock: ahead by {offset_s:.6} s, error at most {error_us:.1} us, drift {drift_ppm:.2} ppm"
                )
            }
            _ => writeln!(f, "its clock: unknown after too few answers; use --seconds 2 or more"),
        }
    }
}

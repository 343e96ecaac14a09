//! What can be said of the way to a host before a run: how far its clock is, how long messages take, how evenly.

use super::net::{Inquiry, NetError, patience};
use super::offset::{Exchange, OffsetEstimator};
use super::seat::Endpoint;
use super::wire::{Message, What};
use crate::clock::{monotonic_ns, raw_ns, sleep_until};
use crate::telemetry::{Latency, Percentiles};
use serde::Serialize;

/// Between two questions, ns.
const ASK_NS: u64 = 20_000_000;

/// What was found out about the way to a host.
#[derive(Debug, Clone, Serialize)]
pub struct Probe {
    schema: &'static str,
    /// Where it listens.
    pub address: String,
    /// Questions for the time that were answered, and those that were not.
    pub answered: u64,
    /// See `answered`.
    pub unanswered: u64,
    /// The clock there less the clock here, ns; none of too few answers.
    pub offset_ns: Option<i64>,
    /// How much faster the clock there goes, parts per million.
    pub drift_ppm: Option<f64>,
    /// The offset is wrong by no more than this, µs.
    pub error_us: Option<f64>,
    /// There and back, as a question and its answer: longer than a sample and its like take.
    pub round_trip: Percentiles,
    /// How much longer the slowest in a hundred takes than the usual one, there and back, µs.
    pub jitter_us: f64,
}

/// Asks a host that waits for others to join, for so many seconds.
///
/// # Errors
/// [`NetError`] if there is none.
pub fn probe(endpoint: &Endpoint, seconds: f64) -> Result<Probe, NetError> {
    let inquiry = Inquiry::open(endpoint, patience(endpoint))?;
    let (mut estimator, mut round_trip) = (OffsetEstimator::default(), Latency::default());
    let (mut answered, mut unanswered, mut failed) = (0, 0, None);
    let end_ns = raw_ns() + (seconds * 1e9) as u64;
    while raw_ns() < end_ns {
        let answer = inquiry.time();
        let returned_ns = raw_ns();
        let pong = answer.as_deref().ok().and_then(Message::decode).map(|message| message.what);
        if let Some(What::Pong { sent_ns, received_ns, answered_ns, .. }) = pong {
            let exchange = Exchange { sent_ns, received_ns, answered_ns, returned_ns };
            round_trip.record(0, exchange.round_trip_ns().unwrap_or(0));
            estimator.take(exchange);
            answered += 1;
        } else {
            unanswered += 1;
            failed = answer.err();
        }
        sleep_until(monotonic_ns() + ASK_NS);
    }
    if let Some(error) = failed.filter(|_| answered == 0) {
        return Err(error);
    }
    let (estimate, figures) = (estimator.at(raw_ns()), round_trip.percentiles());
    Ok(Probe {
        schema: "corotate/link/v1",
        address: endpoint.address.to_string(),
        answered,
        unanswered,
        offset_ns: estimate.map(|estimate| estimate.offset_ns),
        drift_ppm: estimate.map(|estimate| estimate.drift * 1e6),
        error_us: estimate.map(|estimate| estimate.error_ns / 1e3),
        round_trip: figures,
        jitter_us: figures.p99_us - figures.p50_us,
    })
}

impl std::fmt::Display for Probe {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Percentiles { min_us, p50_us, p99_us, max_us, .. } = self.round_trip;
        writeln!(f, "{}: {} questions answered, {} not", self.address, self.answered, self.unanswered)?;
        writeln!(f, "there and back, us: least {min_us:.0}, p50 {p50_us:.0}, p99 {p99_us:.0}, max {max_us:.0}")?;
        writeln!(f, "jitter, us: {:.0}", self.jitter_us)?;
        match (self.offset_ns, self.drift_ppm, self.error_us) {
            (Some(offset_ns), Some(drift_ppm), Some(error_us)) => {
                let offset_s = offset_ns as f64 / 1e9;
                writeln!(
                    f,
                    "its clock is ahead by {offset_s:.6} s, known to {error_us:.1} us, and drifts by {drift_ppm:.2} ppm"
                )
            }
            _ => writeln!(f, "its clock: too few answers; give --seconds 2 or more"),
        }
    }
}

//! Scores a run from the truth and the estimates. No role in the loop reads both.
//!
//! Must not delay the loop, except through the ticks that it permits in lockstep.

mod response;
mod result;
mod scorer;
mod scoring;
mod timed;

pub use response::StepResponse;
pub use result::{CertificateScore, MetricScore, Score};
pub use scorer::Scorer;
pub(crate) use scorer::score_rig;
pub(crate) use scoring::Scoring;
pub use scoring::lyapunov_floor;
pub use timed::TimedView;
pub(crate) use timed::timed_view;

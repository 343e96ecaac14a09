//! The samples that roles exchange: fixed-size plain data, the same bytes in memory, on the wire and in a recording.
//!
//! Every sample is a `repr(C)` struct of `u64` and `f64` without padding, begins with a [`Stamp`], and has a
//! versioned type name. Its bytes are the little-endian CDR body of the message with the same fields. A change of
//! layout changes the version in the name. Samples must not depend on the transport.

mod applied;
#[cfg(feature = "std")]
mod definition;
mod field;
mod fleet;
mod layout;
mod message;
mod orbit;
mod order;
mod rigid;
mod run;
mod stamp;
pub mod status;

pub use applied::Applied;
#[cfg(feature = "std")]
pub use definition::{CDR_HEADER, Column, Layout, MESSAGE_ENCODING, SCHEMA_ENCODING, frame, topic_of};
pub use field::{Field, FieldKind, FieldType, field_named, is_number, same_name};
pub use fleet::{
    CommandLayout, FleetCommand, FleetLayout, FleetMeasurement, FleetSample, FleetTruth, MeasurementLayout, TruthLayout,
};
pub use layout::{LayoutName, type_name_of};
pub use message::{Message, Sample, content_length, copy_fields};
pub use orbit::{OrbitCommand, OrbitEstimate, OrbitMeasurement, OrbitTruth};
pub use order::{Order, Place};
pub use rigid::{RateCommand, RateEstimate, RateMeasurement, RateTruth};
pub use run::{Health, InputChange, Phase, RoleState, Schedule};
pub use stamp::{NO_SAMPLE, Stamp};

pub use crate::sample;

//! Failures of a role's process.

use crate::bus::BusError;
use crate::bus::domain::DomainError;
use crate::config::ConfigError;
use crate::runtime::{DeviceError, NodeError};
use crate::system::remedy;
use crate::telemetry::LedgerError;
use std::io;
use std::path::PathBuf;

/// A role ended without a report.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum RoleError {
    /// The directory is not a usable domain.
    #[error(transparent)]
    #[strum(transparent)]
    Domain(#[from] DomainError),
    /// The scenario in the domain was refused.
    #[error(transparent)]
    #[strum(serialize = "refused-scenario")]
    Config(#[from] ConfigError),
    /// Only a part of the run's signals exists on this host.
    #[error("the run in {} was launched on another host, and only a part of its signals exists here; join it on that host", .0.display())]
    #[strum(serialize = "partial-run")]
    Part(PathBuf),
    /// The scenario has no such role.
    #[error("there is no role `{role}` in this scenario; it has: {known}")]
    NoSuchRole {
        /// As given.
        role: String,
        /// The existing roles.
        known: String,
    },
    /// The role shares the process of another role.
    #[error(
        "in this run {role} runs in the process of {host} (launch.processes); start that one, or give each a process of its own"
    )]
    #[strum(serialize = "hosted-role")]
    Hosted {
        /// As given.
        role: String,
        /// The role that the process is named after.
        host: String,
    },
    /// The run uses another scenario.
    #[error("the run in {} uses another scenario or other overrides; give its scenario file, {}", domain.display(), scenario.display())]
    OtherScenario {
        /// The domain's directory.
        domain: PathBuf,
        /// The scenario of its run.
        scenario: PathBuf,
    },
    /// A device cannot have these roles.
    #[error(
        "a device cannot be `{roles}`; name one driven body (here: {driven}), observer, controller, or observer,controller, none of \
         which may serve a fleet"
    )]
    #[strum(serialize = "no-device-role")]
    NoDevice {
        /// As given.
        roles: String,
        /// The driven bodies that are not fleets.
        driven: String,
    },
    /// The controller reads an estimate that the protocol of devices does not carry.
    #[error(
        "a device cannot be the controller here: that reads the own estimate of {body}, which a device does not receive; take {body} \
         out of `observed`, or run the controller as a program"
    )]
    DeviceReadsOwn {
        /// The driven body with an observer of its own.
        body: String,
    },
    /// The device failed or cannot take part.
    #[error(transparent)]
    #[strum(transparent)]
    Device(#[from] DeviceError),
    /// A link failed.
    #[error(transparent)]
    #[strum(transparent)]
    Bus(#[from] BusError),
    /// The node cannot continue.
    #[error(transparent)]
    #[strum(transparent)]
    Node(#[from] NodeError),
    /// The ledger could not be opened.
    #[error(transparent)]
    #[strum(transparent)]
    Ledger(#[from] LedgerError),
    /// The launcher did not publish the awaited phase in time.
    #[error("the launcher was silent for {waited_s} s; is `corotate run` alive in this domain?")]
    NoLauncher {
        /// Waiting time, s.
        waited_s: f64,
    },
    /// The program that computes the role's samples is gone before the ticks.
    #[error("no program computes this role: {reason}; start it again")]
    #[strum(serialize = "no-seat-program")]
    SeatProgram {
        /// The reason.
        reason: String,
    },
    /// The samples of the role do not fit into a frame.
    #[error("the samples of {role} take {bytes} bytes per tick, and a frame holds {limit}; drive fewer bodies")]
    #[strum(serialize = "frame-too-long")]
    FrameTooLong {
        /// The role.
        role: String,
        /// Length of a frame of the role, bytes.
        bytes: usize,
        /// Longest frame, bytes.
        limit: usize,
    },
    /// The role serves a fleet.
    #[error("a function cannot compute {role}, which serves a fleet; give its bodies roles of their own")]
    #[strum(serialize = "fleet-role")]
    Fleet {
        /// The role's name.
        role: String,
    },
    /// The run no longer exists, and its launcher sent no stop.
    #[error("the run no longer exists: its launcher was killed; start it again")]
    #[strum(serialize = "run-gone")]
    Gone,
    /// The launcher ended the run without waiting for this role.
    #[error(
        "the run ended while this role still ran, because it did not stop in time; the run's incidents give the reason"
    )]
    #[strum(serialize = "run-ended")]
    Late,
    /// The run has a clock of its own, which cannot be read.
    #[error("cannot read the clock of the run in {}: {source}; {}", path.display(), remedy(source))]
    #[strum(serialize = "no-run-clock")]
    Clock {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The list of received changes cannot be read.
    #[error("cannot read the changes of inputs in {}: {source}; {}", path.display(), remedy(source))]
    #[strum(serialize = "no-changes")]
    Changes {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The report could not be written.
    #[error("cannot write the report {}: {source}; {}", path.display(), remedy(source))]
    #[strum(serialize = "cannot-write")]
    Report {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
}

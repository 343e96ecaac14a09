//! Why a link failed.

/// A link failed. The run cannot continue without it.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum BusError {
    /// The shared-memory domain could not be entered.
    #[error("cannot enter the shared-memory domain {domain}: {reason}")]
    #[strum(serialize = "cannot-enter-domain")]
    Domain {
        /// The domain's directory.
        domain: String,
        /// The reason, with a remedy.
        reason: String,
    },
    /// A signal could not be opened.
    #[error("cannot open {service} as {end}: {reason}")]
    #[strum(serialize = "cannot-open-link")]
    Open {
        /// The service's name.
        service: String,
        /// `writer` or `reader`.
        end: &'static str,
        /// The transport's reason.
        reason: String,
    },
    /// A sample could not be sent.
    #[error("cannot send on {service}: {reason}")]
    #[strum(serialize = "cannot-send")]
    Send {
        /// The service's name.
        service: String,
        /// The transport's reason.
        reason: String,
    },
    /// A sample could not be received.
    #[error("cannot receive on {service}: {reason}")]
    #[strum(serialize = "cannot-receive")]
    Receive {
        /// The service's name.
        service: String,
        /// The transport's reason.
        reason: String,
    },
}

//! Opens the ends of signals and repeats attempts that failed for a temporary reason.
//!
//! Must not wait longer than its limit, nor clean up after other processes.

use super::cause;
use super::service::{Ipc, config};
use crate::bus::domain::Domain;
use crate::bus::error::BusError;
use crate::bus::link::Depths;
use crate::bus::names::Topic;
use crate::bus::notifier::Notifiers;
use crate::clock::{monotonic_ns, sleep_until};
use crate::sample::type_name_of;
use iceoryx2::node::Node;
use iceoryx2::port::publisher::PublisherCreateError;
use iceoryx2::port::subscriber::SubscriberCreateError;
use iceoryx2::port::{DegradationAction, DegradationCause, DegradationInfo};
use iceoryx2::service::Service as _;
use iceoryx2::service::builder::blackboard::BlackboardCreateError;
use iceoryx2::service::builder::publish_subscribe::{
    PublishSubscribeCreateError, PublishSubscribeOpenError, PublishSubscribeOpenOrCreateError,
};
use iceoryx2::service::messaging_pattern::MessagingPattern;
use iceoryx2::service::static_config::messaging_pattern::MessagingPattern as PatternDetails;
use std::fmt;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Time limit for the remains of a dead process to be removed by the janitor, ns.
const VACATE_NS: u64 = 2_000_000_000;
/// Pause between two attempts, ns.
const RETRY_NS: u64 = 20_000_000;

/// A node in a run's domain.
pub struct IoxBus {
    pub(super) node: Rc<Node<Ipc>>,
    pub(super) notifiers: Notifiers,
    pub(super) depths: Depths,
    /// True if missing signals are created.
    pub(super) creates: bool,
    pub(super) domain: Domain,
    /// Time limit of an opening, ns.
    pub(super) opening_ns: u64,
}

impl IoxBus {
    /// Opens an end, and repeats the attempt while the failure may be temporary. A signal to this process only
    /// interrupts an attempt; the caller handles the signal.
    pub(super) fn open<T>(
        &self,
        topic: &Topic,
        end: &'static str,
        mut attempt: impl FnMut() -> Result<T, OpenFailure>,
    ) -> Result<T, BusError> {
        let begun_ns = monotonic_ns();
        loop {
            cause::reset();
            let failure = match attempt() {
                Ok(opened) => {
                    let mapped = self.domain.require_own_mappings();
                    return mapped
                        .map(|()| opened)
                        .map_err(|error| self.failed_to_open(topic, end, OpenFailure::never(error)));
                }
                Err(failure) => failure,
            };
            let limit_ns = match failure.retry {
                Retry::Never | Retry::NeverForOtherType => 0,
                Retry::WhenFinished => self.opening_ns,
                Retry::WhenVacated => VACATE_NS.min(self.opening_ns),
            };
            if monotonic_ns() - begun_ns >= limit_ns {
                return Err(self.failed_to_open(topic, end, failure));
            }
            sleep_until(monotonic_ns() + RETRY_NS);
        }
    }

    fn failed_to_open(&self, topic: &Topic, end: &'static str, failure: OpenFailure) -> BusError {
        let OpenFailure { mut reason, retry } = failure;
        if retry == Retry::WhenFinished {
            let limit_s = self.opening_ns as f64 / 1e9;
            let unfinished =
                self.domain.unfinished().iter().map(|path| format!(" {}", path.display())).collect::<String>();
            let files = if unfinished.is_empty() { String::new() } else { format!("; unfinished:{unfinished}") };
            reason = format!("{reason} for {limit_s} s: the process that creates it makes no progress{files}");
        } else if retry != Retry::NeverForOtherType {
            let remedy = format!("is another process of this run its {end}, or of another version?");
            reason = cause::reason(|| format!("{reason}; {remedy}"));
        }
        BusError::Open { service: topic.to_string(), end, reason }
    }

    /// Adds the sample types of the run and of this program to a failure caused by different types.
    pub(super) fn explain(&self, failure: OpenFailure, topic: &Topic, ours: &str) -> OpenFailure {
        if failure.retry != Retry::NeverForOtherType {
            return failure;
        }
        let theirs = self.type_of(topic).unwrap_or_else(|| "another type".to_owned());
        let cause = if type_name_of(&theirs) == type_name_of(ours) {
            "the fields were changed without a new version in the type name"
        } else {
            "the types differ"
        };
        let reason = format!(
            "its samples are `{theirs}` in this run and `{ours}` in this program: {cause}; build all programs of the run from one \
             source, and raise the version in a type name whenever its fields change"
        );
        OpenFailure { reason, ..failure }
    }

    /// Returns the type of a signal's samples in this run, if known.
    fn type_of(&self, topic: &Topic) -> Option<String> {
        let name = topic.to_string().as_str().try_into().ok()?;
        let config = config(self.domain.root(), &self.domain).ok()?;
        let details = Ipc::details(&name, &config, MessagingPattern::PublishSubscribe).ok()??;
        let details = details.static_details.messaging_pattern();
        let PatternDetails::PublishSubscribe(details) = details else { return None };
        Some(details.message_type_details().payload.type_name().to_string())
    }
}

/// Condition under which an opening is repeated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Retry {
    Never,
    /// Never: the signal carries another type.
    NeverForOtherType,
    /// Another process finishes a file, or this process returns from a signal handler.
    WhenFinished,
    /// The janitor removes the remains of a dead process.
    WhenVacated,
}

/// A failed opening.
#[derive(Debug)]
pub(super) struct OpenFailure {
    reason: String,
    retry: Retry,
}

impl OpenFailure {
    pub(super) fn new(error: impl fmt::Debug, retry: Retry) -> Self {
        Self { reason: format!("{error:?}"), retry }
    }

    pub(super) fn never(error: impl fmt::Debug) -> Self {
        Self::new(error, Retry::Never)
    }
}

impl From<PublishSubscribeOpenError> for OpenFailure {
    fn from(error: PublishSubscribeOpenError) -> Self {
        use PublishSubscribeOpenError as Error;
        Self::new(
            error,
            match error {
                Error::Interrupt | Error::HangsInCreation | Error::IsMarkedForDestruction => Retry::WhenFinished,
                Error::ExceedsMaxNumberOfNodes => Retry::WhenVacated,
                Error::IncompatibleTypes => Retry::NeverForOtherType,
                _ => Retry::Never,
            },
        )
    }
}

impl From<PublishSubscribeOpenOrCreateError> for OpenFailure {
    fn from(error: PublishSubscribeOpenOrCreateError) -> Self {
        use PublishSubscribeCreateError as Create;
        use PublishSubscribeOpenOrCreateError as Error;
        match error {
            // A missing service is created. This error means that its creation by another process took too long.
            Error::PublishSubscribeOpenError(PublishSubscribeOpenError::DoesNotExist) => {
                Self::new(error, Retry::WhenFinished)
            }
            Error::PublishSubscribeOpenError(error) => error.into(),
            Error::PublishSubscribeCreateError(
                Create::Interrupt
                | Create::AlreadyExists
                | Create::HangsInCreation
                | Create::IsBeingCreatedByAnotherInstance,
            )
            | Error::SystemInFlux => Self::new(error, Retry::WhenFinished),
            Error::PublishSubscribeCreateError(_) => Self::never(error),
        }
    }
}

impl From<BlackboardCreateError> for OpenFailure {
    fn from(error: BlackboardCreateError) -> Self {
        use BlackboardCreateError as Error;
        let begun = matches!(error, Error::Interrupt | Error::HangsInCreation | Error::IsBeingCreatedByAnotherInstance);
        Self::new(error, if begun { Retry::WhenFinished } else { Retry::Never })
    }
}

impl From<PublisherCreateError> for OpenFailure {
    fn from(error: PublisherCreateError) -> Self {
        let taken = error == PublisherCreateError::ExceedsMaxSupportedPublishers;
        Self::new(error, if taken { Retry::WhenVacated } else { Retry::Never })
    }
}

impl From<SubscriberCreateError> for OpenFailure {
    fn from(error: SubscriberCreateError) -> Self {
        let taken = error == SubscriberCreateError::ExceedsMaxSupportedSubscribers;
        Self::new(error, if taken { Retry::WhenVacated } else { Retry::Never })
    }
}

/// Records whether a new end could connect to all existing ends. The transport only logs a failure and never retries.
#[derive(Clone, Default)]
pub(super) struct Connections {
    failed: Arc<AtomicBool>,
}

impl Connections {
    /// Returns the handler that the transport calls if it cannot connect.
    pub(super) fn failure_handler(
        &self,
    ) -> impl Fn(DegradationCause, &DegradationInfo) -> DegradationAction + Send + 'static {
        let failed = self.failed.clone();
        move |_, _| {
            failed.store(true, Ordering::Relaxed);
            DegradationAction::Warn
        }
    }

    /// Returns the end if it is connected to all others.
    pub(super) fn check<T>(&self, end: T) -> Result<T, OpenFailure> {
        if self.failed.load(Ordering::Relaxed) {
            return Err(OpenFailure {
                reason: "not connected to every process that uses the signal (is /dev/shm full?)".to_owned(),
                // A process that leaves or dies meanwhile is removed soon.
                retry: Retry::WhenVacated,
            });
        }
        Ok(end)
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{bus, topic};
    use super::*;
    use crate::bus::domain::{OwnedDomain, SHARED_MEMORY};
    use std::path::Path;
    use std::time::Duration;

    /// Opens with `until` failed attempts; returns the number of attempts and the result.
    fn attempts(bus: &IoxBus, until: u32, failure: impl Fn() -> OpenFailure) -> (u32, Result<(), BusError>) {
        let mut made = 0;
        let attempt = || {
            made += 1;
            if made > until { Ok(()) } else { Err(failure()) }
        };
        let opened = bus.open(&topic(), "reader", attempt);
        (made, opened)
    }

    #[test]
    fn only_temporary_failures_are_retried() {
        let domain = OwnedDomain::create(0).unwrap();
        let bus = bus(&domain);
        let interrupted = || PublishSubscribeOpenOrCreateError::from(PublishSubscribeOpenError::Interrupt).into();
        assert!(matches!(attempts(&bus, 2, interrupted), (3, Ok(()))));
        let (made, refused) = attempts(&bus, 2, || OpenFailure::never("a signal called Interrupt"));
        assert!(made == 1 && refused.is_err());
    }

    #[test]
    fn a_process_that_leaves_during_an_opening_causes_a_retry() {
        let domain = OwnedDomain::create(0).unwrap();
        let bus = bus(&domain);
        let gone = || {
            let connections = Connections::default();
            connections.failed.store(true, Ordering::Relaxed);
            connections.check(()).unwrap_err()
        };
        assert!(matches!(attempts(&bus, 2, gone), (3, Ok(()))));
    }

    #[test]
    fn an_opening_has_a_limit_and_names_the_unfinished_file() {
        let domain = OwnedDomain::create(0).unwrap();
        let bus = bus(&domain).with_opening_limit(Duration::from_millis(50));
        let path = Path::new(SHARED_MEMORY).join(domain.domain().prefix() + "begun");
        std::fs::write(&path, "").unwrap();
        let (_, refused) = attempts(&bus, u32::MAX, || PublishSubscribeOpenError::HangsInCreation.into());
        let reason = refused.unwrap_err().to_string();
        assert!(reason.contains("0.05 s") && reason.contains(path.to_str().unwrap()), "{reason}");
    }
}

//! A rig behind a table of functions, for code that does not know its type. Every [`Rig`] implements it.
//!
//! Nothing is computed here: each function calls the generic code of a module below.

use crate::analysis::{self, Claim};
use crate::bus::{AnyBus, BusError};
use crate::config::{BodyInfo, InputInfo, Settings};
use crate::direct;
use crate::rig::{CertificateReport, Figure, Picture, Rig, WordView};
use crate::runtime::{ReadyNode, RoleImpl, build_rig};
use crate::score::{Score, Scorer, TimedView, score_rig, timed_view};
use crate::telemetry::{Ledger, RoleReport};
use std::any::Any;
use std::fmt;
use std::sync::Arc;

/// A rig of any type.
pub trait AnyRig: WordView + Any + Send + Sync {
    /// Returns the bodies, without their observers, which are in the settings.
    fn bodies(&self) -> &[BodyInfo];
    /// Returns true if the rig has an estimator for the body with this index.
    fn observes(&self, index: usize) -> bool;
    /// Returns the names of the metrics of a run.
    fn metrics(&self) -> Vec<&'static str>;
    /// Returns the proofs about the closed loop, one per driven body.
    fn certificates(&self) -> Vec<CertificateReport>;
    /// Returns the physical bounds that the guards use.
    fn limits(&self) -> Vec<Figure>;
    /// See [`Rig::ideal`].
    fn ideal(&self) -> Arc<dyn AnyRig>;
    /// Returns the quantities that the controller can watch. A reason is given for each that cannot be watched in this scenario.
    fn monitors(&self) -> Vec<(&'static str, Option<&'static str>)>;
    /// Returns the scenario keys that may change while the loop runs.
    fn inputs(&self) -> Vec<InputInfo>;
    /// Returns notes for readers of the results.
    fn notes(&self) -> Vec<String>;
    /// Returns the pictures of the motion in a report.
    fn pictures(&self) -> Vec<Picture>;
    /// See [`Rig::counterpart`].
    fn counterpart(&self) -> &'static [&'static str];
    /// See [`claims`](super::claims).
    fn claims(&self, settings: &Settings) -> Vec<Claim>;
    /// See [`build`](super::build).
    ///
    /// # Errors
    /// [`BusError::Open`].
    fn node(
        &self,
        settings: &Settings,
        role_impl: RoleImpl,
        bus: AnyBus<'_>,
        ledger: &Ledger,
    ) -> Result<ReadyNode, BusError>;
    /// See [`scorer`](super::scorer).
    ///
    /// # Errors
    /// [`BusError::Open`].
    fn scorer(&self, settings: &Settings, bus: AnyBus<'_>) -> Result<Box<dyn Scorer>, BusError>;
    /// Returns a view of samples as words that follows the inputs of a run.
    fn timed_view(&self, settings: &Settings) -> Box<dyn TimedView>;
    /// Runs the roles in this thread, on samples that stay in place. Returns `None` if the run needs nodes and links.
    fn direct(
        &self,
        settings: &Settings,
        checkpoints: bool,
        proceed: &mut dyn FnMut(u64, f64) -> bool,
    ) -> Option<(Vec<RoleReport>, Score)>;
    /// Returns the ticks per second of the roles without guards, hashes, counters and score; `None` for a loop with a fleet.
    fn roles_alone(&self, settings: &Settings) -> Option<f64>;
}

impl<R: Rig> AnyRig for R {
    fn bodies(&self) -> &[BodyInfo] {
        Rig::bodies(self)
    }

    fn observes(&self, index: usize) -> bool {
        self.estimator_of(index).is_some()
    }

    fn metrics(&self) -> Vec<&'static str> {
        Rig::metrics(self)
    }

    fn certificates(&self) -> Vec<CertificateReport> {
        Rig::certificates(self)
    }

    fn limits(&self) -> Vec<Figure> {
        Rig::limits(self)
    }

    fn ideal(&self) -> Arc<dyn AnyRig> {
        Arc::new(Rig::ideal(self))
    }

    fn monitors(&self) -> Vec<(&'static str, Option<&'static str>)> {
        R::monitors().iter().map(|monitor| (monitor.name, (monitor.absent)(self))).collect()
    }

    fn inputs(&self) -> Vec<InputInfo> {
        Rig::inputs(self)
    }

    fn notes(&self) -> Vec<String> {
        Rig::notes(self)
    }

    fn pictures(&self) -> Vec<Picture> {
        R::pictures()
    }

    fn counterpart(&self) -> &'static [&'static str] {
        Rig::counterpart(self)
    }

    fn claims(&self, settings: &Settings) -> Vec<Claim> {
        analysis::of_rig(self, settings)
    }

    fn node(
        &self,
        settings: &Settings,
        role_impl: RoleImpl,
        bus: AnyBus<'_>,
        ledger: &Ledger,
    ) -> Result<ReadyNode, BusError> {
        match bus {
            AnyBus::Memory(bus) => build_rig(self, settings, role_impl, bus, ledger),
            AnyBus::Shared(bus) => build_rig(self, settings, role_impl, bus, ledger),
        }
    }

    fn scorer(&self, settings: &Settings, bus: AnyBus<'_>) -> Result<Box<dyn Scorer>, BusError> {
        match bus {
            AnyBus::Memory(bus) => score_rig(self, settings, bus),
            AnyBus::Shared(bus) => score_rig(self, settings, bus),
        }
    }

    fn timed_view(&self, settings: &Settings) -> Box<dyn TimedView> {
        timed_view(self, settings)
    }

    fn direct(
        &self,
        settings: &Settings,
        checkpoints: bool,
        proceed: &mut dyn FnMut(u64, f64) -> bool,
    ) -> Option<(Vec<RoleReport>, Score)> {
        direct::run_rig(self, settings, checkpoints, proceed)
    }

    fn roles_alone(&self, settings: &Settings) -> Option<f64> {
        direct::roles_alone(self, settings)
    }
}

impl dyn AnyRig {
    /// Returns the rig if it is of this type.
    pub fn downcast_ref<R: Rig>(&self) -> Option<&R> {
        (self as &dyn Any).downcast_ref()
    }
}

impl fmt::Debug for dyn AnyRig {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("AnyRig").field(&self.bodies()).finish()
    }
}

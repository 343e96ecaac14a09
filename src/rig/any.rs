//! A rig whose types only itself knows: what the program asks of any rig, answered once for every [`Rig`].
//!
//! Must not compute anything: each answer is the generic code of the module that asks.

use super::{BodyInfo, CertificateReport, Figure, Picture, Rig, WordView};
use crate::analysis::{self, Claim};
use crate::bench;
use crate::bus::{AnyBus, BusError};
use crate::config::{Fields, Scenario, fields};
use crate::launch::{Launch, Outcome, Scorer, run_directly, score_rig};
use crate::runtime::{Port, ReadyNode, RoleId, RoleImpl, build_rig, ports_of_rig};
use crate::telemetry::Ledger;
use std::any::Any;
use std::fmt;
use std::sync::Arc;

/// Any rig.
#[derive(Clone)]
pub struct AnyRig(Arc<dyn Face>);

/// What is asked of a rig, whichever it is.
pub(crate) trait Face: WordView + Any + Send + Sync {
    fn bodies(&self) -> &[BodyInfo];
    fn metrics(&self) -> Vec<&'static str>;
    fn certificates(&self) -> Vec<CertificateReport>;
    fn limits(&self) -> Vec<Figure>;
    fn monitors(&self) -> Vec<(&'static str, Option<&'static str>)>;
    fn notes(&self) -> Vec<String>;
    fn pictures(&self) -> Vec<Picture>;
    fn counterpart(&self) -> &'static [&'static str];
    fn fields(&self, role: &str, fleet: Option<usize>) -> Fields;
    fn claims(&self, scenario: &Scenario) -> Vec<Claim>;
    fn ports(&self, scenario: &Scenario, role: RoleId) -> (Vec<Port>, Vec<Port>);
    fn node(
        &self,
        scenario: &Scenario,
        occupant: RoleImpl,
        bus: AnyBus<'_>,
        ledger: &Ledger,
    ) -> Result<ReadyNode, BusError>;
    fn scorer(&self, scenario: &Scenario, bus: AnyBus<'_>) -> Result<Box<dyn Scorer>, BusError>;
    fn direct(&self, scenario: &Scenario, launch: &mut Launch<'_>) -> Option<Outcome>;
    fn arithmetic(&self, scenario: &Scenario, hashed: bool) -> Option<f64>;
}

impl<R: Rig> Face for R {
    fn bodies(&self) -> &[BodyInfo] {
        Rig::bodies(self)
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

    fn monitors(&self) -> Vec<(&'static str, Option<&'static str>)> {
        R::monitors().iter().map(|monitor| (monitor.name, (monitor.absent)(self))).collect()
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

    fn fields(&self, role: &str, fleet: Option<usize>) -> Fields {
        fields::<R>(role, fleet)
    }

    fn claims(&self, scenario: &Scenario) -> Vec<Claim> {
        analysis::of_rig(self, scenario)
    }

    fn ports(&self, scenario: &Scenario, role: RoleId) -> (Vec<Port>, Vec<Port>) {
        ports_of_rig(self, scenario, role)
    }

    fn node(
        &self,
        scenario: &Scenario,
        occupant: RoleImpl,
        bus: AnyBus<'_>,
        ledger: &Ledger,
    ) -> Result<ReadyNode, BusError> {
        match bus {
            AnyBus::Memory(bus) => build_rig(self, scenario, occupant, bus, ledger),
            AnyBus::Shared(bus) => build_rig(self, scenario, occupant, bus, ledger),
        }
    }

    fn scorer(&self, scenario: &Scenario, bus: AnyBus<'_>) -> Result<Box<dyn Scorer>, BusError> {
        match bus {
            AnyBus::Memory(bus) => score_rig(self, scenario, bus),
            AnyBus::Shared(bus) => score_rig(self, scenario, bus),
        }
    }

    fn direct(&self, scenario: &Scenario, launch: &mut Launch<'_>) -> Option<Outcome> {
        run_directly(self, scenario, launch)
    }

    fn arithmetic(&self, scenario: &Scenario, hashed: bool) -> Option<f64> {
        bench::arithmetic_alone(self, scenario, hashed)
    }
}

impl AnyRig {
    /// A rig as any.
    pub fn new(rig: impl Rig) -> Self {
        Self(Arc::new(rig))
    }

    /// The rig, if it is of this type.
    pub fn downcast_ref<R: Rig>(&self) -> Option<&R> {
        (&*self.0 as &dyn Any).downcast_ref()
    }

    /// What only the program's own parts ask of it.
    pub(crate) fn face(&self) -> &dyn Face {
        &*self.0
    }

    /// The bodies; the first is the observed one.
    pub fn bodies(&self) -> &[BodyInfo] {
        self.0.bodies()
    }

    /// The names of all roles, in the order in which one tick passes through them.
    pub fn roles(&self) -> Vec<&str> {
        let controller = self.bodies().iter().any(|body| body.driven).then_some("controller");
        let bodies = self.bodies().iter().map(|body| &*body.name);
        bodies.chain(["observer"]).chain(controller).collect()
    }

    /// What a run is scored by.
    pub fn metrics(&self) -> Vec<&'static str> {
        self.0.metrics()
    }

    /// What is proven of the closed loop.
    pub fn certificates(&self) -> Vec<CertificateReport> {
        self.0.certificates()
    }

    /// The physical bounds that the guards work with.
    pub fn limits(&self) -> Vec<Figure> {
        self.0.limits()
    }

    /// The quantities that the controller can watch, each with the reason why it cannot in this scenario, if so.
    pub fn monitors(&self) -> Vec<(&'static str, Option<&'static str>)> {
        self.0.monitors()
    }

    /// What a report draws of the motion.
    pub fn pictures(&self) -> Vec<Picture> {
        self.0.pictures()
    }

    /// See [`Rig::counterpart`].
    pub fn counterpart(&self) -> &'static [&'static str] {
        self.0.counterpart()
    }

    /// What a reader of the results must know of the scenario.
    pub fn notes(&self) -> Vec<String> {
        self.0.notes()
    }
}

impl fmt::Debug for AnyRig {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("AnyRig").field(&self.bodies()).finish()
    }
}

//! The resources of a run that outlive its roles.

use super::janitor::Janitor;
use crate::bus::domain::OwnedDomain;
use crate::bus::iox::IoxBus;
use std::fmt;

/// The resources of a run that outlive its roles. They are removed in this order when this is dropped: after the
/// results have been written and printed.
pub(super) struct Remains {
    _bus: IoxBus,
    _domain: OwnedDomain,
    _janitor: Janitor,
}

impl Remains {
    pub fn new(bus: IoxBus, domain: OwnedDomain, janitor: Janitor) -> Self {
        Self { _bus: bus, _domain: domain, _janitor: janitor }
    }
}

impl fmt::Debug for Remains {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Remains").field(&self._domain).finish()
    }
}

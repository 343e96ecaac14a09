//! What is still there of a run whose roles have ended.

use super::janitor::Janitor;
use crate::bus::domain::OwnedDomain;
use crate::bus::iox::IoxBus;
use std::fmt;

/// What is still there of a run whose roles have ended. It is removed when this is dropped, in this order: after the
/// results have been written and told.
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

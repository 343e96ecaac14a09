//! The bodies of a scenario and their roles.

use std::borrow::Cow;

/// One body of a rig, or a fleet of them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BodyInfo {
    /// The name of its role, also part of service names.
    pub name: Cow<'static, str>,
    /// True if the controller drives it.
    pub driven: bool,
    /// The number of bodies of a fleet, which share one process and are driven as one; `None` for a single body.
    pub fleet: Option<usize>,
}

impl BodyInfo {
    /// Creates a single body that the controller drives.
    pub const fn driven(name: &'static str) -> Self {
        Self { name: Cow::Borrowed(name), driven: true, fleet: None }
    }

    /// Creates a single body that moves freely.
    pub const fn free(name: &'static str) -> Self {
        Self { name: Cow::Borrowed(name), driven: false, fleet: None }
    }

    /// Returns the number of bodies in its signals.
    pub fn bodies(&self) -> usize {
        self.fleet.unwrap_or(1)
    }
}

/// Returns the names of all roles, in the order in which one tick passes through them.
pub fn role_names(bodies: &[BodyInfo]) -> Vec<&str> {
    let controller = bodies.iter().any(|body| body.driven).then_some("controller");
    bodies.iter().map(|body| &*body.name).chain(["observer"]).chain(controller).collect()
}

//! The bodies of a scenario, and the roles that follow from them.

use std::borrow::Cow;

/// One body of a rig, or a fleet of them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BodyInfo {
    /// The name of its role and its part of service names.
    pub name: Cow<'static, str>,
    /// Whether the controller drives it.
    pub driven: bool,
    /// How many bodies it is, if it is a fleet: many in one process, driven as one.
    pub fleet: Option<usize>,
}

impl BodyInfo {
    /// How many bodies its signals tell of.
    pub fn bodies(&self) -> usize {
        self.fleet.unwrap_or(1)
    }
}

/// Returns the names of all roles, in the order in which one tick passes through them.
pub fn role_names(bodies: &[BodyInfo]) -> Vec<&str> {
    let controller = bodies.iter().any(|body| body.driven).then_some("controller");
    bodies.iter().map(|body| &*body.name).chain(["observer"]).chain(controller).collect()
}

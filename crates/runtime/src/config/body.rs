//! The bodies of a scenario and their roles.

use super::checks::Checks;
use super::error::nearest;
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
    /// The name of the role that observes it: `observer` for the first body, `observer-NAME` for another one; `None` without observer. A
    /// rig leaves it empty, the scenario fills it in.
    pub observer: Option<String>,
}

impl BodyInfo {
    /// Creates a single body that the controller drives.
    pub const fn driven(name: &'static str) -> Self {
        Self { name: Cow::Borrowed(name), driven: true, fleet: None, observer: None }
    }

    /// Creates a single body that moves freely.
    pub const fn free(name: &'static str) -> Self {
        Self { name: Cow::Borrowed(name), driven: false, fleet: None, observer: None }
    }

    /// Returns the number of bodies in its signals.
    pub fn bodies(&self) -> usize {
        self.fleet.unwrap_or(1)
    }
}

/// Returns the names of all roles, in the order in which one tick passes through them.
pub fn role_names(bodies: &[BodyInfo]) -> Vec<&str> {
    let controller = bodies.iter().any(|body| body.driven).then_some("controller");
    let observers = bodies.iter().filter_map(|body| body.observer.as_deref());
    bodies.iter().map(|body| &*body.name).chain(observers).chain(controller).collect()
}

/// Resolves the scenario's list of observed bodies: returns the bodies of a rig with their observers. Without the list the first body
/// alone has one. `observes` tells whether the rig has an estimator for the body with an index.
///
/// The list must name the first body: every law reads its estimate.
pub(crate) fn observe(
    observed: Option<&[String]>,
    bodies: &[BodyInfo],
    observes: impl Fn(usize) -> bool,
    checks: &mut Checks<'_>,
) -> Vec<BodyInfo> {
    let mut bodies = bodies.to_vec();
    if let Some(first) = bodies.first_mut() {
        first.observer = Some("observer".to_owned());
    }
    let Some(observed) = observed else { return bodies };
    let names: Vec<String> = bodies.iter().map(|body| body.name.to_string()).collect();
    let known: Vec<&str> = names.iter().map(String::as_str).collect();
    for (position, name) in observed.iter().enumerate() {
        let key = format!("observed[{position}]");
        let Some(index) = known.iter().position(|body| body == name) else {
            checks.refuse(&key, "unknown-body", format!("there is no body `{name}`; {}", nearest(name, &known)));
            continue;
        };
        checks.require(!observed[..position].contains(name), &key, "given-twice", || {
            format!("`{name}` is in the list already; remove it here")
        });
        let role = format!("observer-{name}");
        checks.require(bodies[index].fleet.is_none(), &key, "fleet-observer", || {
            format!("`{name}` is a fleet, whose bodies have no observers; remove it, or make it a single body")
        });
        checks.require(bodies[index].fleet.is_some() || observes(index), &key, "no-estimator", || {
            format!("the rig has no estimator for `{name}`; remove it, or let the rig return one for it")
        });
        checks.require(index == 0 || !names.contains(&role), &key, "taken-name", || {
            format!("the observer of `{name}` would be called `{role}`, as a body is; rename that body")
        });
        if index > 0 {
            bodies[index].observer = Some(role);
        }
    }
    let first = known.first().is_none_or(|first| observed.iter().any(|name| name == first));
    checks.require(first, "observed", "first-unobserved", || {
        format!("every law reads the estimate of the first body; add \"{}\"", known.first().unwrap_or(&""))
    });
    bodies
}

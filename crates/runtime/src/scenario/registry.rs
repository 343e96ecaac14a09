//! The rigs that scenarios of this program may name.
//!
//! Must not know more of a rig than how it is named, which tables are its own, and how it is made of them.

use super::any::AnyRig;
use crate::config::{Checks, ConfigError, Document, Key, Shape, nearest};
use crate::rig::{Context, OrbitRig, Rig, RigidBodyRig};
use std::sync::Arc;
use std::sync::OnceLock;

/// A rig that scenarios may name.
#[derive(Clone)]
pub struct RigKind {
    names: &'static [&'static str],
    tables: Vec<&'static str>,
    lists: &'static [&'static str],
    resolve: fn(&str, &Document, Context, &mut Checks<'_>) -> Resolved,
}

/// A rig, unless a problem with it was noted, and its tables with every default filled in.
type Resolved = Result<(Option<Arc<dyn AnyRig>>, toml::Table), ConfigError>;

impl RigKind {
    /// That of a rig.
    pub fn new<R: Rig>() -> Self {
        let resolve = |name: &str, sections: &Document, context: Context, checks: &mut Checks<'_>| {
            let (rig, table) = R::resolve(name, sections, context, checks)?;
            Ok((rig.map(|rig| Arc::new(rig) as Arc<dyn AnyRig>), table))
        };
        Self { names: R::NAMES, tables: R::tables(), lists: R::LISTS, resolve }
    }
}

static KINDS: OnceLock<Vec<RigKind>> = OnceLock::new();

/// Makes these the rigs of this program. Must come before its first scenario is read; then it is too late, and false.
pub fn register(kinds: Vec<RigKind>) -> bool {
    KINDS.set(kinds).is_ok()
}

/// The rigs of this crate, compiled with it: a program that names them so does not compile them once more.
pub fn shipped() -> Vec<RigKind> {
    vec![RigKind::new::<RigidBodyRig>(), RigKind::new::<OrbitRig>()]
}

/// The rigs of this program: those of this crate where none were registered.
fn kinds() -> &'static [RigKind] {
    KINDS.get_or_init(shipped)
}

/// The keys of tables that belong to a rig, whichever it is: those that hold one table.
pub(crate) fn tables() -> Vec<&'static str> {
    kinds().iter().flat_map(|kind| &kind.tables).copied().collect()
}

/// The same, and those that hold a list of tables.
pub(crate) fn sections() -> Vec<&'static str> {
    tables().into_iter().chain(kinds().iter().flat_map(|kind| kind.lists).copied()).collect()
}

/// The keys of a scenario that are a rig's own, by the rig's name, as the types read them that the rig makes of them.
pub(crate) fn shapes() -> Vec<(&'static str, Vec<Key>)> {
    let of = |kind: &RigKind, name: &'static str| {
        let sections = Document::asking();
        // It is refused, having asked.
        let _ = (kind.resolve)(
            name,
            &sections,
            Context { tick_s: 1e-3, duration_s: 1.0, seed: 1, actuation_delay_ticks: 1 },
            &mut Checks::new(&sections),
        );
        let unknown = |name: &&'static str| Key { name, required: false, shape: Shape::Any(None) };
        match sections.asked() {
            Some(Shape::Table { keys, .. }) => (name, keys),
            _ => (name, kind.tables.iter().chain(kind.lists).map(unknown).collect()),
        }
    };
    kinds().iter().flat_map(|kind| kind.names.iter().map(move |name| of(kind, name))).collect()
}

/// Resolves the rig's own sections of a scenario. The rig is absent if `checks` noted a problem with it.
///
/// # Errors
/// [`ConfigError`] for keys that are unknown, missing or of the wrong type.
pub(crate) fn resolve(name: &str, sections: &Document, context: Context, checks: &mut Checks<'_>) -> Resolved {
    if let Some(kind) = kinds().iter().find(|kind| kind.names.contains(&name)) {
        return (kind.resolve)(name, sections, context, checks);
    }
    let names: Vec<&str> = kinds().iter().flat_map(|kind| kind.names).copied().collect();
    checks.refuse("rig", "unknown-rig", format!("there is no rig `{name}`; {}", nearest(name, &names)));
    Ok((None, toml::Table::new()))
}

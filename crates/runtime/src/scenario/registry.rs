//! The rigs that scenarios of this program can select.
//!
//! This file knows only a rig's names, its tables, and the function that creates it.

use super::any::AnyRig;
use crate::config::{Checks, ConfigError, Document, Key, Shape, nearest};
use crate::rig::{Context, OrbitRig, Rig, RigidBodyRig};
use std::sync::Arc;
use std::sync::OnceLock;

/// A rig that scenarios can select.
#[derive(Clone)]
pub struct RigKind {
    names: &'static [&'static str],
    tables: Vec<&'static str>,
    lists: &'static [&'static str],
    resolve: fn(&str, &Document, Context, &mut Checks<'_>) -> Resolved,
}

/// A rig and its tables with every default filled in. The rig is `None` if a problem with it was recorded.
type Resolved = Result<(Option<Arc<dyn AnyRig>>, toml::Table), ConfigError>;

impl RigKind {
    /// Creates the entry of the rig `R`.
    pub fn new<R: Rig>() -> Self {
        let resolve = |name: &str, sections: &Document, context: Context, checks: &mut Checks<'_>| {
            let (rig, table) = R::resolve(name, sections, context, checks)?;
            Ok((rig.map(|rig| Arc::new(rig) as Arc<dyn AnyRig>), table))
        };
        Self { names: R::NAMES, tables: R::tables(), lists: R::LISTS, resolve }
    }
}

static KINDS: OnceLock<Vec<RigKind>> = OnceLock::new();

/// Sets the rigs of this program. Returns false, with no effect, if a scenario has been read before.
pub fn register(kinds: Vec<RigKind>) -> bool {
    KINDS.set(kinds).is_ok()
}

/// Returns the rigs of this crate. They are compiled with it, so a program that calls this function does not compile them again.
pub fn shipped() -> Vec<RigKind> {
    vec![RigKind::new::<RigidBodyRig>(), RigKind::new::<OrbitRig>()]
}

/// Returns the registered rigs, or those of this crate if none were registered.
fn kinds() -> &'static [RigKind] {
    KINDS.get_or_init(shipped)
}

/// Returns the keys of all rigs that hold one table.
pub(crate) fn tables() -> Vec<&'static str> {
    kinds().iter().flat_map(|kind| &kind.tables).copied().collect()
}

/// Returns the keys of all rigs that hold a table or a list of tables.
pub(crate) fn sections() -> Vec<&'static str> {
    tables().into_iter().chain(kinds().iter().flat_map(|kind| kind.lists).copied()).collect()
}

/// Returns every rig name with the keys of its own, as the types that read them define.
pub(crate) fn shapes() -> Vec<(&'static str, Vec<Key>)> {
    let keys_of_rig = |kind: &RigKind, name: &'static str| {
        let sections = Document::asking();
        // The document is empty, so this fails after it has recorded what was asked for.
        let _ = (kind.resolve)(name, &sections, Context::every_tick(1e-3), &mut Checks::new(&sections));
        let unknown = |name: &&'static str| Key { name, required: false, shape: Shape::Any(None) };
        match sections.asked() {
            Some(Shape::Table { keys, .. }) => (name, keys),
            _ => (name, kind.tables.iter().chain(kind.lists).map(unknown).collect()),
        }
    };
    kinds().iter().flat_map(|kind| kind.names.iter().map(move |name| keys_of_rig(kind, name))).collect()
}

/// Resolves the tables of the rig with this name. The rig is `None` if `checks` recorded a problem with it.
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

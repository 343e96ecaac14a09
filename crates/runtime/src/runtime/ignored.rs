//! Changes of inputs that a role ignores because a program runs it that takes no inputs. Must not know how a program shows that.

use super::role_id::RoleId;
use crate::config::{InputInfo, Settings};

/// Returns the reason why an input cannot change: a role that uses it, for which `ignores` returns true. `None` if every role takes it.
pub fn ignoring_role(scenario: &Settings, info: &InputInfo, ignores: &dyn Fn(RoleId) -> bool) -> Option<String> {
    let role = info.uses.iter().flat_map(|by| RoleId::using(scenario, by.user)).find(|role| ignores(*role))?;
    let (key, name) = (&info.key, role.name(scenario));
    Some(format!(
        "{key} is used by {name}, which another program runs: a device, another host, or a program that does not use this library \
         takes no changes of inputs"
    ))
}

/// Returns the reasons of [`ignoring_role`] for the changes of a scenario, one per input.
pub fn ignored_changes(scenario: &Settings, ignores: &dyn Fn(RoleId) -> bool) -> Vec<String> {
    let inputs = &scenario.inputs;
    let is_changed = |number: usize| inputs.scripted.iter().any(|change| change.input == number);
    let changed = inputs.infos.iter().enumerate().filter(|(number, _)| is_changed(*number));
    changed.filter_map(|(_, info)| ignoring_role(scenario, info, ignores)).collect()
}

//! The current values of a scenario's inputs that a role uses, for a function that computes the role.
//!
//! Must not allocate after it was created.

use super::role_id::RoleId;
use super::role_inputs::RoleInputs;
use crate::config::{InputInfo, InputUse, Inputs};

/// The place of an input among the values of a role.
#[derive(Debug, Clone, Copy)]
pub struct RoleValue<'a> {
    /// The input: key, meaning, initial values.
    pub info: &'a InputInfo,
    /// The use by the role; the first one of several.
    used: InputUse,
    /// The index of its first component.
    pub index: usize,
}

/// Returns the inputs that a role uses, in the order of their values.
pub fn role_values(inputs: &Inputs, role: RoleId) -> Vec<RoleValue<'_>> {
    let (mut used_inputs, mut index) = (Vec::new(), 0);
    for info in &inputs.infos {
        if let Some(used) = info.use_by(|user| role.takes(user)) {
            used_inputs.push(RoleValue { info, used, index });
            index += info.initial.len();
        }
    }
    used_inputs
}

/// The values at the current tick of the inputs that a role uses.
#[derive(Debug)]
pub struct CurrentValues {
    inputs: RoleInputs,
    places: Vec<(InputUse, usize)>,
    values: Vec<f64>,
}

impl CurrentValues {
    /// Collects the inputs that a role uses, with their values at the first tick.
    pub fn new(inputs: &Inputs, role: RoleId) -> Self {
        let used = role_values(inputs, role);
        Self {
            inputs: RoleInputs::new(inputs, |user| role.takes(user)),
            places: used.iter().map(|value| (value.used, value.index)).collect(),
            values: used.iter().flat_map(|value| value.info.initial.iter().copied()).collect(),
        }
    }

    /// Returns the values at a tick, in the order of [`role_values`]. Ticks do not decrease.
    pub fn at(&mut self, tick: u64) -> &[f64] {
        if self.inputs.is_due(tick) {
            let (places, values) = (&self.places, &mut self.values);
            self.inputs.advance(tick, |new| {
                if let Some((_, index)) = places.iter().find(|(used, _)| *used == new.by) {
                    values[*index..][..new.values.len()].copy_from_slice(new.values);
                }
            });
        }
        &self.values
    }
}

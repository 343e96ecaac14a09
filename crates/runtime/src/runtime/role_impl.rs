//! Who takes a role's seat.

use super::device::DeviceLink;
use super::role_function::RoleFunction;
use super::role_id::RoleId;
use crate::telemetry::Ledger;

/// Who takes a role's seat.
pub enum RoleImpl {
    /// This program, with other roles in the same process: these, in the order of a tick, with their ledgers.
    Role(RoleId, Vec<(RoleId, Ledger)>),
    /// This program's node, whose samples a function computes.
    Function(RoleId, Box<dyn RoleFunction>),
    /// A device: a role, with others in the same device, as above.
    Device(RoleId, Vec<(RoleId, Ledger)>, Box<DeviceLink>),
}

impl RoleImpl {
    /// The seat.
    pub fn role(&self) -> RoleId {
        match self {
            Self::Role(role, _) | Self::Function(role, _) | Self::Device(role, ..) => *role,
        }
    }

    /// Its roles with their ledgers, in the order of a tick; `ledger` is that of the seat.
    pub(crate) fn ledgers(&self, ledger: &Ledger) -> Vec<(RoleId, Ledger)> {
        let others = match self {
            Self::Role(_, others) | Self::Device(_, others, _) => &others[..],
            Self::Function(..) => &[],
        };
        let others = others.iter().map(|(role, ledger)| (*role, ledger.reopened()));
        others.chain([(self.role(), ledger.reopened())]).collect()
    }
}

impl From<RoleId> for RoleImpl {
    fn from(role: RoleId) -> Self {
        Self::Role(role, Vec::new())
    }
}

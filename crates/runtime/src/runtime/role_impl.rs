//! The implementation of a role: built in, a function, or a device.

use super::device::DeviceLink;
use super::role_function::RoleFunction;
use super::role_id::RoleId;
use crate::telemetry::Ledger;

/// The implementation of a role.
pub enum RoleImpl {
    /// The built-in role, with the other roles of its process in the order of a tick, each with its ledger.
    Role(RoleId, Vec<(RoleId, Ledger)>),
    /// A node of this program whose samples a function computes.
    Function(RoleId, Box<dyn RoleFunction>),
    /// A device, with its other roles in the order of a tick, each with its ledger.
    Device(RoleId, Vec<(RoleId, Ledger)>, Box<DeviceLink>),
}

impl RoleImpl {
    /// Returns the role of the process.
    pub fn role(&self) -> RoleId {
        match self {
            Self::Role(role, _) | Self::Function(role, _) | Self::Device(role, ..) => *role,
        }
    }

    /// Returns all roles with their ledgers, in the order of a tick; `ledger` is that of [`role`](Self::role).
    pub(crate) fn ledgers(&self, ledger: &Ledger) -> Vec<(RoleId, Ledger)> {
        let companions = match self {
            Self::Role(_, companions) | Self::Device(_, companions, _) => &companions[..],
            Self::Function(..) => &[],
        };
        let companions = companions.iter().map(|(role, ledger)| (*role, ledger.reopened()));
        companions.chain([(self.role(), ledger.reopened())]).collect()
    }
}

impl From<RoleId> for RoleImpl {
    fn from(role: RoleId) -> Self {
        Self::Role(role, Vec::new())
    }
}

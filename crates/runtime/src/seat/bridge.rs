//! A device in a role's seat: the process that serves it to the end of the run.

use super::process::{
    RoleError, device_failure_path, failure_path, find_role, in_domain, join, require_process, take_ledger, write_whole,
};
use crate::config::{ClockKind, Settings};
use crate::runtime::{DeviceConfig, DeviceLink, NodeError, RoleId, RoleImpl};
use crate::serial::LineCounters;
use crate::telemetry::Outage;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// The result of a device's run.
#[derive(Debug, Clone)]
pub struct BridgeResult {
    /// The line's counters.
    pub counters: LineCounters,
    /// When the device was absent.
    pub outages: Vec<Outage>,
    /// Why the device was lost to the run, if it was: at the end, or in real time for longer than commands last.
    pub lost: Option<String>,
}

/// The seat's roles, in the order of a tick, if a device can have them: one that travels in samples of fixed size, or observer
/// and controller together.
fn roles(scenario: &Settings, names: &[String]) -> Result<Vec<RoleId>, RoleError> {
    let mut roles = names.iter().map(|name| find_role(scenario, name)).collect::<Result<Vec<_>, _>>()?;
    roles.sort_by_key(|role| *role == RoleId::Controller);
    let bodies = &scenario.bodies;
    let single = |index: usize| bodies[index].fleet.is_none();
    let fits = match roles[..] {
        [RoleId::Plant(index)] => bodies[index].driven && single(index),
        [RoleId::Observer] => true,
        [RoleId::Controller] | [RoleId::Observer, RoleId::Controller] => (0..bodies.len()).all(single),
        _ => false,
    };
    if fits {
        return Ok(roles);
    }
    let driven = bodies.iter().filter(|body| body.driven && body.fleet.is_none()).map(|body| &*body.name);
    let driven = driven.collect::<Vec<_>>().join(", ");
    Err(RoleError::NoDevice { roles: names.join(","), driven })
}

/// The file in a domain's directory with the name of the device that has a seat, for a bridge that is started again.
fn device_path(root: &Path, roles: &str) -> PathBuf {
    root.join(format!("{roles}.device"))
}

/// Puts a device into a role's seat and serves it to the end of the run. `welcomed` is told the device's name.
/// Gives an account of it, if a run was served.
///
/// # Errors
/// [`RoleError`].
pub fn run_bridge(
    seat: &DeviceConfig,
    terminated: &AtomicBool,
    welcomed: impl FnOnce(&str),
) -> Result<Option<BridgeResult>, RoleError> {
    let (domain, scenario) = join(&seat.domain)?;
    let roles = roles(&scenario, &seat.roles)?;
    roles.iter().try_for_each(|role| require_process(&scenario, *role))?;
    // A bridge that is started again in the same run finds a device that knows it.
    let run = xxhash_rust::xxh3::xxh3_64(domain.root().as_os_str().as_encoded_bytes());
    let mut link = DeviceLink::open(seat, &scenario, &roles, run)?;
    let known = device_path(domain.root(), link.role());
    let before = std::fs::read_to_string(&known).ok();
    let Some(name) = link.greet(before, terminated)? else { return Ok(None) };
    welcomed(&format!("{name}{}", link.remark()));
    write_whole(&known, name.as_bytes()).map_err(|source| RoleError::Report { path: known.clone(), source })?;
    let (last, others) = roles.split_last().expect("a seat has a role");
    let others = others.iter().map(|other| Ok((*other, take_ledger(&domain, &scenario, *other)?)));
    let others = others.collect::<Result<_, RoleError>>()?;
    let (mut served, role_impl) = (None, RoleImpl::Device(*last, others, Box::new(link)));
    let done = in_domain(&domain, &scenario, role_impl, terminated, |report| {
        if let Some(counters) = report.line {
            let lost = report.outages.iter().rev().find_map(|outage| lost(outage, &scenario));
            served = Some(BridgeResult { counters, outages: report.outages.clone(), lost });
        }
    });
    if let Err(RoleError::Node(NodeError::Device(error))) = &done {
        // For the launcher, which has no line to it. If the run is gone, the caller is told all the same.
        for role in &roles {
            let path = if scenario.clock == ClockKind::Realtime { device_failure_path } else { failure_path };
            let _ = write_whole(&path(domain.root(), role.name(&scenario)), error.to_string().as_bytes());
        }
    }
    done.map(|()| served)
}

/// Returns why an outage has cost the run its device, if it has.
fn lost(outage: &Outage, scenario: &Settings) -> Option<String> {
    let timeout_s = scenario.command_timeout_ticks as f64 * scenario.tick_s();
    let Outage { tick, cause, .. } = outage;
    let at_s = scenario.time_s(*tick);
    match outage.back_at_tick {
        None => Some(format!("at tick {tick} ({at_s:.3} s) {cause}, to the end of the run")),
        Some(back) if scenario.clock == ClockKind::Realtime && outage.seconds > timeout_s => {
            Some(format!("at tick {tick} ({at_s:.3} s) {cause}; it answered again at tick {back}"))
        }
        Some(_) => None,
    }
}

//! A device in the place of a role: the process that serves it until the end of the run.

use super::error::RoleError;
use super::paths::{device_failure_path, failure_path, take_ledger, write_whole};
use super::process::{find_role, in_domain, join, require_process};
use crate::config::{BodyInfo, ClockKind, Settings};
use crate::runtime::{DeviceConfig, DeviceError, DeviceLink, NodeError, Pace, RoleId, RoleImpl};
use crate::serial::LineCounters;
use crate::telemetry::{Outage, PaceReport};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// The result of a device's run.
#[derive(Debug, Clone)]
pub struct BridgeResult {
    /// The line's counters.
    pub counters: LineCounters,
    /// The outages of the device.
    pub outages: Vec<Outage>,
    /// The relation of the run's clock to the device, if that sets the pace.
    pub pace: Option<PaceReport>,
    /// Reason if the device was lost: at the end of the run, or in real time for longer than the command timeout.
    pub lost: Option<String>,
}

/// Returns the roles in the order of a tick if a device can have them: one role whose samples have a fixed size, or
/// observer and controller together.
fn roles(scenario: &Settings, names: &[String]) -> Result<Vec<RoleId>, RoleError> {
    let mut roles = names.iter().map(|name| find_role(scenario, name)).collect::<Result<Vec<_>, _>>()?;
    roles.sort_by_key(|role| *role == RoleId::Controller);
    let bodies = &scenario.bodies;
    let single = |index: usize| bodies[index].fleet.is_none();
    let fits = match roles[..] {
        [RoleId::Plant(index)] => bodies[index].driven && single(index),
        [RoleId::Observer(_)] => true,
        [RoleId::Controller] | [RoleId::Observer(0), RoleId::Controller] => (0..bodies.len()).all(single),
        _ => false,
    };
    let self_observed = |body: &&BodyInfo| body.driven && body.observer.is_some();
    if let (true, Some(body)) = (roles.contains(&RoleId::Controller), bodies.iter().skip(1).find(self_observed)) {
        return Err(RoleError::DeviceReadsOwn { body: body.name.to_string() });
    }
    if fits {
        return Ok(roles);
    }
    let driven = bodies.iter().filter(|body| body.driven && body.fleet.is_none()).map(|body| &*body.name);
    let driven = driven.collect::<Vec<_>>().join(", ");
    Err(RoleError::NoDevice { roles: names.join(","), driven })
}

/// Returns the file in a domain's directory with the device's name, for a bridge that is restarted.
fn device_path(root: &Path, roles: &str) -> PathBuf {
    root.join(format!("{roles}.device"))
}

/// Runs a device in place of its roles until the end of the run. Calls `welcomed` with the device's name; returns the
/// result if a run was served.
///
/// # Errors
/// [`RoleError`].
pub fn run_bridge(
    config: &DeviceConfig,
    terminated: &AtomicBool,
    welcomed: impl FnOnce(&str),
) -> Result<Option<BridgeResult>, RoleError> {
    let (domain, scenario) = join(&config.domain)?;
    let roles = roles(&scenario, &config.roles)?;
    roles.iter().try_for_each(|role| require_process(&scenario, *role))?;
    // A bridge that is restarted in the same run has the same run number.
    let run = xxhash_rust::xxh3::xxh3_64(domain.root().as_os_str().as_encoded_bytes());
    let mut link = DeviceLink::open(config, &scenario, &roles, run)?;
    let known = device_path(domain.root(), link.role());
    let before = std::fs::read_to_string(&known).ok();
    let Some(name) = link.greet(before, terminated)? else { return Ok(None) };
    if let Some(options) = config.pace {
        if !matches!(roles[..], [RoleId::Plant(_)]) {
            return Err(DeviceError::PaceRole { role: link.role().to_owned() }.into());
        }
        if !link.follow(Pace::open(&domain, &scenario, options)?, terminated)? {
            return Ok(None);
        }
    }
    welcomed(&format!("{name}{}", link.remark()));
    write_whole(&known, name.as_bytes()).map_err(|source| RoleError::Report { path: known.clone(), source })?;
    let (last, companions) = roles.split_last().expect("a device has a role");
    let companions = companions.iter().map(|role| Ok((*role, take_ledger(&domain, &scenario, *role)?)));
    let companions = companions.collect::<Result<_, RoleError>>()?;
    let (mut served, role_impl) = (None, RoleImpl::Device(*last, companions, Box::new(link)));
    let done = in_domain(&domain, &scenario, role_impl, terminated, |report| {
        if let Some(counters) = report.line {
            let lost = report.outages.iter().rev().find_map(|outage| lost(outage, &scenario));
            served = Some(BridgeResult { counters, outages: report.outages.clone(), pace: report.pace.clone(), lost });
        }
    });
    if let Err(RoleError::Node(NodeError::Device(error))) = &done {
        // For the launcher, which has no other connection to this process. The caller gets the error in any case.
        for role in &roles {
            let ends = scenario.clock != ClockKind::Realtime || matches!(error, DeviceError::PaceLost { .. });
            let path = if ends { failure_path } else { device_failure_path };
            let _ = write_whole(&path(domain.root(), role.name(&scenario)), error.to_string().as_bytes());
        }
    }
    done.map(|()| served)
}

/// Returns the reason if an outage has cost the run its device.
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

//! Checks of the keys that every scenario has, whatever its rig.

use super::checks::Checks;
use super::error::nearest;
use super::raw::{ClockKind, Cores, Launch, Policy, Raw, Realtime, Supervision};
use super::settings::NotExternal;
use crate::control::ACTUATION_DELAY_MAX;

/// The slowest tick rate: a period must lie well within the range of a latency histogram.
const MIN_TICK_HZ: f64 = 0.1;
/// The fastest tick rate: beyond it, reading the clock alone fills the period.
pub(crate) const MAX_TICK_HZ: f64 = 1e5;
/// The largest number of ticks of a run: ten years at 1 kHz.
const MAX_TICKS: f64 = 3.2e11;

/// Returns true if the tick rate is within the limits.
pub(crate) fn tick_possible(tick_hz: f64) -> bool {
    (MIN_TICK_HZ..=MAX_TICK_HZ).contains(&tick_hz)
}

/// Returns true if the number of ticks is within the limits, or unknown because the tick rate is refused.
pub(crate) fn length_possible(raw: &Raw) -> bool {
    !tick_possible(raw.tick_hz) || (1.0..=MAX_TICKS).contains(&(raw.duration_s * raw.tick_hz))
}

/// Checks everything that no rig is needed for.
pub(crate) fn check(raw: &Raw, checks: &mut Checks<'_>) {
    let named = !raw.name.is_empty()
        && raw.name.len() <= 32
        && raw.name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-');
    checks.require(named, "name", "bad-name", || {
        format!("`{}` cannot name services and files; use 1 to 32 of a-z, 0-9 and -", raw.name)
    });
    checks.require(tick_possible(raw.tick_hz), "tick_hz", "out-of-range", || {
        format!(
            "{} Hz is outside the range of tick rates; give a rate from {MIN_TICK_HZ} to {MAX_TICK_HZ} Hz",
            raw.tick_hz
        )
    });
    checks.require(length_possible(raw), "duration_s", "out-of-range", || {
        let ticks = raw.duration_s * raw.tick_hz;
        format!("{} s is {ticks} ticks; give a length of 1 to {MAX_TICKS:e} ticks", raw.duration_s)
    });
    checks.require(
        (1..=ACTUATION_DELAY_MAX).contains(&raw.actuation_delay_ticks),
        "actuation_delay_ticks",
        "out-of-range",
        || {
            format!(
                "a command cannot act {} ticks after its measurement; give 1 (the next tick) to {ACTUATION_DELAY_MAX}",
                raw.actuation_delay_ticks
            )
        },
    );
    checks.require(raw.actuator.command_timeout_ticks >= 1, "actuator.command_timeout_ticks", "out-of-range", || {
        "0 would apply the safe command at every tick; give at least 1".to_owned()
    });
    check_realtime(&raw.realtime, checks);
    check_supervision(&raw.supervision, checks);
    checks.require(
        (0.1..=3600.0).contains(&raw.launch.startup_timeout_s),
        "launch.startup_timeout_s",
        "out-of-range",
        || format!("{} s is out of range; give 0.1 to 3600", raw.launch.startup_timeout_s),
    );
    if let Some(timeout_s) = raw.launch.external_timeout_s {
        checks.require((0.1..=604_800.0).contains(&timeout_s), "launch.external_timeout_s", "out-of-range", || {
            format!("{timeout_s} s is out of range; give 0.1 to 604800, or remove it")
        });
    }
}

fn check_supervision(supervision: &Supervision, checks: &mut Checks<'_>) {
    let (heartbeat_s, interval_s) = (supervision.heartbeat_timeout_s, supervision.restart_interval_s);
    checks.require((0.1..=3600.0).contains(&heartbeat_s), "supervision.heartbeat_timeout_s", "out-of-range", || {
        format!("{heartbeat_s} s is out of range (heartbeats are due every 0.02 s); give 0.1 to 3600")
    });
    checks.require((0.0..=3600.0).contains(&interval_s), "supervision.restart_interval_s", "out-of-range", || {
        format!("{interval_s} s is out of range; give 0 to 3600")
    });
    checks.require(supervision.restarts_max <= 1000, "supervision.restarts_max", "out-of-range", || {
        format!("{} restarts of one role are too many; give 0 to 1000", supervision.restarts_max)
    });
}

/// Checks external and debugged roles. Without a rig, the roles are unknown and not checked.
pub(crate) fn check_external(raw: &Raw, roles: Option<Vec<&str>>, checks: &mut Checks<'_>) {
    let Launch { external, debug, .. } = &raw.launch;
    checks.require(external.is_empty() || raw.clock != ClockKind::InProcess, "launch.external", "one-process", || {
        "an in-process run has no external roles; give clock = \"realtime\" or \"lockstep\", or leave it empty"
            .to_owned()
    });
    checks.require(debug.is_empty() || raw.clock != ClockKind::InProcess, "launch.debug", "one-process", || {
        "all roles share one process: start it in a debugger, as `gdb --args corotate run …`, or give clock = \"lockstep\"".to_owned()
    });
    for (index, role) in debug.iter().enumerate().filter(|(_, role)| external.contains(role)) {
        let refused = Err(NotExternal::DebuggedAndExternal { role: role.clone() });
        checks.accept::<(), _>(&format!("launch.debug[{index}]"), refused);
    }
    let Some(roles) = roles else { return };
    check_processes(&raw.launch, &roles, checks);
    for (key, names) in [("external", external), ("debug", debug)] {
        for (index, role) in names.iter().enumerate().filter(|(_, role)| !roles.contains(&role.as_str())) {
            let known = roles.join(", ");
            checks.refuse(
                &format!("launch.{key}[{index}]"),
                "unknown-role",
                format!("there is no role `{role}`; this scenario has: {known}"),
            );
        }
    }
}

/// Checks that every listed role exists, is listed once, and is not external.
fn check_processes(launch: &Launch, roles: &[&str], checks: &mut Checks<'_>) {
    let mut taken = Vec::new();
    for (process, names) in launch.processes.iter().enumerate() {
        let key = format!("launch.processes[{process}]");
        checks.require(names.len() > 1, &key, "role-alone", || {
            "a single role always has a process of its own; name two roles or more, or remove the entry".to_owned()
        });
        for (index, name) in names.iter().enumerate() {
            let key = format!("{key}[{index}]");
            if !roles.contains(&name.as_str()) {
                let known = roles.join(", ");
                checks.refuse(&key, "unknown-role", format!("there is no role `{name}`; this scenario has: {known}"));
            } else if taken.contains(&name) {
                checks.refuse(&key, "role-twice", format!("the {name} is listed twice; list it once"));
            } else if launch.external.contains(name) {
                checks.accept::<(), _>(&key, Err(NotExternal::SharedAndExternal { role: name.clone() }));
            }
            taken.push(name);
        }
    }
}

/// Checks that the roles named by a policy exist.
pub(crate) fn check_roles(policy: &Policy, known: &[&str], checks: &mut Checks<'_>) {
    let Policy::ByRole(roles) = policy else { return };
    for role in roles.keys().filter(|role| !known.contains(&role.as_str())) {
        checks.refuse(
            &format!("supervision.on_failure.{role}"),
            "unknown-role",
            format!("there is no such role; {}", nearest(role, known)),
        );
    }
}

fn check_realtime(realtime: &Realtime, checks: &mut Checks<'_>) {
    let priority = realtime.priority;
    checks.require(priority == 0 || (1..=99).contains(&priority), "realtime.priority", "out-of-range", || {
        format!("{priority} is not a SCHED_FIFO priority; give 1 to 99, or 0 to run without")
    });
    let late_us = realtime.late_us.unwrap_or_default();
    for (key, value) in [
        ("realtime.wake_lead_us", realtime.wake_lead_us),
        ("realtime.spin_us", realtime.spin_us),
        ("realtime.late_us", late_us),
    ] {
        checks.require((0.0..=100_000.0).contains(&value), key, "out-of-range", || {
            format!("{value} us is out of range; give 0 to 100000")
        });
    }
    checks.require(realtime.cutoff > 0.0 && realtime.cutoff <= 1.0, "realtime.cutoff", "out-of-range", || {
        format!("{} is not a part of the period; give a number above 0, up to 1", realtime.cutoff)
    });
    if let Cores::List(cores) = &realtime.cores {
        checks.require(
            !cores.is_empty() && cores.iter().all(|core| *core < 1024),
            "realtime.cores",
            "bad-cores",
            || {
                "the list is empty or names a core beyond 1023; name cores of this machine, \"auto\" or \"any\""
                    .to_owned()
            },
        );
    }
}

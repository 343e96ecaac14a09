//! Checks of the cores that the roles may use: how many, how many of them are left to the roles, and what disturbs them.

use super::check::Check;
use super::machine::{Demand, Machine};
use crate::runtime::{CpuQuota, CpuSetLimit, cpu_quota, cpu_set};

impl Machine {
    pub(super) fn core_count(demand: &Demand) -> Check {
        let (name, found) = ("cores", format!("{} for {} roles", demand.cores, demand.roles));
        let remedy = "roles that share a core wait for each other: give the run more cores, or lower tick_hz";
        if demand.cores >= demand.roles { Check::ok(name, found) } else { Check::warn(name, found, remedy) }
    }

    pub(super) fn isolation(&self) -> Check {
        let name = "isolated cores";
        match self.read("sys/devices/system/cpu/isolated") {
            Some(cores) => {
                let ticking = self.cores_with_tick(&cores);
                if ticking.is_empty() {
                    return Check::ok(name, format!("{cores}: name them in realtime.cores"));
                }
                let found = format!("{cores}, and the kernel's tick interrupts {}", joined(&ticking));
                Check::warn(name, found, format!("boot with nohz_full={cores}, and name these cores in realtime.cores"))
            }
            None => {
                Check::warn(name, "none", "boot with isolcpus= and nohz_full=, and name these cores in realtime.cores")
            }
        }
    }

    /// Returns those of the listed cores that keep the kernel's tick while one task runs.
    fn cores_with_tick(&self, cores: &str) -> Vec<usize> {
        let quiet = core_list(&self.read("sys/devices/system/cpu/nohz_full").unwrap_or_default());
        core_list(cores).into_iter().filter(|core| !quiet.contains(core)).collect()
    }

    /// The kernel does not apply a quota to tasks with SCHED_FIFO, but launcher and recorder have none.
    pub(super) fn quota(&self, demand: &Demand) -> Check {
        let name = "processor quota";
        let Some(CpuQuota { file, quota_us, period_us }) = cpu_quota(&self.root) else {
            return Check::ok(name, "none found");
        };
        let found = format!("{quota_us} us of processor time in every {period_us} us");
        if quota_us >= period_us.saturating_mul(demand.cores as u64) {
            return Check::ok(name, format!("{found}: as much as the cores have"));
        }
        let found = format!("{found}: once it is used, processes without SCHED_FIFO stop until the next period");
        let unlimited = if file.ends_with("cpu.max") { "max" } else { "-1" };
        let remedy = format!("`echo {unlimited} > {}`, or start from another cgroup", file.display());
        if demand.priority > 0 { Check::warn(name, found, remedy) } else { Check::bad(name, found, remedy) }
    }

    /// Checks if the set of cores of the cgroup has those that the scenario names, or else one for each role.
    pub(super) fn cpu_set(&self, demand: &Demand) -> Check {
        let name = "cpuset";
        let Some(CpuSetLimit { file, cores }) = cpu_set(&self.root) else { return Check::ok(name, "none found") };
        let online = self.read("sys/devices/system/cpu/online").unwrap_or_default();
        let (own, all) = (core_list(&cores), core_list(&online));
        let absent: Vec<usize> = demand.named_cores.iter().filter(|core| !own.contains(core)).copied().collect();
        let remedy = format!("`echo {online} > {}`, or start from another cgroup", file.display());
        if all.iter().all(|core| own.contains(core)) {
            return Check::ok(name, format!("{cores}: all cores"));
        }
        if !absent.is_empty() {
            let found = format!("{cores}, and realtime.cores names {}", joined(&absent));
            return Check::bad(name, found, remedy);
        }
        let found = format!("{cores} of {online}");
        if demand.named_cores.is_empty() && own.len() < demand.roles {
            return Check::warn(name, format!("{found}: roles share cores although the machine has more"), remedy);
        }
        Check::ok(name, found)
    }

    /// Returns the cores that the roles may use: those of the scenario, or those that this process may use.
    fn cores_of_roles(&self, demand: &Demand) -> Vec<usize> {
        let status = self.read("proc/self/status").unwrap_or_default();
        let allowed = status.lines().find_map(|line| line.strip_prefix("Cpus_allowed_list:")).unwrap_or_default();
        if demand.named_cores.is_empty() { core_list(allowed) } else { demand.named_cores.clone() }
    }

    pub(super) fn siblings(&self, demand: &Demand) -> Check {
        let name = "hardware threads";
        let used = self.cores_of_roles(demand);
        let siblings = |core: &usize| {
            let path = format!("sys/devices/system/cpu/cpu{core}/topology/thread_siblings_list");
            self.read(&path).map(|list| (*core, core_list(&list)))
        };
        let known: Vec<(usize, Vec<usize>)> = used.iter().filter_map(siblings).collect();
        let shared = |(core, siblings): &(usize, Vec<usize>)| {
            siblings.iter().find(|sibling| *sibling > core && used.contains(sibling)).map(|sibling| (*core, *sibling))
        };
        match known.iter().find_map(shared) {
            None if known.len() < used.len() || used.is_empty() => Check::ok(name, "unknown"),
            None => Check::ok(name, "one per core, of those that roles use"),
            Some((core, sibling)) => Check::warn(
                name,
                format!("{core} and {sibling} share a core: a role on one slows a role on the other"),
                "name one thread per core in realtime.cores, or `echo off > /sys/devices/system/cpu/smt/control`",
            ),
        }
    }

    /// Checks if the cores that the scenario names handle interrupts of devices. Without named cores the roles use all, and no
    /// interrupt can be kept away.
    pub(super) fn interrupts(&self, demand: &Demand) -> Check {
        let name = "device interrupts";
        let Ok(numbers) = std::fs::read_dir(self.root.join("proc/irq")) else { return Check::ok(name, "unknown") };
        let numbers = numbers.flatten().filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
        let cores = |number: &u32| {
            let path = |file: &str| format!("proc/irq/{number}/{file}");
            let text = self.read(&path("effective_affinity_list")).or_else(|| self.read(&path("smp_affinity_list")));
            core_list(&text.unwrap_or_default())
        };
        let mut met: Vec<u32> =
            numbers.filter(|number| cores(number).iter().any(|core| demand.named_cores.contains(core))).collect();
        met.sort_unstable();
        match (demand.named_cores.is_empty(), met.first()) {
            (true, _) => Check::ok(name, "on all cores: realtime.cores names none for the roles"),
            (false, None) => Check::ok(name, "none on the cores of the roles"),
            (false, Some(first)) => Check::warn(
                name,
                format!("{} may come on the cores of the roles, such as {first}, and delay them", met.len()),
                format!("write other cores to /proc/irq/{first}/smp_affinity_list, and likewise for the others"),
            ),
        }
    }
}

/// Reads a list of cores, such as `0-2,5`; a malformed part is left out.
fn core_list(text: &str) -> Vec<usize> {
    let part = |part: &str| {
        let (first, last) = part.split_once('-').unwrap_or((part, part));
        // No machine has more cores.
        let [first, last] = [first.trim().parse().ok()?, last.trim().parse::<usize>().ok()?.min(8192)];
        Some(first..=last)
    };
    text.split(',').filter_map(part).flatten().collect()
}

/// Formats a list of cores.
fn joined(cores: &[usize]) -> String {
    cores.iter().map(usize::to_string).collect::<Vec<_>>().join(",")
}

#[cfg(test)]
mod tests {
    use super::super::Verdict;
    use super::super::machine::tests::{DEMAND, machine};
    use super::*;

    #[test]
    fn threads_of_one_core_and_interrupts_on_named_cores_are_reported() {
        let (_root, machine) = machine(&[
            ("proc/self/status", "Cpus_allowed_list:\t0-1,4\n"),
            ("sys/devices/system/cpu/cpu0/topology/thread_siblings_list", "0,4\n"),
            ("sys/devices/system/cpu/cpu1/topology/thread_siblings_list", "1\n"),
            ("sys/devices/system/cpu/cpu4/topology/thread_siblings_list", "0,4\n"),
            ("proc/irq/24/effective_affinity_list", "1\n"),
            ("proc/irq/25/smp_affinity_list", "0-3\n"),
            ("proc/irq/default_smp_affinity", "f\n"),
            ("proc/irq/26/smp_affinity_list", "\u{1}-\n"),
        ]);
        let on = |named_cores: &[usize]| Demand { named_cores: named_cores.to_vec(), ..DEMAND };
        let verdicts =
            |named: &[usize]| [machine.siblings(&on(named)), machine.interrupts(&on(named))].map(|c| c.verdict);
        assert_eq!(verdicts(&[]), [Verdict::Warn, Verdict::Ok]);
        assert_eq!(verdicts(&[4]), [Verdict::Ok, Verdict::Ok]);
        assert_eq!(verdicts(&[1, 2]), [Verdict::Ok, Verdict::Warn]);
        assert!(machine.interrupts(&on(&[1])).found.starts_with("2 "));
        let threads = |named: &[usize]| machine.siblings(&on(named)).found;
        assert!(threads(&[0, 1]) != "unknown" && threads(&[1, 2]) == "unknown", "core 2 has no file");
        assert_eq!(core_list("0-2,5,x,7-"), [0, 1, 2, 5]);
        assert_eq!(core_list("0-18446744073709551615").len(), 8193);
    }

    #[test]
    fn isolated_cores_with_the_kernels_tick_are_reported() {
        let check = |quiet: &str| {
            let files = [("sys/devices/system/cpu/isolated", "2-4\n"), ("sys/devices/system/cpu/nohz_full", quiet)];
            machine(&files).1.isolation()
        };
        // A kernel without such cores writes "(null)".
        for (quiet, ticking) in [("3\n", "2,4"), ("(null)\n", "2,3,4"), ("\n", "2,3,4")] {
            let check = check(quiet);
            assert!(check.verdict == Verdict::Warn && check.found.ends_with(ticking), "{check:?}");
            assert!(check.remedy.unwrap().contains("nohz_full=2-4"));
        }
        assert_eq!(check("0-7\n").verdict, Verdict::Ok);
    }

    #[test]
    fn a_cpuset_matters_if_it_lacks_cores_of_the_roles() {
        let (_root, machine) = machine(&[
            ("proc/self/cgroup", "0::/a\n"),
            ("proc/self/mountinfo", "40 31 0:40 / /sys/fs/cgroup rw - cgroup2 cgroup2 rw\n"),
            ("sys/fs/cgroup/a/cpuset.cpus.effective", "0-2\n"),
            ("sys/devices/system/cpu/online", "0-7\n"),
        ]);
        let check = |named_cores: &[usize], roles| {
            machine.cpu_set(&Demand { named_cores: named_cores.to_vec(), roles, ..DEMAND })
        };
        assert_eq!(
            [check(&[], 4), check(&[], 3), check(&[1], 4)].map(|c| c.verdict),
            [Verdict::Warn, Verdict::Ok, Verdict::Ok]
        );
        let outside = check(&[1, 5, 6], 4);
        assert!(outside.verdict == Verdict::Bad && outside.found.ends_with("names 5,6"), "{outside:?}");
        assert_eq!(outside.remedy.unwrap(), "`echo 0-7 > /sys/fs/cgroup/a/cpuset.cpus`, or start from another cgroup");
    }

    /// The kernel applies a quota to tasks without SCHED_FIFO only, and one of all cores limits nothing.
    #[test]
    fn a_quota_is_bad_only_where_it_stops_the_roles() {
        let (_root, machine) = machine(&[
            ("proc/self/cgroup", "0::/a\n"),
            ("proc/self/mountinfo", "40 31 0:40 / /sys/fs/cgroup rw - cgroup2 cgroup2 rw\n"),
            ("sys/fs/cgroup/a/cpu.max", "200000 100000\n"),
        ]);
        let verdict = |priority, cores| machine.quota(&Demand { priority, cores, ..DEMAND }).verdict;
        assert_eq!([verdict(80, 4), verdict(0, 4), verdict(0, 2)], [Verdict::Warn, Verdict::Bad, Verdict::Ok]);
    }
}

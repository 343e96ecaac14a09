//! Reads a machine's settings from files, and compares them with the demands of a run.
//!
//! All files lie below a root, so that a test can simulate a machine. Must not write; it only opens files that must be writable.

use super::check::Check;
use crate::config::{Cores, Realtime};
use crate::runtime::{RoleId, shared_memory_bytes};
use crate::scenario::Scenario;
use rustix::fs::statvfs;
use std::fs::OpenOptions;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// Bits of the effective capabilities.
const CAP_IPC_LOCK: u64 = 1 << 14;
const CAP_SYS_NICE: u64 = 1 << 23;
/// Lines of /proc/self/limits.
const PRIORITY_LIMIT: &str = "Max realtime priority";
const LOCKED_LIMIT: &str = "Max locked memory";
/// The device that keeps idle cores out of deep sleep states while it is open.
const IDLE_DEVICE: &str = "dev/cpu_dma_latency";
/// A limit on locked memory below this is not safe: see `runtime/privileges.rs`.
const ENOUGH_LOCKED: u64 = 256 << 20;
/// The least acceptable share of a period for real-time tasks.
const RT_SHARE_MIN: f64 = 0.9;
/// Clock sources that are read without a system call, or nearly so.
const FAST_CLOCKS: [&str; 5] =
    ["tsc", "kvm-clock", "hyperv_clocksource_tsc_page", "arch_sys_counter", "riscv_clocksource"];
/// Clock sources that need a slow bus cycle per read.
const SLOW_CLOCKS: [&str; 4] = ["hpet", "acpi_pm", "pit", "jiffies"];

/// The demands of a run on the machine.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Demand {
    /// Number of processes that take part in a tick.
    pub roles: usize,
    /// Number of cores that this process may use.
    pub cores: usize,
    /// The cores that the scenario names; empty if it names none.
    pub named_cores: Vec<usize>,
    /// The SCHED_FIFO priority; 0 for none.
    pub priority: i32,
    /// Shared memory, bytes.
    pub shared_memory: u64,
}

impl Demand {
    /// Returns the demands of a scenario.
    pub fn new(scenario: &Scenario) -> Self {
        Self {
            roles: RoleId::all(scenario).len(),
            cores: std::thread::available_parallelism().map_or(1, usize::from),
            named_cores: if let Cores::List(cores) = &scenario.realtime.cores { cores.clone() } else { Vec::new() },
            priority: scenario.realtime.priority,
            shared_memory: shared_memory_bytes(scenario) as u64,
        }
    }
}

/// A machine, represented by its files.
#[derive(Debug, Clone)]
pub struct Machine {
    pub(super) root: PathBuf,
}

impl Machine {
    /// Returns the machine whose files lie below `root`; `/` is this machine.
    pub fn at(root: &Path) -> Self {
        Self { root: root.to_owned() }
    }

    /// Runs all checks of files.
    pub fn examine(&self, demand: &Demand) -> Vec<Check> {
        vec![
            self.preemption(),
            self.hypervisor(),
            self.priority(demand.priority),
            self.locked_memory(),
            self.throttling(),
            self.idle(),
            self.governor(),
            self.isolation(),
            Self::core_count(demand),
            self.quota(demand),
            self.cpu_set(demand),
            self.siblings(demand),
            self.interrupts(demand),
            self.load(demand.cores),
            self.clock_source(),
            self.shared_memory(demand.shared_memory),
        ]
    }

    /// Returns the requests of a real-time run that will be refused, in words, and one command that grants them to the shell in
    /// which it is typed; `None` if no request is known to be refused.
    pub fn ungranted(&self, asked: &Realtime) -> Option<(String, String)> {
        let below = |capability, title, needed: u64| {
            !self.capable(capability) && matches!(self.limit(title), Some(Some(limit)) if limit < needed)
        };
        let (mut lacking, mut limits, mut commands) = (Vec::new(), String::new(), Vec::new());
        if asked.priority > 0 && below(CAP_SYS_NICE, PRIORITY_LIMIT, asked.priority.unsigned_abs().into()) {
            lacking.push(format!("SCHED_FIFO {}", asked.priority));
            limits += " --rtprio=99";
        }
        if asked.lock_memory && below(CAP_IPC_LOCK, LOCKED_LIMIT, ENOUGH_LOCKED) {
            lacking.push("locked memory".to_owned());
            limits += " --memlock=unlimited";
        }
        if !limits.is_empty() {
            // Child processes inherit the limits of the shell.
            commands.push(format!("prlimit --pid $${limits}"));
        }
        let idle = OpenOptions::new().write(true).open(self.root.join(IDLE_DEVICE));
        if asked.low_latency_idle && idle.is_err_and(|error| error.kind() == ErrorKind::PermissionDenied) {
            lacking.push("low-latency idle".to_owned());
            commands.push(format!("chmod o+w /{IDLE_DEVICE}"));
        }
        let command = match commands.as_slice() {
            [] => return None,
            [one] => format!("sudo {one}"),
            all => format!("sudo sh -c \"{}\"", all.join("; ")),
        };
        Some((lacking.join(", "), command))
    }

    /// Returns a file's text without surrounding blanks; `None` if it is empty, missing or unreadable.
    pub(super) fn read(&self, path: &str) -> Option<String> {
        let bytes = std::fs::read(self.root.join(path)).ok()?;
        Some(String::from_utf8_lossy(&bytes).trim().to_owned()).filter(|text| !text.is_empty())
    }

    fn preemption(&self) -> Check {
        let name = "kernel preemption";
        let version = self.read("proc/version").unwrap_or_default();
        // The file marks the current mode of a dynamic kernel: "none voluntary (full) lazy".
        let modes = self.read("sys/kernel/debug/sched/preempt");
        let mode = modes.as_deref().and_then(|modes| Some(modes.split_once('(')?.1.split_once(')')?.0.to_owned()));
        let kernel = |word: &str| version.split_whitespace().any(|part| part == word);
        let realtime = self.read("sys/kernel/realtime").is_some_and(|flag| flag == "1") || kernel("PREEMPT_RT");
        let remedy = "boot a PREEMPT_RT kernel for bounded latencies, or at least with preempt=full";
        if realtime {
            return Check::ok(name, "PREEMPT_RT");
        }
        match (kernel("PREEMPT_DYNAMIC"), kernel("PREEMPT"), mode.as_deref()) {
            (_, _, Some(mode @ ("none" | "voluntary"))) => {
                Check::bad(name, format!("{mode}, of PREEMPT_DYNAMIC"), remedy)
            }
            (_, _, Some(mode)) => Check::warn(name, format!("{mode}, of PREEMPT_DYNAMIC"), remedy),
            (true, _, None) => Check::warn(name, "PREEMPT_DYNAMIC, in a mode that cannot be read", remedy),
            (_, true, None) => Check::warn(name, "PREEMPT", remedy),
            _ if version.is_empty() => Check::warn(name, "unknown", remedy),
            _ => Check::bad(name, "none, or voluntary", remedy),
        }
    }

    fn hypervisor(&self) -> Check {
        let name = "virtual machine";
        let information = self.read("proc/cpuinfo").unwrap_or_default();
        let mut flags = information.lines().filter(|line| line.starts_with("flags"));
        if flags.any(|line| line.split_whitespace().any(|flag| flag == "hypervisor")) {
            let remedy = "its host may take a core away at any time: use bare metal, or cores that the host has pinned";
            return Check::warn(name, "yes", remedy);
        }
        Check::ok(name, "no")
    }

    /// Returns the soft limit in a line of /proc/self/limits; the inner `None` means unlimited.
    fn limit(&self, title: &str) -> Option<Option<u64>> {
        let limits = self.read("proc/self/limits")?;
        let soft = limits.lines().find_map(|line| line.strip_prefix(title))?.split_whitespace().next()?;
        if soft == "unlimited" { Some(None) } else { soft.parse().ok().map(Some) }
    }

    /// Returns true if this process is known to have an effective capability.
    fn capable(&self, capability: u64) -> bool {
        let status = self.read("proc/self/status").unwrap_or_default();
        let effective = status.lines().find_map(|line| line.strip_prefix("CapEff:"));
        effective.and_then(|hex| u64::from_str_radix(hex.trim(), 16).ok()).is_some_and(|set| set & capability != 0)
    }

    fn priority(&self, asked: i32) -> Check {
        let name = "rtprio limit";
        let remedy = "raise it: `* - rtprio 99` in /etc/security/limits.conf, or grant CAP_SYS_NICE";
        if self.capable(CAP_SYS_NICE) {
            return Check::ok(name, "none (CAP_SYS_NICE)");
        }
        match self.limit(PRIORITY_LIMIT) {
            Some(None) => Check::ok(name, "none"),
            Some(Some(limit)) if limit >= asked.unsigned_abs().into() => Check::ok(name, limit.to_string()),
            Some(Some(limit)) => Check::bad(name, format!("{limit}, and SCHED_FIFO {asked} is asked for"), remedy),
            None => Check::warn(name, "unknown", remedy),
        }
    }

    fn locked_memory(&self) -> Check {
        let name = "memlock limit";
        let enough = ENOUGH_LOCKED >> 10;
        let remedy = format!("raise it above {enough} KiB: `* - memlock unlimited` in limits.conf, or CAP_IPC_LOCK");
        if self.capable(CAP_IPC_LOCK) {
            return Check::ok(name, "none (CAP_IPC_LOCK)");
        }
        match self.limit(LOCKED_LIMIT) {
            Some(None) => Check::ok(name, "none"),
            Some(Some(limit)) if limit >= ENOUGH_LOCKED => Check::ok(name, format!("{} KiB", limit >> 10)),
            Some(Some(limit)) => {
                Check::warn(name, format!("{} KiB: memory stays unlocked, pages may fault", limit >> 10), remedy)
            }
            None => Check::warn(name, "unknown", remedy),
        }
    }

    fn throttling(&self) -> Check {
        let name = "real-time throttling";
        let number = |file: &str| self.read(&format!("proc/sys/kernel/{file}"))?.parse::<i64>().ok();
        let remedy = "write 950000 to /proc/sys/kernel/sched_rt_runtime_us";
        match (number("sched_rt_runtime_us"), number("sched_rt_period_us")) {
            (Some(-1), _) => Check::ok(name, "off"),
            (Some(runtime), Some(period)) if period > 0 => {
                let found = format!("{runtime} of {period} us for real-time tasks");
                let share = runtime as f64 / period as f64;
                // Roles spin for a bounded time, so they leave the usual 5 % to other tasks anyway.
                if share >= RT_SHARE_MIN { Check::ok(name, found) } else { Check::bad(name, found, remedy) }
            }
            _ => Check::warn(name, "unknown", remedy),
        }
    }

    fn idle(&self) -> Check {
        let name = "cpu_dma_latency";
        let remedy = "allow this user to write /dev/cpu_dma_latency: else cores sleep deeply and wake late";
        // Opening alone requests nothing; only a write does.
        match OpenOptions::new().write(true).open(self.root.join(IDLE_DEVICE)) {
            Ok(_) => Check::ok(name, "writable"),
            Err(error) => Check::warn(name, format!("not writable: {error}"), remedy),
        }
    }

    fn governor(&self) -> Check {
        let name = "cpufreq governor";
        let governor = |core: usize| self.read(&format!("sys/devices/system/cpu/cpu{core}/cpufreq/scaling_governor"));
        // Core numbers may have gaps; none is above this.
        let mut governors: Vec<String> = (0..1024).filter_map(governor).collect();
        governors.sort();
        governors.dedup();
        let found = governors.join(", ");
        match governors.as_slice() {
            [] => Check::ok(name, "none: the frequency is not set from here"),
            [one] if one == "performance" => Check::ok(name, found),
            _ => Check::warn(name, found, "`cpupower frequency-set -g performance`: raising a frequency takes time"),
        }
    }

    fn load(&self, cores: usize) -> Check {
        let name = "load";
        let average = self.read("proc/loadavg").and_then(|text| text.split_whitespace().next()?.parse::<f64>().ok());
        match average {
            Some(load) if load > cores as f64 => {
                let found = format!("{load:.2} on {cores} cores: more threads want to run than there are cores");
                Check::warn(
                    name,
                    found,
                    "end programs that are not needed; without SCHED_FIFO the loop shares its cores with them",
                )
            }
            Some(load) => Check::ok(name, format!("{load:.2}")),
            None => Check::ok(name, "unknown"),
        }
    }

    fn clock_source(&self) -> Check {
        let name = "clock source";
        let remedy = "boot with clocksource=tsc if the processor's TSC is invariant";
        match self.read("sys/devices/system/clocksource/clocksource0/current_clocksource") {
            Some(source) if FAST_CLOCKS.contains(&source.as_str()) => Check::ok(name, source),
            Some(source) if SLOW_CLOCKS.contains(&source.as_str()) => {
                Check::bad(name, format!("{source}: every look at the time takes about a microsecond or more"), remedy)
            }
            Some(source) => Check::warn(name, format!("{source}, of which we know nothing"), remedy),
            None => Check::warn(name, "unknown", remedy),
        }
    }

    fn shared_memory(&self, needed: u64) -> Check {
        let (name, mib) = ("/dev/shm", |bytes: u64| bytes as f64 / (1 << 20) as f64);
        let Ok(room) = statvfs(self.root.join("dev/shm")) else {
            return Check::bad(name, "cannot be looked at", "mount a tmpfs at /dev/shm");
        };
        let [size, free] = [room.f_blocks, room.f_bavail].map(|blocks| blocks.saturating_mul(room.f_frsize));
        let found = format!("{:.1} of {:.1} MiB free, a run takes up to {:.1}", mib(free), mib(size), mib(needed));
        let remedy = "free some, or `mount -o remount,size=2g /dev/shm`";
        match free {
            free if free < needed => Check::bad(name, found, remedy),
            // A second run or a recorder's cache would fill it.
            free if free < needed.saturating_mul(2) => Check::warn(name, found, remedy),
            _ => Check::ok(name, found),
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::Verdict;
    use super::*;

    pub const DEMAND: Demand = Demand { roles: 4, cores: 4, named_cores: Vec::new(), priority: 80, shared_memory: 1 };

    /// Creates a machine of these files.
    pub fn machine(files: &[(&str, &str)]) -> (tempfile::TempDir, Machine) {
        let root = tempfile::tempdir().unwrap();
        for (path, text) in files {
            let path = root.path().join(path);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        }
        let machine = Machine::at(root.path());
        (root, machine)
    }

    fn limits(priority: &str, locked: &str) -> String {
        format!(
            "Limit                     Soft Limit           Hard Limit           Units     \n\
             Max locked memory         {locked}              {locked}              bytes     \n\
             Max realtime priority     {priority}                   {priority}                    \n"
        )
    }

    #[test]
    fn an_empty_machine_is_unknown_without_a_panic() {
        let (_root, machine) = machine(&[]);
        for check in machine.examine(&DEMAND) {
            assert!(check.remedy.is_some() || check.verdict == Verdict::Ok, "{check:?}");
        }
        let verdict =
            |name: &str| machine.examine(&DEMAND).into_iter().find(|check| check.name == name).unwrap().verdict;
        assert_eq!(verdict("/dev/shm"), Verdict::Bad);
        for name in ["kernel preemption", "rtprio limit", "clock source", "cpu_dma_latency", "real-time throttling"] {
            assert_eq!(verdict(name), Verdict::Warn, "{name}");
        }
    }

    #[test]
    fn refused_requests_are_granted_with_one_command() {
        let ungranted = |priority: &str, locked: &str, capabilities: &str| {
            let status = format!("CapEff:\t{capabilities}\n");
            let (_root, machine) =
                machine(&[("proc/self/limits", &limits(priority, locked)), ("proc/self/status", &status)]);
            machine.ungranted(&Realtime::default())
        };
        let (lacking, command) = ungranted("0", "8388608", "0000000000000000").unwrap();
        assert_eq!(lacking, "SCHED_FIFO 80, locked memory");
        assert_eq!(command, "sudo prlimit --pid $$ --rtprio=99 --memlock=unlimited");
        let (lacking, command) = ungranted("80", "8388608", "0000000000000000").unwrap();
        assert_eq!((&*lacking, &*command), ("locked memory", "sudo prlimit --pid $$ --memlock=unlimited"));
        assert_eq!(ungranted("80", "unlimited", "0000000000000000"), None);
        assert_eq!(ungranted("0", "8388608", "0000000000804000"), None, "by capabilities");
        let (_root, machine) = machine(&[("proc/self/limits", &limits("0", "8388608"))]);
        let modest = Realtime { priority: 0, lock_memory: false, ..Realtime::default() };
        assert_eq!(machine.ungranted(&modest), None, "it is not asked for");
    }

    #[test]
    fn invalid_values_are_unknown() {
        let (_root, machine) = machine(&[
            ("proc/version", "\u{1}\u{2}"),
            ("proc/self/limits", "Max locked memory   much\nMax realtime priority\n"),
            ("proc/self/status", "CapEff:\tzzzz\n"),
            ("proc/sys/kernel/sched_rt_runtime_us", "9e9"),
            ("proc/sys/kernel/sched_rt_period_us", "0"),
            ("proc/loadavg", "-"),
            ("sys/kernel/debug/sched/preempt", ")none("),
        ]);
        for check in machine.examine(&DEMAND) {
            assert!(check.remedy.is_some() || check.verdict == Verdict::Ok, "{check:?}");
        }
        assert_eq!(machine.priority(80).found, "unknown");
        assert_eq!(machine.locked_memory().found, "unknown");
        assert_eq!(machine.throttling().found, "unknown");
    }

    #[test]
    fn preemption_follows_the_mode_of_the_kernel() {
        let verdict = |version: &str, modes: &str| {
            let (_root, machine) = machine(&[("proc/version", version), ("sys/kernel/debug/sched/preempt", modes)]);
            machine.preemption().verdict
        };
        assert_eq!(verdict("Linux 6.12 #1 SMP PREEMPT_RT", ""), Verdict::Ok);
        assert_eq!(verdict("Linux 6.12 #1 SMP PREEMPT_DYNAMIC", "none voluntary (full) lazy"), Verdict::Warn);
        assert_eq!(verdict("Linux 6.12 #1 SMP PREEMPT_DYNAMIC", "none (voluntary) full"), Verdict::Bad);
        assert_eq!(verdict("Linux 6.12 #1 SMP PREEMPT_DYNAMIC", ""), Verdict::Warn);
        assert_eq!(verdict("Linux 6.12 #1 SMP", ""), Verdict::Bad);
    }

    #[test]
    fn limits_must_cover_the_requests_unless_capabilities_do() {
        let (_root, poor) =
            machine(&[("proc/self/limits", &limits("0", "8388608")), ("proc/self/status", "CapEff:\t0\n")]);
        assert_eq!((poor.priority(80).verdict, poor.locked_memory().verdict), (Verdict::Bad, Verdict::Warn));
        assert!(poor.locked_memory().found.starts_with("8192 KiB"));
        assert_eq!(poor.priority(0).verdict, Verdict::Ok, "none is asked for");
        let rich = limits("90", "unlimited");
        let (_root, rich) = machine(&[("proc/self/limits", &rich)]);
        assert_eq!((rich.priority(80).verdict, rich.locked_memory().verdict), (Verdict::Ok, Verdict::Ok));
        assert_eq!(rich.priority(95).verdict, Verdict::Bad);
        let capable =
            [("proc/self/limits", &*limits("0", "65536")), ("proc/self/status", "CapEff:\t0000000000804000\n")];
        let (_root, capable) = machine(&capable);
        assert_eq!((capable.priority(80).verdict, capable.locked_memory().verdict), (Verdict::Ok, Verdict::Ok));
    }

    #[test]
    fn a_well_kept_machine_has_nothing_to_improve() {
        let (_root, machine) = machine(&[
            ("proc/version", "Linux version 6.12.1-rt #1 SMP PREEMPT_RT"),
            ("proc/cpuinfo", "flags\t\t: fpu tsc\n"),
            ("proc/self/limits", &limits("99", "unlimited")),
            ("proc/sys/kernel/sched_rt_runtime_us", "950000\n"),
            ("proc/sys/kernel/sched_rt_period_us", "1000000\n"),
            ("proc/loadavg", "0.10 0.20 0.30 1/100 1\n"),
            ("dev/cpu_dma_latency", ""),
            ("dev/shm/x", ""),
            ("sys/devices/system/cpu/cpu0/cpufreq/scaling_governor", "performance\n"),
            ("sys/devices/system/cpu/cpu3/cpufreq/scaling_governor", "performance\n"),
            ("sys/devices/system/cpu/isolated", "2-3\n"),
            ("sys/devices/system/cpu/nohz_full", "1-3\n"),
            ("sys/devices/system/clocksource/clocksource0/current_clocksource", "tsc\n"),
        ]);
        let checks = machine.examine(&DEMAND);
        assert!(checks.iter().all(|check| check.verdict == Verdict::Ok && check.remedy.is_none()), "{checks:#?}");
    }

    #[test]
    fn every_shortage_has_its_verdict() {
        let (_root, machine) = machine(&[
            ("proc/cpuinfo", "flags\t\t: fpu hypervisor tsc\n"),
            ("proc/sys/kernel/sched_rt_runtime_us", "500000\n"),
            ("proc/sys/kernel/sched_rt_period_us", "1000000\n"),
            ("proc/loadavg", "9.10 0.20 0.30 1/100 1\n"),
            ("dev/shm/x", ""),
            ("sys/devices/system/cpu/cpu0/cpufreq/scaling_governor", "performance\n"),
            ("sys/devices/system/cpu/cpu1/cpufreq/scaling_governor", "powersave\n"),
            ("sys/devices/system/clocksource/clocksource0/current_clocksource", "hpet\n"),
        ]);
        let demand = Demand { cores: 2, shared_memory: u64::MAX, ..DEMAND };
        let checks = machine.examine(&demand);
        let verdict = |name: &str| checks.iter().find(|check| check.name == name).unwrap().verdict;
        for name in ["real-time throttling", "clock source", "/dev/shm"] {
            assert_eq!(verdict(name), Verdict::Bad, "{name}");
        }
        for name in ["virtual machine", "load", "cores", "cpufreq governor", "isolated cores"] {
            assert_eq!(verdict(name), Verdict::Warn, "{name}");
        }
    }
}

//! Observes a whole `corotate run` from outside: the times to start and stop, the resources of its processes, and the true rate
//! of its ticks.
//!
//! It reads /proc and the run's signals, as any program may. Must not disturb the run more than a reader of these signals does.

use super::session::{Bench, BenchError};
use crate::bus::domain::Domain;
use crate::bus::iox::{IoxBus, IoxReader};
use crate::bus::{Bus, Read, Reader, Signal, WordReader};
use crate::clock::monotonic_ns;
use crate::runtime::{RoleId, depths, ports, topic};
use crate::sample::{Phase, Schedule, Stamp};
use crate::scenario::Scenario;
use crate::system::this_program;
use rustix::process::{Pid, Signal as Kill, kill_process};
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Child, Stdio};
use std::time::Duration;

/// The time between two observations, ns.
const OBSERVE_NS: u64 = 1_000_000;
/// Observations between two readings of memory.
const MEMORY_EVERY: u64 = 20;
/// Words of a stamp.
const STAMP: usize = size_of::<Stamp>() / size_of::<u64>();
/// The excess duration after which a run counts as hung, ns.
const HUNG_NS: u64 = 60_000_000_000;

/// One process of a run.
#[derive(Debug, Clone)]
pub(super) struct Process {
    /// The role's name, or `launcher`.
    pub name: String,
    pub pid: i32,
}

/// The observations of a run.
#[derive(Debug, Default)]
pub(super) struct Observed {
    /// From the start of the process to the first tick, ms.
    pub start_ms: Option<f64>,
    /// From the last tick to the end of the process, ms.
    pub stop_ms: Option<f64>,
    /// Peak resident memory by process, and the part of it that is not the program's own file, MiB.
    pub resident_mib: BTreeMap<String, [f64; 2]>,
    /// The most shared memory at any observation, MiB.
    pub shared_mib: f64,
    /// The error of the leader's tick rate, %.
    pub rate_error_percent: Option<f64>,
}

/// The settings of an observed run.
pub(super) struct Watch<'a> {
    /// Overrides of the measured scenario.
    pub overrides: &'a [&'a str],
    /// Environment variables of all its processes.
    pub environment: Vec<(&'static str, OsString)>,
    /// Called once, a sixth of the run after the first tick, with its processes and its period, ns.
    pub midway: &'a mut dyn FnMut(&[Process], u64),
}

/// The signals of the run.
struct Signals {
    domain: Domain,
    schedule: IoxReader<Schedule>,
    leader: WordReader,
    /// Tick and time of the first and the last received measurement.
    seen: Option<[(u64, u64); 2]>,
    /// The last field, so that it is dropped after the readers opened on it.
    _bus: IoxBus,
}

impl Watch<'_> {
    /// Runs the scenario to its end and returns the observations.
    pub fn run(&mut self, bench: &mut Bench<'_>) -> Result<Observed, BenchError> {
        let scenario = bench.scenario(self.overrides)?;
        let directory = tempfile::tempdir().map_err(BenchError::system("make a temporary directory"))?;
        let file = directory.path().join("scenario.toml");
        fs::write(&file, scenario.to_toml()).map_err(BenchError::system("write a scenario"))?;
        let mut command = this_program().map_err(BenchError::system("find this program"))?;
        command.arg("run").arg(&file).arg("--out").arg(directory.path().join("out"));
        command.envs(self.environment.drain(..)).process_group(0);
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::inherit());
        let started_ns = monotonic_ns();
        let mut child = command.spawn().map_err(BenchError::system("start a run"))?;
        let observed = self.follow(bench, &scenario, &mut child, started_ns);
        if observed.is_err() {
            // The launcher ends its roles, then itself.
            let _ = Pid::from_raw(child.id() as i32).map(|pid| kill_process(pid, Kill::TERM));
            let _ = child.wait();
        }
        observed
    }

    fn follow(
        &mut self,
        bench: &mut Bench<'_>,
        scenario: &Scenario,
        child: &mut Child,
        started_ns: u64,
    ) -> Result<Observed, BenchError> {
        let length_ns = scenario.last_tick * scenario.period_ns;
        let (mut observed, mut signals, mut epoch_ns, mut observations) = (Observed::default(), None, None, 0_u64);
        let mut processes = vec![Process { name: "launcher".to_owned(), pid: child.id() as i32 }];
        let mut midway_done = false;
        loop {
            std::thread::sleep(Duration::from_nanos(OBSERVE_NS));
            observations += 1;
            if let Some(status) = child.try_wait().map_err(BenchError::system("wait for a run"))? {
                let last_tick_ns = epoch_ns.map(|epoch_ns: u64| epoch_ns + length_ns);
                observed.stop_ms = last_tick_ns.map(|last_ns| monotonic_ns().saturating_sub(last_ns) as f64 / 1e6);
                observed.rate_error_percent =
                    signals.as_ref().and_then(|signals: &Signals| signals.rate_error(scenario));
                return match status.success() {
                    true => Ok(observed),
                    false => Err(BenchError::Peer(format!("a whole run ended with {status}"))),
                };
            }
            bench.interrupted()?;
            if monotonic_ns() > started_ns + length_ns + HUNG_NS {
                return Err(BenchError::Peer("a whole run hangs".to_owned()));
            }
            match &mut signals {
                None => {
                    let children = children_of(child.id() as i32);
                    signals = Signals::open(scenario, &children);
                }
                Some(signals) => {
                    if epoch_ns.is_none() {
                        epoch_ns = signals.epoch_ns()?;
                        observed.start_ms = epoch_ns.map(|epoch| epoch.saturating_sub(started_ns) as f64 / 1e6);
                    }
                    signals.read_leader()?;
                }
            }
            let due = epoch_ns.is_some_and(|epoch_ns| monotonic_ns() > epoch_ns + length_ns / 6);
            if due && !midway_done {
                midway_done = true;
                processes.extend(roles(scenario, child.id() as i32));
                (self.midway)(&processes, scenario.period_ns);
            }
            if observations % MEMORY_EVERY == 0 || due {
                observed.read_memory(&processes, signals.as_ref().map(|signals| &signals.domain));
            }
        }
    }
}

impl Observed {
    fn read_memory(&mut self, processes: &[Process], domain: Option<&Domain>) {
        for process in processes {
            // The peak never falls; a process that is ending has no value.
            let words = ["VmHWM:", "RssAnon:", "RssShmem:"].map(|word| status_word(process.pid, word));
            if let [Some(peak), Some(anonymous), Some(shared)] = words {
                let mib = self.resident_mib.entry(process.name.clone()).or_default();
                for (most, kib) in mib.iter_mut().zip([peak, anonymous + shared]) {
                    *most = most.max(kib as f64 / 1024.0);
                }
            }
        }
        let bytes = domain.map_or(0, shared_bytes);
        self.shared_mib = self.shared_mib.max(bytes as f64 / f64::from(1 << 20));
    }
}

impl Signals {
    /// Opens the signals of the run whose roles are among these processes; `None` while there are no roles.
    fn open(scenario: &Scenario, processes: &[(i32, Vec<String>)]) -> Option<Self> {
        let root = processes.iter().find_map(|(_, words)| argument(words, "--domain").map(PathBuf::from))?;
        let domain = Domain::join(&root).ok()?;
        let bus = IoxBus::enter(&domain, "bench", depths(scenario)).ok()?;
        let schedule = bus.reader(&topic(scenario, "run", Signal::Schedule), Reader::Role).ok()?;
        let mut written = ports(scenario, RoleId::Plant(0)).writes.into_iter();
        let measurement = written.find(|port| port.topic.signal == Signal::Measurement)?;
        let leader = measurement.reader(&bus, Reader::Role).ok()?;
        Some(Self { domain, schedule, leader, seen: None, _bus: bus })
    }

    /// Returns the time at which the first tick is due, once it is known.
    fn epoch_ns(&mut self) -> Result<Option<u64>, BenchError> {
        while self.schedule.advance()? {}
        let runs = self.schedule.current().filter(|word| Phase::from_number(word.phase) == Phase::Run);
        Ok(runs.map(|word| word.epoch_ns).filter(|epoch_ns| *epoch_ns > 0))
    }

    fn read_leader(&mut self) -> Result<(), BenchError> {
        while let Some(words) = self.leader.next()? {
            let stamp: Stamp = bytemuck::pod_read_unaligned(bytemuck::cast_slice(&words[..STAMP]));
            // Generation 0 is warm-up.
            if stamp.generation > 0 {
                let now = (stamp.tick, stamp.sent_ns);
                self.seen = Some([self.seen.map_or(now, |[first, _]| first), now]);
            }
        }
        Ok(())
    }

    /// Returns the error of the tick rate relative to the scenario's, %.
    fn rate_error(&self, scenario: &Scenario) -> Option<f64> {
        let [(first, from_ns), (last, to_ns)] = self.seen?;
        let expected_ns = (last - first) * scenario.period_ns;
        (expected_ns > 0).then(|| ((to_ns - from_ns) as f64 / expected_ns as f64 - 1.0).abs() * 100.0)
    }
}

/// Returns the child processes of a process, with their command lines.
fn children_of(parent: i32) -> Vec<(i32, Vec<String>)> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    let pids = entries.filter_map(|entry| entry.file_name().to_str()?.parse::<i32>().ok());
    pids.filter(|pid| status_word(*pid, "PPid:") == Some(parent as u64)).map(|pid| (pid, words_of(pid))).collect()
}

fn words_of(pid: i32) -> Vec<String> {
    let line = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
    line.split(|byte| *byte == 0).map(|word| String::from_utf8_lossy(word).into_owned()).collect()
}

fn argument<'a>(words: &'a [String], name: &str) -> Option<&'a str> {
    let index = words.iter().position(|word| word == name)?;
    words.get(index + 1).map(String::as_str)
}

/// Returns the roles that a launcher has started.
fn roles(scenario: &Scenario, launcher: i32) -> Vec<Process> {
    let names = scenario.roles();
    let role = |(pid, words): (i32, Vec<String>)| {
        let kind = words.get(1)?.clone();
        let name = argument(&words, "--body").map_or(kind, str::to_owned);
        names.contains(&name.as_str()).then_some(Process { name, pid })
    };
    children_of(launcher).into_iter().filter_map(role).collect()
}

/// Returns a number of /proc/PID/status.
pub(super) fn status_word(pid: i32, key: &str) -> Option<u64> {
    let text = fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    text.lines().find_map(|line| line.strip_prefix(key)?.split_whitespace().next()?.parse().ok())
}

/// Returns the shared memory of a domain's files, bytes.
fn shared_bytes(domain: &Domain) -> u64 {
    let own = domain
        .shared_memory_files()
        .chain(fs::read_dir(domain.shared("")).into_iter().flatten().flatten().map(|entry| entry.path()));
    own.filter_map(|path| fs::metadata(path).ok()).map(|data| data.blocks() * 512).sum()
}

//! Random kills: a random role of a random scenario, at a random failpoint, instant or system call, alone or together
//! with companions. In lockstep nothing may be lost: hash, counters and metrics equal those of an undisturbed run.
//!
//! `tests/kill-campaign N` makes N kills; without a number it is a short run. Needs the feature `hooks`.

use crate::common::{Bench, Done, Running, send_signal, skipped};
use corotate::config::SHIPPED;
use corotate::runtime::RoleId;
use corotate::scenario::Scenario;
use rand_pcg::Pcg64;
use rand_pcg::rand_core::{Rng, SeedableRng};
use serde_json::Value;
use std::collections::BTreeMap;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{LazyLock, Mutex};
use std::time::Duration;

/// Ticks of a run, long enough for most kills to hit it.
const TICKS: u64 = 4_000;
const PLACES: [&str; 6] = ["staged", "committing", "in-commit", "committed", "sent", "waiting"];
/// Faults on samples and ticks throughout the run, so that every death happens among faults. (A flipped bit in a
/// generation differs between generations and is left out.)
const DISTURBED: &str = r#"
[[fault]]
kind = "delay"
role = "observer"
delay_ticks = 3
jitter_ticks = 3
from_tick = 5
ticks = 100000
probability = 0.3

[[fault]]
kind = "duplicate"
role = "observer"
from_tick = 5
ticks = 100000
probability = 0.3

[[fault]]
kind = "bit-flip"
role = "observer"
field = "tick"
from_tick = 5
ticks = 100000
probability = 0.05

[[fault]]
kind = "drop"
role = "leader"
from_tick = 5
ticks = 100000
probability = 0.1

[[fault]]
kind = "duplicate"
role = "leader"
from_tick = 5
ticks = 100000
probability = 0.3

[[fault]]
kind = "delay"
role = "controller"
delay_ticks = 2
from_tick = 5
ticks = 100000
probability = 0.3

[[fault]]
kind = "bit-flip"
role = "follower"
field = "tick"
from_tick = 5
ticks = 100000
probability = 0.05

[[fault]]
kind = "duplicate"
role = "follower"
from_tick = 5
ticks = 100000
probability = 0.3
"#;
const CALLS: [&str; 5] = ["futex", "clock_nanosleep", "sched_yield", "mmap", "openat"];

/// The way a role is killed.
#[derive(Debug)]
enum Kill {
    /// By itself, when it passes a failpoint for the n-th time.
    Place(&'static str, u64),
    /// From outside, at this time after it was found, µs.
    Instant(u64),
    /// By a tracer, at its n-th system call of a kind.
    Call(&'static str, u64),
}

#[derive(Debug)]
struct Case {
    scenario: &'static str,
    role: String,
    /// Roles that are killed at the same instant.
    companions: Vec<String>,
    realtime: bool,
    kill: Kill,
}

fn below(random: &mut Pcg64, limit: u64) -> u64 {
    random.next_u64() % limit
}

/// Returns the shipped scenarios, and one with faults.
fn scenarios() -> &'static [(&'static str, String)] {
    static ALL: LazyLock<Vec<(&str, String)>> = LazyLock::new(|| {
        let shipped = SHIPPED.iter().map(|(name, text)| (*name, (*text).to_owned()));
        let (_, pair) = SHIPPED.iter().find(|(name, _)| *name == "rigid-pair").unwrap();
        shipped.chain([("disturbed", format!("{pair}{DISTURBED}"))]).collect()
    });
    &ALL
}

fn parsed(scenario: &str) -> Scenario {
    let (_, text) = scenarios().iter().find(|(name, _)| *name == scenario).unwrap();
    Scenario::parse(text, scenario, &[]).unwrap()
}

impl Case {
    fn draw(number: u64, seed: u64, traced: bool) -> Self {
        let mut random = Pcg64::seed_from_u64(seed ^ number.wrapping_mul(0x9e37_79b9_7f4a_7c15));
        let scenario = scenarios()[below(&mut random, scenarios().len() as u64) as usize].0;
        let parsed = parsed(scenario);
        let roles = RoleId::all(&parsed);
        let names: Vec<String> = roles.iter().map(|role| role.name(&parsed).to_owned()).collect();
        let role = names[below(&mut random, names.len() as u64) as usize].clone();
        let realtime = below(&mut random, 10) == 0;
        let kill = match below(&mut random, 10) {
            0..5 => {
                let place = PLACES[below(&mut random, PLACES.len() as u64) as usize];
                let often = if realtime {
                    150
                } else if place == "waiting" {
                    60
                } else {
                    TICKS
                };
                Kill::Place(place, 1 + below(&mut random, often))
            }
            5 if traced => {
                let call = CALLS[below(&mut random, CALLS.len() as u64) as usize];
                Kill::Call(call, 1 + below(&mut random, 100))
            }
            _ => Kill::Instant(below(&mut random, if realtime { 1_000_000 } else { 250_000 })),
        };
        let together = matches!(kill, Kill::Instant(_)) && below(&mut random, 2) == 0;
        let companions =
            names.into_iter().filter(|name| together && *name != role && below(&mut random, 2) == 0).collect();
        Self { scenario, role, companions, realtime, kill }
    }

    fn arguments(&self) -> Vec<String> {
        let clock = if self.realtime {
            ["--clock=realtime", "--tick-hz=200", "--duration=1.5", "--set=fault=[]", "--set=watchdog={}"]
                .map(str::to_owned)
                .to_vec()
        } else {
            lockstep(self.scenario)
        };
        let fixed =
            ["run", &format!("{}.toml", self.scenario), "--json", "--out=out", "--set=accept={}"].map(str::to_owned);
        // Enough time for a loaded machine to start all roles.
        let fixed = fixed.into_iter().chain(["--set=launch.startup_timeout_s=120".to_owned()]);
        fixed.into_iter().chain(clock).collect()
    }

    /// Runs the case; returns whether the role was killed, and what is wrong.
    fn run(&self) -> (bool, Option<String>) {
        let bench = bench(self.scenario);
        let mut command = bench.command();
        command.args(self.arguments());
        if let Kill::Place(place, count) = self.kill {
            command.env("COROTATE_HOOK", format!("{} {place} {count} KILL", self.role));
        }
        let mut running = Running::new(&mut command);
        let mut tracer = None;
        match self.kill {
            Kill::Place(..) => {}
            Kill::Instant(after_us) => {
                let roles = self.companions.iter().chain([&self.role]);
                let pids: Vec<_> = roles.map(|role| running.await_role_or_end(&bench, role)).collect();
                std::thread::sleep(Duration::from_micros(after_us));
                pids.iter().flatten().for_each(|pid| send_signal(*pid, libc_kill()));
            }
            Kill::Call(call, count) => {
                if let Some(pid) = running.await_role_or_end(&bench, &self.role) {
                    let inject = format!("inject={call}:signal=KILL:when={count}");
                    let mut strace = Command::new("strace");
                    strace.args(["-f", "-qq", "-o", "/dev/null", "-e", &format!("trace={call}"), "-e", &inject]);
                    strace
                        .args(["-p", &pid.to_string()])
                        .stdin(Stdio::null())
                        .stdout(Stdio::null())
                        .stderr(Stdio::null());
                    tracer = strace.spawn().ok();
                }
            }
        }
        let done = running.wait();
        tracer.iter_mut().for_each(|tracer| drop((tracer.kill(), tracer.wait())));
        bench.assert_clean(&[]);
        self.judge(&done)
    }

    fn judge(&self, done: &Done) -> (bool, Option<String>) {
        // A role that dies before the ticks run ends the run with an error.
        if done.code == Some(4) && done.stdout.is_empty() {
            let mut killed = self.companions.iter().chain([&self.role]);
            let named = killed.any(|role| done.stderr.contains(&format!("{role} died")));
            return (true, (!named).then(|| format!("its death is not reported: {done:?}")));
        }
        let Ok(summary) = serde_json::from_str::<Value>(&done.stdout) else {
            return (false, Some(format!("no summary: {done:?}")));
        };
        let killed = summary["incidents"].as_array().is_some_and(|incidents| {
            incidents.iter().any(|incident| {
                incident["role"] == self.role.as_str()
                    && incident["cause"].as_str().is_some_and(|cause| cause.contains("SIGKILL"))
            })
        });
        let wrong = if summary["books"]["balanced"] != true {
            Some(format!("the counters do not balance: {:#}", summary["books"]["problems"]))
        } else if done.code != Some(0) && done.code != Some(3) {
            Some(format!("exit code {:?}: {}", done.code, done.stderr))
        } else if self.realtime {
            None
        } else {
            let undisturbed = undisturbed(self.scenario);
            difference(&invariant_parts(&undisturbed), &invariant_parts(&summary))
        };
        (killed, wrong)
    }
}

fn libc_kill() -> i32 {
    rustix::process::Signal::KILL.as_raw()
}

fn lockstep(scenario: &str) -> Vec<String> {
    let parsed = parsed(scenario);
    // Scripted faults run to their end.
    let ticks = if parsed.faults.is_empty() { TICKS } else { parsed.last_tick };
    vec!["--clock=lockstep".to_owned(), format!("--duration={}", ticks as f64 * parsed.tick_s())]
}

fn bench(scenario: &str) -> Bench {
    let bench = Bench::new();
    let (_, text) = scenarios().iter().find(|(name, _)| *name == scenario).unwrap();
    std::fs::write(bench.path(&format!("{scenario}.toml")), text).unwrap();
    bench
}

/// Returns the summary of an undisturbed run of a scenario.
fn undisturbed(scenario: &'static str) -> Value {
    static KNOWN: LazyLock<Mutex<BTreeMap<&'static str, Value>>> = LazyLock::new(Mutex::default);
    let mut known = KNOWN.lock().unwrap();
    let run = || {
        let case =
            Case { scenario, role: String::new(), companions: Vec::new(), realtime: false, kill: Kill::Instant(0) };
        let arguments = case.arguments();
        let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
        let done = bench(scenario).run(&arguments);
        done.json()
    };
    known.entry(scenario).or_insert_with(run).clone()
}

/// Returns the parts of a summary that must not depend on a kill.
fn invariant_parts(summary: &Value) -> Value {
    serde_json::json!({
        "state": summary["state"],
        "roles": summary["books"]["roles"],
        "links": summary["books"]["links"],
        "injected": summary["books"]["injected_faults"],
        "metrics": summary["score"]["metrics"],
        "certificate": summary["score"]["certificate"],
        "watchdog": summary["watchdog"],
    })
}

/// Returns the first difference of two values.
fn difference(was: &Value, is: &Value) -> Option<String> {
    let keys = |value: &Value| value.as_object().map(|object| object.keys().cloned().collect::<Vec<_>>());
    match (was, is) {
        (Value::Object(a), Value::Object(b)) if keys(was) == keys(is) => {
            a.iter().zip(b.values()).find_map(|((key, a), b)| difference(a, b).map(|found| format!("{key}: {found}")))
        }
        (Value::Array(a), Value::Array(b)) if a.len() == b.len() => {
            a.iter().zip(b).enumerate().find_map(|(n, (a, b))| difference(a, b).map(|found| format!("{n}: {found}")))
        }
        _ => (was != is).then(|| format!("{was} became {is}")),
    }
}

#[test]
fn random_kills_lose_nothing_in_lockstep_and_balance_in_real_time() {
    let variable = |name: &str, otherwise: u64| std::env::var(name).map_or(otherwise, |text| text.parse().unwrap());
    let (kills, seed) = (variable("COROTATE_KILLS", 40), variable("COROTATE_SEED", 1));
    let traced = Command::new("strace").arg("-V").stdout(Stdio::null()).status().is_ok();
    if !traced {
        skipped("kills at system calls", "strace is missing (Debian: apt install strace)");
    }
    let (next, hit) = (AtomicU64::new(0), AtomicU64::new(0));
    let wrong = Mutex::new(Vec::new());
    std::thread::scope(|scope| {
        for _ in 0..3 {
            scope.spawn(|| {
                loop {
                    let number = next.fetch_add(1, Ordering::Relaxed);
                    if number >= kills {
                        break;
                    }
                    let case = Case::draw(number, seed, traced);
                    let (killed, difference) = case.run();
                    hit.fetch_add(u64::from(killed), Ordering::Relaxed);
                    if let Some(difference) = difference {
                        eprintln!("{number}: {case:?}: {difference}");
                        wrong.lock().unwrap().push(format!("{number}: {case:?}: {difference}"));
                    }
                    if number % 500 == 499 {
                        println!("{} of {kills} done", number + 1);
                    }
                }
            });
        }
    });
    let (hit, wrong) = (hit.into_inner(), wrong.into_inner().unwrap());
    println!("{kills} runs with seed {seed}: {hit} roles killed, {} differences", wrong.len());
    assert!(wrong.is_empty(), "{wrong:#?}");
    assert!(hit * 2 > kills, "only {hit} of {kills} kills hit a role");
}

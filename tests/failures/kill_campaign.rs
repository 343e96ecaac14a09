//! Roles killed at random: a random role of a random scenario, at a random place of its life, at a random instant,
//! alone or together with others, or at a random system call. In lockstep nothing may be lost: hash, counters and metrics are those of an undisturbed run.
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

/// Ticks of a run: long enough to be hit in the midst.
const TICKS: u64 = 4_000;
const PLACES: [&str; 6] = ["staged", "committing", "in-commit", "committed", "sent", "waiting"];
/// What happens to samples on their way and to their ticks, all the time: whoever dies, dies amid it. (A generation with a
/// flipped bit is another one in every life.)
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

/// How a role is killed.
#[derive(Debug)]
enum Kill {
    /// By itself, the how manieth time that it comes by a place.
    Place(&'static str, u64),
    /// From outside, so long after it was seen, µs.
    Instant(u64),
    /// By a tracer, at its how manieth system call of a kind.
    Call(&'static str, u64),
}

#[derive(Debug)]
struct Case {
    scenario: &'static str,
    role: String,
    /// Who is killed in the same instant.
    others: Vec<String>,
    realtime: bool,
    kill: Kill,
}

fn below(random: &mut Pcg64, limit: u64) -> u64 {
    random.next_u64() % limit
}

/// The shipped scenarios, and one whose samples are disturbed.
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
        let others = names.into_iter().filter(|name| together && *name != role && below(&mut random, 2) == 0).collect();
        Self { scenario, role, others, realtime, kill }
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
        // However long a loaded machine takes to start everybody.
        let fixed = fixed.into_iter().chain(["--set=launch.startup_timeout_s=120".to_owned()]);
        fixed.into_iter().chain(clock).collect()
    }

    /// Runs it; whether the role was killed at all, and what is wrong.
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
                let roles = self.others.iter().chain([&self.role]);
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
        // Before the ticks run a role that dies ends the run, and says so.
        if done.code == Some(4) && done.stdout.is_empty() {
            let mut killed = self.others.iter().chain([&self.role]);
            let named = killed.any(|role| done.stderr.contains(&format!("{role} died")));
            return (true, (!named).then(|| format!("its death is not told: {done:?}")));
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
            difference(&told(&undisturbed), &told(&summary))
        };
        (killed, wrong)
    }
}

fn libc_kill() -> i32 {
    rustix::process::Signal::KILL.as_raw()
}

fn lockstep(scenario: &str) -> Vec<String> {
    let parsed = parsed(scenario);
    // What is scripted is played to its end.
    let ticks = if parsed.faults.is_empty() { TICKS } else { parsed.last_tick };
    vec!["--clock=lockstep".to_owned(), format!("--duration={}", ticks as f64 * parsed.tick_s())]
}

fn bench(scenario: &str) -> Bench {
    let bench = Bench::new();
    let (_, text) = scenarios().iter().find(|(name, _)| *name == scenario).unwrap();
    std::fs::write(bench.path(&format!("{scenario}.toml")), text).unwrap();
    bench
}

/// The summary of a run of a scenario that nobody disturbs.
fn undisturbed(scenario: &'static str) -> Value {
    static KNOWN: LazyLock<Mutex<BTreeMap<&'static str, Value>>> = LazyLock::new(Mutex::default);
    let mut known = KNOWN.lock().unwrap();
    let run = || {
        let case = Case { scenario, role: String::new(), others: Vec::new(), realtime: false, kill: Kill::Instant(0) };
        let arguments = case.arguments();
        let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
        let done = bench(scenario).run(&arguments);
        done.json()
    };
    known.entry(scenario).or_insert_with(run).clone()
}

/// What of a summary must not depend on whether a role was killed.
fn told(summary: &Value) -> Value {
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

/// The first thing in which two values differ.
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
    let of = |name: &str, otherwise: u64| std::env::var(name).map_or(otherwise, |text| text.parse().unwrap());
    let (kills, seed) = (of("COROTATE_KILLS", 40), of("COROTATE_SEED", 1));
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
    assert!(hit * 2 > kills, "most of them were hit: {hit} of {kills}");
}

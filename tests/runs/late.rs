//! Late ticks: causes that a test plants at random instants are named, in the kernel's trace by name and in the counters by kind.

use crate::common::{Bench, Running, send_signal, skipped};
use corotate::clock::raw_ns;
use corotate::late::{CauseKind, LateReport, LateTick};
use rustix::thread::{CpuSet, sched_setaffinity};
use std::ffi::CString;
use std::net::UdpSocket;
use std::path::Path;
use std::process::Command;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// The name of the thread that takes cores away.
const CULPRIT: &str = "culprit";
/// The least number of planted late ticks of a run that is judged.
const PLANTED: usize = 50;
/// Only one run at a time plants culprits: they would disturb each other.
static TURN: Mutex<()> = Mutex::new(());

/// Times of disturbances, ns.
type Times = Vec<(u64, u64)>;

/// Runs a scenario in real time while `disturb` runs beside it, until the flag is set. Returns the late ticks.
fn run_beside(
    bench: &Bench,
    trace: &str,
    options: &[&str],
    disturb: impl Fn(&Bench, &AtomicBool) -> Times + Sync,
) -> (LateReport, Times) {
    run_command(bench, trace, options, with_tracefs(bench, &[]), disturb)
}

/// The same with a variable in the environment.
#[cfg(feature = "hooks")]
fn run_with(
    bench: &Bench,
    trace: &str,
    options: &[&str],
    variable: (&str, &str),
    disturb: impl Fn(&Bench, &AtomicBool) -> Times + Sync,
) -> (LateReport, Times) {
    let mut command = with_tracefs(bench, &[]);
    command.env(variable.0, variable.1);
    run_command(bench, trace, options, command, disturb)
}

fn run_command(
    bench: &Bench,
    trace: &str,
    options: &[&str],
    mut command: Command,
    disturb: impl Fn(&Bench, &AtomicBool) -> Times + Sync,
) -> (LateReport, Times) {
    let _turn = TURN.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    let trace = format!("--set=realtime.trace=\"{trace}\"");
    let arguments =
        ["run", "rigid-pair", "--clock=realtime", "--duration=8", "--out=out", "--set=accept={}", "--quiet"];
    let ended = AtomicBool::new(false);
    let (done, times) = std::thread::scope(|scope| {
        let running = Running::new(command.args(arguments).arg(trace).args(options));
        bench.await_ticks("controller");
        let culprit = scope.spawn(|| disturb(bench, &ended));
        let done = running.wait();
        ended.store(true, Ordering::Relaxed);
        (done, culprit.join().unwrap())
    });
    done.succeeded();
    (serde_json::from_slice(&std::fs::read(bench.path("out/late.json")).unwrap()).unwrap(), times)
}

/// Returns a command of the program that another one, if given, starts; in a mount namespace with tracefs if the machine has not
/// mounted it.
fn with_tracefs(bench: &Bench, through: &[&str]) -> Command {
    let program = bench.command().get_program().to_owned();
    let mount = "mount -t tracefs nodev /sys/kernel/tracing 2>/dev/null; exec \"$0\" \"$@\"";
    let namespace = ["unshare", "--mount", "sh", "-c", mount];
    let needs_mount = !has_tracefs() && rustix::process::geteuid().is_root();
    let words: Vec<&str> = namespace.into_iter().filter(|_| needs_mount).chain(through.iter().copied()).collect();
    match words.split_first() {
        None => bench.command(),
        Some((first, rest)) => {
            let mut command = bench.command_of(Path::new(first));
            command.args(rest).arg(program);
            command
        }
    }
}

fn has_tracefs() -> bool {
    Path::new("/sys/kernel/tracing/instances").exists()
}

/// Returns true if a run here records the kernel's trace; otherwise reports a skipped check.
fn has_kernel_trace(report: &LateReport, what: &str) -> bool {
    let traced = report.source == corotate::late::Source::Kernel;
    if !traced {
        skipped(what, report.note.as_deref().unwrap_or("there is no kernel trace"));
    }
    traced
}

/// Pseudo-random pauses of 20 to 60 ms.
fn pauses() -> impl Iterator<Item = Duration> {
    let mut state = 7_u64;
    std::iter::from_fn(move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        Some(Duration::from_micros(20_000 + (state >> 33) % 40_000))
    })
}

/// Makes the calling thread the culprit: its name, its core, and its priority as words of `chrt` or `renice`.
fn become_culprit(core: usize, priority: &[&str]) {
    rustix::thread::set_name(&CString::new(CULPRIT).unwrap()).unwrap();
    let mut set = CpuSet::new();
    set.set(core);
    sched_setaffinity(None, &set).unwrap();
    if let Some((program, words)) = priority.split_first() {
        let tid = rustix::thread::gettid().as_raw_nonzero().to_string();
        assert!(Command::new(program).args(words).arg(tid).output().unwrap().status.success(), "{priority:?}");
    }
}

/// Calls `disturb` again and again after random pauses; it enters when it disturbed.
fn at_random_instants(ended: &AtomicBool, mut disturb: impl FnMut(&mut Times)) -> Times {
    let mut times = Vec::new();
    for pause in pauses() {
        std::thread::sleep(pause);
        if ended.load(Ordering::Relaxed) {
            break;
        }
        disturb(&mut times);
    }
    times
}

/// Computes on core 1 for `busy` at random instants.
fn hog(priority: &[&str], busy: Duration, ended: &AtomicBool) -> Times {
    work(priority, busy, ended, || ())
}

/// Repeats `step` on core 1 for `busy` at random instants. Times in which another task had its core are left out.
fn work(priority: &[&str], busy: Duration, ended: &AtomicBool, mut step: impl FnMut()) -> Times {
    const PREEMPTED_NS: u64 = 50_000;
    become_culprit(1, priority);
    at_random_instants(ended, |times| {
        let (mut begun_ns, mut last_ns) = (raw_ns(), raw_ns());
        let end_ns = begun_ns + busy.as_nanos() as u64;
        while last_ns < end_ns {
            step();
            let now_ns = raw_ns();
            if now_ns - last_ns > PREEMPTED_NS {
                times.push((begun_ns, last_ns));
                begun_ns = now_ns;
            }
            last_ns = now_ns;
        }
        times.push((begun_ns, last_ns));
    })
}

/// Returns the late ticks of which disturbances took at least half of the delay, and which no other late tick caused.
fn planted<'a>(report: &'a LateReport, times: &Times) -> Vec<&'a LateTick> {
    let overlap = |late: &LateTick| {
        let from_ns = report.epoch_ns + (late.time_s * 1e9) as u64;
        let to_ns = from_ns + (late.late_us * 1e3) as u64;
        times.iter().map(|(begun, ended)| (*ended).min(to_ns).saturating_sub((*begun).max(from_ns))).sum::<u64>()
    };
    let roots = report.ticks.iter().filter(|late| late.caused_by.is_none());
    roots.filter(|late| overlap(late) as f64 >= 500.0 * late.late_us).collect()
}

/// Asserts that the main cause of at least `part` of these late ticks is the right one.
#[track_caller]
fn assert_named(late: &[&LateTick], part: f64, is_right: impl Fn(&LateTick) -> bool) {
    late.iter().for_each(|late| assert_explained(late));
    // On a busy machine other programs delay the roles too. Their names show that the trace was read; without a name it was not.
    let by_another = |late: &LateTick| {
        let (kind, name) = main_cause(late);
        kind == CauseKind::Task && name != CULPRIT && !is_right(late)
    };
    let late: Vec<&LateTick> = late.iter().copied().filter(|late| !by_another(late)).collect();
    assert!(late.len() >= PLANTED, "{} planted late ticks", late.len());
    let (right, wrong): (Vec<&LateTick>, Vec<&LateTick>) = late.iter().partition(|late| is_right(late));
    println!("{} of {} named rightly", right.len(), late.len());
    let enough = right.len() as f64 >= part * late.len() as f64;
    assert!(enough, "{} of {}; wrong: {:#?}", right.len(), late.len(), wrong.first());
}

/// Asserts that the causes never explain more than the delay.
#[track_caller]
fn assert_explained(late: &LateTick) {
    let sum: f64 = late.causes.iter().map(|cause| cause.us).sum();
    assert!(sum <= late.late_us * 1.001 + 1.0, "{late:#?}");
}

fn main_cause(late: &LateTick) -> (CauseKind, &str) {
    late.causes.first().map_or((CauseKind::Unknown, ""), |cause| (cause.kind, &cause.name))
}

/// Returns true if the test can take cores from roles; otherwise reports a skipped check.
fn can_disturb(what: &str) -> bool {
    let cores = rustix::thread::sched_getaffinity(None).unwrap();
    match (rustix::process::geteuid().is_root(), cores.is_set(0) && cores.is_set(1)) {
        (true, true) => true,
        (false, _) => {
            skipped(what, "it needs root");
            false
        }
        (true, false) => {
            skipped(what, "it needs cores 0 and 1");
            false
        }
    }
}

/// Returns true if a main cause is the planted one.
type IsRight = dyn Fn(CauseKind, &str) -> bool;

/// Plants one culprit in a run with each source, and asserts that the main cause is right: by name in the kernel's trace, by kind in the
/// counters. Returns the report with the kernel's trace.
#[track_caller]
fn assert_culprit(
    what: &str,
    options: &[&str],
    disturb: impl Fn(&Bench, &AtomicBool) -> Times + Sync,
    [named, of_kind]: [&IsRight; 2],
) -> Option<LateReport> {
    if !can_disturb(what) {
        return None;
    }
    let bench = Bench::new();
    let mut traced = None;
    for trace in ["kernel", "counters"] {
        let (report, times) = run_beside(&bench, trace, &[options, &["--overwrite"]].concat(), &disturb);
        let late = planted(&report, &times);
        let is = |right: &IsRight, late: &LateTick| {
            let (kind, name) = main_cause(late);
            right(kind, name)
        };
        if trace == "counters" {
            assert_eq!(report.traced, Some(0));
            assert_named(&late, 0.8, |late| is(of_kind, late));
        } else if has_kernel_trace(&report, what) {
            assert!(report.traced.is_some_and(|traced| (1..=report.examined).contains(&traced)), "{:?}", report.traced);
            assert_named(&late, 0.95, |late| is(named, late));
            traced = Some(report.clone());
        }
    }
    traced
}

#[test]
fn a_task_of_higher_priority_is_named() {
    let _ = assert_culprit(
        "a task of higher priority as the cause of late ticks",
        &["--set=realtime.cores=[1]", "--set=realtime.late_us=300"],
        |_, ended| hog(&["chrt", "-f", "-p", "95"], Duration::from_micros(800), ended),
        [&|kind, name| (kind, name) == (CauseKind::Task, CULPRIT), &|kind, _| kind == CauseKind::Task],
    );
}

#[test]
fn an_ordinary_task_beside_unprivileged_roles_is_named() {
    let _ = assert_culprit(
        "an ordinary task as the cause of late ticks",
        &["--set=realtime.cores=[1]", "--set=realtime.priority=0", "--set=realtime.late_us=300"],
        |_, ended| hog(&["renice", "-n", "-20", "-p"], Duration::from_millis(3), ended),
        [&|kind, name| (kind, name) == (CauseKind::Task, CULPRIT), &|kind, _| kind == CauseKind::Task],
    );
}

/// Packets over loopback are received in a softirq in the time of their sender.
#[test]
fn network_load_is_named() {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    let to = socket.local_addr().unwrap();
    // A full queue drops packets.
    let flood = |_: &Bench, ended: &AtomicBool| {
        work(&["renice", "-n", "-20", "-p"], Duration::from_millis(3), ended, || {
            let _ = socket.send_to(&[0; 1024], to);
        })
    };
    let kernel = assert_culprit(
        "network load as the cause of late ticks",
        &["--set=realtime.cores=[1]", "--set=realtime.priority=0", "--set=realtime.late_us=300"],
        flood,
        [
            &|kind, name| {
                matches!((kind, name), (CauseKind::Task, CULPRIT | "ksoftirqd/1") | (CauseKind::Softirq, "NET_RX"))
            },
            &|kind, _| matches!(kind, CauseKind::Task | CauseKind::CoreTaken),
        ],
    );
    if let Some(report) = kernel {
        let received = report.causes.iter().find(|total| (total.kind, &*total.name) == (CauseKind::Softirq, "NET_RX"));
        assert!(received.is_some_and(|total| total.ticks > 0), "{:?}", report.causes);
    }
}

#[test]
fn a_stop_by_a_signal_is_named() {
    let stop = |bench: &Bench, ended: &AtomicBool| {
        let leader = bench.await_role("leader");
        at_random_instants(ended, |times| {
            let begun_ns = raw_ns();
            send_signal(leader, libc::SIGSTOP);
            std::thread::sleep(Duration::from_millis(3));
            send_signal(leader, libc::SIGCONT);
            times.push((begun_ns, raw_ns()));
        })
    };
    let stopped = |kind, _: &str| kind == CauseKind::Stopped;
    let _ = assert_culprit("a stop by a signal as the cause of late ticks", &[], stop, [&stopped, &stopped]);
}

#[test]
fn a_stalled_leader_is_blamed_for_the_late_ticks_of_its_readers() {
    if !can_disturb("a late input as the cause of late ticks") {
        return;
    }
    let bench = Bench::new();
    let stall = "--set=fault=[{kind=\"stall\", role=\"leader\", from_tick=100, ticks=7800, every=97, stall_ms=2.0}]";
    for (trace, part) in [("kernel", 0.95), ("counters", 0.8)] {
        let (report, _) = run_beside(&bench, trace, &[stall, "--overwrite"], |_, _| Vec::new());
        let stalled = |late: &&LateTick| late.role == "leader" && main_cause(late).0 == CauseKind::Fault;
        let leader: Vec<&LateTick> = report.ticks.iter().filter(stalled).collect();
        assert!(leader.len() >= PLANTED, "{trace}: {} stalls named", leader.len());
        for role in ["observer", "controller"] {
            // Ticks that only the leader delayed: the follower may be late at the same time.
            let during = |late: &&LateTick| {
                late.role == role && leader.iter().any(|stall| stall.tick == late.tick && stall.ticks == late.ticks)
            };
            let late: Vec<&LateTick> = report.ticks.iter().filter(during).collect();
            assert_named(&late, part, |late| {
                let roots = report.root_causes(late);
                let largest = roots.iter().max_by(|a, b| a.us.total_cmp(&b.us));
                main_cause(late).0 == CauseKind::Input && largest.is_some_and(|root| root.kind == CauseKind::Fault)
            });
        }
    }
}

/// Asserts that of the disturbances by a failpoint, at every 50th tick of the controller, the right part is named.
#[cfg(feature = "hooks")]
#[track_caller]
fn assert_failpoint(action: &str, kind: CauseKind, least_us: f64) {
    const EVERY: u64 = 50;
    if !can_disturb(action) {
        return;
    }
    let bench = Bench::new();
    for (trace, part) in [("kernel", 0.95), ("counters", 0.8)] {
        let hook = format!("controller computing {EVERY} {action}");
        let options = ["--overwrite", "--set=realtime.late_us=50"];
        let (report, _) = run_with(&bench, trace, &options, ("COROTATE_HOOK", &hook), |_, _| Vec::new());
        if trace == "kernel" && !has_kernel_trace(&report, action) {
            continue;
        }
        let summary = bench.summary_in("out");
        let executed = summary["books"]["roles"]["controller"]["executed"].as_u64().unwrap();
        let planted = (executed / EVERY) as usize;
        let named = |late: &&LateTick| {
            let cause = late.causes.iter().find(|cause| cause.kind == kind);
            late.role == "controller" && cause.is_some_and(|cause| cause.us >= least_us)
        };
        let late: Vec<&LateTick> = report.ticks.iter().filter(named).collect();
        println!("{action}, {trace}: {} of {planted} named", late.len());
        assert!(planted >= PLANTED && late.len() as f64 >= part * planted as f64, "{} of {planted}", late.len());
        report.ticks.iter().for_each(assert_explained);
    }
}

#[cfg(feature = "hooks")]
#[test]
fn a_long_step_is_named() {
    assert_failpoint("BURN", CauseKind::Step, 200.0);
}

#[cfg(feature = "hooks")]
#[test]
fn page_faults_are_named() {
    assert_failpoint("FAULT", CauseKind::PageFault, 20.0);
}

/// A cgroup with a limit of 20 ms of processor time in 100 ms.
struct Quota(std::path::PathBuf);

impl Quota {
    /// Creates the group; `None` if the machine has no cgroup with such limits, or this user must not create one.
    fn create() -> Option<Self> {
        let name = format!("corotate-test-{}", std::process::id());
        let (old, unified) = (Path::new("/sys/fs/cgroup/cpu").join(&name), Path::new("/sys/fs/cgroup").join(&name));
        if std::fs::create_dir(&old).is_ok() {
            let group = Self(old);
            let set = |file: &str, text: &str| std::fs::write(group.0.join(file), text).is_ok();
            return (set("cpu.cfs_period_us", "100000") && set("cpu.cfs_quota_us", "20000")).then_some(group);
        }
        std::fs::create_dir(&unified).ok()?;
        let group = Self(unified);
        std::fs::write(group.0.join("cpu.max"), "20000 100000").is_ok().then_some(group)
    }
}

impl Drop for Quota {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir(&self.0);
    }
}

#[test]
fn a_processor_quota_is_named_with_its_period() {
    let what = "a processor quota as the cause of late ticks";
    if !can_disturb(what) {
        return;
    }
    let Some(quota) = Quota::create() else { return skipped(what, "no cgroup with a limit can be created here") };
    let bench = Bench::new();
    for (trace, part) in [("kernel", 0.95), ("counters", 0.8)] {
        let tasks = quota.0.join("cgroup.procs");
        // Roles that spin all the time use up the quota.
        let options =
            ["--overwrite", "--set=realtime.priority=0", "--set=realtime.wake=\"spin\"", "--set=realtime.spin_us=250"];
        let move_there = format!("echo $$ > {}; exec \"$0\" \"$@\"", tasks.display());
        let (report, _) =
            run_command(&bench, trace, &options, with_tracefs(&bench, &["sh", "-c", &move_there]), |_, _| Vec::new());
        if trace == "kernel" && !has_kernel_trace(&report, what) {
            continue;
        }
        // Ticks of a body that lacked most of a quota's pause.
        let stopped = |late: &&LateTick| late.caused_by.is_none() && late.late_us > 30_000.0;
        let late: Vec<&LateTick> = report.ticks.iter().filter(stopped).collect();
        assert_named(&late, part, |late| main_cause(late).0 == CauseKind::Throttled);
        let found = report.patterns.iter().any(|pattern| pattern.period_ms == 100.0);
        assert!(found, "{:?}", report.patterns);
    }
}

#[test]
fn a_quiet_run_accuses_no_task_that_did_not_run() {
    if !can_disturb("the accusations of a quiet run") {
        return;
    }
    let bench = Bench::new();
    let (report, _) = run_beside(&bench, "kernel", &[], |_, _| Vec::new());
    report.ticks.iter().for_each(assert_explained);
    assert!(report.causes.iter().all(|total| total.name != CULPRIT));
    for late in report.ticks.iter().filter(|late| !late.slices.is_empty()) {
        for cause in late.causes.iter().filter(|cause| cause.kind == CauseKind::Task && late.late_us < 10_000.0) {
            let ran: f64 = late
                .slices
                .iter()
                .filter(|slice| slice.name == cause.name)
                .map(|slice| slice.to_us - slice.from_us)
                .sum();
            assert!(ran + 1.0 >= cause.us, "{cause} in {late:#?}");
        }
    }
}

//! Misbehaving participants of a run, and other users: none of them stalls, corrupts or starves the loop.

use crate::common::{Bench, Running, await_some, shipped, skipped};
use iceoryx2::prelude::*;
use libc::SIGTERM;
use serde_json::Value;
use std::os::unix::fs::MetadataExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};

const LEADER: &str = "corotate/rigid-pair/leader/measurement";

/// The type name and size of a rate measurement.
#[repr(C)]
#[derive(Debug, Clone, Copy, ZeroCopySend)]
#[type_name("corotate/rigid-body/measurement/v1#bcfd8b41")]
struct Measurement([u64; 12]);

/// The same name with another size.
#[repr(C)]
#[derive(Debug, Clone, Copy, ZeroCopySend)]
#[type_name("corotate/rigid-body/measurement/v1#bcfd8b41")]
struct Short([u64; 11]);

/// The same size with another version.
#[repr(C)]
#[derive(Debug, Clone, Copy, ZeroCopySend)]
#[type_name("corotate/rigid-body/measurement/v999")]
struct Later([u64; 12]);

type Ipc = ipc::Service;

/// A running run, and a neighbour's node in its domain.
struct Visit {
    bench: Bench,
    run: Running,
    domain: PathBuf,
    node: Node<Ipc>,
}

impl Visit {
    fn new(clock: &str) -> Self {
        // A neighbour that outlives the domain prints errors, which do not matter here.
        set_log_level(LogLevel::Fatal);
        let bench = Bench::new();
        let file = shipped("rigid-pair");
        let common = ["--duration=100000", "--set=accept={}", "--out=out", "--json", "--clock", clock];
        let run = bench.start(&[&["run", file.to_str().unwrap()][..], &common].concat());
        bench.await_role("controller");
        let domain = bench.await_domain();
        let mut config = Config::default();
        config.global.set_root_path(&iceoryx2::prelude::Path::new(domain.to_str().unwrap().as_bytes()).unwrap());
        let id = domain.file_name().unwrap().to_str().unwrap().to_owned();
        config.global.prefix = FileName::new(format!("corotate_{id}_").as_bytes()).unwrap();
        let node = await_some(|| NodeBuilder::new().config(&config).create::<Ipc>().ok());
        let visit = Self { bench, run, domain, node };
        // Ticks run once the follower has reported some.
        let reader = await_some(|| visit.service::<Measurement>(LEADER)?.subscriber_builder().create().ok());
        await_some(|| reader.receive().ok()?.filter(|sample| sample.payload().0[0] > 100));
        visit
    }

    /// Opens the service by name and type; `None` if that fails.
    fn service<T: ZeroCopySend + std::fmt::Debug + 'static>(
        &self,
        name: &str,
    ) -> Option<iceoryx2::service::port_factory::publish_subscribe::PortFactory<Ipc, T, ()>> {
        self.node.service_builder(&name.try_into().unwrap()).publish_subscribe::<T>().open().ok()
    }

    fn signal_tick(&self) -> u64 {
        let reader = self.service::<Measurement>(LEADER).unwrap().subscriber_builder().create().unwrap();
        await_some(|| reader.receive().unwrap().map(|sample| sample.payload().0[0]))
    }

    /// Lets the run continue for a while, ends it, and asserts that it was undisturbed.
    fn assert_unharmed(self) -> Value {
        let before = self.signal_tick();
        await_some(|| (self.signal_tick() > before + 300).then_some(()));
        self.run.signal(SIGTERM);
        drop(self.node);
        let done = self.run.wait();
        assert_eq!(done.code, Some(128 + SIGTERM), "{done:?}");
        let summary = done.json();
        assert_eq!(summary["books"]["balanced"], true, "{:#}", summary["books"]);
        assert_eq!(summary["incidents"].as_array().unwrap().len(), 0, "{summary:#}");
        assert!(summary["score"]["metrics"][0]["last"].as_f64().unwrap() < 2.0, "{:#}", summary["score"]);
        self.bench.assert_clean(&[self.domain]);
        summary
    }
}

#[test]
fn a_neighbour_with_another_type_version_or_size_is_refused() {
    let visit = Visit::new("realtime");
    assert!(visit.service::<Measurement>(LEADER).is_some(), "the right type must open");
    assert!(visit.service::<Short>(LEADER).is_none());
    assert!(visit.service::<Later>(LEADER).is_none());
    assert!(visit.service::<u64>(LEADER).is_none());
    visit.assert_unharmed();
}

#[test]
fn a_signal_has_one_publisher() {
    let visit = Visit::new("realtime");
    for signal in ["leader/measurement", "follower/measurement"] {
        let service = visit.service::<Measurement>(&format!("corotate/rigid-pair/{signal}")).unwrap();
        assert!(service.publisher_builder().create().is_err(), "{signal}");
    }
    visit.assert_unharmed();
}

/// One reader takes samples and never returns them, another never takes any.
#[test]
fn readers_that_hold_or_ignore_samples_do_not_delay_the_loop() {
    for clock in ["realtime", "lockstep"] {
        let visit = Visit::new(clock);
        let service = visit.service::<Measurement>(LEADER).unwrap();
        let (greedy, deaf) = (service.subscriber_builder().create().unwrap(), service.subscriber_builder().create());
        let mut held = Vec::new();
        await_some(|| {
            held.extend(greedy.receive().ok().flatten());
            (held.len() == 2).then_some(())
        });
        let values: Vec<[u64; 12]> = held.iter().map(|sample| sample.payload().0).collect();
        // Samples that it holds do not change.
        let before = visit.signal_tick();
        await_some(|| (visit.signal_tick() > before + 500).then_some(()));
        assert_eq!(values, held.iter().map(|sample| sample.payload().0).collect::<Vec<_>>());
        assert!(greedy.receive().is_err(), "a reader may hold two samples at most");
        drop((held, greedy, deaf));
        visit.assert_unharmed();
    }
}

/// Sends as many samples as the machine can, on a signal of the neighbour in the run's domain.
#[test]
fn a_flood_of_other_samples_does_not_affect_the_loop() {
    let visit = Visit::new("lockstep");
    let name = "corotate/rigid-pair/flood/measurement".try_into().unwrap();
    let service = visit.node.service_builder(&name).publish_subscribe::<Measurement>().create().unwrap();
    let (publisher, _deaf) =
        (service.publisher_builder().create().unwrap(), service.subscriber_builder().create().unwrap());
    for tick in 0..200_000 {
        // The transport's default mode would block on a reader that never reads; this signal overflows.
        publisher.send_copy(Measurement([tick; 12])).unwrap();
    }
    drop((publisher, service));
    visit.assert_unharmed();
}

/// A second process for a role that is taken is refused, and the counters stay those of the first.
#[test]
fn a_role_is_taken_once() {
    let visit = Visit::new("realtime");
    for role in [&["observer"][..], &["controller"], &["plant", "--body", "follower"]] {
        let done = visit.bench.run(&[role, &["--domain", visit.domain.to_str().unwrap()]].concat());
        assert_eq!(done.code, Some(1), "{done:?}");
        assert!(done.says("seat-taken"), "{done:?}");
    }
    visit.assert_unharmed();
}

/// All files of a running run are private to its user.
#[test]
fn no_file_of_a_run_is_open_to_other_users() {
    let visit = Visit::new("realtime");
    let id = visit.domain.file_name().unwrap().to_str().unwrap().to_owned();
    let shared = std::fs::read_dir("/dev/shm").unwrap().map(|entry| entry.unwrap().path());
    let shared: Vec<PathBuf> = shared.filter(|path| path.to_string_lossy().contains(&id)).collect();
    assert!(shared.len() > 20, "the signals and ledgers of four roles: {shared:?}");
    for path in shared.iter().chain([&visit.domain]) {
        // The mode of the domain's directory protects its content.
        let Ok(metadata) = std::fs::metadata(path) else { continue };
        assert_eq!(metadata.mode() & 0o077, 0, "{}: {:o}", path.display(), metadata.mode());
    }
    if rustix::process::getuid().is_root() {
        assert_closed_to_another_user(&visit, &shared);
    } else {
        skipped("what another user can reach", "only root can act as another user");
    }
    visit.assert_unharmed();
}

/// As another user, with the program itself and with a shell.
fn assert_closed_to_another_user(visit: &Visit, shared: &[PathBuf]) {
    let copy = tempfile::Builder::new().prefix("ct").tempdir_in("/tmp").unwrap();
    let program = copy.path().join("corotate");
    std::fs::copy(env!("CARGO_BIN_EXE_corotate"), &program).unwrap();
    std::fs::set_permissions(copy.path(), std::os::unix::fs::PermissionsExt::from_mode(0o755)).unwrap();
    let as_nobody = |program: &Path, arguments: &[&str]| {
        let mut command = std::process::Command::new(program);
        command.args(arguments).uid(65534).gid(65534).current_dir("/");
        Running::new(&mut command).wait()
    };
    let domain = visit.domain.to_str().unwrap();
    let done = as_nobody(&program, &["observer", "--domain", domain]);
    assert_eq!(done.code, Some(2), "{done:?}");
    assert!(done.says("not-a-domain"), "{done:?}");
    for path in shared.iter().chain([&visit.domain]) {
        let path = path.to_str().unwrap();
        let done = as_nobody(Path::new("/bin/sh"), &["-c", &format!("cat {path}/* {path} > /dev/null")]);
        assert_ne!(done.code, Some(0), "{path}: {done:?}");
    }
}

//! The hot path of a role allocates nothing between its first and last tick, as counted by a global allocator. iceoryx2
//! makes one small allocation per loan, off the critical path, which is counted separately.

use corotate::bus::domain::OwnedDomain;
use corotate::bus::iox::IoxBus;
use corotate::bus::{Bus, BusError, Carried, Read, Reader, Signal, Topic, Write};
use corotate::input::Change;
use corotate::rig::Rig;
use corotate::runtime::{
    DeviceConfig, DeviceLink, LineAddress, Privileges, RoleId, RoleImpl, build_rig, depths, private_ledger, topic,
};
use corotate::sample::{FleetLayout, Health, Phase, RoleState, Sample, Schedule};
use corotate::scenario::Scenario;
use corotate::seat::{RoleEnvironment, serve};
use corotate::serial::{Device, DeviceFlightComputer, DevicePlant, DeviceRole, Hello};
use corotate::telemetry::RoleReport;
use corotate::with_shipped_rig;
use rustix::fd::OwnedFd;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

/// The counters of this thread.
#[derive(Clone, Copy)]
struct Count {
    armed: bool,
    in_prepare: bool,
    prepares: u64,
    ours: u64,
    transport: u64,
    /// `ours` at the last real sample: the report, which allocates, is not part of the loop.
    ours_in_loop: u64,
}

impl Count {
    const ZERO: Self = Self { armed: false, in_prepare: false, prepares: 0, ours: 0, transport: 0, ours_in_loop: 0 };
}

thread_local! {
    static COUNT: Cell<Count> = const { Cell::new(Count::ZERO) };
}

fn update(change: impl FnOnce(&mut Count)) {
    // The allocator is also called while a thread's local values are destroyed.
    let _ = COUNT.try_with(|count| {
        let mut value = count.get();
        change(&mut value);
        count.set(value);
    });
}

struct CountingAllocator;

#[allow(unsafe_code)]
// SAFETY: every call is passed on unchanged to the system's allocator; counting only changes a thread-local cell.
unsafe impl GlobalAlloc for CountingAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        update(|count| {
            if count.armed && count.in_prepare {
                count.transport += 1;
            } else if count.armed {
                count.ours += 1;
            }
        });
        // SAFETY: the caller guarantees for `layout` what the system allocator requires.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: `pointer` came from `alloc` above, that is from the system's allocator.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

/// The real bus; the first real sample that a role sends starts the counting.
struct CountedBus(IoxBus);
struct CountedWriter<W>(W);

impl Bus for CountedBus {
    const REPEATS: bool = <IoxBus as Bus>::REPEATS;
    type Writer<S: Sample> = CountedWriter<<IoxBus as Bus>::Writer<S>>;
    type Reader<S: Sample> = <IoxBus as Bus>::Reader<S>;
    type FleetWriter<L: FleetLayout> = CountedWriter<<IoxBus as Bus>::FleetWriter<L>>;
    type FleetReader<L: FleetLayout> = <IoxBus as Bus>::FleetReader<L>;

    fn writer<S: Sample>(&self, topic: &Topic, generation: u64) -> Result<Self::Writer<S>, BusError> {
        self.0.writer(topic, generation).map(CountedWriter)
    }

    fn reader<S: Sample>(&self, topic: &Topic, reader: Reader) -> Result<Self::Reader<S>, BusError> {
        self.0.reader(topic, reader)
    }

    fn fleet_writer<L: FleetLayout>(&self, topic: &Topic, bodies: usize) -> Result<Self::FleetWriter<L>, BusError> {
        self.0.fleet_writer(topic, bodies).map(CountedWriter)
    }

    fn fleet_reader<L: FleetLayout>(
        &self,
        topic: &Topic,
        reader: Reader,
        bodies: usize,
    ) -> Result<Self::FleetReader<L>, BusError> {
        self.0.fleet_reader(topic, reader, bodies)
    }
}

impl<S: Carried + ?Sized, W: Write<S>> Write<S> for CountedWriter<W> {
    fn fill(&mut self, fill: impl FnOnce(&mut S)) -> Result<(), BusError> {
        let mut real = false;
        self.0.fill(|sample| {
            fill(sample);
            real = S::type_name() != Health::TYPE_NAME && sample.stamp().generation != 0;
        })?;
        if real {
            update(|count| (count.armed, count.ours_in_loop) = (true, count.ours));
        }
        Ok(())
    }

    fn deliver(&mut self) -> Result<(), BusError> {
        self.0.deliver()
    }

    fn prepare(&mut self) -> Result<(), BusError> {
        update(|count| {
            count.in_prepare = true;
            count.prepares += u64::from(count.armed);
        });
        let prepared = self.0.prepare();
        update(|count| count.in_prepare = false);
        prepared
    }

    fn refresh(&mut self) -> Result<(), BusError> {
        self.0.refresh()
    }
}

/// Serves one role in this thread; returns its report and its allocations.
fn count_role(scenario: &Scenario, role_impl: impl Into<RoleImpl>, domain: &OwnedDomain) -> (RoleReport, Count) {
    let role_impl = role_impl.into();
    let role = role_impl.role();
    let bus = CountedBus(IoxBus::enter(domain.domain(), role.name(scenario), depths(scenario)).unwrap());
    let terminated = AtomicBool::new(false);
    let mut result = None;
    let ledger = private_ledger(scenario, role);
    let build = |role_impl| with_shipped_rig!(scenario.rig, rig => build_rig(rig, scenario, role_impl, &bus, &ledger));
    let privileges = Privileges::default();
    let service = RoleEnvironment { scenario, bus: &bus, ledger: &ledger, terminated: &terminated, privileges };
    serve(service, role_impl, build, |report| {
        result = Some((report.clone(), COUNT.get()));
        Ok(())
    })
    .unwrap();
    result.unwrap()
}

/// Leads the roles through a real-time run like the launcher.
fn conduct(scenario: &Scenario, domain: &OwnedDomain) {
    let bus = IoxBus::enter(domain.domain(), "conductor", depths(scenario)).unwrap();
    let mut schedule = bus.writer::<Schedule>(&topic(scenario, "run", Signal::Schedule), 1).unwrap();
    let mut health: Vec<_> = RoleId::all(scenario)
        .iter()
        .map(|role| bus.reader::<Health>(&topic(scenario, role.name(scenario), Signal::Health), Reader::Role).unwrap())
        .collect();
    let end = Instant::now() + Duration::from_secs(120);
    let steps = [(Phase::Gather, RoleState::Open), (Phase::WarmUp, RoleState::Ready), (Phase::Run, RoleState::Done)];
    for (phase, state) in steps {
        let epoch_ns = corotate::clock::monotonic_ns() + 100_000_000;
        let reached = |health: &mut <IoxBus as Bus>::Reader<Health>| {
            while health.advance().unwrap() {}
            health.current().is_some_and(|health| RoleState::from_number(health.state) >= state)
        };
        while !health.iter_mut().all(reached) {
            assert!(Instant::now() < end, "the run hung");
            schedule
                .send(|word| {
                    (word.phase, word.epoch_ns, word.credit_tick) = (phase as u64, epoch_ns, scenario.last_tick)
                })
                .unwrap();
            std::thread::sleep(Duration::from_millis(1));
        }
    }
    schedule.send(|word| word.phase = Phase::Stop as u64).unwrap();
}

/// Opens a pty; returns the device's end and the path of the bridge's end.
fn line() -> (OwnedFd, PathBuf) {
    let far = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
    grantpt(&far).unwrap();
    unlockpt(&far).unwrap();
    let name = ptsname(&far, Vec::new()).unwrap();
    (far, PathBuf::from(name.to_str().unwrap()))
}

/// Runs a device with these roles of the scenario until the other end hangs up.
fn device(scenario: &Scenario, roles: &[RoleId], far: &OwnedFd) {
    with_shipped_rig!(scenario.rig, rig => match roles {
        [RoleId::Plant(index)] => serve_device(|hello| Some(DevicePlant::new(rig.body(*index), hello)), far),
        _ => serve_device(|hello| Some(DeviceFlightComputer::new(rig.estimator(), [rig.law(1)], hello)), far),
    })
}

fn serve_device<S: DeviceRole>(create: impl FnMut(&Hello<'_>) -> Option<S>, far: &OwnedFd) {
    let (mut device, mut bytes) = (Device::new("test", create), [0; 512]);
    while let Ok(count @ 1..) = rustix::io::read(far, &mut bytes) {
        device.receive(&bytes[..count], 0, |frame| assert_eq!(rustix::io::write(far, frame), Ok(frame.len())));
    }
}

/// Opens the link to that device and exchanges greetings.
fn link_device(scenario: &Scenario, roles: &[RoleId], path: &Path) -> RoleImpl {
    let names = roles.iter().map(|role| role.name(scenario).to_owned()).collect();
    let config = DeviceConfig {
        domain: PathBuf::new(),
        roles: names,
        line: LineAddress::Serial { path: path.to_owned(), baud: None },
        patience_s: 60.0,
        other_device: false,
        pace: None,
    };
    let mut link = DeviceLink::open(&config, scenario, roles, 1).unwrap();
    assert!(link.greet(None, &AtomicBool::new(false)).unwrap().is_some());
    let (last, rest) = roles.split_last().unwrap();
    let rest = rest.iter().map(|role| (*role, private_ledger(scenario, *role))).collect();
    RoleImpl::Device(*last, rest, Box::new(link))
}

/// Returns the counts of every process; the roles `in_device` run in a device.
fn counts(text: &str, in_device: &[RoleId], processes: &str) -> Vec<(RoleReport, Count)> {
    let processes = format!("launch.processes={processes}");
    // With a device, slow enough for any machine.
    let (tick, duration) =
        if in_device.is_empty() { ("tick_hz=1000", "duration_s=1") } else { ("tick_hz=200", "duration_s=4") };
    let overrides = ["clock=realtime", tick, duration, "accept={}", "fault=[]", "watchdog={}", &processes];
    let overrides = overrides.map(str::to_owned);
    let scenario = Scenario::parse(text, "test", &overrides).unwrap();
    // The run receives each change of the scenario once more, a little later.
    let again = |change: &Change| Change { tick: change.tick + 50, ..*change };
    let again: Vec<Change> = scenario.inputs.scripted.iter().map(again).collect();
    assert!(again.is_empty() || scenario.inputs.received().append(&again, || true));
    let domain = OwnedDomain::create(0).unwrap();
    // All roles of a device are in the process of the last.
    let elsewhere = &in_device[..in_device.len().saturating_sub(1)];
    let hosts = RoleId::all(&scenario).into_iter();
    let hosts = hosts.filter(|role| role.process_role(&scenario) == *role && !elsewhere.contains(role));
    let (roles, (far, path)) = (hosts.collect::<Vec<_>>(), line());
    std::thread::scope(|scope| {
        let (scenario, domain, path) = (&scenario, &domain, &path);
        let mut by_device = None;
        let threads: Vec<_> = roles
            .iter()
            .map(|role| match role {
                role if in_device.last() == Some(role) => {
                    by_device = Some(scope.spawn(|| device(scenario, in_device, &far)));
                    scope.spawn(move || count_role(scenario, link_device(scenario, in_device, path), domain))
                }
                role => scope.spawn(move || {
                    let rest = role.process_members(scenario).into_iter().filter(|member| member != role);
                    let rest = rest.map(|member| (member, private_ledger(scenario, member))).collect();
                    count_role(scenario, RoleImpl::Role(*role, rest), domain)
                }),
            })
            .collect();
        conduct(scenario, domain);
        let counts = threads.into_iter().map(|thread| thread.join().unwrap()).collect();
        if let Some(device) = by_device {
            device.join().unwrap();
        }
        counts
    })
}

fn assert_no_allocation(name: &str, counts: Vec<(RoleReport, Count)>) {
    for (report, count) in counts {
        let ticks = report.ticks.executed;
        println!(
            "{name} {}: {ticks} ticks, {} allocations of ours, {} of iceoryx2 in {} loans",
            report.role, count.ours_in_loop, count.transport, count.prepares
        );
        assert!(count.armed && ticks > 0, "{name} {}: nothing was counted", report.role);
        assert_eq!(count.ours_in_loop, 0, "{name} {}", report.role);
        assert!(count.transport <= count.prepares, "{name} {}: one per loan at most", report.role);
    }
}

#[test]
fn no_role_allocates_between_its_first_tick_and_its_last() {
    for (name, text) in corotate::config::SHIPPED {
        assert_no_allocation(name, counts(text, &[], "[]"));
    }
}

#[test]
fn changes_of_inputs_do_not_allocate() {
    let (name, text) = corotate::config::SHIPPED[0];
    let input = |at_s: f64, key: &str, value: &str, shape: &str| {
        format!("\n[[input]]\nat_s = {at_s}\nkey = \"{key}\"\nvalue = {value}\n{shape}\n")
    };
    let ramp = "shape = \"ramp\"\nduration_s = 0.1";
    let sine = "shape = \"sine\"\nduration_s = 0.3\nfrequency_hz = 20.0";
    let changes = input(0.3, "controller.gain_per_s", "[5.0, 5.0, 5.0]", ramp)
        + &input(0.4, "observer.decay_rate_per_s", "7.0", "")
        + &input(0.5, "follower.0.offset_rad_s", "[0.1, 0.0, 0.0]", "")
        + &input(0.55, "follower.0.disturbance_rad_s2", "[0.0, 0.1, 0.0]", sine)
        + &input(0.6, "actuator.safe", "true", "shape = \"pulse\"\nduration_s = 0.01");
    assert_no_allocation(name, counts(&(text.to_owned() + &changes), &[], "[]"));
}

#[test]
fn a_process_of_several_roles_does_not_allocate() {
    let (name, text) = corotate::config::SHIPPED[0];
    for (processes, count) in [
        ("[['observer', 'controller']]", 3),
        ("[['leader', 'controller'], ['follower', 'observer']]", 2),
        ("[['leader', 'follower', 'observer', 'controller']]", 1),
    ] {
        let counts = counts(text, &[], processes);
        assert_eq!(counts.len(), count, "{processes}");
        assert_no_allocation(name, counts);
    }
}

#[test]
fn a_bridge_to_a_device_does_not_allocate() {
    let (name, text) = corotate::config::SHIPPED[0];
    for roles in [&[RoleId::Plant(1)][..], &[RoleId::Observer(0), RoleId::Controller]] {
        let counts = counts(text, roles, "[]");
        assert!(roles.len() > 1 || counts.iter().any(|(report, _)| report.role == "follower" && report.line.is_some()));
        assert_no_allocation(name, counts);
    }
}

//! Any bytes from an external role or launcher: its health, its schedule, its report.
#![no_main]

use corotate::bus::memory::MemoryBus;
use corotate::bus::{Bus, Reader, Signal, Write};
use corotate::config::SHIPPED;
use corotate::record::RecordingReport;
use corotate::runtime::{LauncherLink, depths, topic};
use corotate::sample::{Health, Message, RoleState, Schedule};
use corotate::scenario::Scenario;
use corotate::telemetry::RoleReport;
use corotate::watch::RoleLine;
use libfuzzer_sys::fuzz_target;
use std::cell::OnceCell;
use std::sync::atomic::AtomicBool;

thread_local! {
    static PAIR: OnceCell<Scenario> = const { OnceCell::new() };
}

fn fill(sample: &mut impl Message, raw: &[u8]) {
    let bytes: &mut [u8] = bytemuck::cast_slice_mut(sample.words_mut());
    let count = raw.len().min(bytes.len());
    bytes[..count].copy_from_slice(&raw[..count]);
}

fn samples(scenario: &Scenario, pieces: &[(bool, &[u8])]) {
    let bus = MemoryBus::new(depths(scenario));
    let schedule_topic = topic(scenario, "run", Signal::Schedule);
    let mut schedules = bus.writer::<Schedule>(&schedule_topic, 1).expect("a writer");
    let terminated = AtomicBool::new(false);
    let reader = bus.reader(&schedule_topic, Reader::Role).expect("a reader");
    let mut control = LauncherLink::<MemoryBus>::new(&bus, reader, Vec::new(), 0, &terminated);
    let mut line = RoleLine::new("follower");
    for (number, (health, raw)) in pieces.iter().enumerate() {
        if *health {
            let mut sample = Health::default();
            fill(&mut sample, raw);
            line.state = RoleState::from_number(sample.state);
            line.rate.push(number as f64, sample.executed);
            assert!(line.rate.per_s().is_none_or(f64::is_finite));
        } else {
            schedules.send(|schedule| fill(schedule, raw)).expect("writing to memory succeeds");
            let known = control.schedule().expect("reading from memory succeeds").phase <= 2;
            assert_eq!(control.stopped().expect("reading from memory succeeds"), !known);
        }
    }
}

fn report(bytes: &[u8]) {
    let Ok(report) = serde_json::from_slice::<RoleReport>(bytes) else { return };
    for stage in &report.stages {
        let latency = stage.latency();
        let _ = latency.is_empty() || latency.percentiles().max_us.is_finite();
    }
    let empty = "{\"file\":\"\",\"complete\":true,\"whole\":true,\"problem\":null,\"messages\":0,\"bytes\":0,\
                 \"signals\":[{\"service\":\"s\",\"recorded\":1,\"void\":0,\"extra\":0,\"published\":null,\"lost\":null,\
                 \"last_tick\":0,\"gaps\":[],\"more_gaps\":0}]}";
    let mut recording: RecordingReport = serde_json::from_str(empty).expect("an empty report is valid");
    recording.reconcile(&[report], &|_| 0);
}

fuzz_target!(|input: (Vec<(bool, &[u8])>, &[u8])| {
    PAIR.with(|pair| {
        let scenario =
            pair.get_or_init(|| Scenario::parse(SHIPPED[0].1, SHIPPED[0].0, &[]).expect("a shipped scenario is valid"));
        samples(scenario, &input.0);
    });
    report(input.1);
});

//! Any bytes as samples of a loop's signals: the outputs of every role stay finite.
#![no_main]

use corotate::bus::memory::MemoryBus;
use corotate::bus::{Bus, Reader, Signal, Write};
use corotate::clock::Grid;
use corotate::config::SHIPPED;
use corotate::runtime::{Input, Poll, ReadyNode, RoleId, RunCondition, depths, private_ledger, topic};
use corotate::sample::{RateCommand, RateEstimate, RateMeasurement, Sample};
use corotate::scenario::Scenario;
use corotate::scenario::build;
use libfuzzer_sys::fuzz_target;
use std::cell::OnceCell;

thread_local! {
    static PAIR: OnceCell<Scenario> = const { OnceCell::new() };
}

/// Sends raw words as a sample. With a first byte below 192 the stamp is valid, so that the fuzzer reaches more than
/// the stamp checks.
fn send<S: Sample>(writer: &mut impl Write<S>, tick: u64, raw: &[u8]) {
    let Some((honest, raw)) = raw.split_first() else { return };
    let mut sample = S::default();
    let bytes = bytemuck::bytes_of_mut(&mut sample);
    let count = raw.len().min(bytes.len());
    bytes[..count].copy_from_slice(&raw[..count]);
    if *honest < 192 {
        (sample.stamp_mut().tick, sample.stamp_mut().generation) = (tick, 1);
    }
    writer.send(|out| *out = sample).unwrap();
}

fn run_loop(scenario: &Scenario, pieces: &[(u8, &[u8])]) {
    let bus = MemoryBus::new(depths(scenario));
    let topic_of = |body: &str, signal| topic(scenario, body, signal);
    let role = |role: RoleId| -> ReadyNode {
        let ledger = private_ledger(scenario, role);
        let mut node = build(scenario, role, &bus, &ledger).unwrap();
        node.start(Grid { epoch_ns: 0, period_ns: scenario.period_ns }, 0).unwrap();
        node
    };
    let mut nodes = [role(RoleId::Observer(0)), role(RoleId::Controller), role(RoleId::Plant(1))];
    let mut measurement = bus.writer::<RateMeasurement>(&topic_of("leader", Signal::Measurement), 1).unwrap();
    let mut estimate = bus.writer::<RateEstimate>(&topic_of("leader", Signal::Estimate), 1).unwrap();
    let mut command = bus.writer::<RateCommand>(&topic_of("follower", Signal::Command), 1).unwrap();
    let mut estimates =
        Input::<_, RateEstimate>::open(&bus, &topic_of("leader", Signal::Estimate), Reader::Role).unwrap();
    let mut commands =
        Input::<_, RateCommand>::open(&bus, &topic_of("follower", Signal::Command), Reader::Role).unwrap();
    for (index, (which, raw)) in pieces.iter().enumerate() {
        let (tick, foreign) = (index as u64 / 4, which % 4);
        match foreign {
            0 => send(&mut measurement, tick, raw),
            1 => send(&mut estimate, tick, raw),
            2 => send(&mut command, tick, raw),
            _ => {}
        }
        for node in &mut nodes {
            if node.poll(RunCondition::Inputs { up_to: scenario.last_tick }).unwrap() == Poll::Executed {
                node.finish_tick().unwrap();
            }
        }
        // Checks the roles' own outputs only: a foreign estimate or command may have any value.
        while estimates.advance().unwrap() {
            let estimate = estimates.sample().filter(|_| foreign != 1);
            assert!(
                estimate.is_none_or(|sample| sample.omega_rad_s.iter().all(|value| value.is_finite())),
                "{estimate:?}"
            );
        }
        while commands.advance().unwrap() {
            let command = commands.sample().filter(|_| foreign != 2);
            assert!(
                command.is_none_or(|sample| sample.acceleration_rad_s2.iter().all(|value| value.is_finite())),
                "{command:?}"
            );
        }
    }
}

fuzz_target!(|pieces: Vec<(u8, &[u8])>| {
    PAIR.with(|pair| {
        let short = ["clock=in-process", "duration_s=1", "accept={}"].map(str::to_owned);
        let scenario = pair.get_or_init(|| Scenario::parse(SHIPPED[0].1, SHIPPED[0].0, &short).unwrap());
        run_loop(scenario, &pieces);
    });
});

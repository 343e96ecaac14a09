//! Any bytes on the line to both ends, as they are and as the payloads of valid frames, which random bytes never are.
#![no_main]

use corotate::config::SHIPPED;
use corotate::rig::{Rig, RigidBodyRig};
use corotate::scenario::Scenario;
use corotate::serial::{Device, DeviceFlightComputer, Hello, HostSession, MAX_FRAME, Samples, Terms, decode, encode};
use libfuzzer_sys::fuzz_target;
use std::cell::OnceCell;

thread_local! {
    static PAIR: OnceCell<Scenario> = const { OnceCell::new() };
}

fn feed(scenario: &Scenario, pieces: &[&[u8]], framed: bool) {
    let rig = scenario.rig.downcast_ref::<RigidBodyRig>().expect("the first shipped scenario is of rigid bodies");
    let make_role = |hello: &Hello<'_>| Some(DeviceFlightComputer::new(rig.estimator(), [rig.law(1)], hello));
    let mut device = Device::new("fuzz", make_role);
    let mut outputs = [0; 32];
    (outputs[0], outputs[1]) = (64, 56);
    let mut host = HostSession::new(Terms { run: 1, period_ns: Some(1_000_000), outputs, required: 1 });
    let mut frame = [0; MAX_FRAME];
    for (index, piece) in pieces.iter().enumerate() {
        let now_ns = index as u64 * 1_000_000;
        let bytes = match (framed, encode(piece, &mut frame)) {
            (true, Ok(frame)) => frame,
            _ => piece,
        };
        decode(bytes, |message| {
            let _ = message;
        });
        // The host receives the bytes and the device's answers to them.
        let mut answers = Vec::new();
        device.receive(bytes, now_ns, |frame| answers.extend_from_slice(frame));
        device.elapse(now_ns);
        for &byte in bytes.iter().chain(&answers) {
            let _ = host.push(byte, now_ns);
        }
        host.request(index as u64, Samples::default(), now_ns);
    }
}

fuzz_target!(|input: (bool, Vec<&[u8]>)| {
    PAIR.with(|pair| {
        let scenario = pair.get_or_init(|| Scenario::parse(SHIPPED[0].1, SHIPPED[0].0, &[]).unwrap());
        feed(scenario, &input.1, input.0);
    });
});

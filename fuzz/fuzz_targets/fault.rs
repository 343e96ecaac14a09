//! Any `[[fault]]` tables in a shipped scenario: they are refused with reasons, or run to the end with finite
//! commands and estimates.
#![no_main]

use arbitrary::Arbitrary;
use corotate::config::SHIPPED;
use corotate::launch::{Launch, run};
use corotate::scenario::Scenario;
use libfuzzer_sys::fuzz_target;
use std::fmt::Write;
use std::sync::atomic::AtomicUsize;

const KINDS: [&str; 12] = [
    "drop",
    "duplicate",
    "delay",
    "freeze",
    "not-a-number",
    "infinite",
    "out-of-range",
    "bit-flip",
    "lost-axis",
    "noise-burst",
    "stall",
    "kill",
];
const ROLES: [&str; 5] = ["leader", "follower", "observer", "controller", "unknown"];
const FIELDS: [&str; 7] =
    ["omega_rad_s", "applied_rad_s2", "acceleration_rad_s2", "closure", "valid", "status", "radius_du"];

#[derive(Debug, Arbitrary)]
struct Table {
    kind: u8,
    role: u8,
    from_tick: u8,
    ticks: Option<u8>,
    probability: Option<f64>,
    field: Option<u8>,
    component: Option<u8>,
    value: Option<f64>,
    bit: Option<u8>,
    deviation: Option<f64>,
    delay_ticks: Option<u16>,
    stall_ms: Option<f64>,
}

fn pick<'a>(names: &[&'a str], index: u8) -> &'a str {
    names[usize::from(index) % names.len()]
}

impl Table {
    fn to_toml(&self) -> String {
        let mut text = format!(
            "[[fault]]\nkind = \"{}\"\nrole = \"{}\"\nfrom_tick = {}\n",
            pick(&KINDS, self.kind),
            pick(&ROLES, self.role),
            self.from_tick
        );
        let number = |value: f64| toml::Value::Float(value).to_string();
        let entries = [
            ("ticks", self.ticks.map(|ticks| ticks.to_string())),
            ("probability", self.probability.map(number)),
            ("field", self.field.map(|field| format!("\"{}\"", pick(&FIELDS, field)))),
            ("component", self.component.map(|component| (component % 8).to_string())),
            ("value", self.value.map(number)),
            ("bit", self.bit.map(|bit| bit.to_string())),
            ("deviation", self.deviation.map(number)),
            ("delay_ticks", self.delay_ticks.map(|ticks| ticks.to_string())),
            ("stall_ms", self.stall_ms.map(number)),
        ];
        for (key, value) in entries {
            if let Some(value) = value {
                writeln!(text, "{key} = {value}").expect("a string takes all");
            }
        }
        text
    }
}

fuzz_target!(|tables: Vec<Table>| {
    let text: String = [SHIPPED[0].1.to_owned()].into_iter().chain(tables.iter().take(8).map(Table::to_toml)).collect();
    let short = ["clock=in-process", "duration_s=0.1", "accept={}"].map(str::to_owned);
    match Scenario::parse(&text, "fault.toml", &short) {
        Ok(scenario) => {
            let again = Scenario::parse(&scenario.to_toml(), "again.toml", &[]).expect("a resolved scenario is valid");
            // Compared as text, because NaN is unequal to itself.
            assert_eq!(format!("{:?}", again.faults), format!("{:?}", scenario.faults));
            let outcome =
                run(&scenario, &mut Launch::new(&AtomicUsize::new(0), &mut |_| {})).expect("a run in one thread ends");
            assert!(outcome.reports.len() == 4 && outcome.problems.is_empty(), "{:?}", outcome.problems);
        }
        Err(error) => assert!(!error.to_string().is_empty()),
    }
});

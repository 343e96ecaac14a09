//! Any text as a scenario: refused with reasons, or resolved to one that resolves to itself.
#![no_main]

use corotate::scenario::Scenario;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| match Scenario::parse(text, "fuzz.toml", &[]) {
    Ok(scenario) => {
        let again = Scenario::parse(&scenario.to_toml(), "again.toml", &[]).expect("what was resolved resolves");
        assert_eq!(again.resolved, scenario.resolved);
        let _ = (scenario.rig.certificates(), scenario.rig.notes());
    }
    Err(error) => assert!(!error.to_string().is_empty()),
});

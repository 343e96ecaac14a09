//! Any text as a scenario: it is refused with reasons, or resolved to a scenario that resolves to itself.
#![no_main]

use corotate::scenario::Scenario;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| match Scenario::parse(text, "fuzz.toml", &[]) {
    Ok(scenario) => {
        let again = Scenario::parse(&scenario.to_toml(), "again.toml", &[]).expect("a resolved scenario is valid");
        assert_eq!(again.resolved, scenario.resolved);
        let _ = (scenario.rig.certificates(), scenario.rig.notes());
    }
    Err(error) => assert!(!error.to_string().is_empty()),
});

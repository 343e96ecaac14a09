//! Any lines as `--set` arguments of a shipped scenario; the first byte selects it.
#![no_main]

use corotate::config::SHIPPED;
use corotate::scenario::Scenario;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: (u8, &str)| {
    let (name, text) = SHIPPED[usize::from(input.0) % SHIPPED.len()];
    let arguments: Vec<String> = input.1.lines().map(str::to_owned).collect();
    match Scenario::parse(text, name, &arguments) {
        Ok(scenario) => {
            Scenario::parse(&scenario.to_toml(), "again.toml", &[]).expect("a resolved scenario is valid");
        }
        Err(error) => assert!(!error.to_string().is_empty()),
    }
});

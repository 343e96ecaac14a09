//! Scenarios and campaigns that ship with the program, its name and its command line.

use std::ffi::OsString;
use std::path::Path;
use std::sync::OnceLock;

pub static SCENARIOS: OnceLock<Vec<(&str, &str)>> = OnceLock::new();

/// Returns the shipped scenarios, as names and texts.
pub fn scenarios() -> &'static [(&'static str, &'static str)] {
    SCENARIOS.get().map_or(&[], Vec::as_slice)
}

pub static CAMPAIGNS: OnceLock<Vec<(&str, &str)>> = OnceLock::new();

/// Returns the shipped campaigns, as names and texts.
pub fn campaigns() -> &'static [(&'static str, &'static str)] {
    CAMPAIGNS.get().map_or(&[], Vec::as_slice)
}

/// The words of the command line; the first is the program's name.
pub static WORDS: OnceLock<Vec<OsString>> = OnceLock::new();

pub fn words_given() -> &'static [OsString] {
    WORDS.get().map_or(&[], Vec::as_slice)
}

/// Returns the file name of the program.
pub fn name() -> &'static str {
    static NAME: OnceLock<String> = OnceLock::new();
    NAME.get_or_init(|| {
        let file = words_given().first().map(Path::new).and_then(Path::file_name);
        file.map_or("corotate".into(), |name| name.to_string_lossy().into_owned())
    })
}

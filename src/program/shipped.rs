//! What this program was made with and called with: the scenarios and campaigns that ship with it, its name, its words.

use std::ffi::OsString;
use std::path::Path;
use std::sync::OnceLock;

pub static SCENARIOS: OnceLock<Vec<(&str, &str)>> = OnceLock::new();

/// The scenarios that ship with this program.
pub fn scenarios() -> &'static [(&'static str, &'static str)] {
    SCENARIOS.get().map_or(&[], Vec::as_slice)
}

pub static CAMPAIGNS: OnceLock<Vec<(&str, &str)>> = OnceLock::new();

/// The campaigns that ship with this program.
pub fn campaigns() -> &'static [(&'static str, &'static str)] {
    CAMPAIGNS.get().map_or(&[], Vec::as_slice)
}

/// What the program was called with.
pub static WORDS: OnceLock<Vec<OsString>> = OnceLock::new();

pub fn words_given() -> &'static [OsString] {
    WORDS.get().map_or(&[], Vec::as_slice)
}

/// How this program is called.
pub fn name() -> &'static str {
    static NAME: OnceLock<String> = OnceLock::new();
    NAME.get_or_init(|| {
        let file = words_given().first().map(Path::new).and_then(Path::file_name);
        file.map_or("corotate".into(), |name| name.to_string_lossy().into_owned())
    })
}

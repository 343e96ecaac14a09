//! `corotate new`: creates a crate, a copy of a template under another name.

use super::output::{CommandResult, Exit, Failure, fail, say};
use crate::files::{create_directories, write};
use std::io;
use std::path::{Path, PathBuf};

/// A crate to begin with, without its manifest: a package cannot contain the manifest of another package.
#[derive(Clone, Copy, clap::ValueEnum)]
enum Template {
    /// Two DC motors, a leader and a follower
    MotorPair,
    /// One plant with state feedback, observer and reference
    CartPole,
    /// The least that a rig needs
    Empty,
}

impl Template {
    /// Returns the template's own name, its sources, and its scenario.
    fn parts(self) -> (&'static str, &'static str, &'static str) {
        match self {
            Self::MotorPair => {
                ("motor-pair", include_str!("new/motor-pair/main.rs"), include_str!("new/motor-pair/scenario.toml"))
            }
            Self::CartPole => {
                ("cart-pole", include_str!("new/cart-pole/main.rs"), include_str!("new/cart-pole/scenario.toml"))
            }
            Self::Empty => ("empty", include_str!("new/empty/main.rs"), include_str!("new/empty/scenario.toml")),
        }
    }
}

/// The test of every template, and the name of the crate that it tests.
const TEST: (&str, &str) = (include_str!("new/clocks.rs"), "motor-pair");
/// Refused names: this crate's own, and names that Cargo refuses.
const TAKEN: [&str; 4] = ["corotate", "test", "core", "std"];

/// Options of `corotate new`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// Name of the crate, its rig and its scenario: 2 to 32 of a-z, 0-9 and -
    name: String,
    /// The crate to begin with
    #[arg(long, value_enum, default_value = "motor-pair")]
    template: Template,
    /// Directory of the crate [default: ./NAME]
    #[arg(long, value_name = "DIR")]
    path: Option<PathBuf>,
    /// Print the crate's path as one JSON object (corotate/new/v1)
    #[arg(long)]
    json: bool,
}

/// Layout version of the JSON.
const SCHEMA: &str = "corotate/new/v1";

const EXAMPLES: &str = "\
Example:
  corotate new thermostat --template cart-pole && cd thermostat && cargo test
                                   create a crate with a rig that works, then
                                   change the rig (docs/your-own-rig.md)";

/// Writes the crate.
pub fn new(arguments: &Arguments) -> CommandResult {
    let name = &arguments.name;
    let plain = (2..=32).contains(&name.len())
        && name.starts_with(|first: char| first.is_ascii_lowercase())
        && name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-');
    if !plain || name.ends_with('-') || TAKEN.contains(&&**name) {
        let reason = "invalid or reserved name; use 2 to 32 of a-z, 0-9 and -, a letter first";
        return Err(fail(Exit::Usage, Failure::new("bad-name", format!("`{name}`: {reason}"))));
    }
    let directory = arguments.path.clone().unwrap_or_else(|| PathBuf::from(name));
    if directory.read_dir().is_ok_and(|mut entries| entries.next().is_some()) {
        let path = directory.display();
        let reason = format!("{path} exists and is not empty; name another directory with --path");
        return Err(fail(Exit::Usage, Failure::new("not-empty", reason)));
    }
    match write_all(&directory, name, arguments.template) {
        Ok(()) => say(&created_text(&directory, arguments.json)),
        Err(error) => {
            let reason = format!("cannot write {}: {error}; name another directory with --path", directory.display());
            Err(fail(Exit::Failure, Failure::new("cannot-write", reason)))
        }
    }
}

fn created_text(directory: &Path, json: bool) -> String {
    let path = directory.display();
    if json {
        return format!("{}\n", serde_json::json!({ "schema": SCHEMA, "crate": path.to_string() }));
    }
    format!("created the crate {path}; next:\n  cd {path}\n  cargo test\n  cargo run --release\n")
}

fn write_all(directory: &Path, name: &str, template: Template) -> io::Result<()> {
    let (example, sources, scenario) = template.parts();
    let files = [
        ("src/main.rs".to_owned(), sources, example),
        (format!("{name}.toml"), scenario, example),
        ("tests/clocks.rs".to_owned(), TEST.0, TEST.1),
    ];
    for (file, text, own_name) in files {
        let path = directory.join(file);
        path.parent().map_or(Ok(()), create_directories)?;
        write(&path, text.replace(own_name, name).as_bytes())?;
    }
    write(&directory.join("Cargo.toml"), manifest(name).as_bytes())?;
    write(&directory.join(".gitignore"), b"/target\n/runs\n")
}

/// Returns the manifest. It depends on the sources of this program if they are on this machine, else on the published crate.
fn manifest(name: &str) -> String {
    let version = env!("CARGO_PKG_VERSION");
    let lines = ["name = \"corotate\"", &format!("version = \"{version}\"")];
    let here = option_env!("COROTATE_SOURCES").filter(|sources| {
        let own = std::fs::read_to_string(Path::new(sources).join("Cargo.toml"));
        own.is_ok_and(|own| lines.iter().all(|wanted| own.lines().any(|line| line == *wanted)))
    });
    let from = here.map_or(format!("version = \"{version}\""), |sources| format!("path = {sources:?}"));
    format!(
        "[package]\nname = \"{name}\"\nversion = \"0.1.0\"\nedition = \"2024\"\npublish = false\n\n\
         [dependencies]\ncorotate = {{ {from} }}\nserde = {{ version = \"1\", features = [\"derive\"] }}\n\n\
         [workspace]\n"
    )
}

//! `corotate new`: a crate of one's own to start from, the one of `examples/motor-pair` under another name.

use super::output::{Ended, Exit, Failure, fail, say};
use crate::files::{create_directories, write};
use std::io;
use std::path::{Path, PathBuf};

/// The files of the example. Its manifest is not among them: a package does not hold that of another.
const FILES: [(&str, &str); 3] = [
    ("src/main.rs", include_str!("new/main.rs")),
    ("NAME.toml", include_str!("new/scenario.toml")),
    ("tests/clocks.rs", include_str!("new/clocks.rs")),
];
/// What the example is called.
const EXAMPLE: &str = "motor-pair";
/// What nothing may be called: the rigs of this crate, and names that Cargo refuses.
const TAKEN: [&str; 4] = ["corotate", "test", "core", "std"];

/// Options of `corotate new`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// What the crate, its rig and its scenario are called: 2 to 32 of a-z, 0-9 and -
    name: String,
    /// Where to write it [default: ./NAME]
    #[arg(long, value_name = "DIR")]
    path: Option<PathBuf>,
    /// Print where the crate is as one JSON object (corotate/new/v1)
    #[arg(long)]
    json: bool,
}

/// Layout version of the JSON.
const SCHEMA: &str = "corotate/new/v1";

const EXAMPLES: &str = "\
Example:
  corotate new thermostat && cd thermostat && cargo test
                                   a crate with a rig of its own, that runs;
                                   make the rig yours (docs/your-own-rig.md)";

/// Writes the crate.
pub fn new(arguments: &Arguments) -> Ended {
    let name = &arguments.name;
    let plain = (2..=32).contains(&name.len())
        && name.starts_with(|first: char| first.is_ascii_lowercase())
        && name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-');
    if !plain || name.ends_with('-') || TAKEN.contains(&&**name) {
        let reason = "cannot name a crate and its scenario; use 2 to 32 of a-z, 0-9 and -, a letter first";
        return Err(fail(Exit::Usage, Failure::new("bad-name", format!("`{name}` {reason}"))));
    }
    let directory = arguments.path.clone().unwrap_or_else(|| PathBuf::from(name));
    if directory.read_dir().is_ok_and(|mut entries| entries.next().is_some()) {
        let path = directory.display();
        let reason = format!("{path} is there already and is not empty; name another with --path");
        return Err(fail(Exit::Usage, Failure::new("not-empty", reason)));
    }
    match write_all(&directory, name) {
        Ok(()) => say(&told(&directory, arguments.json)),
        Err(error) => {
            let reason = format!("{}: {error}; name another with --path", directory.display());
            Err(fail(Exit::Failure, Failure::new("cannot-write", reason)))
        }
    }
}

fn told(directory: &Path, json: bool) -> String {
    let path = directory.display();
    if json {
        return format!("{}\n", serde_json::json!({ "schema": SCHEMA, "crate": path.to_string() }));
    }
    format!("{path}: a crate with a rig of its own\n  cd {path}\n  cargo test\n  cargo run --release\n")
}

fn write_all(directory: &Path, name: &str) -> io::Result<()> {
    for (file, text) in FILES {
        let path = directory.join(file.replace("NAME", name));
        path.parent().map_or(Ok(()), create_directories)?;
        write(&path, text.replace(EXAMPLE, name).as_bytes())?;
    }
    write(&directory.join("Cargo.toml"), manifest(name).as_bytes())?;
    write(&directory.join(".gitignore"), b"/target\n/runs\n")
}

/// The manifest: with the sources that this program was built from where they are here, otherwise with the published ones.
fn manifest(name: &str) -> String {
    let (version, sources) = (env!("CARGO_PKG_VERSION"), Path::new(env!("CARGO_MANIFEST_DIR")));
    let own = std::fs::read_to_string(sources.join("Cargo.toml"));
    let lines = ["name = \"corotate\"", &format!("version = \"{version}\"")];
    let here = own.is_ok_and(|own| lines.iter().all(|wanted| own.lines().any(|line| line == *wanted)));
    let from =
        if here { format!("path = {:?}", sources.display().to_string()) } else { format!("version = \"{version}\"") };
    format!(
        "[package]\nname = \"{name}\"\nversion = \"0.1.0\"\nedition = \"2024\"\npublish = false\n\n\
         [dependencies]\ncorotate = {{ {from} }}\nserde = {{ version = \"1\", features = [\"derive\"] }}\n\n\
         [workspace]\n"
    )
}

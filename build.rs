//! Notes what the program is made of, for its summaries, `--version` and `new`: the source revision, the target, and the directory of the
//! sources. The revision is that of the variable COROTATE_REVISION, of the package, or of git, and else `unknown`.

use std::path::Path;
use std::process::Command;

/// Sources of the program: only a change of these changes its revision.
const SOURCES: [&str; 7] = ["build.rs", "Cargo.toml", "Cargo.lock", "bin", "config", "crates", "src"];

fn main() {
    // A package may lie in another repository. Its program is for other machines, which do not have these sources.
    let given = std::env::var("COROTATE_REVISION").ok().filter(|revision| !revision.is_empty());
    if given.is_none() {
        println!("cargo::rustc-env=COROTATE_SOURCES={}", std::env::var("CARGO_MANIFEST_DIR").expect("cargo sets it"));
    }
    let revision = given.or_else(packaged).or_else(|| git(&["describe", "--always", "--dirty", "--abbrev=12"]));
    let revision = revision.unwrap_or("unknown".to_owned());
    let target = std::env::var("TARGET").unwrap_or("unknown".to_owned());
    // Cargo gives these variables to programs and tests that it runs, and so to what they build: none may have the name of one read here.
    for (name, value) in [("BUILT_REVISION", revision), ("TARGET", target)] {
        println!("cargo::rustc-env=COROTATE_{name}={value}");
    }
    println!("cargo::rerun-if-env-changed=COROTATE_REVISION");
    SOURCES.iter().for_each(|path| println!("cargo::rerun-if-changed={path}"));
    // Commits and checkouts. Not the index, which `git status` may rewrite; and only what is there,
    // or all would be built again every time.
    let logs = ["HEAD", "logs/HEAD"].iter().filter_map(|name| git(&["rev-parse", "--git-path", name]));
    logs.filter(|path| Path::new(path).exists()).for_each(|path| println!("cargo::rerun-if-changed={path}"));
}

/// The revision that a package was made of, as `cargo package` notes it.
fn packaged() -> Option<String> {
    let noted = std::fs::read_to_string(".cargo_vcs_info.json").ok()?;
    let revision = noted.split_once("\"sha1\": \"")?.1.split_once('"')?.0;
    Some(revision.chars().take(12).collect())
}

fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).output().ok().filter(|output| output.status.success())?;
    Some(String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

//! Notes the source revision, for the summary of every run. Without git the revision is `unknown`.

use std::path::Path;
use std::process::Command;

/// What the program is made of: a change elsewhere does not make it another one.
const SOURCES: [&str; 6] = ["build.rs", "Cargo.toml", "Cargo.lock", "src", "bin", "config"];

fn main() {
    let revision = git(&["describe", "--always", "--dirty", "--abbrev=12"]).unwrap_or("unknown".to_owned());
    println!("cargo::rustc-env=COROTATE_REVISION={revision}");
    SOURCES.iter().for_each(|path| println!("cargo::rerun-if-changed={path}"));
    // Commits and checkouts. Not the index, which every look at the state of the tree may write anew; and only what is there,
    // or all would be built again every time.
    let logs = ["HEAD", "logs/HEAD"].iter().filter_map(|name| git(&["rev-parse", "--git-path", name]));
    logs.filter(|path| Path::new(path).exists()).for_each(|path| println!("cargo::rerun-if-changed={path}"));
}

fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).output().ok().filter(|output| output.status.success())?;
    Some(String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

//! Runs the commands of README and of the manual as they are written, in the order of each page, in a directory per page.
//!
//! Commands that are not run here are listed with a reason. The synopses of `docs/commands.md` are compared with the program's help.

use crate::common::{Bench, Done, Running, documented_codes, root};
use corotate::record::{Recording, SignalInfo};
use std::collections::BTreeSet;
use std::fs;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::Path;

/// Commands that are not run here: first words, and where the command is run or why it cannot be.
const ELSEWHERE: [(&str, &str); 35] = [
    ("corotate run pair.toml --host", "it waits for another host; tests/runs/hosts"),
    ("corotate run pair.toml --clock lockstep --debug", "it waits for a debugger; tests/runs/debugging.rs"),
    ("corotate join", "it needs a run to join; tests/runs/hosts"),
    ("corotate doctor --link", "it needs a run that waits; tests/runs/hosts"),
    ("corotate doctor --hunt", "it takes a minute; tests/tools/doctor.rs, a second"),
    ("cargo run --release", "tests/run builds it so; `run` without arguments is run here"),
    ("tests/run", "it runs this test"),
    ("cargo install --path . --locked", "tests/run"),
    ("cargo build --release --features", "tests/run builds with them"),
    ("cargo build --release --config", "it compiles for minutes; tests/run, without these options"),
    ("cargo build --release", "for a board, in firmware/; tests/board"),
    ("cargo bench --bench", "tests/run, short"),
    ("corotate bench", "five minutes; tests/tools/bench.rs, some rows"),
    ("cargo test --release --features hooks --test all claims::claims_of_sampled", "tests/runs/claims.rs"),
    ("corotate run config/rigid-pair.toml --external follower", "it waits for a partner; tests/runs/hil.rs"),
    ("corotate run rigid-pair --external follower", "it waits for a partner; tests/runs/hil.rs and tests/runs/serial/"),
    ("corotate run rigid-pair --clock lockstep --external", "it waits for a partner; tests/board"),
    ("corotate run tests/hil/pair.toml --clock lockstep", "it waits for a partner; tests/runs/hil.rs"),
    ("$(tests/hil/venv) tests/hil/follower.py", "tests/runs/hil.rs"),
    ("corotate bridge --serial", "it needs a device; tests/runs/serial/"),
    ("corotate bridge --udp", "it needs a device; tests/runs/pace.rs"),
    ("qemu-system-arm", "it needs firmware; tests/board"),
    ("socat", "it goes on until it is ended; tests/runs/serial/ has a line of its own"),
    ("cargo run --release --example serial_device", "it needs a line; tests/runs/serial/"),
    ("corotate why", "it needs a run with late ticks; tests/tools/late.rs"),
    ("corotate watch --once", "during a run, below"),
    ("corotate run rigid-pair --duration 600", "it takes ten minutes; the commands below it have a run of their own"),
    ("corotate watch runs/pair", "a screen that is left by a key; tests/tools/watch.rs, in a terminal"),
    ("corotate watch", "a screen that is left by a key; tests/tools/watch.rs, in a terminal"),
    ("corotate new two-motors", "tests/run"),
    ("cargo run --release --", "tests/runs/own_rig.rs"),
    ("tests/", "a campaign of its own; its short form is in the tests"),
    ("fuzz/run", "a campaign of its own; tests/run checks the targets"),
    ("COROTATE_", "a campaign of its own; its short form is in the tests"),
    ("packaging/", "it compiles for many minutes, or needs its packages; CONTRIBUTING.md"),
];
/// Commands that need a run.
const DURING_A_RUN: [&str; 9] = [
    "corotate get",
    "corotate set actuator.safe=true",
    "corotate set --save pair.toml",
    "corotate set controller.gain_per_s=[6,6,6]",
    "corotate set follower.0.offset_rad_s=[0,0,0.2] --ramp 2",
    "corotate record --out part.mcap",
    "corotate watch --once 0.5",
    "corotate watch --once 0.5 --json",
    "corotate foxglove",
];

/// Returns the commands of a page with their lines: what begins with the name of one of the programs in a block of code.
fn commands(text: &str) -> Vec<(usize, String)> {
    let (mut found, mut code, mut before) = (Vec::new(), false, "");
    let mut lines = text.lines().enumerate();
    while let Some((index, line)) = lines.next() {
        code = line.starts_with("    ") && (code || before.trim().is_empty());
        before = line;
        if !code {
            continue;
        }
        let mut command = line.trim().to_owned();
        // A loop is one command.
        if command.starts_with("for ") {
            for (_, line) in lines.by_ref() {
                command = format!("{command}\n{line}");
                if line.trim() == "done" {
                    break;
                }
            }
        }
        let programs = [
            "corotate ",
            "cargo ",
            "tests/",
            "fuzz/",
            "packaging/",
            "socat ",
            "for ",
            "mkdir ",
            "$(tests",
            "COROTATE_",
        ];
        let ours = programs.iter().any(|program| command.starts_with(program));
        // Output of the program and trees of files begin like commands.
        let printed = command.starts_with("corotate rigid-pair ")
            || command.contains("/            ")
            || command.contains("/             ");
        if ours && !printed {
            found.push((index + 1, command));
        }
    }
    found
}

/// The page that begins with the synopses.
const SYNOPSES: &str = "docs/commands.md";

/// Strips the comment of a command.
fn bare(command: &str) -> &str {
    command.split(" #").next().unwrap_or(command).trim_end()
}

struct Page {
    bench: Bench,
    /// The shell's PATH.
    path: String,
}

impl Page {
    fn new() -> Self {
        let bench = Bench::new();
        let root = root();
        for directory in ["config", "tests"] {
            symlink(root.join(directory), bench.path(directory)).unwrap();
        }
        let programs = bench.path("programs");
        fs::create_dir(&programs).unwrap();
        symlink(env!("CARGO_BIN_EXE_corotate"), programs.join("corotate")).unwrap();
        // A desktop that shows pages.
        let opener = programs.join("xdg-open");
        fs::write(&opener, "#!/bin/sh\ntest -s \"$1\"\n").unwrap();
        fs::set_permissions(&opener, fs::Permissions::from_mode(0o755)).unwrap();
        for name in ["throws.csv", "racquet.csv"] {
            fs::write(bench.path(name), throws(root)).unwrap();
        }
        let path = format!("{}:{}", programs.display(), std::env::var("PATH").unwrap());
        Self { bench, path }
    }

    fn start(&self, command: &str) -> Running {
        let mut shell = self.bench.command_of("bash".as_ref());
        shell.env("PATH", &self.path).env("HOME", self.bench.path("home")).args(["-c", command]);
        Running::new(&mut shell)
    }

    fn run(&self, command: &str) -> Done {
        self.start(command).wait()
    }

    /// Starts a run of a few seconds and waits for its first ticks.
    fn start_run(&self) -> Running {
        let run = self.bench.start(&[
            "run",
            "--duration",
            "8",
            "--set",
            "accept={}",
            "--set",
            "limits={}",
            "--out",
            "beside",
            "--overwrite",
        ]);
        self.bench.await_ticks("controller");
        run
    }
}

/// Returns the shipped log as three throws.
fn throws(root: &Path) -> String {
    let text = fs::read_to_string(root.join("config/tumbling-throw.csv")).unwrap();
    let mut lines = text.lines().filter(|line| !line.starts_with('#'));
    let head = lines.next().unwrap();
    let rows: Vec<&str> = lines.collect();
    let throw = |number: usize| rows.iter().map(move |row| format!("{row},{number}\n"));
    format!("{head},throw\n{}", (1..=3).flat_map(throw).collect::<String>())
}

/// Runs a page's commands and returns those that failed, with their lines.
fn check(name: &str) -> Vec<String> {
    let text = fs::read_to_string(root().join(name)).unwrap();
    // Skips the synopses.
    let first = if name == SYNOPSES { text.lines().position(|line| line.starts_with('|')).unwrap() } else { 0 };
    let page = Page::new();
    let mut failed = Vec::new();
    for (line, command) in commands(&text).into_iter().filter(|(line, _)| *line > first) {
        let typed = bare(&command);
        let needs_run = DURING_A_RUN.contains(&typed);
        if !needs_run
            && ELSEWHERE.iter().any(|(start, _)| {
                typed == *start
                    || typed.starts_with(&format!("{start} "))
                    || start.ends_with(['/', '_']) && typed.starts_with(start)
            })
        {
            continue;
        }
        let needs = ["--parquet", "foxglove"].into_iter().zip([cfg!(feature = "parquet"), cfg!(feature = "foxglove")]);
        let refused = needs.into_iter().any(|(word, built)| typed.contains(word) && !built);
        let run = needs_run.then(|| page.start_run());
        let done = page.run(&command);
        // In real time, during other tests, a limit may be missed; `doctor` judges the machine, `diff` two runs.
        let judged = ["corotate run", "corotate doctor", "corotate diff"].iter().any(|start| typed.starts_with(start))
            && !typed.contains("--clock in-process");
        let codes: &[i32] = if refused {
            &[2]
        } else if judged {
            &[0, 3]
        } else {
            &[0]
        };
        if !done.code.is_some_and(|code| codes.contains(&code)) {
            failed.push(format!("{name}:{line}: {command}\n{done:?}"));
        }
        run.map(Running::wait);
    }
    failed
}

macro_rules! pages {
    ($($test:ident: $page:literal,)*) => {
        $(#[test]
        fn $test() {
            let failed = check($page);
            assert!(failed.is_empty(), "{}", failed.join("\n"));
        })*

        const PAGES: &[&str] = &[$($page),*];
    };
}

pages! {
    readme: "README.md",
    quickstart: "docs/quickstart.md",
    c_and_cpp: "docs/c-and-cpp.md",
    claims: "docs/claims.md",
    concepts: "docs/concepts.md",
    campaigns: "docs/campaigns.md",
    commands_page: "docs/commands.md",
    debugging: "docs/debugging.md",
    foreign_role: "docs/foreign-role.md",
    hosts: "docs/hosts.md",
    inputs: "docs/inputs.md",
    formats: "docs/formats.md",
    foxglove: "docs/foxglove.md",
    own_data: "docs/own-data.md",
    packages: "docs/packages.md",
    papers: "docs/papers.md",
    python: "docs/python.md",
    real_time: "docs/real-time.md",
    record_replay: "docs/record-replay.md",
    report: "docs/report.md",
    scenario: "docs/scenario.md",
    security: "docs/security.md",
    serial_device: "docs/serial-device.md",
    serial_protocol: "docs/serial-protocol.md",
    table: "docs/table.md",
    troubleshooting: "docs/troubleshooting.md",
    watch: "docs/watch.md",
    when_things_go_wrong: "docs/when-things-go-wrong.md",
    your_board: "docs/your-board.md",
    your_own_rig: "docs/your-own-rig.md",
    benchmarks: "docs/benchmarks.md",
}

#[test]
fn every_page_has_a_test() {
    let pages = fs::read_dir(root().join("docs")).unwrap();
    let names =
        pages.map(|entry| entry.unwrap().file_name().into_string().unwrap()).filter(|name| name.ends_with(".md"));
    for name in names.filter(|name| !["SUMMARY.md", "glossary.md"].contains(&name.as_str())) {
        assert!(PAGES.contains(&format!("docs/{name}").as_str()), "docs/{name} has no test");
    }
}

/// Every synopsis names an existing command and its options.
#[test]
fn the_synopses_agree_with_the_help() {
    let bench = Bench::new();
    let text = fs::read_to_string(root().join(SYNOPSES)).unwrap();
    let mut command = String::new();
    let mut checked = 0;
    for line in text.lines().take_while(|line| !line.starts_with('|')).filter(|line| line.starts_with("    ")) {
        if let Some(rest) = line.trim().strip_prefix("corotate ").filter(|rest| !rest.starts_with(' ')) {
            let word = rest.split_whitespace().next().unwrap_or_default();
            command = word.split('|').next().unwrap().to_owned();
        }
        if command.is_empty() {
            continue;
        }
        let help = bench.run(&[&command, "--help"]);
        assert_eq!(help.code, Some(0), "{line}: {help:?}");
        let options = line.split(|letter: char| !(letter.is_ascii_alphanumeric() || letter == '-'));
        for option in options.filter(|word| word.starts_with("--") && word.len() > 2) {
            assert!(help.stdout.contains(option) || option == "--external", "{line}: {option} is not in its help");
            checked += 1;
        }
    }
    assert!(checked > 30, "{checked} options were found");
}

/// Returns the arguments of a call, from the text behind its opening bracket.
fn arguments(text: &str) -> Vec<&str> {
    let (mut depth, mut quoted, mut escaped, mut start, mut found) = (0, false, false, 0, Vec::new());
    for (at, letter) in text.char_indices() {
        match letter {
            _ if escaped => escaped = false,
            '\\' => escaped = quoted,
            '"' => quoted = !quoted,
            _ if quoted => {}
            '(' | '[' | '{' => depth += 1,
            ',' | ')' if depth == 0 => {
                found.push(text[start..at].trim());
                start = at + 1;
                if letter == ')' {
                    break;
                }
            }
            ')' | ']' | '}' => depth -= 1,
            _ => {}
        }
    }
    found
}

/// Returns every error code of the sources: the name of a variant, or a literal in a conversion, in a check or next to the text.
fn codes_written(sources: &str) -> BTreeSet<String> {
    let literal = |text: &str| Some(text.strip_prefix('"')?.split_once('"')?.0.to_owned());
    let after = |before: &'static str| sources.split(before).skip(1);
    let body = |text: &'_ str| text.split("\n}\n").next().unwrap().to_owned();
    let mut codes = BTreeSet::new();
    for variants in after("IntoStaticStr)]").map(body) {
        let mut named = None;
        for line in variants.lines() {
            if let Some((_, name)) = line.split_once("#[strum(serialize = ") {
                named = literal(name);
            } else if line.contains("#[strum(transparent)]") {
                named = Some(String::new());
            } else if line.starts_with("    ") && line[4..].starts_with(char::is_uppercase) {
                let name: String = line[4..].chars().take_while(|letter| letter.is_alphanumeric()).collect();
                let kebab = || {
                    name.chars().fold(String::new(), |kebab, letter| match letter.is_uppercase() {
                        true if !kebab.is_empty() => format!("{kebab}-{}", letter.to_lowercase()),
                        _ => format!("{kebab}{}", letter.to_lowercase()),
                    })
                };
                codes.insert(named.take().unwrap_or_else(kebab));
            }
        }
    }
    for conversion in after("for &'static str {").map(body) {
        codes.extend(conversion.split("=> ").skip(1).filter_map(literal));
    }
    for (call, place) in [("checks.refuse(", 1), (".require(", 2), ("Failure::new(", 0)] {
        codes.extend(after(call).filter_map(|text| literal(arguments(text).get(place)?)));
    }
    codes.extend(after("code: ").filter_map(literal));
    codes.remove("");
    codes
}

/// The manual lists exactly the codes that the sources use.
#[test]
fn the_manual_lists_the_codes_of_all_errors() {
    let (mut sources, mut directories) = (String::new(), vec![root().join("src"), root().join("crates")]);
    while let Some(directory) = directories.pop() {
        for path in fs::read_dir(directory).unwrap().map(|entry| entry.unwrap().path()) {
            if path.is_dir() {
                directories.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") && !path.ends_with("tests.rs") {
                let text = fs::read_to_string(path).unwrap();
                sources += text.split("#[cfg(test)]\nmod tests").next().unwrap();
            }
        }
    }
    let listed = documented_codes();
    let variant = |code: &str| -> String {
        let capital = |word: &str| word[..1].to_uppercase() + &word[1..];
        code.split('-').map(capital).collect()
    };
    for code in &listed {
        let written = [format!("\"{code}\""), format!("[{code}]"), format!("    {}", variant(code))];
        assert!(written.iter().any(|written| sources.contains(written)), "{code} is in no source");
    }
    for code in codes_written(&sources) {
        assert!(listed.contains(&code), "{code} is not in the manual");
    }
}

/// The layouts for Foxglove and PlotJuggler name fields that a recording of `rigid-pair` has.
#[test]
fn the_layouts_name_recorded_fields() {
    let bench = Bench::new();
    bench.run(&["run", "rigid-pair", "--clock", "in-process", "--record", "--out", "run"]).succeeded();
    let recording = Recording::open(&bench.path("run/run.mcap")).unwrap();
    let fields = |between: char| -> Vec<String> {
        let names = |signal: &SignalInfo| {
            let topic = format!("/corotate/rigid_pair/{}/{}", signal.body, signal.signal);
            let elements = signal.layout.columns.iter().flat_map(|column| column.elements());
            elements.map(|element| format!("{topic}{between}{element}")).collect::<Vec<_>>()
        };
        recording.signals().iter().flat_map(names).collect()
    };
    for (file, between) in [("foxglove.json", '.'), ("plotjuggler.xml", '/')] {
        let text = fs::read_to_string(root().join("packaging/layouts").join(file)).unwrap();
        let named: Vec<&str> = text.split('"').filter(|word| word.starts_with("/corotate/")).collect();
        let known = fields(between);
        assert!(
            named.len() == 11 && named.iter().all(|name| known.iter().any(|field| field == name)),
            "{file}: {named:?}, {known:?}"
        );
    }
}

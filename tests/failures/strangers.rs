//! Another user of the same machine as attacker: with directories and files created in advance, in a race with the
//! launcher, and in the directories of results. Needs root, which can act as two users.

use crate::common::{Bench, Done, await_some, shipped, skipped};
use std::fs::{self, Permissions};
use std::os::unix::fs::{MetadataExt, PermissionsExt, chown, lchown, symlink};
use std::path::Path;

const ATTACKER: u32 = 65_534;
const ATTACKER_NAME: &str = "nobody";
const SHORT: [&str; 4] = ["--duration=1", "--clock=lockstep", "--set=accept={}", "--json"];

fn root() -> bool {
    let root = rustix::process::geteuid().is_root();
    if !root {
        skipped("what another user can do to a run", "only root can act as two users");
    }
    root
}

fn set_mode(path: &Path, mode: u32) {
    fs::set_permissions(path, Permissions::from_mode(mode)).unwrap();
}

fn run_short(bench: &Bench, arguments: &[&str]) -> Done {
    let scenario = shipped("rigid-pair");
    bench.run(&[&["run", scenario.to_str().unwrap()], &SHORT[..], arguments].concat())
}

/// The creator of the directory of all domains can put anything in it, whatever its mode is now.
#[test]
fn every_command_refuses_a_directory_of_another_user() {
    if !root() {
        return;
    }
    let bench = Bench::new();
    let base = bench.runtime().join("corotate");
    fs::create_dir(&base).unwrap();
    for mode in [0o777, 0o700] {
        set_mode(&base, mode);
        chown(&base, Some(ATTACKER), Some(ATTACKER)).unwrap();
        // It looks like a run of ours.
        let domain = base.join("0123456789abcdef0123456789abcdef");
        fs::create_dir_all(&domain).unwrap();
        for file in [domain.join("scenario.toml"), domain.with_extension("lock")] {
            fs::copy(shipped("rigid-pair"), &file).unwrap();
        }
        set_mode(&domain, 0o700);
        let refusal = format!("{} belongs to {ATTACKER_NAME} (uid {ATTACKER}), not to root (uid 0)", base.display());
        let watched = ["watch", "--once", "1"];
        for (code, done) in
            [(1, run_short(&bench, &[])), (2, bench.run(&watched)), (3, bench.run(&["doctor", "--seconds=0"]))]
        {
            let output = format!("{}{}", done.stdout, done.stderr);
            assert!(done.code == Some(code) && output.contains(&refusal), "{code}: {done:?}");
            assert!(output.contains("XDG_RUNTIME_DIR"), "{done:?}");
        }
        let named = ["watch", "--once", "1", domain.to_str().unwrap()];
        let done = bench.run(&named);
        assert!(done.code != Some(0) && done.says("exposed-directory"), "{done:?}");
        fs::remove_dir_all(&domain).unwrap();
    }
    // A directory of ours that other users can write to or replace.
    chown(&base, Some(0), Some(0)).unwrap();
    set_mode(&base, 0o770);
    let done = run_short(&bench, &[]);
    assert!(done.code == Some(1) && done.says("open-directory"), "{done:?}");
    set_mode(&base, 0o700);
    set_mode(&bench.runtime(), 0o777);
    let done = run_short(&bench, &[]);
    assert!(done.code == Some(1) && done.says("exposed-directory"), "{done:?}");
    set_mode(&bench.runtime(), 0o1777);
    assert_eq!(run_short(&bench, &[]).code, Some(0));
}

/// Creates hostile files as soon as the first file of a run appears, and opens everything it can. Prints a summary at
/// the end.
const RACER: &str = r#"
import json, os, signal, sys
secret, attacker, stopped = sys.argv[1], int(sys.argv[2]), False
os.setgroups([]), os.setgid(attacker), os.setuid(attacker)
def stop(*_):
    global stopped
    stopped = True
signal.signal(signal.SIGTERM, stop)
print("ready", flush=True)
seen, planted, opened = set(), 0, []
names = ["_zzz", "_bells", "-zzz", ".zzz", "_leader.books", "_9204dd183d1c4d8e1ff592a30766ffa6765aa8b5_node.0_10_0.global_mgmt"]
while not stopped:
    for name in os.listdir("/dev/shm"):
        path = "/dev/shm/" + name
        try:
            if not name.startswith("corotate_") or os.lstat(path).st_uid == attacker:
                continue
            id = name[:len("corotate_") + 32]
            if id not in seen:
                seen.add(id)
                for number, suffix in enumerate(names * 2):
                    try:
                        target = f"/dev/shm/{id}{suffix}" + ("" if number < len(names) else "2")
                        if number % 3 == 0:
                            os.symlink(secret, target)
                        elif number % 3 == 1:
                            os.close(os.open(target, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666))
                            os.chmod(target, 0o666)
                        else:
                            os.mkdir(target, 0o777)
                        planted += 1
                    except FileExistsError:
                        pass
            descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW)
            opened.append(name)
            os.ftruncate(descriptor, 0)
        except OSError:
            pass
print(json.dumps({"seen": len(seen), "planted": planted, "opened": opened}))
"#;

/// In a private /dev/shm: the attacker's files would disturb other tests.
fn raced(victim: u32, runs: u32) {
    let bench = Bench::new();
    let at = |name: &str| bench.path(name).to_str().unwrap().to_owned();
    fs::write(at("racer.py"), RACER).unwrap();
    fs::write(at("secret"), "kept").unwrap();
    set_mode(Path::new(&at("secret")), 0o640);
    fs::copy(env!("CARGO_BIN_EXE_corotate"), at("corotate")).unwrap();
    fs::copy(shipped("rigid-pair"), at("pair.toml")).unwrap();
    for path in [bench.path(""), bench.runtime(), at("secret").into()] {
        chown(path, Some(victim), Some(victim)).unwrap();
    }
    set_mode(&bench.path(""), 0o755);
    let script = format!(
        "mount -t tmpfs -o mode=1777 tmpfs /dev/shm || exit 77
        python3 racer.py {secret} {ATTACKER} > attack & racer=$!
        until grep -q ready attack; do sleep 0.01; done
        for number in $(seq {runs}); do
            setpriv --reuid={victim} --regid={victim} --clear-groups ./corotate run pair.toml {short} --record --out out$number > out$number.json || echo failed $?
        done
        kill $racer; wait $racer
        find /dev/shm -user {victim} -type f",
        secret = at("secret"),
        short = SHORT.map(|word| format!("'{word}'")).join(" "),
    );
    let done = bench.start_program(Path::new("unshare"), &["-m", "sh", "-c", &script]).wait();
    if done.code == Some(77) || done.stderr.contains("unshare failed") {
        return skipped("a race with another user", "a mount of a /dev/shm of one's own is forbidden");
    }
    assert!(done.code == Some(0) && done.stdout.is_empty(), "every run is accepted, nothing is left: {done:?}");
    let attack = fs::read_to_string(at("attack")).unwrap();
    let attack: serde_json::Value = serde_json::from_str(attack.lines().last().unwrap()).unwrap();
    println!("uid {victim}: {attack}");
    assert!(attack["seen"].as_u64() >= Some(1) && attack["planted"].as_u64() >= Some(1), "{attack}");
    assert_eq!(attack["opened"].as_array().map(Vec::len), Some(0), "{attack}");
    let secret = fs::metadata(at("secret")).unwrap();
    assert_eq!((secret.mode() & 0o777, fs::read_to_string(at("secret")).unwrap().as_str()), (0o640, "kept"));
    for number in 1..=runs {
        let summary: serde_json::Value =
            serde_json::from_str(&fs::read_to_string(at(&format!("out{number}.json"))).unwrap()).unwrap();
        assert!(summary["books"]["balanced"] == true && summary["recording"]["complete"] == true, "{summary}");
    }
}

#[test]
fn an_attacker_that_races_the_launcher_opens_nothing_and_stops_no_run() {
    if !root() {
        return;
    }
    let runs = std::env::var("COROTATE_RACES").map_or(5, |count| count.parse().unwrap());
    raced(0, runs);
    raced(54_321, runs);
}

/// In a directory where the attacker can write, links lead to his targets: nothing is written through them.
#[test]
fn results_are_not_written_through_links_of_another_user() {
    if !root() {
        return;
    }
    let bench = Bench::new();
    let at = |name: &str| bench.path(name).to_str().unwrap().to_owned();
    assert_eq!(run_short(&bench, &["--record", "--out=ours"]).code, Some(0));
    let secrets = bench.path("secrets");
    fs::create_dir(&secrets).unwrap();
    fs::write(secrets.join("file"), "kept").unwrap();
    fs::create_dir(at("open")).unwrap();
    set_mode(Path::new(&at("open")), 0o1777);
    for (target, link) in [("file", "file"), ("", "directory"), ("new", "new"), ("file", "leader.truth.csv")] {
        let link = at(&format!("open/{link}"));
        symlink(secrets.join(target), &link).unwrap();
        lchown(link, Some(ATTACKER), Some(ATTACKER)).unwrap();
    }
    let scenario = shipped("rigid-pair");
    let scenario = scenario.to_str().unwrap();
    let (ours, recording) = (at("ours"), at("ours/run.mcap"));
    let short = |arguments: &[&str]| {
        [&["run", scenario], &SHORT[..], arguments].concat().iter().map(|&word| word.to_owned()).collect::<Vec<_>>()
    };
    let words = |words: &[&str]| words.iter().map(|&word| word.to_owned()).collect::<Vec<_>>();
    for (link, arguments) in [
        ("file", short(&["--junit", &at("open/file"), "--out", &at("a")])),
        ("new", short(&["--junit", &at("open/new"), "--out", &at("b")])),
        ("directory", short(&["--junit", &at("open/directory/x.xml"), "--out", &at("c")])),
        ("directory", short(&["--out", &at("open/directory")])),
        ("directory", short(&["--out", &at("open/directory/run")])),
        ("directory", words(&["export", &recording, "--csv", &at("open/directory")])),
        ("file", words(&["report", &ours, "--out", &at("open/file")])),
        ("directory", words(&["report", &ours, "--out", &at("open/directory/page.html")])),
        ("directory", words(&["bench", "tick", "--quick", "--out", &at("open/directory")])),
    ] {
        let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
        let done = bench.run(&arguments);
        let refusal = format!("{link} is a link of {ATTACKER_NAME} (uid {ATTACKER}), and is not followed");
        assert!(done.code == Some(1) && done.stderr.contains(&refusal), "{arguments:?}: {done:?}");
    }
    // A table replaces the link, not its target.
    bench.run(&["export", &recording, "--csv", &at("open")]).succeeded();
    assert!(fs::symlink_metadata(at("open/leader.truth.csv")).unwrap().is_file());
    assert_eq!(fs::read_to_string(secrets.join("file")).unwrap(), "kept");
    assert_eq!(fs::read_dir(&secrets).unwrap().count(), 1);
    // A run's directory with a link in place of a file is refused.
    symlink(secrets.join("file"), at("open/summary.json")).unwrap();
    let done = run_short(&bench, &["--out", &at("open")]);
    assert!(done.code != Some(0) && done.says("foreign-file"), "{done:?}");
    await_some(|| bench.left(&[]).is_empty().then_some(()));
}

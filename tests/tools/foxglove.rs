//! A run on a Foxglove WebSocket, seen by an independent client; clients that stall and servers that are killed.

use crate::common::{Bench, Running, await_some, python, root, send_signal, shipped};
use libc::{SIGINT, SIGKILL};
use serde_json::Value;
use std::collections::BTreeMap;
use std::net::TcpListener;
use std::path::Path;

/// More unsent bytes than a client that reads ever has.
const ROOM: usize = 256 << 10;
const ANY_PORT: &str = "127.0.0.1:0";

/// Starts the program with its stderr in a file, to be read while it runs.
fn start(bench: &Bench, errors: &str, arguments: &[&str]) -> Running {
    let program = bench.command().get_program().to_str().unwrap().to_owned();
    let script = [&["-c", "errors=$1; shift; exec \"$@\" 2>\"$errors\"", "sh", errors, &program], arguments].concat();
    bench.start_program(Path::new("sh"), &script)
}

/// Starts a run with a WebSocket that waits for its follower.
fn start_waiting(bench: &Bench, out: &str, arguments: &[&str]) -> Running {
    let file = shipped("rigid-pair");
    let fixed = ["run", file.to_str().unwrap(), "--out", out, "--foxglove", ANY_PORT, "--external", "follower"];
    start(bench, &format!("{out}.errors"), &[&fixed[..], arguments].concat())
}

fn start_follower(bench: &Bench) -> Running {
    let domain = bench.domains().pop().unwrap();
    bench.start(&["plant", "--body", "follower", "--domain", domain.to_str().unwrap()])
}

/// Waits until the program has printed its address, and returns it.
fn url(bench: &Bench, errors: &str) -> String {
    await_some(|| {
        let text = std::fs::read_to_string(bench.path(errors)).ok()?;
        let line = text.lines().find_map(|line| line.strip_prefix("foxglove: "))?;
        text.contains(&format!("{line}\n")).then(|| line.to_owned())
    })
}

/// Starts a client and waits until it has subscribed.
fn client(bench: &Bench, url: &str, directory: &str, options: &[&str]) -> Running {
    let program = root().join("tests/readers/foxglove.py");
    let directory = bench.path(directory);
    let fixed = [program.to_str().unwrap(), url, directory.to_str().unwrap()];
    let client = bench.start_program(&python("readers"), &[&fixed, options].concat());
    await_some(|| directory.join("channels.json").exists().then_some(()));
    client
}

/// Reads state, local address and unsent bytes of every socket at this port from /proc/net.
fn sockets(url: &str) -> Vec<(String, String, usize)> {
    let port = format!(":{:04X}", url.rsplit_once(':').unwrap().1.parse::<u16>().unwrap());
    let tables = ["/proc/net/tcp", "/proc/net/tcp6"].map(|path| std::fs::read_to_string(path).unwrap_or_default());
    let lines = tables.iter().flat_map(|table| table.lines().skip(1));
    let words = lines.map(|line| line.split_whitespace().collect::<Vec<_>>());
    let local = words.filter_map(|words| Some((words[1].strip_suffix(&port)?.to_owned(), words)));
    let waiting = |words: &[&str]| usize::from_str_radix(words[4].split_once(':').unwrap().0, 16).unwrap();
    local.map(|(address, words)| (words[3].to_owned(), address, waiting(&words))).collect()
}

/// The due time of a message, ns, and its bytes.
type Message = (u64, Vec<u8>);

fn tick(payload: &[u8]) -> u64 {
    u64::from_le_bytes(payload[4..12].try_into().unwrap())
}

/// Returns the messages that a client received on a channel, in order.
fn received(bench: &Bench, directory: &str, channel: &Value) -> Vec<Message> {
    let bytes = std::fs::read(bench.path(directory).join(channel["id"].to_string())).unwrap();
    let word = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
    let (mut at, mut messages) = (0, Vec::new());
    while at < bytes.len() {
        let begin = at + 16;
        let end = begin + word(at + 8) as usize;
        messages.push((word(at), bytes[begin..end].to_vec()));
        at = end;
    }
    messages
}

fn channels(bench: &Bench, directory: &str) -> Vec<Value> {
    serde_json::from_slice(&std::fs::read(bench.path(directory).join("channels.json")).unwrap()).unwrap()
}

/// Waits for the first message, and so for the first tick.
fn await_messages(bench: &Bench, directory: &str) {
    let file = bench.path(directory).join(channels(bench, directory)[0]["id"].to_string());
    await_some(|| std::fs::metadata(&file).ok().filter(|file| file.len() > 0));
}

fn assert_ended_in_order(bench: &Bench, running: Running, out: &str) {
    let done = running.wait();
    assert_eq!(done.code, Some(128 + SIGINT), "{done:?}");
    let summary = bench.summary_in(out);
    assert_eq!(summary["books"]["balanced"], true, "{summary:#}");
}

/// Asserts that a client received the recorded channels, and messages equal to those of the recording.
fn assert_as_recorded(bench: &Bench, directory: &str, recording: &Path) {
    let bytes = std::fs::read(recording).unwrap();
    let mut recorded: BTreeMap<String, BTreeMap<u64, Message>> = BTreeMap::new();
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let message = message.unwrap();
        let messages = recorded.entry(message.channel.topic.clone()).or_default();
        messages.insert(tick(&message.data), (message.publish_time, message.data.to_vec()));
    }
    let shown = channels(bench, directory);
    for channel in mcap::Summary::read(&bytes).unwrap().unwrap().channels.values() {
        let shown = shown.iter().find(|shown| shown["topic"] == *channel.topic).unwrap();
        let schema = channel.schema.as_ref().unwrap();
        assert_eq!(shown["encoding"], *channel.message_encoding);
        assert_eq!(shown["schemaEncoding"], *schema.encoding);
        assert_eq!(shown["schemaName"], *schema.name);
        assert_eq!(shown["schema"], *std::str::from_utf8(&schema.data).unwrap());
        assert_eq!(shown["metadata"], serde_json::to_value(&channel.metadata).unwrap());
        let messages = received(bench, directory, shown);
        assert!(!messages.is_empty(), "{}", channel.topic);
        assert!(messages.windows(2).all(|pair| tick(&pair[0].1) < tick(&pair[1].1)), "{}: in order", channel.topic);
        for message in &messages {
            assert!(recorded[&channel.topic][&tick(&message.1)] == *message, "{}: {message:?}", channel.topic);
        }
    }
    assert_eq!(shown.len(), recorded.len());
}

#[test]
fn a_client_receives_the_recorded_bits() {
    let bench = Bench::new();
    for (clock, seconds) in [("realtime", "2"), ("lockstep", "20")] {
        let options = ["--clock", clock, "--duration", seconds, "--record", "--set", "accept={}"];
        let running = start_waiting(&bench, clock, &options);
        let url = url(&bench, &format!("{clock}.errors"));
        assert_eq!(
            sockets(&url),
            [("0A".to_owned(), "0100007F".to_owned(), 0)],
            "listens on the loopback address only"
        );
        let client = client(&bench, &url, &format!("{clock}.seen"), &[]);
        let (domain, follower) = (bench.domains().pop().unwrap(), start_follower(&bench));
        let (done, seen) = (running.wait(), client.wait());
        assert_eq!(done.code, Some(0), "{done:?}");
        assert_eq!(seen.code, Some(0), "{seen:?}");
        assert_eq!(follower.wait().code, Some(0));
        assert_as_recorded(&bench, &format!("{clock}.seen"), &bench.path(clock).join("run.mcap"));
        bench.assert_clean(&[domain]);
    }
}

/// The client's buffer is full long before the end of these runs: a pair in lockstep and a fleet in real time.
#[test]
fn a_client_that_never_reads_does_not_harm_the_run() {
    let bench = Bench::new();
    let fleet = shipped("rigid-fleet");
    let fleet = ["run", fleet.to_str().unwrap(), "--set", "accept={}", "--clock", "realtime", "--duration", "3"];
    let pair = shipped("rigid-pair");
    let pair = ["run", pair.to_str().unwrap(), "--clock", "lockstep", "--duration", "100"];
    for (out, arguments) in [("pair", &pair[..]), ("fleet", &fleet[..])] {
        let shown = ["--out", out, "--foxglove", ANY_PORT, "--external", "controller"];
        let errors = format!("{out}.errors");
        let running = start(&bench, &errors, &[arguments, &shown].concat());
        let url = url(&bench, &errors);
        let stalled = client(&bench, &url, &format!("{out}.seen"), &["--stall"]);
        let domain = bench.domains().pop().unwrap();
        let controller = bench.start(&["controller", "--domain", domain.to_str().unwrap()]);
        await_some(|| sockets(&url).into_iter().find(|(_, _, waiting)| *waiting > ROOM));
        let done = running.wait();
        let errors = std::fs::read_to_string(bench.path(&errors)).unwrap();
        assert_eq!(done.code, Some(0), "{done:?} {errors}");
        assert!(!errors.contains("companion-lost"), "{errors}");
        assert_eq!(controller.wait().code, Some(0));
        drop(stalled);
        bench.assert_clean(&[domain]);
    }
}

#[test]
fn a_server_that_is_killed_does_not_harm_the_run() {
    let bench = Bench::new();
    for clock in ["realtime", "lockstep"] {
        let running = start_waiting(&bench, clock, &["--clock", clock, "--duration", "100000", "--set", "accept={}"]);
        let (errors, seen) = (format!("{clock}.errors"), format!("{clock}.seen"));
        let client = client(&bench, &url(&bench, &errors), &seen, &[]);
        let (domain, follower) = (bench.domains().pop().unwrap(), start_follower(&bench));
        await_messages(&bench, &seen);
        send_signal(bench.await_role("foxglove"), SIGKILL);
        let error = await_some(|| {
            let text = std::fs::read_to_string(bench.path(&errors)).unwrap();
            text.lines().find(|line| line.ends_with("[companion-lost]")).map(str::to_owned)
        });
        assert!(error.contains("foxglove") && error.contains("SIGKILL"), "{error}");
        assert_eq!(client.wait().code, Some(0));
        running.signal(SIGINT);
        assert_ended_in_order(&bench, running, clock);
        assert_eq!(follower.wait().code, Some(0));
        bench.assert_clean(&[domain]);
    }
}

#[test]
fn an_address_in_use_ends_the_run_before_it_begins() {
    let bench = Bench::new();
    let taken = TcpListener::bind(ANY_PORT).unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let done = bench.run(&["run", "--clock", "lockstep", "--out", "out", "--foxglove", &address]);
    assert!(done.code == Some(4) && done.says("cannot-listen"), "{done:?}");
    assert!(done.stderr.contains(&address), "{done:?}");
    assert!(!bench.path("out/summary.json").exists());
    assert!(bench.domains().is_empty() && bench.processes().is_empty());
}

/// Another program of this machine may use the default port; the error names the address, too.
#[test]
fn without_an_address_the_run_listens_on_the_loopback_only() {
    let bench = Bench::new();
    let arguments = ["run", "--duration", "1", "--clock", "lockstep", "--set", "accept={}", "--foxglove"];
    let done = bench.run(&arguments);
    let listened = done.code == Some(0) && done.stderr.contains("foxglove: ws://127.0.0.1:8765\n");
    let taken = done.code == Some(4) && done.says("cannot-listen") && done.stderr.contains("127.0.0.1:8765");
    assert!(listened || taken, "{done:?}");
    for wrong in [&["--foxglove", "8765"][..], &["--foxglove", "--clock", "in-process"]] {
        let done = bench.run(&[&["run"], wrong].concat());
        assert!(done.code == Some(2) && done.stderr.contains("--foxglove"), "{done:?}");
    }
}

#[test]
fn a_running_loop_is_shown_until_the_server_is_interrupted() {
    let bench = Bench::new();
    let refused = bench.run(&["foxglove"]);
    assert!(refused.code == Some(2) && refused.says("no-run"), "{refused:?}");
    let running = bench.start(&["run", "--duration", "60", "--tick-hz", "200", "--out", "out", "--set", "accept={}"]);
    bench.await_role("controller");
    let server = start(&bench, "server.errors", &["foxglove", "--address", ANY_PORT]);
    let seen = client(&bench, &url(&bench, "server.errors"), "seen", &[]);
    await_messages(&bench, "seen");
    let domain = bench.domains().pop().unwrap();
    server.signal(SIGINT);
    assert_eq!((server.wait().code, seen.wait().code), (Some(0), Some(0)));
    running.signal(SIGINT);
    assert_ended_in_order(&bench, running, "out");
    bench.assert_clean(&[domain]);
}

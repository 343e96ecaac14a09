//! Seats that a program serves to the process that started it: any rig's roles, the values of inputs, and every bad end.

use super::own_rig;
use crate::common::{Bench, Running, await_some, send_signal};
use bytemuck::from_bytes;
use corotate::config::{InputUser, SHIPPED};
use corotate::rig::{Command as Acceleration, Estimate, Measurement, Rig, RigidBodyRig};
use corotate::role::Controller;
use corotate::sample::Message;
use corotate::scenario::Scenario;
use serde_json::{Value, json};
use std::io::{Read, Write};
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command};

type R = RigidBodyRig;

const STAMP: usize = 4;
const OUTPUTS: u64 = 1;
const FAILURE: u64 = 2;

/// The program's end of a served seat, written from the description of the frames alone.
struct Client {
    socket: UnixStream,
    child: Child,
    seat: Value,
}

/// One tick: its inputs without stamps, and the values.
struct Tick {
    tick: u64,
    inputs: Vec<Option<Vec<u64>>>,
    values: Vec<f64>,
}

/// A frame from the server.
enum Frame {
    Tick(Tick),
    End(String),
    /// The server died.
    Closed,
}

#[allow(unsafe_code, reason = "a pair of sockets that keep packets, one of them inherited")]
fn spawn(command: &mut Command) -> (UnixStream, Child) {
    let mut pair = [0; 2];
    let kind = libc::SOCK_SEQPACKET | libc::SOCK_CLOEXEC;
    // SAFETY: the kernel writes two numbers of sockets.
    let made = unsafe { libc::socketpair(libc::AF_UNIX, kind, 0, pair.as_mut_ptr()) };
    assert_eq!(made, 0);
    // SAFETY: both sockets were just opened, and nothing else owns them.
    let [own, given] = pair.map(|number| unsafe { OwnedFd::from_raw_fd(number) });
    let number = given.as_raw_fd();
    // SAFETY: between fork and exec only a system call is made.
    unsafe {
        command.pre_exec(move || match libc::fcntl(number, libc::F_SETFD, 0) {
            0 => Ok(()),
            _ => Err(std::io::Error::last_os_error()),
        })
    };
    let child = command.args(["--fd", &number.to_string()]).spawn().unwrap();
    (UnixStream::from(own), child)
}

impl Client {
    /// Starts the program that the seat file names.
    fn start(bench: &Bench, seat: &Path) -> Self {
        let written: Value = serde_json::from_slice(&std::fs::read(seat).unwrap()).unwrap();
        let program: Vec<&str> =
            written["program"].as_array().unwrap().iter().map(|word| word.as_str().unwrap()).collect();
        let mut command = bench.command_of(Path::new(program[0]));
        command
            .args(&program[1..])
            .arg("serve-seat")
            .arg(seat.parent().unwrap())
            .arg(written["role"].as_str().unwrap());
        let (socket, child) = spawn(&mut command);
        let mut client = Self { socket, child, seat: Value::Null };
        let hello = client.packet();
        let [1, 1, length] = words(&hello)[..] else { panic!("{hello:?}") };
        let mut text = Vec::new();
        while text.len() < length as usize {
            let packet = client.packet();
            assert_eq!(words(&packet[..8]), [2]);
            text.extend_from_slice(&packet[8..]);
        }
        client.seat = serde_json::from_slice(&text).unwrap();
        assert_eq!(client.seat, written, "the file and the server describe the same seat");
        client
    }

    fn packet(&mut self) -> Vec<u8> {
        let mut bytes = vec![0; 256 << 10];
        // A server that died with an unread answer resets the connection.
        let length = self.socket.read(&mut bytes).unwrap_or(0);
        bytes.truncate(length);
        bytes
    }

    fn next(&mut self) -> Frame {
        let packet = self.packet();
        let Some(kind) = packet.get(..8).map(|kind| words(kind)[0]) else { return Frame::Closed };
        if kind == 4 {
            return Frame::End(String::from_utf8(packet[8..].to_vec()).unwrap());
        }
        let words = words(&packet);
        assert_eq!(kind, 3);
        let reads = self.seat["reads"].as_array().unwrap();
        let presence = reads.len().div_ceil(64).max(1);
        let mut at = 2 + presence;
        let mut inputs = Vec::new();
        for (index, read) in reads.iter().enumerate() {
            let length = read["size"].as_u64().unwrap() as usize / 8 - STAMP;
            let is_present = words[2 + index / 64] >> (index % 64) & 1 == 1;
            inputs.push(is_present.then(|| words[at..at + length].to_vec()));
            at += length;
        }
        Frame::Tick(Tick { tick: words[1], inputs, values: words[at..].iter().copied().map(f64::from_bits).collect() })
    }

    fn send(&self, kind: u64, tick: u64, content: &[u8]) {
        let frame = [&kind.to_ne_bytes(), &tick.to_ne_bytes(), content].concat();
        let _ = (&self.socket).write(&frame);
    }

    fn outputs_size(&self) -> usize {
        let size = |port: &Value| port["size"].as_u64().unwrap() as usize - 8 * STAMP;
        self.seat["writes"].as_array().unwrap().iter().map(size).sum()
    }

    /// Answers each tick with what `compute` returns, up to the end; returns its text.
    fn serve(&mut self, mut compute: impl FnMut(&Tick) -> Vec<u64>) -> String {
        loop {
            match self.next() {
                Frame::Tick(tick) => {
                    let outputs = compute(&tick);
                    self.send(OUTPUTS, tick.tick, bytemuck::cast_slice(&outputs));
                }
                Frame::End(text) => return text,
                Frame::Closed => panic!("the server died"),
            }
        }
    }

    /// Answers the ticks before `tick` with zeros.
    fn serve_before(&mut self, tick: u64) {
        let outputs = vec![0; self.outputs_size()];
        loop {
            match self.next() {
                Frame::Tick(asked) if asked.tick >= tick => return,
                Frame::Tick(asked) => self.send(OUTPUTS, asked.tick, &outputs),
                Frame::End(text) => panic!("the seat ended: {text}"),
                Frame::Closed => panic!("the server died"),
            }
        }
    }

    fn exit_code(&mut self) -> Option<i32> {
        await_some(|| self.child.try_wait().unwrap()).code()
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn words(bytes: &[u8]) -> Vec<u64> {
    bytes.chunks_exact(8).map(|word| u64::from_ne_bytes(word.try_into().unwrap())).collect()
}

/// The changes of gains and set points that a law must follow.
const CHANGES: &str = r#"
[[input]]
at_s = 0.5
key = "controller.gain_per_s"
value = [6.0, 5.0, 4.5]
shape = "ramp"
duration_s = 0.5

[[input]]
at_s = 0.8
key = "follower.0.offset_rad_s"
value = [0.0, 0.1, 0.2]
"#;

fn start(bench: &Bench, scenario: &str, role: &str, options: &[&str]) -> (Running, std::path::PathBuf) {
    let waits = ["run", scenario, "--external", role, "--set", "accept={}", "--json"];
    let running = bench.start(&[&waits[..], options].concat());
    (running, bench.await_seat(role))
}

/// The rig's law follows the values that come with the ticks: scripted changes, and one that another program makes.
#[test]
fn a_served_controller_follows_the_inputs_and_equals_the_built_in_one_bit_by_bit() {
    let bench = Bench::new();
    let text = SHIPPED.iter().find(|(name, _)| *name == "rigid-pair").unwrap().1;
    let file = bench.path("pair.toml");
    std::fs::write(&file, format!("{text}\n{CHANGES}")).unwrap();
    let (file, brief) = (file.to_str().unwrap(), ["--clock", "lockstep", "--duration", "2"]);
    let (running, seat) = start(&bench, file, "controller", &[&brief[..], &["--out", "served"]].concat());
    let scenario = Scenario::parse(text, "rigid-pair", &[]).unwrap();
    let law = scenario.rig.downcast_ref::<R>().unwrap().law(1);
    let mut controller = Controller::new(law, scenario.tick_s());
    let mut client = Client::start(&bench, &seat);
    let keys: Vec<&str> =
        client.seat["values"].as_array().unwrap().iter().map(|value| value["key"].as_str().unwrap()).collect();
    assert_eq!(keys, ["controller.gain_per_s", "observer.decay_rate_per_s", "follower.0.offset_rad_s"]);
    let places: Vec<(usize, usize, usize)> = client.seat["values"]
        .as_array()
        .unwrap()
        .iter()
        .map(|value| {
            let (_, info) = scenario.inputs.find(value["key"].as_str().unwrap()).unwrap();
            let port = info.use_by(|user| user == InputUser::Law(1)).unwrap().port;
            (port, value["index"].as_u64().unwrap() as usize, value["count"].as_u64().unwrap() as usize)
        })
        .collect();
    let mut received = None;
    let ended = client.serve(|tick| {
        if tick.tick == 1200 {
            let set = bench.run(&["set", "controller.gain_per_s=[7,7,7]", "--json"]);
            received = Some(set.succeeded().json()["tick"].as_u64().unwrap());
        }
        for (port, index, count) in &places {
            controller.set_input(*port, &tick.values[*index..][..*count]);
        }
        let padded = |input: &Option<Vec<u64>>| [&[0; STAMP], &input.as_ref().unwrap()[..]].concat();
        let (estimate, measured) = (padded(&tick.inputs[0]), padded(&tick.inputs[1]));
        let estimate: &Estimate<R> = from_bytes(bytemuck::cast_slice(&estimate));
        let measured: &Measurement<R> = from_bytes(bytemuck::cast_slice(&measured));
        let mut command = Acceleration::<R>::default();
        controller.step(estimate, None, measured, &mut command);
        command.words()[STAMP..].to_vec()
    });
    assert_eq!((ended.as_str(), client.exit_code()), ("", Some(0)));
    let served = running.wait().succeeded().json();
    assert!(
        served["books"]["balanced"] == true && served["books"]["roles"]["controller"]["executed"] == 2001,
        "{served:#}"
    );
    let scripted = format!(
        "{text}\n{CHANGES}\n[[input]]\nat_s = {}\nkey = \"controller.gain_per_s\"\nvalue = [7.0, 7.0, 7.0]\n",
        received.unwrap() as f64 / 1e3
    );
    std::fs::write(file, scripted).unwrap();
    let built_in = bench
        .run(&[&["run", file, "--set", "accept={}", "--json", "--out", "alone"], &brief[..]].concat())
        .succeeded()
        .json();
    assert_eq!(served["state"]["hash"], built_in["state"]["hash"]);
    bench.assert_clean(&[seat.parent().unwrap().to_owned()]);
}

/// A program of another crate serves its own rig's roles; the law is written by hand.
#[test]
fn any_rig_s_program_serves_its_seats() {
    let bench = Bench::with_program(own_rig::program());
    let brief = ["--clock", "lockstep", "--duration", "2"];
    let (running, seat) = start(&bench, "motor-pair", "controller", &[&brief[..], &["--out", "served"]].concat());
    let mut client = Client::start(&bench, &seat);
    let motor = client.seat["scenario"]["motor"].clone();
    let [inertia, friction, torque] =
        ["inertia_kg_m2", "friction_n_m_s", "torque_n_m_per_a"].map(|key| motor[key].as_f64().unwrap());
    let ended = client.serve(|tick| {
        let number = |input: usize, word: usize| f64::from_bits(tick.inputs[input].as_ref().unwrap()[word]);
        let (leader_rad_s, rise_rad_s2, own_rad_s) = (number(0, 0), number(0, 2), number(1, 0));
        let rise = rise_rad_s2 - tick.values[0] * (own_rad_s - leader_rad_s);
        vec![((inertia * rise + friction * own_rad_s) / torque).to_bits()]
    });
    assert_eq!((ended.as_str(), client.exit_code()), ("", Some(0)));
    let served = running.wait().succeeded().json();
    let built_in =
        bench.run(&[&["run", "motor-pair", "--set", "accept={}", "--json", "--out", "alone"], &brief[..]].concat());
    assert_eq!(served["state"]["hash"], built_in.succeeded().json()["state"]["hash"]);
}

/// Every bad answer ends the run in order at its tick, with the reason; the heartbeat timeout is an hour.
#[test]
fn a_bad_answer_ends_the_run_with_its_reason() {
    type Misuse = fn(&mut Client);
    let cases: [(&str, Misuse); 8] = [
        ("it cannot divide by zero", |client| client.send(FAILURE, 50, b"it cannot divide by zero")),
        ("tick 49", |client| client.send(OUTPUTS, 49, &vec![0; client.outputs_size()])),
        ("24 bytes", |client| client.send(OUTPUTS, 50, &[0; 8])),
        ("kind 7", |client| client.send(7, 50, &vec![0; client.outputs_size()])),
        ("bytes", |client| client.send(OUTPUTS, 50, &[0; 100_000])),
        ("kind 2 for tick 3", |client| client.send(FAILURE, 3, b"late")),
        ("ended, or closed its seat", |client| client.socket.shutdown(std::net::Shutdown::Both).unwrap()),
        ("bytes", |client| drop((&client.socket).write(&[1]))),
    ];
    for (words, misuse) in cases {
        let bench = Bench::new();
        let patient = ["--clock", "lockstep", "--duration", "1000", "--set", "supervision.heartbeat_timeout_s=3600"];
        let (running, seat) = start(&bench, "rigid-pair", "controller", &patient);
        let mut client = Client::start(&bench, &seat);
        client.serve_before(50);
        misuse(&mut client);
        let done = running.wait();
        assert_eq!(done.code, Some(4), "{words}: {done:?}");
        let incident = &done.json()["incidents"][0];
        assert!(incident["last_words"].as_str().unwrap().contains(words), "{words}: {incident}");
        assert_eq!(incident["tick"], 50, "{incident}");
        assert_eq!(client.exit_code(), Some(1), "{words}");
        if words != "ended, or closed its seat" {
            assert!(matches!(client.next(), Frame::End(text) if text.contains(words)), "{words}");
        }
        bench.assert_clean(&[seat.parent().unwrap().to_owned()]);
    }
}

#[test]
fn a_seat_is_free_again_if_its_program_ends_before_the_ticks() {
    let bench = Bench::new();
    let brief = ["--clock", "lockstep", "--duration", "0.2", "--external", "observer"];
    let (running, seat) = start(&bench, "rigid-pair", "controller", &brief);
    let mut first = Client::start(&bench, &seat);
    first.socket.shutdown(std::net::Shutdown::Both).unwrap();
    assert_eq!(first.exit_code(), Some(0));
    let mut controller = Client::start(&bench, &seat);
    let zeros = |client: &Client| vec![0; client.outputs_size() / 8];
    let controls = std::thread::spawn(move || {
        let blank = zeros(&controller);
        controller.serve(|_| blank.clone())
    });
    let mut observer = Client::start(&bench, &bench.await_seat("observer"));
    let blank = zeros(&observer);
    assert_eq!(observer.serve(|_| blank.clone()), "");
    assert_eq!(controls.join().unwrap(), "");
    assert_eq!(running.wait().succeeded().json()["incidents"], json!([]));
}

#[test]
fn the_program_sees_the_death_of_its_server_and_the_run_ends() {
    let bench = Bench::new();
    let (running, seat) = start(&bench, "rigid-pair", "controller", &["--clock", "lockstep", "--duration", "1000"]);
    let mut client = Client::start(&bench, &seat);
    client.serve_before(50);
    send_signal(client.child.id(), libc::SIGKILL);
    assert!(matches!(client.next(), Frame::Closed));
    let done = running.wait();
    assert_eq!(done.code, Some(4), "{done:?}");
    assert_eq!(done.json()["incidents"][0]["code"], "left");
    bench.assert_clean(&[seat.parent().unwrap().to_owned()]);
}

/// A program that computes for ever costs the run its role, and its server ends with the run.
#[test]
fn a_program_that_stops_answering_holds_up_nothing_for_ever() {
    for (clock, limit) in
        [("lockstep", "launch.external_timeout_s=5"), ("realtime", "supervision.heartbeat_timeout_s=5")]
    {
        let bench = Bench::new();
        let (running, seat) =
            start(&bench, "rigid-pair", "controller", &["--clock", clock, "--duration", "1000", "--set", limit]);
        let mut client = Client::start(&bench, &seat);
        client.serve_before(50);
        let done = running.wait();
        assert_eq!(done.code, Some(4), "{clock}: {done:?}");
        assert!(matches!(client.next(), Frame::End(text) if text.contains("the run ended")), "{clock}");
        assert_eq!(client.exit_code(), Some(1));
        bench.assert_clean(&[seat.parent().unwrap().to_owned()]);
    }
}

#[test]
fn what_cannot_be_served_is_refused_with_a_code() {
    let bench = Bench::new();
    let refused = |domain: &str, role: &str| {
        let (socket, mut child) = spawn(bench.command().args(["serve-seat", domain, role]));
        let mut bytes = vec![0; 65536];
        let length = (&socket).read(&mut bytes).unwrap();
        assert!(!child.wait().unwrap().success());
        assert_eq!(words(&bytes[..8]), [4]);
        String::from_utf8_lossy(&bytes[8..length]).split_once('\n').unwrap().0.to_owned()
    };
    assert_eq!(refused("nowhere", "controller"), "not-a-domain");
    let (running, seat) =
        start(&bench, "rigid-fleet", "controller", &["--clock", "lockstep", "--set", "follower.0.count=2"]);
    let domain = seat.parent().unwrap().to_str().unwrap();
    assert_eq!(refused(domain, "nobody"), "no-such-role");
    assert_eq!(refused(domain, "controller"), "fleet-role");
    running.signal(libc::SIGINT);
    running.wait();
    for number in ["0", "77"] {
        let done = bench.run(&["serve-seat", domain, "controller", "--fd", number]);
        assert_eq!(done.code, Some(2), "{done:?}");
    }
    assert!(bench.run(&["serve-seat", domain, "controller", "--fd", "77"]).says("no-seat-socket"));
}

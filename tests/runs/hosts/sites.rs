//! Simulated computers. If this user is root, each has its own network and monotonic clock, and a veth pair to the first; otherwise all
//! share loopback and the clock.

use crate::common::{Bench, Running, skipped};
use libc::SIGKILL;
use std::fs::File;
use std::process::{Child, Command, Stdio};

/// Difference between the clocks of neighbouring sites, s.
pub const APART_S: i64 = 1000;

/// A simulated computer.
pub struct Site {
    pub bench: Bench,
    /// The process that keeps the site's namespaces, and the process id inside them.
    holder: Option<(Child, u32)>,
    /// Index of the site.
    number: usize,
}

impl Site {
    fn new(number: usize, apart: bool) -> Self {
        let holder = apart.then(|| {
            let offset_s = (number as i64 * APART_S).to_string();
            let mut command = Command::new("unshare");
            command.args(["--net", "--time", "--monotonic", &offset_s, "--fork", "--kill-child", "sleep", "infinity"]);
            let child = command.stdin(Stdio::null()).spawn().unwrap();
            let children = format!("/proc/{0}/task/{0}/children", child.id());
            let inner = crate::common::await_some(|| {
                let pid: u32 = std::fs::read_to_string(&children).ok()?.split_whitespace().next()?.parse().ok()?;
                // Before it executes `sleep`, it may not be in the namespaces yet.
                let name = std::fs::read_to_string(format!("/proc/{pid}/comm")).ok()?;
                (name.trim() == "sleep").then_some(pid)
            });
            (child, inner)
        });
        let site = Self { bench: Bench::new(), holder, number };
        if apart {
            site.system(&["ip", "link", "set", "lo", "up"]);
        }
        site
    }

    /// Returns a command that runs at the site.
    pub fn command(&self, program: &std::path::Path) -> Command {
        let Some((_, pid)) = &self.holder else { return self.bench.command_of(program) };
        let mut command = self.bench.command_of(std::path::Path::new("nsenter"));
        command.args(["-t", &pid.to_string(), "--net", "--time", "--"]).arg(program);
        command
    }

    /// Starts corotate at the site.
    pub fn start(&self, arguments: &[&str]) -> Running {
        Running::new(self.command(std::path::Path::new(env!("CARGO_BIN_EXE_corotate"))).args(arguments))
    }

    fn system(&self, words: &[&str]) {
        let done = self.command(std::path::Path::new(words[0])).args(&words[1..]).output().unwrap();
        assert!(done.status.success(), "{words:?}: {}", String::from_utf8_lossy(&done.stderr));
    }

    /// Moves the calling thread into the site's network, if it has its own.
    pub fn enter(&self) {
        if let Some((_, pid)) = &self.holder {
            let network = File::open(format!("/proc/{pid}/ns/net")).unwrap();
            let kind = rustix::thread::LinkNameSpaceType::Network;
            rustix::thread::move_into_link_name_space(std::os::fd::AsFd::as_fd(&network), Some(kind)).unwrap();
        }
    }

    /// Sets its network interface `up` or `down`.
    pub fn plug(&self, state: &str) {
        self.system(&["ip", "link", "set", "eth0", state]);
    }

    /// Returns the address of the first site, as seen from this one.
    pub fn hub(&self) -> String {
        if self.holder.is_some() { format!("10.77.{}.1", self.number) } else { "127.0.0.1".to_owned() }
    }

    /// Kills all processes of the site, like a power cut.
    pub fn cut_power(&self) {
        self.bench.processes().into_iter().for_each(|pid| crate::common::send_signal(pid, SIGKILL));
    }
}

impl Drop for Site {
    fn drop(&mut self) {
        if let Some((child, _)) = &mut self.holder {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// Returns true if sites have their own networks and clocks here.
pub fn apart() -> bool {
    let output =
        Command::new("unshare").args(["--net", "--time", "--monotonic", "1000", "--fork", "ip", "link"]).output();
    let can = rustix::process::getuid().is_root() && output.is_ok_and(|done| done.status.success());
    if !can {
        skipped("networks and clocks of their own", "this user may not create namespaces: all hosts are on loopback");
    }
    can
}

/// Creates `count` sites, all connected to the first.
pub fn sites(count: usize) -> Vec<Site> {
    let apart = apart();
    let sites: Vec<Site> = (0..count).map(|number| Site::new(number, apart)).collect();
    for site in sites.iter().skip(1).filter(|_| apart) {
        let (_, pid) = site.holder.as_ref().unwrap();
        let (near, pid) = (format!("eth{}", site.number), pid.to_string());
        let [here, there] = [1, 2].map(|end| format!("10.77.{}.{end}/24", site.number));
        sites[0].system(&["ip", "link", "add", &near, "type", "veth", "peer", "name", "eth0", "netns", &pid]);
        sites[0].system(&["ip", "addr", "add", &here, "dev", &near]);
        sites[0].system(&["ip", "link", "set", &near, "up"]);
        site.system(&["ip", "addr", "add", &there, "dev", "eth0"]);
        site.plug("up");
    }
    sites
}

/// Returns a free port of the first site.
pub fn free_port() -> u16 {
    std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

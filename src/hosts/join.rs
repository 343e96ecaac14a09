//! How a host joins a run: what it asks, what it is told, and whether both are the same program.
//!
//! Must not open anything: bytes in, bytes out.

use crate::config::{ConfigError, Document};
use crate::runtime::{RoleId, ports};
use crate::scenario::Scenario;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

/// After so long without a word whoever had a host's part has left it, ns: somebody else may have it, as long as no ticks run.
pub(super) const GONE_NS: u64 = 3_000_000_000;

/// What a host asks.
#[derive(Debug, Serialize, Deserialize)]
pub struct Request {
    /// The version of its program.
    version: String,
    /// The part that it wants; none takes one that is free.
    host: Option<String>,
    /// By which it is known if it asks again.
    token: u64,
}

impl Request {
    /// That of a host of this name.
    pub fn new(host: Option<&str>, token: u64) -> Self {
        Self { version: env!("CARGO_PKG_VERSION").to_owned(), host: host.map(str::to_owned), token }
    }

    /// Its bytes.
    pub fn encode(&self) -> Vec<u8> {
        serde_json::to_vec(self).expect("plain values are JSON")
    }
}

/// What it is told.
#[derive(Debug, Serialize, Deserialize)]
struct Answer {
    version: String,
    /// Why it cannot join.
    refused: Option<String>,
    host: String,
    hub: String,
    run: String,
    scenario: String,
    layouts: BTreeMap<String, String>,
    /// Files that the scenario names: key, name, length of what follows.
    files: Vec<(String, String, usize)>,
}

/// Why a host does not take part.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum JoinError {
    /// The run does not want it.
    #[error("{0}")]
    #[strum(serialize = "join-refused")]
    Refused(String),
    /// It is another version.
    #[error("the run is of version {theirs} and this program of {ours}; install the same on all hosts")]
    #[strum(serialize = "other-version")]
    Version {
        /// The version there.
        theirs: String,
        /// The version here.
        ours: &'static str,
    },
    /// A sample is laid out otherwise there.
    #[error(
        "{service} is `{theirs}` there and `{ours}` here; install the same program, with the same rigs, on all hosts"
    )]
    #[strum(serialize = "other-layout")]
    Layout {
        /// The signal.
        service: String,
        /// Type, size and fields there.
        theirs: String,
        /// The same here.
        ours: String,
    },
    /// What came is no answer.
    #[error("what came is no answer to a host that wants to join; is it another program that listens there?")]
    NoAnswer,
    /// The scenario is refused here.
    #[error(transparent)]
    #[strum(serialize = "refused-scenario")]
    Config(#[from] ConfigError),
    /// A file that the scenario names cannot be kept.
    #[error("cannot write {}: {source}; {}", path.display(), crate::system::remedy(source))]
    #[strum(serialize = "cannot-write")]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
}

/// The layouts of all samples of a scenario, by service.
fn layouts(scenario: &Scenario) -> BTreeMap<String, String> {
    let of = |role: RoleId| {
        ports(scenario, role).writes.into_iter().map(|port| {
            let fields: Vec<String> =
                port.fields.iter().map(|field| format!("{}@{}x{}", field.name, field.offset, field.count)).collect();
            (port.topic.to_string(), format!("{} {} {}", port.layout, port.size, fields.join(" ")))
        })
    };
    RoleId::all(scenario).into_iter().flat_map(of).collect()
}

/// The part of each host, at the one that launched: who has it.
pub struct Parts {
    scenario: String,
    run: String,
    hub: String,
    layouts: BTreeMap<String, String>,
    files: Vec<(String, String, Vec<u8>)>,
    /// By the number of the host: its name, and who has it.
    parts: Mutex<Vec<(String, Option<Taken>)>>,
}

/// By which token a part is taken, and since when, ns.
#[derive(Clone, Copy)]
struct Taken {
    token: u64,
    since_ns: u64,
}

impl Parts {
    /// Those of a run; `text` is its scenario's file.
    pub fn new(scenario: &Scenario, text: String, run: &str, hub: &str) -> Self {
        let read = |(key, path): &(String, PathBuf)| {
            let name = path.file_name()?.to_string_lossy().into_owned();
            // One that ships with the program is there too.
            Some((key.clone(), name, std::fs::read(path).ok()?))
        };
        Self {
            scenario: text,
            run: run.to_owned(),
            hub: hub.to_owned(),
            layouts: layouts(scenario),
            files: scenario.files.iter().filter_map(read).collect(),
            parts: Mutex::new(scenario.hosts.hosts.iter().map(|host| (host.name.clone(), None)).collect()),
        }
    }

    /// Answers a request at a time, ns; `begun` tells whether ticks run, `heard_ns` when each host was heard last.
    pub fn answer(&self, request: &[u8], now_ns: u64, begun: bool, heard_ns: &[AtomicU64]) -> Vec<u8> {
        let granted = match serde_json::from_slice::<Request>(request) {
            Ok(request) => self.grant(&request, now_ns, begun, heard_ns),
            Err(_) => Err("this is no request to join a run; install the same version on all hosts".to_owned()),
        };
        let refused = granted.as_ref().err().cloned();
        let given = refused.is_none();
        let files: &[_] = if given { &self.files } else { &[] };
        let answer = Answer {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            refused,
            host: granted.unwrap_or_default(),
            hub: self.hub.clone(),
            run: if given { self.run.clone() } else { String::new() },
            scenario: if given { self.scenario.clone() } else { String::new() },
            layouts: if given { self.layouts.clone() } else { BTreeMap::new() },
            files: files.iter().map(|(key, name, bytes)| (key.clone(), name.clone(), bytes.len())).collect(),
        };
        let head = serde_json::to_vec(&answer).expect("plain values are JSON");
        let mut bytes = (head.len() as u64).to_le_bytes().to_vec();
        bytes.extend(head);
        files.iter().for_each(|(_, _, content)| bytes.extend(content));
        bytes
    }

    /// The name of the part that is given, or why none is.
    fn grant(&self, request: &Request, now_ns: u64, begun: bool, heard_ns: &[AtomicU64]) -> Result<String, String> {
        if request.version != env!("CARGO_PKG_VERSION") {
            // Told by the version that is in the answer.
            return Err(String::new());
        }
        let mut parts = self.parts.lock().map_err(|_| "the host that launches failed; start the run again")?;
        let names: Vec<&str> = parts.iter().map(|(name, _)| &**name).filter(|name| *name != self.hub).collect();
        let known = names.join(", ");
        if request.host.as_ref().is_some_and(|host| !names.contains(&host.as_str())) {
            let host = request.host.as_deref().unwrap_or_default();
            return Err(format!("no host `{host}` joins this run; it waits for: {known}"));
        }
        let free = |index: usize, taken: &Option<Taken>| {
            let heard_ns = heard_ns.get(index).map_or(0, |heard_ns| heard_ns.load(Ordering::Relaxed));
            taken.is_none_or(|Taken { token, since_ns }| {
                token == request.token || (!begun && now_ns.saturating_sub(since_ns.max(heard_ns)) > GONE_NS)
            })
        };
        let wanted = |name: &str| name != self.hub && request.host.as_ref().is_none_or(|host| host == name);
        let found = parts.iter_mut().enumerate().find(|(index, (name, taken))| wanted(name) && free(*index, taken));
        let Some((_, (name, taken))) = found else {
            let which = request.host.as_ref().map_or(known, Clone::clone);
            return Err(format!("{which} has joined already; end that one first, or give --host another name"));
        };
        *taken = Some(Taken { token: request.token, since_ns: now_ns });
        Ok(name.clone())
    }

    /// Returns the hosts that joined and then were not heard for so long, ns. Only meaningful before ticks run.
    pub fn lost(&self, now_ns: u64, silent_ns: u64, heard_ns: &[AtomicU64]) -> Vec<String> {
        let Ok(parts) = self.parts.lock() else { return Vec::new() };
        let heard_ns = heard_ns.iter().map(|heard_ns| heard_ns.load(Ordering::Relaxed));
        let silent = |taken: &Taken, heard_ns: u64| now_ns.saturating_sub(taken.since_ns.max(heard_ns)) > silent_ns;
        let lost =
            parts.iter().zip(heard_ns).filter(|((_, taken), at_ns)| taken.is_some_and(|taken| silent(&taken, *at_ns)));
        lost.map(|((name, _), _)| name.clone()).collect()
    }
}

/// The part that a host was given.
pub struct Part {
    /// Its name, and that of the host which launched.
    pub host: String,
    /// See `host`.
    pub hub: String,
    /// The run's key in messages.
    pub run: String,
    text: String,
    layouts: BTreeMap<String, String>,
    files: Vec<(String, String, Vec<u8>)>,
}

impl Part {
    /// The part in an answer.
    ///
    /// # Errors
    /// [`JoinError`].
    pub fn decode(bytes: &[u8]) -> Result<Self, JoinError> {
        let parse = || {
            let (length, rest) = bytes.split_first_chunk()?;
            let (head, mut rest) = rest.split_at_checked(usize::try_from(u64::from_le_bytes(*length)).ok()?)?;
            let answer: Answer = serde_json::from_slice(head).ok()?;
            let mut files = Vec::new();
            for (key, name, length) in &answer.files {
                let (content, left) = rest.split_at_checked(*length)?;
                files.push((key.clone(), name.clone(), content.to_vec()));
                rest = left;
            }
            rest.is_empty().then_some((answer, files))
        };
        let (answer, files) = parse().ok_or(JoinError::NoAnswer)?;
        let ours = env!("CARGO_PKG_VERSION");
        if answer.version != ours {
            return Err(JoinError::Version { theirs: answer.version, ours });
        }
        if let Some(reason) = answer.refused {
            return Err(JoinError::Refused(reason));
        }
        let Answer { host, hub, run, scenario, layouts, .. } = answer;
        Ok(Self { host, hub, run, text: scenario, layouts, files })
    }

    /// Its scenario, with the files that it names, which are kept in a directory. All layouts must be those of this program.
    ///
    /// # Errors
    /// [`JoinError::Layout`], [`JoinError::Config`], [`JoinError::Write`].
    pub fn scenario(&self, directory: &Path) -> Result<Scenario, JoinError> {
        let mut document = Document::parse(&self.text, "the run's scenario")?;
        for (key, name, content) in &self.files {
            let plain = Path::new(name).file_name().map_or_else(|| "data".into(), ToOwned::to_owned);
            let path = directory.join(plain);
            let write = crate::seat::write_whole(&path, content);
            write.map_err(|source| JoinError::Write { path: path.clone(), source })?;
            document.set(&format!("{key}={}", toml::Value::String(path.display().to_string())))?;
        }
        let scenario = Scenario::resolve(document)?;
        let ours = layouts(&scenario);
        let all = ours.keys().chain(self.layouts.keys());
        let differs = |service: &&String| ours.get(*service) != self.layouts.get(*service);
        if let Some(service) = all.into_iter().find(differs) {
            let of = |layouts: &BTreeMap<String, String>| layouts.get(service).cloned().unwrap_or_default();
            return Err(JoinError::Layout { service: service.clone(), theirs: of(&self.layouts), ours: of(&ours) });
        }
        Ok(scenario)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SHIPPED;

    fn parts(more: &str) -> Parts {
        let hosts = "[[host]]\nname = \"a\"\nroles = [\"leader\", \"follower\"]\n[[host]]\nname = \"b\"\nroles = [\"observer\", \"controller\"]\n";
        let text = format!("{}{hosts}{more}", SHIPPED[0].1);
        let scenario = Scenario::parse(&text, "x.toml", &["actuation_delay_ticks=2".to_owned()]).unwrap();
        Parts::new(&scenario, scenario.to_file(), "run", "a")
    }

    fn heard() -> Vec<AtomicU64> {
        (0..2).map(|_| AtomicU64::new(0)).collect()
    }

    fn ask(parts: &Parts, host: Option<&str>, token: u64, now_ns: u64, begun: bool) -> Result<String, String> {
        let answer = parts.answer(&Request::new(host, token).encode(), now_ns, begun, &heard());
        Part::decode(&answer).map(|part| part.host).map_err(|error| error.to_string())
    }

    #[test]
    fn a_part_is_given_once() {
        let parts = parts("");
        assert_eq!(ask(&parts, Some("b"), 1, 0, false), Ok("b".to_owned()));
        assert_eq!(ask(&parts, None, 1, 0, false), Ok("b".to_owned()), "again to the same");
        assert!(ask(&parts, None, 2, 0, false).unwrap_err().contains("b has joined already"));
        assert!(
            ask(&parts, Some("a"), 2, 0, false).unwrap_err().contains("no host `a` joins this run; it waits for: b")
        );
        assert!(ask(&parts, Some("b"), 2, GONE_NS + 1, true).is_err(), "ticks run");
        assert_eq!(ask(&parts, Some("b"), 2, GONE_NS + 1, false), Ok("b".to_owned()), "it was left");
    }

    #[test]
    fn a_host_that_joined_and_is_not_heard_is_lost() {
        let (parts, heard_ns) = (parts(""), heard());
        assert!(parts.lost(1_000, 100, &heard_ns).is_empty(), "no host has joined");
        ask(&parts, Some("b"), 1, 1_000, false).unwrap();
        assert!(parts.lost(1_100, 100, &heard_ns).is_empty());
        assert_eq!(parts.lost(1_101, 100, &heard_ns), ["b"]);
        heard_ns[1].store(1_050, Ordering::Relaxed);
        assert!(parts.lost(1_101, 100, &heard_ns).is_empty(), "it was heard");
        assert_eq!(parts.lost(1_151, 100, &heard_ns), ["b"]);
        ask(&parts, Some("b"), 2, 1_151 + GONE_NS, false).unwrap();
        assert!(parts.lost(1_152 + GONE_NS, 100, &heard_ns).is_empty(), "another process has its part");
    }

    #[test]
    fn another_program_is_refused_by_name() {
        let parts = parts("");
        let other = Request { version: "0.0.1".to_owned(), ..Request::new(None, 1) };
        let answer = parts.answer(&other.encode(), 0, false, &heard());
        let head = String::from_utf8(answer[8..].to_vec()).unwrap().replace(env!("CARGO_PKG_VERSION"), "9.9.9");
        let told = [&answer[..8], head.as_bytes()].concat();
        assert!(matches!(Part::decode(&told), Err(JoinError::Version { theirs, .. }) if theirs == "9.9.9"));
        assert!(matches!(Part::decode(b"HTTP/1.1 400 Bad Request"), Err(JoinError::NoAnswer)));
        assert!(parts.answer(b"x", 0, false, &heard()).len() < 400, "a stranger is told nothing of the run");
        let directory = tempfile::tempdir().unwrap();
        let answer = parts.answer(&Request::new(None, 1).encode(), 0, false, &heard());
        let mut part = Part::decode(&answer).unwrap();
        assert_eq!(part.scenario(directory.path()).unwrap().hosts.hosts.len(), 2);
        part.layouts.values_mut().next().unwrap().push('x');
        let error = part.scenario(directory.path()).unwrap_err().to_string();
        assert!(
            error.starts_with("corotate/rigid-pair/follower/command is `") && error.contains("same rigs"),
            "{error}"
        );
    }
}

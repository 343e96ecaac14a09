//! Admission of hosts to a run: request, answer, and the check that both programs are the same.
//!
//! Must not open a connection: bytes in, bytes out.

use crate::config::{ConfigError, Document};
use crate::runtime::{RoleId, ports};
use crate::scenario::Scenario;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

/// Silence after which a joined host counts as gone, ns: before the ticks run, another process may then join as that host.
pub(super) const GONE_NS: u64 = 3_000_000_000;

/// A request to join a run.
#[derive(Debug, Serialize, Deserialize)]
pub struct JoinRequest {
    /// Version of the host's program.
    version: String,
    /// Name of the host; `None` takes any free one.
    host: Option<String>,
    /// Identifies the process if it repeats the request.
    token: u64,
}

impl JoinRequest {
    /// Creates the request of a host, or of any free one.
    pub fn new(host: Option<&str>, token: u64) -> Self {
        Self { version: env!("CARGO_PKG_VERSION").to_owned(), host: host.map(str::to_owned), token }
    }

    /// Returns the bytes.
    pub fn encode(&self) -> Vec<u8> {
        serde_json::to_vec(self).expect("plain values are JSON")
    }
}

/// The answer to a [`JoinRequest`].
#[derive(Debug, Serialize, Deserialize)]
struct JoinAnswer {
    version: String,
    /// Reason to refuse the request.
    refused: Option<String>,
    host: String,
    hub: String,
    run: String,
    scenario: String,
    layouts: BTreeMap<String, String>,
    /// Files that the scenario names: key, name, and length of the content that follows the answer.
    files: Vec<(String, String, usize)>,
}

/// Reasons why a host cannot join.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum JoinError {
    /// The launching host refuses it.
    #[error("{0}")]
    #[strum(serialize = "join-refused")]
    Refused(String),
    /// The versions differ.
    #[error("version {ours} cannot join a run of version {theirs}; install the same version on all hosts")]
    #[strum(serialize = "other-version")]
    Version {
        /// Version of the launching host.
        theirs: String,
        /// Version of this program.
        ours: &'static str,
    },
    /// The layouts of a sample differ.
    #[error(
        "the layout of {service} is `{theirs}` on the launching host and `{ours}` here; install the same program, with the same rigs, on \
         all hosts"
    )]
    #[strum(serialize = "other-layout")]
    Layout {
        /// The signal.
        service: String,
        /// Type, size and fields on the launching host.
        theirs: String,
        /// Type, size and fields here.
        ours: String,
    },
    /// The answer is malformed.
    #[error(
        "the answer to the request to join is malformed; check that `corotate run --listen` listens at this address"
    )]
    NoAnswer,
    /// This program refuses the scenario.
    #[error(transparent)]
    #[strum(serialize = "refused-scenario")]
    Config(#[from] ConfigError),
    /// A file that the scenario names cannot be written.
    #[error("cannot write {}: {source}; {}", path.display(), crate::system::remedy(source))]
    #[strum(serialize = "cannot-write")]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
}

/// Returns the layouts of all samples of a scenario, by signal.
fn layouts(scenario: &Scenario) -> BTreeMap<String, String> {
    let layouts = |role: RoleId| {
        ports(scenario, role).writes.into_iter().map(|port| {
            let fields: Vec<String> =
                port.fields.iter().map(|field| format!("{}@{}x{}", field.name, field.offset, field.count)).collect();
            (port.topic.to_string(), format!("{} {} {}", port.layout, port.size, fields.join(" ")))
        })
    };
    RoleId::all(scenario).into_iter().flat_map(layouts).collect()
}

/// The hosts of a run with the processes that joined as them, on the launching host.
pub struct HostTable {
    scenario: String,
    run: String,
    hub: String,
    layouts: BTreeMap<String, String>,
    files: Vec<(String, String, Vec<u8>)>,
    /// By the host's number: its name, and the process that joined as it.
    claims: Mutex<Vec<(String, Option<Claim>)>>,
}

/// The token of a process that joined, and the time of its last request, ns.
#[derive(Clone, Copy)]
struct Claim {
    token: u64,
    since_ns: u64,
}

impl HostTable {
    /// Creates the table of a run; `text` is its scenario file.
    pub fn new(scenario: &Scenario, text: String, run: &str, hub: &str) -> Self {
        let read = |(key, path): &(String, PathBuf)| {
            let name = path.file_name()?.to_string_lossy().into_owned();
            // A file that ships with the program exists on the other host too.
            Some((key.clone(), name, std::fs::read(path).ok()?))
        };
        Self {
            scenario: text,
            run: run.to_owned(),
            hub: hub.to_owned(),
            layouts: layouts(scenario),
            files: scenario.files.iter().filter_map(read).collect(),
            claims: Mutex::new(scenario.hosts.hosts.iter().map(|host| (host.name.clone(), None)).collect()),
        }
    }

    /// Answers a request. `running` is true once ticks run; `last_message_ns` has the time of each host's last message, ns.
    pub fn answer(&self, request: &[u8], now_ns: u64, running: bool, last_message_ns: &[AtomicU64]) -> Vec<u8> {
        let granted = match serde_json::from_slice::<JoinRequest>(request) {
            Ok(request) => self.grant(&request, now_ns, running, last_message_ns),
            Err(_) => Err("the request to join is malformed; install the same version on all hosts".to_owned()),
        };
        let refused = granted.as_ref().err().cloned();
        let is_granted = refused.is_none();
        let files: &[_] = if is_granted { &self.files } else { &[] };
        let answer = JoinAnswer {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            refused,
            host: granted.unwrap_or_default(),
            hub: self.hub.clone(),
            run: if is_granted { self.run.clone() } else { String::new() },
            scenario: if is_granted { self.scenario.clone() } else { String::new() },
            layouts: if is_granted { self.layouts.clone() } else { BTreeMap::new() },
            files: files.iter().map(|(key, name, bytes)| (key.clone(), name.clone(), bytes.len())).collect(),
        };
        let head = serde_json::to_vec(&answer).expect("plain values are JSON");
        let mut bytes = (head.len() as u64).to_le_bytes().to_vec();
        bytes.extend(head);
        files.iter().for_each(|(_, _, content)| bytes.extend(content));
        bytes
    }

    /// Returns the name of the granted host, or the reason to refuse the request.
    fn grant(
        &self,
        request: &JoinRequest,
        now_ns: u64,
        running: bool,
        last_message_ns: &[AtomicU64],
    ) -> Result<String, String> {
        if request.version != env!("CARGO_PKG_VERSION") {
            // The answer contains this program's version, which is reason enough.
            return Err(String::new());
        }
        let mut claims = self.claims.lock().map_err(|_| "the launching host failed; start the run again")?;
        let names: Vec<&str> = claims.iter().map(|(name, _)| &**name).filter(|name| *name != self.hub).collect();
        let known = names.join(", ");
        if request.host.as_ref().is_some_and(|host| !names.contains(&host.as_str())) {
            let host = request.host.as_deref().unwrap_or_default();
            return Err(format!("this run does not wait for a host `{host}`; choose one of: {known}"));
        }
        let is_free = |index: usize, claim: &Option<Claim>| {
            let last_ns = last_message_ns.get(index).map_or(0, |last_ns| last_ns.load(Ordering::Relaxed));
            claim.is_none_or(|Claim { token, since_ns }| {
                token == request.token || (!running && now_ns.saturating_sub(since_ns.max(last_ns)) > GONE_NS)
            })
        };
        let is_wanted = |name: &str| name != self.hub && request.host.as_ref().is_none_or(|host| host == name);
        let found =
            claims.iter_mut().enumerate().find(|(index, (name, claim))| is_wanted(name) && is_free(*index, claim));
        let Some((_, (name, claim))) = found else {
            let names = request.host.as_ref().map_or(known, Clone::clone);
            return Err(format!(
                "{names} has already joined; end its `join` first, or choose another host with --host"
            ));
        };
        *claim = Some(Claim { token: request.token, since_ns: now_ns });
        Ok(name.clone())
    }

    /// Returns the hosts that joined and then sent nothing for `silent_ns`. Only meaningful before ticks run.
    pub fn lost(&self, now_ns: u64, silent_ns: u64, last_message_ns: &[AtomicU64]) -> Vec<String> {
        let Ok(claims) = self.claims.lock() else { return Vec::new() };
        let last_ns = last_message_ns.iter().map(|last_ns| last_ns.load(Ordering::Relaxed));
        let is_silent = |claim: &Claim, last_ns: u64| now_ns.saturating_sub(claim.since_ns.max(last_ns)) > silent_ns;
        let lost = claims
            .iter()
            .zip(last_ns)
            .filter(|((_, claim), last_ns)| claim.is_some_and(|claim| is_silent(&claim, *last_ns)));
        lost.map(|((name, _), _)| name.clone()).collect()
    }
}

/// The admission of a host to a run.
pub struct Admission {
    /// Name of the host.
    pub host: String,
    /// Name of the launching host.
    pub hub: String,
    /// Key of the run in messages.
    pub run: String,
    text: String,
    layouts: BTreeMap<String, String>,
    files: Vec<(String, String, Vec<u8>)>,
}

impl Admission {
    /// Decodes the answer to a request.
    ///
    /// # Errors
    /// [`JoinError`].
    pub fn decode(bytes: &[u8]) -> Result<Self, JoinError> {
        let parse = || {
            let (length, rest) = bytes.split_first_chunk()?;
            let (head, mut rest) = rest.split_at_checked(usize::try_from(u64::from_le_bytes(*length)).ok()?)?;
            let answer: JoinAnswer = serde_json::from_slice(head).ok()?;
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
        let JoinAnswer { host, hub, run, scenario, layouts, .. } = answer;
        Ok(Self { host, hub, run, text: scenario, layouts, files })
    }

    /// Returns the scenario, and writes the files that it names to `directory`. All layouts must be those of this program.
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
            let layout = |layouts: &BTreeMap<String, String>| layouts.get(service).cloned().unwrap_or_default();
            return Err(JoinError::Layout {
                service: service.clone(),
                theirs: layout(&self.layouts),
                ours: layout(&ours),
            });
        }
        Ok(scenario)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SHIPPED;

    fn table(more: &str) -> HostTable {
        let hosts = "[[host]]\nname = \"a\"\nroles = [\"leader\", \"follower\"]\n[[host]]\nname = \"b\"\nroles = [\"observer\", \"controller\"]\n";
        let text = format!("{}{hosts}{more}", SHIPPED[0].1);
        let scenario = Scenario::parse(&text, "x.toml", &["actuation_delay_ticks=2".to_owned()]).unwrap();
        HostTable::new(&scenario, scenario.to_file(), "run", "a")
    }

    fn no_messages() -> Vec<AtomicU64> {
        (0..2).map(|_| AtomicU64::new(0)).collect()
    }

    fn ask(table: &HostTable, host: Option<&str>, token: u64, now_ns: u64, running: bool) -> Result<String, String> {
        let answer = table.answer(&JoinRequest::new(host, token).encode(), now_ns, running, &no_messages());
        Admission::decode(&answer).map(|admission| admission.host).map_err(|error| error.to_string())
    }

    #[test]
    fn a_second_process_cannot_join_as_the_same_host_unless_the_first_is_gone() {
        let table = table("");
        assert_eq!(ask(&table, Some("b"), 1, 0, false), Ok("b".to_owned()));
        assert_eq!(ask(&table, None, 1, 0, false), Ok("b".to_owned()), "repeated request");
        assert!(ask(&table, None, 2, 0, false).unwrap_err().contains("b has already joined"));
        assert!(ask(&table, Some("a"), 2, 0, false).unwrap_err().contains("choose one of: b"));
        assert!(ask(&table, Some("b"), 2, GONE_NS + 1, true).is_err(), "ticks run");
        assert_eq!(ask(&table, Some("b"), 2, GONE_NS + 1, false), Ok("b".to_owned()), "the first process is gone");
    }

    #[test]
    fn a_host_that_joined_and_fell_silent_is_lost() {
        let (table, last_ns) = (table(""), no_messages());
        assert!(table.lost(1_000, 100, &last_ns).is_empty(), "no host has joined");
        ask(&table, Some("b"), 1, 1_000, false).unwrap();
        assert!(table.lost(1_100, 100, &last_ns).is_empty());
        assert_eq!(table.lost(1_101, 100, &last_ns), ["b"]);
        last_ns[1].store(1_050, Ordering::Relaxed);
        assert!(table.lost(1_101, 100, &last_ns).is_empty(), "a message arrived");
        assert_eq!(table.lost(1_151, 100, &last_ns), ["b"]);
        ask(&table, Some("b"), 2, 1_151 + GONE_NS, false).unwrap();
        assert!(table.lost(1_152 + GONE_NS, 100, &last_ns).is_empty(), "another process joined as this host");
    }

    #[test]
    fn a_host_with_another_version_or_layout_is_refused() {
        let table = table("");
        let outdated = JoinRequest { version: "0.0.1".to_owned(), ..JoinRequest::new(None, 1) };
        let answer = table.answer(&outdated.encode(), 0, false, &no_messages());
        let head = String::from_utf8(answer[8..].to_vec()).unwrap().replace(env!("CARGO_PKG_VERSION"), "9.9.9");
        let answer = [&answer[..8], head.as_bytes()].concat();
        assert!(matches!(Admission::decode(&answer), Err(JoinError::Version { theirs, .. }) if theirs == "9.9.9"));
        assert!(matches!(Admission::decode(b"HTTP/1.1 400 Bad Request"), Err(JoinError::NoAnswer)));
        assert!(table.answer(b"x", 0, false, &no_messages()).len() < 400, "a refusal contains nothing of the run");
        let directory = tempfile::tempdir().unwrap();
        let answer = table.answer(&JoinRequest::new(None, 1).encode(), 0, false, &no_messages());
        let mut admission = Admission::decode(&answer).unwrap();
        assert_eq!(admission.scenario(directory.path()).unwrap().hosts.hosts.len(), 2);
        admission.layouts.values_mut().next().unwrap().push('x');
        let error = admission.scenario(directory.path()).err();
        assert!(
            matches!(&error, Some(JoinError::Layout { service, .. }) if service == "corotate/rigid-pair/follower/command"),
            "{error:?}"
        );
    }
}

//! The hosts of a run: the roles of each, and the delay budgets of the links between them.
//!
//! Must not know the transport between hosts.

use super::body::{BodyInfo, role_names};
use super::checks::Checks;
use serde::{Deserialize, Serialize};

/// The longest budget, ticks: no command is in flight for longer.
const BUDGET_MAX: u64 = crate::control::ACTUATION_DELAY_MAX;

/// A host of a run, with its roles.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Host {
    /// The host's name in this scenario.
    pub name: String,
    /// The roles that run there.
    pub roles: Vec<String>,
}

/// The network between the hosts of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Network {
    /// The delay budget from one host to another, ticks, for links without a budget of their own.
    pub budget_ticks: u64,
    /// The common time of the hosts.
    pub clock_source: ClockSource,
    /// The silence after which a host counts as lost, s.
    pub silence_timeout_s: f64,
    /// The links with a budget of their own.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub link: Vec<LinkBudget>,
}

/// The delay budget of the link from one host to another.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LinkBudget {
    /// The host that sends.
    pub from: String,
    /// The host that receives.
    pub to: String,
    /// The delay budget, ticks.
    pub budget_ticks: u64,
}

/// The source of the common time of the hosts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ClockSource {
    /// Offset and drift of each host's monotonic clock are estimated over the network.
    Estimated,
    /// CLOCK_TAI, which the machines synchronise, for example by PTP; the network only verifies it.
    System,
}

impl Default for Network {
    fn default() -> Self {
        Self { budget_ticks: 1, clock_source: ClockSource::Estimated, silence_timeout_s: 5.0, link: Vec::new() }
    }
}

impl Network {
    pub(crate) fn is_default(&self) -> bool {
        *self == Self::default()
    }
}

/// The hosts of a scenario, and the loop that crosses them.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Hosts {
    /// The hosts in the order of the file; empty if there is only one.
    pub hosts: Vec<Host>,
    /// The network between the hosts.
    pub network: Network,
}

impl Hosts {
    /// Returns the name of the host that runs a role; `None` if there is only one host.
    pub fn host_of(&self, role: &str) -> Option<&str> {
        let has = |host: &&Host| host.roles.iter().any(|name| name == role);
        self.hosts.iter().find(has).map(|host| &*host.name)
    }

    /// Returns the delay budget from one role to another, ticks.
    fn role_budget(&self, from: &str, to: &str) -> u64 {
        match (self.host_of(from), self.host_of(to)) {
            (Some(from), Some(to)) if from != to => self.budget(from, to),
            _ => 0,
        }
    }

    /// Returns the delay budget from one host to another, ticks.
    fn budget(&self, from: &str, to: &str) -> u64 {
        let link = self.network.link.iter().find(|link| link.from == from && link.to == to);
        link.map_or(self.network.budget_ticks, |link| link.budget_ticks)
    }

    /// Returns the smallest budget of a link from or to a host.
    pub fn least_budget(&self, host: &str) -> u64 {
        let peers = self.hosts.iter().map(|peer| peer.name.as_str()).filter(|peer| *peer != host);
        let budgets = peers.flat_map(|peer| [self.budget(host, peer), self.budget(peer, host)]);
        budgets.min().unwrap_or(self.network.budget_ticks)
    }

    /// Returns the observer of a body, and the delay budget from the body to it, ticks; `None` without observer.
    fn estimated<'a>(&self, body: &'a BodyInfo) -> Option<(&'a str, u64)> {
        let observer = body.observer.as_deref()?;
        Some((observer, self.role_budget(&body.name, observer)))
    }

    /// Returns the ticks after its own tick during which a role may still wait for inputs: the sum of the budgets from the
    /// measurements to it, 0 if no input crosses hosts.
    pub fn lag_ticks(&self, role: &str, bodies: &[BodyInfo]) -> u64 {
        if role != "controller" {
            let observer =
                bodies.iter().filter_map(|body| self.estimated(body)).find(|(observer, _)| *observer == role);
            return observer.map_or(0, |(_, ticks)| ticks);
        }
        let driven = bodies.iter().filter(|body| body.driven).map(|body| self.role_budget(&body.name, role));
        let read = bodies.iter().enumerate().filter(|(index, body)| *index == 0 || body.driven);
        let estimates = read.filter_map(|(_, body)| self.estimated(body));
        let estimates = estimates.map(|(observer, ticks)| ticks + self.role_budget(observer, role));
        driven.chain(estimates).max().unwrap_or(0)
    }
}

/// Checks that every role has one host, and that the budgets fit into the delay of the actuators.
pub(crate) fn check(hosts: &Hosts, bodies: &[BodyInfo], delay_ticks: u64, checks: &mut Checks<'_>) {
    let roles = role_names(bodies);
    let mut taken: Vec<&str> = Vec::new();
    for (index, host) in hosts.hosts.iter().enumerate() {
        let key = |part: &str| format!("host[{index}].{part}");
        for (position, role) in host.roles.iter().enumerate() {
            let key = format!("{}[{position}]", key("roles"));
            if !roles.contains(&role.as_str()) {
                checks.refuse(
                    &key,
                    "unknown-role",
                    format!("there is no role `{role}`; this scenario has: {}", roles.join(", ")),
                );
            } else if taken.contains(&role.as_str()) {
                checks.refuse(&key, "role-twice", format!("the {role} cannot be on two hosts; name it once"));
            }
            taken.push(role);
        }
    }
    let unassigned: Vec<&str> = roles.iter().copied().filter(|role| !taken.contains(role)).collect();
    checks.require(hosts.hosts.is_empty() || unassigned.is_empty(), "host", "role-without-host", || {
        format!("no host has the role {}; name every role once", unassigned.join(", "))
    });
    let lag = hosts.lag_ticks("controller", bodies);
    for BodyInfo { name: body, .. } in bodies.iter().filter(|body| body.driven) {
        let needed = lag + hosts.role_budget("controller", body);
        checks.require(needed <= delay_ticks, "actuation_delay_ticks", "budget-too-long", || {
            format!(
                "the budgets on the way from the measurements by the controller to {body} come to {needed} ticks, and a command \
                 acts after {delay_ticks}; give {needed} or more, or lower those of [network]"
            )
        });
    }
}

/// Runs the checks that need no rig.
pub(crate) fn check_alone(hosts: &Hosts, processes: &[Vec<String>], external: &[String], checks: &mut Checks<'_>) {
    let mut names: Vec<&str> = Vec::new();
    for (index, host) in hosts.hosts.iter().enumerate() {
        let (name, key) = (host.name.as_str(), format!("host[{index}].name"));
        let letters = name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-');
        checks.require(letters && (1..=32).contains(&name.len()), &key, "bad-name", || {
            format!("`{name}` cannot name files; use 1 to 32 of a-z, 0-9 and -")
        });
        checks.require(!names.contains(&name), &key, "taken-name", || {
            format!("there are two hosts `{name}`; name each once")
        });
        checks.require(!host.roles.is_empty(), &format!("host[{index}].roles"), "empty-list", || {
            "a host without roles is useless; give it a role, or remove it".to_owned()
        });
        names.push(name);
    }
    checks.require(hosts.hosts.is_empty() || hosts.hosts.len() <= 16, "host", "too-many", || {
        format!("{} hosts are too many; give at most 16", hosts.hosts.len())
    });
    for (index, roles) in processes.iter().enumerate() {
        let apart = roles.iter().any(|role| hosts.host_of(role) != hosts.host_of(&roles[0]));
        checks.require(!apart, &format!("launch.processes[{index}]"), "roles-apart", || {
            format!("{} are on different hosts and cannot share a process; separate them", roles.join(", "))
        });
    }
    for (index, role) in external.iter().enumerate() {
        checks.require(hosts.hosts.is_empty(), &format!("launch.external[{index}]"), "external-with-hosts", || {
            format!("a run over several hosts has no external roles; remove {role} here, or the hosts")
        });
    }
    let Network { budget_ticks, silence_timeout_s, link: links, .. } = &hosts.network;
    let budgets = links
        .iter()
        .enumerate()
        .map(|(index, link)| (format!("network.link[{index}].budget_ticks"), link.budget_ticks));
    for (key, ticks) in budgets.chain([("network.budget_ticks".to_owned(), *budget_ticks)]) {
        checks.require((1..=BUDGET_MAX).contains(&ticks), &key, "out-of-range", || {
            format!("a budget of {ticks} ticks is out of range; give 1 to {BUDGET_MAX}")
        });
    }
    for (index, LinkBudget { from, to, .. }) in links.iter().enumerate() {
        for (part, name) in [("from", from), ("to", to)] {
            checks.require(
                names.contains(&name.as_str()),
                &format!("network.link[{index}].{part}"),
                "unknown-host",
                || format!("there is no host `{name}`; this scenario has: {}", names.join(", ")),
            );
        }
        let again = links[..index].iter().any(|link| (&link.from, &link.to) == (from, to));
        checks.require(from != to && !again, &format!("network.link[{index}].to"), "no-such-link", || {
            format!("{from} to {to} is not a link between two hosts, or has a budget already; name each direction once")
        });
    }
    checks.require((0.1..=3600.0).contains(silence_timeout_s), "network.silence_timeout_s", "out-of-range", || {
        format!("{silence_timeout_s} s is out of range (heartbeats come every 0.02 s); give 0.1 to 3600")
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SHIPPED;
    use crate::scenario::Scenario;

    fn bodies(observers: [Option<&str>; 2]) -> [BodyInfo; 2] {
        let [leader, follower] = observers.map(|observer| observer.map(str::to_owned));
        let leader = BodyInfo { observer: leader, ..BodyInfo::free("leader") };
        [leader, BodyInfo { observer: follower, ..BodyInfo::driven("follower") }]
    }

    fn hosts(hosts: &[(&str, &[&str])]) -> Hosts {
        let host = |(name, roles): &(&str, &[&str])| Host {
            name: (*name).to_owned(),
            roles: roles.iter().map(|role| (*role).to_owned()).collect(),
        };
        Hosts { hosts: hosts.iter().map(host).collect(), network: Network { budget_ticks: 3, ..Network::default() } }
    }

    #[test]
    fn budgets_add_up_on_the_way_to_a_role() {
        let lag = |hosts: &Hosts, role: &str| hosts.lag_ticks(role, &bodies([Some("observer"), None]));
        let bench = hosts(&[("bench", &["leader", "follower"]), ("flight", &["observer", "controller"])]);
        assert_eq!([lag(&bench, "observer"), lag(&bench, "controller"), lag(&bench, "follower")], [3, 3, 0]);
        let three = hosts(&[("a", &["leader", "follower"]), ("b", &["observer"]), ("c", &["controller"])]);
        assert_eq!([lag(&three, "observer"), lag(&three, "controller")], [3, 6]);
        let formation = hosts(&[("one", &["leader", "observer", "controller"]), ("two", &["follower"])]);
        assert_eq!([lag(&formation, "observer"), lag(&formation, "controller")], [0, 3]);
        assert_eq!(lag(&Hosts::default(), "controller"), 0, "one computer");
        let both = bodies([Some("observer"), Some("observer-follower")]);
        let apart = hosts(&[("a", &["leader", "follower", "observer", "controller"]), ("b", &["observer-follower"])]);
        assert_eq!([apart.lag_ticks("observer-follower", &both), apart.lag_ticks("controller", &both)], [3, 6]);
        assert_eq!(apart.lag_ticks("observer", &both), 0);
        let link = |from: &str, to: &str, budget_ticks| LinkBudget { from: from.into(), to: to.into(), budget_ticks };
        let network = Network { link: vec![link("a", "b", 1), link("c", "a", 9)], ..three.network.clone() };
        let three = Hosts { network, ..three };
        assert_eq!(
            [lag(&three, "observer"), lag(&three, "controller"), three.role_budget("controller", "follower")],
            [1, 4, 9]
        );
        assert_eq!(["a", "b", "c"].map(|host| three.least_budget(host)), [1, 1, 3]);
    }

    fn refusals(text: &str) -> String {
        let text = format!("{}\n{text}", SHIPPED[0].1);
        Scenario::parse(&text, "x.toml", &[]).err().map_or(String::new(), |error| error.to_string())
    }

    #[test]
    fn an_invalid_host_table_is_refused_with_a_remedy() {
        let bench = "[[host]]\nname = \"bench\"\nroles = [\"leader\", \"follower\"]\n";
        let refused = refusals(bench);
        assert!(refused.contains("host: no host has the role observer, controller; name every role once"), "{refused}");
        let flight = "[[host]]\nname = \"flight\"\nroles = [\"observer\", \"controller\"]\n";
        let refused = refusals(&format!("{bench}{flight}"));
        assert!(refused.contains("come to 2 ticks, and a command acts after 1; give 2 or more"), "{refused}");
        for (text, expected) in [
            ("[[host]]\nname = \"A b\"\nroles = []\n", "cannot name files"),
            ("[[host]]\nname = \"a\"\nroles = []\n", "without roles"),
            ("[[host]]\nname = \"a\"\nroles = [\"pilot\"]\n", "there is no role `pilot`"),
            ("[[host]]\nname = \"a\"\nroles = [\"leader\", \"leader\"]\n", "cannot be on two hosts"),
            ("[network]\nbudget_ticks = 0\n", "a budget of 0 ticks"),
            ("[network]\nsilence_timeout_s = 0.0\n", "give 0.1 to 3600"),
            ("[[network.link]]\nfrom = \"a\"\nto = \"b\"\nbudget_ticks = 1\n", "there is no host `a`"),
            ("[[network.link]]\nfrom = \"a\"\nto = \"a\"\nbudget_ticks = 65\n", "a budget of 65 ticks"),
            ("[[network.link]]\nfrom = \"a\"\nto = \"a\"\nbudget_ticks = 1\n", "is not a link"),
            ("[network]\nclock_source = \"sundial\"\n", "sundial"),
        ] {
            let refused = refusals(text);
            assert!(refused.contains(expected) && refused.contains("x.toml:"), "{refused}");
        }
    }

    #[test]
    fn the_resolved_file_has_the_hosts() {
        let text = SHIPPED[0].1.replacen("tick_hz", "actuation_delay_ticks = 2\ntick_hz", 1)
            + "[[host]]\nname = \"a\"\nroles = [\"leader\", \"follower\"]\n[[host]]\nname = \"b\"\nroles = [\"observer\", \"controller\"]\n";
        let scenario = Scenario::parse(&text, "x.toml", &[]).unwrap();
        let again = Scenario::parse(&scenario.to_toml(), "y.toml", &[]).unwrap();
        assert_eq!(again.hosts, scenario.hosts);
        assert_eq!((again.hosts.host_of("observer"), again.hosts.hosts.len()), (Some("b"), 2));
    }
}

//! The routes of signals between hosts, computed from the scenario alone, so that all hosts compute the same.

use crate::bus::Port;
use crate::config::ClockKind;
use crate::runtime::{RoleId, ports};
use crate::scenario::Scenario;

/// A signal with its route.
pub struct Link {
    /// The signal.
    pub port: Port,
    /// Number of the host that writes it.
    pub from: u8,
    /// The other hosts that receive it.
    pub to: Vec<Destination>,
}

/// A host that receives a signal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Destination {
    /// Number of the host.
    pub host: u8,
    /// True if every sample must arrive: in lockstep, and where no role waits for the signal.
    pub lossless: bool,
}

/// The hosts, roles and links of a run.
pub struct Plan {
    /// Names of the hosts, in the order of the scenario; the index is the host's number.
    pub hosts: Vec<String>,
    /// Number of this host.
    pub own: u8,
    /// Number of the launching host, which receives all signals.
    pub hub: u8,
    /// All signals, in the order of the roles; the index is the link's number.
    pub links: Vec<Link>,
    /// All roles with their hosts, in the order of a tick; the index is the role's number.
    pub roles: Vec<(RoleId, u8)>,
}

impl Plan {
    /// Creates the plan of host `own` in a run that host `hub` launches. `None` if the scenario lacks one of them, or if a role has no
    /// host.
    pub fn new(scenario: &Scenario, own: &str, hub: &str) -> Option<Self> {
        let hosts: Vec<String> = scenario.hosts.hosts.iter().map(|host| host.name.clone()).collect();
        let number = |name: &str| hosts.iter().position(|host| host == name).map(|index| index as u8);
        let (own, hub) = (number(own)?, number(hub)?);
        let host_of = |role: RoleId| number(scenario.hosts.host_of(role.name(scenario))?);
        let roles: Vec<(RoleId, u8)> =
            RoleId::all(scenario).into_iter().map(|role| Some((role, host_of(role)?))).collect::<Option<_>>()?;
        let mut links = Vec::new();
        for (role, from) in &roles {
            for port in ports(scenario, *role).writes {
                let reads = |role: RoleId| ports(scenario, role).reads.iter().any(|read| read.topic == port.topic);
                let readers: Vec<u8> = roles.iter().filter(|(role, _)| reads(*role)).map(|(_, host)| *host).collect();
                let receives = |host: &u8| host != from && (*host == hub || readers.contains(host));
                let lossless = |host: u8| scenario.clock != ClockKind::Realtime || !readers.contains(&host);
                let to =
                    (0..hosts.len() as u8).filter(receives).map(|host| Destination { host, lossless: lossless(host) });
                links.push(Link { to: to.collect(), port, from: *from });
            }
        }
        Some(Self { hosts, own, hub, links, roles })
    }

    /// Returns the name of a host.
    pub fn name(&self, host: u8) -> &str {
        &self.hosts[usize::from(host)]
    }

    /// Returns the numbers of all other hosts.
    pub fn peers(&self) -> impl Iterator<Item = u8> + '_ {
        (0..self.hosts.len() as u8).filter(|host| *host != self.own)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SHIPPED;

    fn scenario(clock: &str) -> Scenario {
        let text = SHIPPED[0].1.to_owned()
            + "[[host]]\nname = \"bench\"\nroles = [\"leader\", \"follower\"]\n[[host]]\nname = \"flight\"\nroles = [\"observer\", \"controller\"]\n";
        let overrides = [format!("clock={clock}"), "actuation_delay_ticks=2".to_owned()];
        Scenario::parse(&text, "x.toml", &overrides).unwrap()
    }

    /// Signal, writing host, and receiving hosts, each with true if the link is lossless.
    type Route = (String, u8, Vec<(u8, bool)>);

    fn routes(plan: &Plan) -> Vec<Route> {
        let route = |link: &Link| {
            let topic = format!("{}/{}", link.port.topic.body, link.port.topic.signal.name());
            (topic, link.from, link.to.iter().map(|destination| (destination.host, destination.lossless)).collect())
        };
        plan.links.iter().map(route).collect()
    }

    #[test]
    fn signals_go_to_the_hosts_that_read_them_and_all_to_the_launching_host() {
        let realtime = scenario("realtime");
        let topic = |name: &str| name.to_owned();
        let hub_has_plants = Plan::new(&realtime, "flight", "bench").unwrap();
        assert_eq!((hub_has_plants.own, hub_has_plants.hub), (1, 0));
        assert_eq!(
            routes(&hub_has_plants),
            [
                (topic("leader/measurement"), 0, vec![(1, false)]),
                (topic("leader/truth"), 0, vec![]),
                (topic("follower/measurement"), 0, vec![(1, false)]),
                (topic("follower/truth"), 0, vec![]),
                (topic("leader/estimate"), 1, vec![(0, true)]),
                (topic("follower/command"), 1, vec![(0, false)]),
            ]
        );
        let hub_has_controller = Plan::new(&realtime, "flight", "flight").unwrap();
        assert_eq!(routes(&hub_has_controller)[1], (topic("leader/truth"), 0, vec![(1, true)]));
        assert_eq!(routes(&hub_has_controller)[4], (topic("leader/estimate"), 1, vec![]));
        let lockstep = scenario("lockstep");
        assert!(
            Plan::new(&lockstep, "bench", "flight")
                .unwrap()
                .links
                .iter()
                .all(|link| link.to.iter().all(|destination| destination.lossless))
        );
        assert!(Plan::new(&lockstep, "moon", "flight").is_none());
    }
}

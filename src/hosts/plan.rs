//! Which signal goes from which host to which, found out from the scenario alone, so that all hosts find the same.

use crate::bus::Port;
use crate::config::ClockKind;
use crate::runtime::{RoleId, ports};
use crate::scenario::Scenario;

/// A signal that is written on some host.
pub struct Link {
    /// The signal.
    pub port: Port,
    /// The number of the host where it is written.
    pub from: u8,
    /// The hosts that it goes to.
    pub to: Vec<Way>,
}

/// One way of a signal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Way {
    /// The number of the host.
    pub host: u8,
    /// Whether nothing of it is lost: where everybody waits for inputs, and where nobody in the loop does.
    pub lossless: bool,
}

/// What crosses hosts in a run.
pub struct Plan {
    /// The hosts' names, in the order of the scenario: their place is their number.
    pub hosts: Vec<String>,
    /// This host.
    pub own: u8,
    /// The one that launched the run: it gets everything.
    pub hub: u8,
    /// All signals, in the order of the roles: their place is their number.
    pub links: Vec<Link>,
    /// All roles with their hosts, in the order of a tick: their place is their number.
    pub roles: Vec<(RoleId, u8)>,
}

impl Plan {
    /// That of a scenario, for a host, in a run that another or the same one launched; none if there is no such host.
    pub fn new(scenario: &Scenario, own: &str, hub: &str) -> Option<Self> {
        let hosts: Vec<String> = scenario.hosts.hosts.iter().map(|host| host.name.clone()).collect();
        let number = |name: &str| hosts.iter().position(|host| host == name).map(|place| place as u8);
        let (own, hub) = (number(own)?, number(hub)?);
        let host_of = |role: RoleId| number(scenario.hosts.host_of(role.name(scenario))?);
        let roles: Vec<(RoleId, u8)> =
            RoleId::all(scenario).into_iter().map(|role| Some((role, host_of(role)?))).collect::<Option<_>>()?;
        let mut links = Vec::new();
        for (role, from) in &roles {
            for port in ports(scenario, *role).writes {
                let reads = |role: RoleId| ports(scenario, role).reads.iter().any(|read| read.topic == port.topic);
                let readers: Vec<u8> = roles.iter().filter(|(role, _)| reads(*role)).map(|(_, host)| *host).collect();
                let goes = |host: &u8| host != from && (*host == hub || readers.contains(host));
                let lossless = |host: u8| scenario.clock != ClockKind::Realtime || !readers.contains(&host);
                let to = (0..hosts.len() as u8).filter(goes).map(|host| Way { host, lossless: lossless(host) });
                links.push(Link { to: to.collect(), port, from: *from });
            }
        }
        Some(Self { hosts, own, hub, links, roles })
    }

    /// The name of a host.
    pub fn name(&self, host: u8) -> &str {
        &self.hosts[usize::from(host)]
    }

    /// The hosts that this one talks to: the hub to all, any other to those that something goes to or comes from, and to the hub.
    pub fn others(&self) -> impl Iterator<Item = u8> + '_ {
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

    /// Signal, host where it is written, hosts that it goes to, and whether without loss.
    type Told = (String, u8, Vec<(u8, bool)>);

    fn ways(plan: &Plan) -> Vec<Told> {
        let of = |link: &Link| {
            let topic = format!("{}/{}", link.port.topic.body, link.port.topic.signal.name());
            (topic, link.from, link.to.iter().map(|way| (way.host, way.lossless)).collect())
        };
        plan.links.iter().map(of).collect()
    }

    #[test]
    fn what_crosses_is_what_somebody_there_reads_and_all_to_the_hub() {
        let realtime = scenario("realtime");
        let of = |name: &str| name.to_owned();
        let hub_has_plants = Plan::new(&realtime, "flight", "bench").unwrap();
        assert_eq!((hub_has_plants.own, hub_has_plants.hub), (1, 0));
        assert_eq!(
            ways(&hub_has_plants),
            [
                (of("leader/measurement"), 0, vec![(1, false)]),
                (of("leader/truth"), 0, vec![]),
                (of("follower/measurement"), 0, vec![(1, false)]),
                (of("follower/truth"), 0, vec![]),
                (of("leader/estimate"), 1, vec![(0, true)]),
                (of("follower/command"), 1, vec![(0, false)]),
            ]
        );
        let hub_has_the_rest = Plan::new(&realtime, "flight", "flight").unwrap();
        assert_eq!(ways(&hub_has_the_rest)[1], (of("leader/truth"), 0, vec![(1, true)]));
        assert_eq!(ways(&hub_has_the_rest)[4], (of("leader/estimate"), 1, vec![]));
        let lockstep = scenario("lockstep");
        assert!(
            Plan::new(&lockstep, "bench", "flight")
                .unwrap()
                .links
                .iter()
                .all(|link| link.to.iter().all(|way| way.lossless))
        );
        assert!(Plan::new(&lockstep, "moon", "flight").is_none());
    }
}

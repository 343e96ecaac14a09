//! The supervisor of a host that joined: its own roles, led by another host's schedule. Must not lead them itself.

use super::super::Progress;
use super::*;
use std::collections::BTreeMap;

impl<'a> Supervisor<'a> {
    /// Starts the roles of a host in a run that another one leads.
    pub fn of_host(
        scenario: &'a Scenario,
        host: &str,
        domain: &'a Domain,
        bus: &'a IoxBus,
        janitor: &'a mut Janitor,
        relay: RelayWatch,
    ) -> Result<Self, LaunchError> {
        let schedule = bus.writer(&topic(scenario, "run", Signal::Schedule), 1)?;
        let changes = ChangeSignal::open(scenario, bus)?;
        let recorder = RecorderWatch::start(None, scenario, domain, bus)?;
        let foxglove = foxglove::start(None, domain)?;
        let own = |role: &RoleId| {
            role.process_role(scenario) == *role && scenario.hosts.host_of(role.name(scenario)) == Some(host)
        };
        let roles = RoleId::all(scenario).into_iter().filter(own);
        let started = roles.map(|role| Ok((role, RoleProcess::start(scenario, role, domain)?)));
        let open = |(role, process)| {
            let member = Member::new(scenario, role, false, domain, bus)?;
            Ok(member.with_process(process))
        };
        let started = started.collect::<Result<Vec<_>, LaunchError>>()?;
        let members = started.into_iter().map(open).collect::<Result<Vec<_>, LaunchError>>()?;
        let externals = ExternalWatch::new(members.len());
        let (word, incidents) = (Schedule::default(), Incidents::default());
        Ok(Self {
            scenario,
            domain,
            janitor,
            members,
            externals,
            schedule,
            changes,
            word,
            incidents,
            recorder,
            foxglove,
            relay,
            tracer: TracerWatch::none()?,
            pace: None,
            overrun: OverrunWatch::off(),
            goes_safe: false,
            inputs: None,
            received: scenario.inputs.received(),
        })
    }

    /// Adopts the schedule of another host's launcher. Returns true if it is new.
    pub fn adopt(&mut self, word: &Schedule) -> bool {
        let Schedule { phase, epoch_ns, credit_tick, .. } = *word;
        let new = (phase, epoch_ns, credit_tick) != (self.word.phase, self.word.epoch_ns, self.word.credit_tick);
        (self.word.phase, self.word.epoch_ns, self.word.credit_tick) = (phase, epoch_ns, credit_tick);
        new
    }

    /// Returns the phase of the run.
    pub fn phase(&self) -> Phase {
        Phase::from_number(self.word.phase)
    }

    /// Returns the tick of the role that is furthest behind, once ticks run.
    pub fn behind(&self) -> Option<u64> {
        let running = self.phase() >= Phase::Run;
        self.members.iter().map(|member| member.last.stamp.tick).min().filter(|_| running)
    }

    /// Returns the roles that have not reached a state, as progress.
    pub fn waiting(&self, state: RoleState) -> Progress<'_> {
        let late = self.members.iter().filter(|member| member.state() < state);
        let roles = late.map(|member| &*member.name).collect();
        Progress::Waiting { roles, external: Vec::new(), hosts: Vec::new(), domain: self.domain.root().to_owned() }
    }

    /// Returns the incidents and the relay once all roles have ended.
    pub fn dismiss(self) -> (Vec<Incident>, RelayWatch) {
        (self.incidents.finish(&BTreeMap::new()), self.relay)
    }
}

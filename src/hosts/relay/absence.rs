//! Hosts that fall silent, and the end of a run.

use super::super::forward::Forwarders;
use super::super::join::{GONE_NS, HostTable};
use super::super::report::{Silence, far_end_path, relay_report_path};
use super::super::wire::Content;
use super::Relay;
use super::error::{RelayError, write};
use crate::clock::{Grid, monotonic_ns};
use crate::config::ClockKind;
use crate::sample::Phase;
use crate::system::tell;
use std::sync::atomic::Ordering;

/// Time without messages after which a host is silent, ns: it sends every `STATUS_NS`.
const SILENT_NS: u64 = 250_000_000;
/// Time for which an ending host sends its final files, and for which the launching host waits for them, ns: since the last message of
/// the other host, and in total.
const LEAVE_NS: u64 = 4_000_000_000;
const LEAVE_MAX_NS: u64 = 20_000_000_000;
/// Time for which the launching host still sends acknowledgements after the run, ns.
const LINGER_NS: u64 = 200_000_000;

impl Relay<'_> {
    /// Notes hosts that fall silent while ticks run.
    pub(super) fn check_silence(&mut self, now_ns: u64) {
        let grid = Grid { epoch_ns: self.schedule.epoch_ns, period_ns: self.scenario.period_ns };
        let realtime = self.scenario.clock == ClockKind::Realtime;
        let tick = if realtime { grid.tick_at(monotonic_ns()).min(self.scenario.last_tick) } else { 0 };
        for host in self.plan.peers().filter(|host| self.plan.own == self.plan.hub || *host == self.plan.hub) {
            let index = usize::from(host);
            let last_ns = self.shared.last_message_ns[index].load(Ordering::Relaxed);
            let silent = now_ns.saturating_sub(last_ns) > SILENT_NS && self.phase() == Phase::Run && !self.ended[index];
            if silent && self.silent[index].is_none() {
                self.silent[index] = Some((last_ns, tick));
                tell(format_args!("corotate: no messages from the host {}", self.plan.name(host)));
            }
        }
    }

    /// Notes hosts that joined and fell silent before the ticks. Another process may then join in their place.
    ///
    /// # Errors
    /// [`RelayError::Lost`] once a host has been silent for the time that roles may take to start.
    pub(super) fn check_joined(&mut self, table: &HostTable, now_ns: u64) -> Result<(), RelayError> {
        if self.shared.running.load(Ordering::Relaxed) {
            return Ok(());
        }
        let limit_s = self.scenario.startup_timeout_s;
        let lost = table.lost(now_ns, GONE_NS, &self.shared.last_message_ns);
        for host in lost.iter().filter(|host| !self.lost.contains(host)) {
            tell(format_args!(
                "corotate: the host {host} joined and then fell silent; waiting {limit_s} s for it or for another `join`"
            ));
        }
        self.lost = lost;
        let host = table.lost(now_ns, (limit_s * 1e9) as u64, &self.shared.last_message_ns).into_iter().next();
        host.map_or(Ok(()), |host| Err(RelayError::Lost { host, limit_s }))
    }

    /// Ends the silence of a host, if it was silent.
    pub(super) fn end_silence(&mut self, host: u8, at_ns: u64) {
        if let Some((since_ns, tick)) = self.silent[usize::from(host)].take() {
            let seconds = at_ns.saturating_sub(since_ns) as f64 / 1e9;
            let host = self.plan.name(host).to_owned();
            tell(format_args!("corotate: the host {host} sends again after {seconds:.2} s"));
            self.silences.push(Silence { host, tick, seconds, healed: true });
        }
    }

    /// Returns true once this host has sent or received all final files, or no longer waits for them.
    pub(super) fn may_leave(
        &mut self,
        since_ns: &mut Option<u64>,
        forwarders: &Forwarders,
        now_ns: u64,
    ) -> Result<bool, RelayError> {
        let (own, root) = (self.plan.own, self.domain.root());
        if own == self.plan.hub {
            if self.phase() < Phase::Stop {
                return Ok(false);
            }
            let since_ns = *since_ns.get_or_insert(now_ns);
            let is_awaited = |host: u8| !self.ended[usize::from(host)] && !self.gives_up(host, since_ns, now_ns);
            return Ok(now_ns - since_ns > LINGER_NS && !self.plan.peers().any(is_awaited));
        }
        let end = far_end_path(root, self.plan.name(own));
        match *since_ns {
            None if end.exists() => {
                *since_ns = Some(now_ns);
                self.fill_streams()?;
                let statistics =
                    serde_json::to_vec(&self.statistics(&forwarders.sent())).expect("plain values are JSON");
                write(&relay_report_path(root, self.plan.name(own)), &statistics)?;
                for path in self.final_files(own) {
                    if let (Ok(bytes), Some(name)) =
                        (std::fs::read(&path), path.file_name().and_then(|name| name.to_str()))
                    {
                        self.streams[usize::from(self.plan.hub)].0.push(Content::File { name, bytes: &bytes }.encode());
                    }
                }
                Ok(false)
            }
            None => Ok(false),
            Some(since_ns) => {
                let is_delivered = self.streams[usize::from(self.plan.hub)].0.is_empty();
                Ok(is_delivered || self.gives_up(self.plan.hub, since_ns, now_ns))
            }
        }
    }

    /// Returns true if a host that leaves since `since_ns` no longer waits for host number `host`.
    fn gives_up(&self, host: u8, since_ns: u64, now_ns: u64) -> bool {
        let last_ns = self.shared.last_message_ns[usize::from(host)].load(Ordering::Relaxed).max(since_ns);
        now_ns.saturating_sub(last_ns) > LEAVE_NS || now_ns - since_ns > LEAVE_MAX_NS
    }
}

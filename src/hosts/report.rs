//! Statistics of a host at the end of a run: its clock, its links, and silences of other hosts. Must not judge them.

use crate::telemetry::Percentiles;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Statistics of one host, written by its relay.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct HostStatistics {
    /// Name of the host.
    pub host: String,
    /// True if it launched the run: its clock is then the run's.
    pub launched: bool,
    /// Its clock relative to the run's; `None` on the launching host.
    pub clock: Option<ClockStatistics>,
    /// Its ends of links.
    pub links: Vec<LinkStatistics>,
    /// Periods without messages from another host.
    pub silences: Vec<Silence>,
    /// Frames sent again because they were not acknowledged.
    pub repeated_frames: u64,
    /// Frames dropped because the queue of unacknowledged ones was full.
    pub refused_frames: u64,
    /// Malformed messages received.
    pub malformed: u64,
}

/// Statistics of a host's clock.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ClockStatistics {
    /// `estimated` or `system`.
    pub source: String,
    /// The run's clock less this host's when the ticks began, ns.
    pub offset_ns: i64,
    /// Rate of the run's clock relative to this host's, at the end, parts per million.
    pub drift_ppm: f64,
    /// The bound on the offset's error when the ticks began, µs.
    pub error_us: f64,
    /// The largest bound of the run, µs.
    pub error_max_us: f64,
    /// The fastest recent round trip, µs.
    pub round_trip_us: f64,
    /// Number of corrections of this host's clock.
    pub corrections: u64,
    /// The largest correction, µs.
    pub largest_correction_us: f64,
    /// One entry per second: seconds since the first time request, the correction's offset less `offset_ns`, µs, and the bound, µs.
    pub track: Vec<[f64; 3]>,
}

/// Counters of a link between hosts, of one end or of both.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LinkStatistics {
    /// The signal.
    pub service: String,
    /// The sending host.
    pub from: String,
    /// The receiving host.
    pub to: String,
    /// True if the link uses the lossless stream.
    pub lossless: bool,
    /// Samples sent, counted by the sending host.
    pub sent: Option<u64>,
    /// Samples received, counted by the receiving host.
    pub received: Option<u64>,
    /// Samples that did not arrive before their successor.
    pub lost: u64,
    /// Samples that arrived again, or after their successor; not passed on.
    pub stale: u64,
    /// Time from the sending role to the receiving host's shared memory, in real time.
    pub one_way: Option<Percentiles>,
}

/// A period without messages from a host.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Silence {
    /// The silent host.
    #[serde(rename = "of")]
    pub host: String,
    /// The tick that was due when the silence was found; 0 in lockstep.
    pub tick: u64,
    /// Its duration, s.
    pub seconds: f64,
    /// True if messages arrived again.
    pub healed: bool,
}

/// Returns the file in a domain's directory to which a relay writes its statistics.
pub fn relay_report_path(root: &Path, host: &str) -> PathBuf {
    root.join(format!("{host}.relay.json"))
}

/// Returns the file in a domain's directory to which the launcher of a joined host writes how its part of the run ended.
pub fn far_end_path(root: &Path, host: &str) -> PathBuf {
    root.join(format!("{host}.host.json"))
}

/// Returns the file in a domain's directory that exists once its relay is ready.
pub fn ready_path(root: &Path) -> PathBuf {
    root.join("relay.ready")
}

/// Statistics of all hosts of a run, and of the links between them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NetworkStatistics {
    /// All hosts, without their links.
    pub hosts: Vec<HostStatistics>,
    /// All links between hosts, each with the counters of both ends.
    pub links: Vec<LinkStatistics>,
}

impl NetworkStatistics {
    /// Merges the statistics of all hosts; `None` without any.
    pub fn merge(reports: &[HostStatistics]) -> Option<Self> {
        if reports.is_empty() {
            return None;
        }
        let mut links: Vec<LinkStatistics> = Vec::new();
        for end in reports.iter().flat_map(|report| &report.links) {
            let same = |link: &&mut LinkStatistics| {
                (&link.service, &link.from, &link.to) == (&end.service, &end.from, &end.to)
            };
            match links.iter_mut().find(same) {
                Some(link) => {
                    link.sent = link.sent.or(end.sent);
                    link.received = link.received.or(end.received);
                    link.lost += end.lost;
                    link.stale += end.stale;
                    link.one_way = link.one_way.take().or(end.one_way);
                }
                None => links.push(end.clone()),
            }
        }
        for link in &mut links {
            // The receiver cannot count samples that were lost after the last one it received.
            if let (Some(sent), Some(received)) = (link.sent, link.received) {
                link.lost = sent.saturating_sub(received);
            }
        }
        let without_links = |report: &HostStatistics| HostStatistics { links: Vec::new(), ..report.clone() };
        Some(Self { hosts: reports.iter().map(without_links).collect(), links })
    }

    /// Returns a sentence for each link whose ends disagree.
    pub fn problems(&self) -> Vec<String> {
        let wrong = self.links.iter().filter(|link| match (link.sent, link.received) {
            (Some(sent), Some(received)) => received > sent || (link.lossless && received != sent),
            _ => true,
        });
        let count = |count: Option<u64>| count.map_or("an unknown number".to_owned(), |count| count.to_string());
        let sentence = |link: &LinkStatistics| {
            let LinkStatistics { service, from, to, .. } = link;
            format!("{service} from {from} to {to}: {} sent, {} received", count(link.sent), count(link.received))
        };
        wrong.map(sentence).collect()
    }

    /// Returns the largest bound on the error of any host's clock, µs.
    pub fn clock_error_us(&self) -> f64 {
        self.hosts.iter().filter_map(|host| host.clock.as_ref()).map(|clock| clock.error_max_us).fold(0.0, f64::max)
    }

    /// Returns the number of samples of a signal that did not reach the launching host.
    pub fn lost(&self, service: &str) -> u64 {
        let hub = self.hosts.iter().find(|host| host.launched);
        let here = |link: &&LinkStatistics| link.service == service && hub.is_some_and(|hub| hub.host == link.to);
        self.links.iter().filter(here).map(|link| link.lost).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn end(sent: Option<u64>, received: Option<u64>, lossless: bool) -> LinkStatistics {
        LinkStatistics {
            service: "s".to_owned(),
            from: "a".to_owned(),
            to: "b".to_owned(),
            lossless,
            sent,
            received,
            lost: 0,
            stale: 0,
            one_way: None,
        }
    }

    fn summary(sent: Option<u64>, received: Option<u64>, lossless: bool) -> NetworkStatistics {
        let host = |name: &str, link| HostStatistics {
            host: name.to_owned(),
            launched: name == "b",
            links: vec![link],
            ..HostStatistics::default()
        };
        let reports = [host("a", end(sent, None, lossless)), host("b", end(None, received, lossless))];
        NetworkStatistics::merge(&reports).unwrap()
    }

    #[test]
    fn a_link_whose_ends_disagree_is_a_problem() {
        let lossy = summary(Some(10), Some(8), false);
        assert_eq!((lossy.links.len(), lossy.lost("s"), lossy.lost("t")), (1, 2, 0));
        assert!(lossy.problems().is_empty());
        assert_eq!(summary(Some(10), Some(8), true).problems(), ["s from a to b: 10 sent, 8 received"]);
        assert_eq!(summary(Some(8), Some(10), false).problems().len(), 1);
        assert_eq!(summary(None, Some(10), false).problems().len(), 1, "the sender's counter is missing");
        assert_eq!(NetworkStatistics::merge(&[]), None);
    }
}

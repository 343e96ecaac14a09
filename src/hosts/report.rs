//! What a host tells of its part in a run when it ends: its clock, its links, its silences. Must not judge.

use crate::telemetry::Percentiles;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// A relay's account of itself.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct HostReport {
    /// The host's name.
    pub host: String,
    /// Whether it launched the run: then its clock is the run's.
    pub launched: bool,
    /// What is known of its clock, if it is not the run's.
    pub clock: Option<ClockReport>,
    /// What it sent and received, by link.
    pub links: Vec<LinkEnd>,
    /// The times in which another host was not heard.
    pub silences: Vec<Silence>,
    /// Frames that were sent again because nothing acknowledged them.
    pub repeated_frames: u64,
    /// Frames that found no room while nothing came through.
    pub refused_frames: u64,
    /// Messages that were none.
    pub malformed: u64,
}

/// What is known of a host's clock.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ClockReport {
    /// `estimated` or `system`.
    pub source: String,
    /// The run's clock less this host's when the ticks began, ns.
    pub offset_ns: i64,
    /// How much faster the run's clock goes, parts per million, at the end.
    pub drift_ppm: f64,
    /// The bound on the error when the ticks began, µs, and the largest one of the run.
    pub error_us: f64,
    /// See `error_us`.
    pub error_max_us: f64,
    /// The fastest way there and back, µs.
    pub round_trip_us: f64,
    /// How often the correction was renewed while the run lasted, and the largest one, µs.
    pub corrections: u64,
    /// See `corrections`.
    pub largest_correction_us: f64,
    /// The estimate each second: seconds since this host asked for the time first, offset less `offset_ns`, µs, and bound, µs.
    pub track: Vec<[f64; 3]>,
}

/// One end of a link that crosses hosts.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LinkEnd {
    /// The service.
    pub service: String,
    /// The host that sends.
    pub from: String,
    /// The host that receives.
    pub to: String,
    /// Whether it goes by the stream that loses nothing.
    pub lossless: bool,
    /// Samples sent, by the sending host.
    pub sent: Option<u64>,
    /// Samples received, by the receiving host.
    pub received: Option<u64>,
    /// Samples that did not come, or later than their successor.
    pub lost: u64,
    /// Samples that came a second time, or later than their successor: not passed on.
    pub stale: u64,
    /// From the sending role to the receiving host's memory; in real time.
    pub one_way: Option<Percentiles>,
}

/// A time in which a host was not heard.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Silence {
    /// The host.
    pub of: String,
    /// The tick that was due when it fell silent; in lockstep 0.
    pub tick: u64,
    /// How long it lasted, s.
    pub seconds: f64,
    /// Whether it was heard again.
    pub healed: bool,
}

/// The file in a domain's directory in which a relay leaves its report.
pub fn relay_report_path(root: &Path, host: &str) -> PathBuf {
    root.join(format!("{host}.relay.json"))
}

/// The file in a domain's directory in which the launcher of a host that joined leaves how it ended.
pub fn far_end_path(root: &Path, host: &str) -> PathBuf {
    root.join(format!("{host}.host.json"))
}

/// The file in a domain's directory that is there once its relay is ready.
pub fn ready_path(root: &Path) -> PathBuf {
    root.join("relay.ready")
}

/// The part of each host in a run, and both ends of every link between them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct HostsSummary {
    /// Each host without its links, the one that launched among them.
    pub hosts: Vec<HostReport>,
    /// Every link between hosts, in the order in which they were told.
    pub links: Vec<LinkEnd>,
}

impl HostsSummary {
    /// That of all hosts' reports; none where there are none.
    pub fn of(reports: &[HostReport]) -> Option<Self> {
        if reports.is_empty() {
            return None;
        }
        let mut links: Vec<LinkEnd> = Vec::new();
        for end in reports.iter().flat_map(|report| &report.links) {
            let same =
                |link: &&mut LinkEnd| (&link.service, &link.from, &link.to) == (&end.service, &end.from, &end.to);
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
            // Of what did not come at the very end the receiver knows nothing.
            if let (Some(sent), Some(received)) = (link.sent, link.received) {
                link.lost = sent.saturating_sub(received);
            }
        }
        let bare = |report: &HostReport| HostReport { links: Vec::new(), ..report.clone() };
        Some(Self { hosts: reports.iter().map(bare).collect(), links })
    }

    /// What does not add up between the ends of links.
    pub fn problems(&self) -> Vec<String> {
        let wrong = self.links.iter().filter(|link| match (link.sent, link.received) {
            (Some(sent), Some(received)) => received > sent || (link.lossless && received != sent),
            _ => true,
        });
        let count = |count: Option<u64>| count.map_or("nobody knows how many".to_owned(), |count| count.to_string());
        let words = |link: &LinkEnd| {
            let LinkEnd { service, from, to, .. } = link;
            format!("{service} from {from} to {to}: {} sent, {} received", count(link.sent), count(link.received))
        };
        wrong.map(words).collect()
    }

    /// The largest bound on the error of any host's clock, µs.
    pub fn clock_error_us(&self) -> f64 {
        self.hosts.iter().filter_map(|host| host.clock.as_ref()).map(|clock| clock.error_max_us).fold(0.0, f64::max)
    }

    /// Samples of a signal that did not come to the host that launched.
    pub fn lost(&self, service: &str) -> u64 {
        let hub = self.hosts.iter().find(|host| host.launched);
        let here = |link: &&LinkEnd| link.service == service && hub.is_some_and(|hub| hub.host == link.to);
        self.links.iter().filter(here).map(|link| link.lost).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn end(sent: Option<u64>, received: Option<u64>, lossless: bool) -> LinkEnd {
        LinkEnd {
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

    fn summary(sent: Option<u64>, received: Option<u64>, lossless: bool) -> HostsSummary {
        let host = |name: &str, link| HostReport {
            host: name.to_owned(),
            launched: name == "b",
            links: vec![link],
            ..HostReport::default()
        };
        let reports = [host("a", end(sent, None, lossless)), host("b", end(None, received, lossless))];
        HostsSummary::of(&reports).unwrap()
    }

    #[test]
    fn both_ends_of_a_link_are_held_against_each_other() {
        let lossy = summary(Some(10), Some(8), false);
        assert_eq!((lossy.links.len(), lossy.lost("s"), lossy.lost("t")), (1, 2, 0));
        assert!(lossy.problems().is_empty());
        assert_eq!(summary(Some(10), Some(8), true).problems(), ["s from a to b: 10 sent, 8 received"]);
        assert_eq!(summary(Some(8), Some(10), false).problems().len(), 1);
        assert_eq!(summary(None, Some(10), false).problems().len(), 1, "one end is silent");
        assert_eq!(HostsSummary::of(&[]), None);
    }
}

//! Counters of the calling thread that the kernel keeps for everyone: time waited for a core, page faults, preemptions, and the time
//! for which a cgroup's limit stopped its tasks.
//!
//! A counter that cannot be read stays zero. Must not allocate after it is opened.

use super::budget::cpu_quota;
use crate::clock::raw_ns;
use crate::telemetry::Usage;
use rustix::io::pread;
use std::fs::File;
use std::path::Path;
use std::sync::Arc;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};

/// Longest text that is read of a counters' file, bytes.
const TEXT: usize = 512;
/// Set by SIGCONT: a signal had stopped this process.
static CONTINUED: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// Announces the flag that SIGCONT sets in this process.
pub fn watch_continued(flag: Arc<AtomicBool>) {
    let _ = CONTINUED.set(flag);
}

/// Returns true if a signal had stopped this process since the last call.
pub fn take_continued() -> bool {
    CONTINUED.get().is_some_and(|flag| flag.swap(false, Ordering::Relaxed))
}

/// The counters of the thread that opened them.
#[derive(Debug)]
pub struct ThreadUsage {
    tid: u64,
    schedstat: Option<File>,
    /// Statistics of the cgroup that limits processor time, if one does.
    throttled: Option<File>,
}

impl ThreadUsage {
    /// Opens the counters of the calling thread.
    pub fn open() -> Self {
        let quota = cpu_quota(Path::new("/"));
        Self {
            tid: rustix::thread::gettid().as_raw_nonzero().get() as u64,
            schedstat: File::open("/proc/thread-self/schedstat").ok(),
            throttled: quota.and_then(|quota| File::open(quota.file.with_file_name("cpu.stat")).ok()),
        }
    }

    /// Returns the thread.
    pub fn tid(&self) -> u64 {
        self.tid
    }

    /// Reads the counters.
    pub fn read(&self) -> Usage {
        let mut text = [0; TEXT];
        let run_delay_ns = read(self.schedstat.as_ref(), &mut text, run_delay_ns);
        let throttled_ns = read(self.throttled.as_ref(), &mut text, throttled_ns);
        let resources = thread_resources();
        let count = |count: libc::c_long| u64::try_from(count).unwrap_or_default();
        Usage {
            run_delay_ns,
            usual_delay_ns: 0,
            minor_faults: count(resources.ru_minflt),
            major_faults: count(resources.ru_majflt),
            preemptions: count(resources.ru_nivcsw),
            throttled_ns,
        }
    }
}

/// Reads a file of counters from its begin; 0 if that fails.
fn read(file: Option<&File>, text: &mut [u8], parse: impl Fn(&str) -> Option<u64>) -> u64 {
    let length = file.and_then(|file| pread(file, &mut *text, 0).ok());
    let text = length.and_then(|length| std::str::from_utf8(&text[..length]).ok());
    text.and_then(parse).unwrap_or_default()
}

/// Returns the time waited for a core, ns, from the text of a `schedstat` file.
fn run_delay_ns(text: &str) -> Option<u64> {
    text.split_ascii_whitespace().nth(1)?.parse().ok()
}

/// Returns the time for which tasks were stopped, ns, from the text of a cgroup's `cpu.stat`, of version 1 or 2.
fn throttled_ns(text: &str) -> Option<u64> {
    text.lines().find_map(|line| {
        let (name, number) = line.split_once(' ')?;
        let number: u64 = number.trim().parse().ok()?;
        match name {
            "throttled_time" => Some(number),
            "throttled_usec" => number.checked_mul(1000),
            _ => None,
        }
    })
}

/// Returns the time of a page fault on this machine, ns: the shortest mean of some short measurements, which take about a millisecond.
/// 0 if memory for them cannot be mapped.
pub fn page_fault_ns() -> u64 {
    const MEASUREMENTS: usize = 8;
    const BYTES: usize = 256 << 10;
    let mean = |_| {
        let mut pages = memmap2::MmapMut::map_anon(BYTES).ok()?;
        let (faults, begun_ns) = (thread_resources().ru_minflt, raw_ns());
        // Also right for pages of more than 4096 bytes, which have fewer faults.
        pages.iter_mut().step_by(4096).for_each(|byte| *byte = std::hint::black_box(1));
        let taken_ns = raw_ns() - begun_ns;
        taken_ns.checked_div(u64::try_from(thread_resources().ru_minflt - faults).ok()?)
    };
    (0..MEASUREMENTS).filter_map(mean).min().unwrap_or_default()
}

#[allow(unsafe_code)]
fn thread_resources() -> libc::rusage {
    // SAFETY: `rusage` is a structure of integers, for which zero is valid.
    let mut resources: libc::rusage = unsafe { std::mem::zeroed() };
    // SAFETY: the kernel writes one `rusage` to a valid pointer to one. On an error it stays zero.
    unsafe { libc::getrusage(libc::RUSAGE_THREAD, &raw mut resources) };
    resources
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_counters_grow_with_page_faults() {
        let usage = ThreadUsage::open();
        let before = usage.read();
        // Too large for the allocator to serve from memory that other tests have touched.
        let mut pages = vec![0_u8; 64 << 20];
        pages.iter_mut().step_by(4096).for_each(|byte| *byte = 1);
        std::hint::black_box(&mut pages);
        let grown = usage.read().since(&before);
        assert!(grown.minor_faults + grown.major_faults > 0 && usage.tid() > 0, "{grown:?}");
    }

    #[test]
    fn a_page_fault_takes_less_than_a_millisecond() {
        assert!((1..1_000_000).contains(&page_fault_ns()), "{} ns", page_fault_ns());
    }

    #[test]
    fn strange_texts_give_nothing() {
        assert_eq!(run_delay_ns("83890 2382634 2\n"), Some(2_382_634));
        assert_eq!(throttled_ns("nr_periods 8\nnr_throttled 3\nthrottled_time 4711\n"), Some(4711));
        assert_eq!(throttled_ns("usage_usec 1\nnr_throttled 3\nthrottled_usec 47\n"), Some(47_000));
        for strange in
            ["", "1", "1 x 2", "-1 -1 -1", "throttled_time", "throttled_usec 99999999999999999999", "\n\n \n"]
        {
            assert_eq!((run_delay_ns(strange), throttled_ns(strange)), (None, None), "{strange:?}");
        }
    }
}

//! The machine of a run, recorded for readers of its results. Nothing here fails: unknown values stay unknown.

use serde::{Deserialize, Serialize};

/// A description of the machine that made a run.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct MachineInfo {
    /// Its host name.
    pub name: String,
    /// The release and version of its kernel.
    pub kernel: String,
    /// The number of cores that this process may use.
    pub cores: usize,
    /// The processor's model name.
    pub cpu: String,
}

impl MachineInfo {
    /// Returns the description of this machine.
    pub fn local() -> Self {
        let system = rustix::system::uname();
        let cpu = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
        let model = cpu.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
        Self {
            name: system.nodename().to_string_lossy().into_owned(),
            kernel: format!("{} {}", system.release().to_string_lossy(), system.version().to_string_lossy()),
            cores: std::thread::available_parallelism().map_or(0, usize::from),
            cpu: model.map_or("unknown".to_owned(), |(_, name)| name.trim().to_owned()),
        }
    }
}

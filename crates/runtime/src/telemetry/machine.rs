//! The machine that a run was made on, for whoever reads its results elsewhere. Must not fail: what is not told is unknown.

use serde::{Deserialize, Serialize};

/// A machine.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct MachineInfo {
    /// Its name.
    pub name: String,
    /// Release and version of its kernel.
    pub kernel: String,
    /// Cores that this process may use.
    pub cores: usize,
    /// The processor's name.
    pub cpu: String,
}

impl MachineInfo {
    /// This machine.
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

//! The limits of a cgroup: a real-time budget of zero, with which the kernel refuses SCHED_FIFO even to root, a quota of
//! processor time, and a set of cores.
//!
//! Must not change a limit.

use std::fs;
use std::path::{Component, Path, PathBuf};

/// The budget in the suggested commands, µs per second.
const GRANTED_US: u32 = 900_000;

/// Returns the budget files with value zero of this process's cgroup and its parents, outermost first. Empty where the
/// kernel keeps no such budgets. `root` is the root of the machine's files.
pub fn empty_budgets(root: &Path) -> Vec<PathBuf> {
    let cgroups = Cgroups::new(root);
    // Version 2 has no budgets.
    let files = cgroups.with("cpu").into_iter().map(|group| group.join("cpu.rt_runtime_us"));
    files.filter(|file| cgroups.read(file).is_some_and(|text| text.trim() == "0")).collect()
}

/// Returns the shell commands that grant a budget in each file.
pub fn grant_budgets(files: &[PathBuf]) -> String {
    let commands = files.iter().map(|file| format!("echo {GRANTED_US} > {}", file.display()));
    commands.collect::<Vec<_>>().join("; ")
}

/// The limit of a cgroup on processor time: its tasks are stopped once they have used it, until the next period.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CpuQuota {
    /// The file that sets it.
    pub file: PathBuf,
    /// Processor time per period, µs.
    pub quota_us: u64,
    /// The period, µs.
    pub period_us: u64,
}

/// Returns the tightest limit on processor time of this process's cgroup and its parents (version 1 or 2), if there is one.
pub fn cpu_quota(root: &Path) -> Option<CpuQuota> {
    let cgroups = Cgroups::new(root);
    let number = |path: &Path| cgroups.read(path)?.trim().parse::<u64>().ok();
    let old = cgroups.with("cpu").into_iter().filter_map(|group| {
        let file = group.join("cpu.cfs_quota_us");
        Some(CpuQuota { quota_us: number(&file)?, period_us: number(&group.join("cpu.cfs_period_us"))?, file })
    });
    let unified = cgroups.unified().into_iter().filter_map(|group| {
        let file = group.join("cpu.max");
        let text = cgroups.read(&file)?;
        let mut numbers = text.split_whitespace().map(|word| word.parse().ok());
        Some(CpuQuota { quota_us: numbers.next()??, period_us: numbers.next()??, file })
    });
    let limits = old.chain(unified).filter(|limit| limit.period_us > 0);
    limits.min_by(|a, b| {
        (u128::from(a.quota_us) * u128::from(b.period_us)).cmp(&(u128::from(b.quota_us) * u128::from(a.period_us)))
    })
}

/// The set of cores of a cgroup: its tasks run on no other core.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CpuSetLimit {
    /// The file that sets it.
    pub file: PathBuf,
    /// The cores, as the kernel lists them, such as `0-2,5`.
    pub cores: String,
}

/// Returns the set of cores of this process's cgroup (version 1 or 2), with the file of the outermost group that has the same set;
/// `None` without such a controller.
pub fn cpu_set(root: &Path) -> Option<CpuSetLimit> {
    let cgroups = Cgroups::new(root);
    let limits = |groups: Vec<PathBuf>, files: &[&str]| -> Vec<CpuSetLimit> {
        let cores = |group: &Path| {
            let texts = files.iter().filter_map(|file| cgroups.read(&group.join(file)));
            texts.map(|text| text.trim().to_owned()).find(|text| !text.is_empty())
        };
        let limit = |group: PathBuf| Some(CpuSetLimit { cores: cores(&group)?, file: group.join("cpuset.cpus") });
        groups.into_iter().filter_map(limit).collect()
    };
    // Older kernels have no effective set in version 1.
    let old = limits(cgroups.with("cpuset"), &["cpuset.effective_cpus", "cpuset.cpus"]);
    let unified = limits(cgroups.unified(), &["cpuset.cpus.effective"]);
    // A kernel has the controller in one of the two versions.
    let limits = if old.is_empty() { unified } else { old };
    let own = limits.last()?.cores.clone();
    limits.into_iter().find(|limit| limit.cores == own)
}

/// The cgroups of this process.
struct Cgroups<'a> {
    root: &'a Path,
    cgroups: String,
    mounts: String,
}

impl<'a> Cgroups<'a> {
    fn new(root: &'a Path) -> Self {
        let text = |path| fs::read_to_string(root.join(path)).unwrap_or_default();
        Self { root, cgroups: text("proc/self/cgroup"), mounts: text("proc/self/mountinfo") }
    }

    /// Returns the text of a file of the machine.
    fn read(&self, path: &Path) -> Option<String> {
        fs::read_to_string(self.root.join(path.strip_prefix("/").unwrap_or(path))).ok()
    }

    /// Returns the directories with a controller of version 1, outermost first.
    fn with(&self, controller: &str) -> Vec<PathBuf> {
        let has = |list: &str| list.split(',').any(|name| name == controller);
        self.groups(has, |kind, options| kind == "cgroup" && has(options))
    }

    /// Returns the directories of version 2, outermost first.
    fn unified(&self) -> Vec<PathBuf> {
        self.groups(str::is_empty, |kind, _| kind == "cgroup2")
    }

    /// Returns the directories of this process's cgroup and its parents, outermost first, by the controllers of its line and by the
    /// type and options of its mount.
    fn groups(&self, is_group: impl Fn(&str) -> bool, is_mount: impl Fn(&str, &str) -> bool) -> Vec<PathBuf> {
        // "1:cpu,cpuacct:/path"
        let path = self.cgroups.lines().find_map(|line| {
            let (controllers, path) = line.split_once(':')?.1.split_once(':')?;
            is_group(controllers).then_some(path)
        });
        // "32 31 0:29 / /sys/fs/cgroup/cpu rw - cgroup cgroup rw,cpu"
        let mount = self.mounts.lines().find_map(|line| {
            let (before, after) = line.split_once(" - ")?;
            let (mut before, mut after) = (before.split(' ').skip(3), after.split(' '));
            let (kind, options) = (after.next()?, after.nth(1)?);
            is_mount(kind, options).then_some((before.next()?, before.next()?))
        });
        let (Some(path), Some((top, mounted))) = (path, mount) else { return Vec::new() };
        // Groups above the mounted one cannot be read.
        let Ok(below) = Path::new(path).strip_prefix(top) else { return Vec::new() };
        if below.components().any(|part| part == Component::ParentDir) {
            return Vec::new();
        }
        let mut groups: Vec<&Path> = below.ancestors().collect();
        groups.reverse();
        groups.into_iter().map(|group| Path::new(mounted).join(group)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MOUNTS: &str = "31 23 0:28 / /sys/fs/cgroup rw - tmpfs tmpfs rw\n\
                          32 31 0:29 / /sys/fs/cgroup/cpu rw,relatime shared:9 - cgroup cgroup rw,cpu,cpuacct\n\
                          33 31 0:31 / /sys/fs/cgroup/cpuset rw - cgroup cgroup rw,cpuset\n\
                          40 31 0:40 / /sys/fs/cgroup/unified rw - cgroup2 cgroup2 rw,nsdelegate\n";

    fn machine(cgroups: &str, files: &[(&str, &str)]) -> tempfile::TempDir {
        let root = tempfile::tempdir().unwrap();
        for (path, text) in [("proc/self/cgroup", cgroups), ("proc/self/mountinfo", MOUNTS)].iter().chain(files) {
            let path = root.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        root
    }

    #[test]
    fn an_empty_budget_is_found_in_every_group_that_has_one() {
        let budgets = [
            ("sys/fs/cgroup/cpu/cpu.rt_runtime_us", "950000\n"),
            ("sys/fs/cgroup/cpu/a/cpu.rt_runtime_us", "0\n"),
            ("sys/fs/cgroup/cpu/a/b/cpu.rt_runtime_us", "0\n"),
        ];
        let empty = |cgroups: &str| empty_budgets(machine(cgroups, &budgets).path());
        let file = |group: &str| PathBuf::from(format!("/sys/fs/cgroup/cpu/{group}cpu.rt_runtime_us"));
        assert_eq!(empty("5:cpuset:/x\n4:cpu,cpuacct:/a/b\n0::/\n"), [file("a/"), file("a/b/")]);
        assert_eq!(empty("4:cpu,cpuacct:/a\n"), [file("a/")]);
        for none in ["4:cpu,cpuacct:/\n", "4:cpu,cpuacct:/../a\n", "4:cpuacct:/a\n0::/a\n", "", "x\n::\n"] {
            assert!(empty(none).is_empty(), "{none}");
        }
        assert!(grant_budgets(&[file("a/")]).contains("> /sys/fs/cgroup/cpu/a/cpu.rt_runtime_us"));
    }

    #[test]
    fn arbitrary_text_does_not_panic() {
        for (cgroups, mounts) in [("1:cpu:/", " - "), ("1:cpu:/", "a b c d e f - cgroup x"), ("::", "- - - -")] {
            let cgroups = Cgroups { root: Path::new("/"), cgroups: cgroups.to_owned(), mounts: mounts.to_owned() };
            let _ = (cgroups.with("cpu"), cgroups.unified());
        }
    }

    #[test]
    fn the_group_that_limits_the_cores_is_found_in_both_versions() {
        let set = |cgroups: &str, files: &[(&str, &str)]| {
            cpu_set(machine(cgroups, files).path()).map(|found| (found.file.display().to_string(), found.cores))
        };
        let found = |file: &str, cores: &str| Some((format!("/sys/fs/cgroup/{file}"), cores.to_owned()));
        let old = [
            ("sys/fs/cgroup/cpuset/cpuset.effective_cpus", "0-3\n"),
            ("sys/fs/cgroup/cpuset/a/cpuset.effective_cpus", "0-1\n"),
            ("sys/fs/cgroup/cpuset/a/b/cpuset.effective_cpus", "0-1\n"),
        ];
        assert_eq!(set("5:cpuset:/a/b\n0::/\n", &old), found("cpuset/a/cpuset.cpus", "0-1"));
        assert_eq!(set("5:cpuset:/\n0::/\n", &old), found("cpuset/cpuset.cpus", "0-3"));
        let older = [("sys/fs/cgroup/cpuset/a/cpuset.cpus", "2\n")];
        assert_eq!(set("5:cpuset:/a\n", &older), found("cpuset/a/cpuset.cpus", "2"));
        let unified = [
            ("sys/fs/cgroup/unified/cpuset.cpus.effective", "0-7\n"),
            ("sys/fs/cgroup/unified/a/cpuset.cpus.effective", "4-5,7\n"),
        ];
        // Group b has no controller of its own.
        assert_eq!(set("0::/a/b\n", &unified), found("unified/a/cpuset.cpus", "4-5,7"));
        for strange in ["", "\n", "0::\n", "5:cpuset:/../a\n0::/../a\n"] {
            assert_eq!(set(strange, &old), None, "{strange:?}");
        }
        assert_eq!(set("5:cpuset:/\n", &[("sys/fs/cgroup/cpuset/cpuset.cpus", "\n")]), None);
    }

    #[test]
    fn the_tightest_quota_of_both_versions_is_found() {
        let quota = |cgroups: &str, files: &[(&str, &str)]| {
            cpu_quota(machine(cgroups, files).path())
                .map(|found| (found.file.display().to_string(), found.quota_us, found.period_us))
        };
        let (old, unified) = ("sys/fs/cgroup/cpu", "sys/fs/cgroup/unified");
        let at = |group: &str, file: &str| format!("{group}/{file}");
        let [quota_file, period_file] = ["a/cpu.cfs_quota_us", "a/cpu.cfs_period_us"].map(|file| at(old, file));
        let (maximum, parent) = (at(unified, "b/c/cpu.max"), at(unified, "b/cpu.max"));
        assert_eq!(quota("4:cpu,cpuacct:/a\n0::/\n", &[(&quota_file, "-1\n"), (&period_file, "100000\n")]), None);
        assert_eq!(
            quota("4:cpu,cpuacct:/a\n0::/\n", &[(&quota_file, "20000\n"), (&period_file, "100000\n")]),
            Some((format!("/{quota_file}"), 20_000, 100_000))
        );
        assert_eq!(quota("0::/b/c\n", &[(&maximum, "max 100000\n")]), None);
        assert_eq!(
            quota("0::/b/c\n", &[(&maximum, "50000 100000\n"), (&parent, "20000 50000\n")]),
            Some((format!("/{parent}"), 20_000, 50_000))
        );
        for strange in ["", "9e9", "10000", "10000 0", "10000 -5", "\u{1}"] {
            assert_eq!(quota("0::/b/c\n", &[(&maximum, strange)]), None, "{strange:?}");
        }
    }
}

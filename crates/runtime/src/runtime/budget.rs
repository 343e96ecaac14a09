//! The real-time budget of a cgroup: where it is zero, the kernel refuses SCHED_FIFO even to root.
//!
//! Must not change a budget.

use std::fs;
use std::path::{Component, Path, PathBuf};

/// The budget in the suggested commands, µs per second.
const GRANTED_US: u32 = 900_000;

/// Returns the budget files with value zero of this process's cgroup and its parents, outermost first. Empty where the
/// kernel keeps no such budgets. `root` is the root of the machine's files.
pub fn empty_budgets(root: &Path) -> Vec<PathBuf> {
    let read = |path: &str| fs::read_to_string(root.join(path)).unwrap_or_default();
    find(&read("proc/self/cgroup"), &read("proc/self/mountinfo"))
        .into_iter()
        .filter(|path| {
            let below = path.strip_prefix("/").unwrap_or(path);
            fs::read_to_string(root.join(below)).is_ok_and(|text| text.trim() == "0")
        })
        .collect()
}

/// Returns the shell commands that grant a budget in each file.
pub fn grant_budgets(files: &[PathBuf]) -> String {
    let commands = files.iter().map(|file| format!("echo {GRANTED_US} > {}", file.display()));
    commands.collect::<Vec<_>>().join("; ")
}

/// Returns the budget files of the cgroups of controller `cpu` (version 1), outermost first. Version 2 has no budgets.
fn find(cgroups: &str, mounts: &str) -> Vec<PathBuf> {
    let has_cpu = |list: &str| list.split(',').any(|name| name == "cpu");
    // "1:cpu,cpuacct:/path"
    let path = cgroups.lines().find_map(|line| {
        let (controllers, path) = line.split_once(':')?.1.split_once(':')?;
        has_cpu(controllers).then_some(path)
    });
    // "32 31 0:29 / /sys/fs/cgroup/cpu rw - cgroup cgroup rw,cpu"
    let mount = mounts.lines().find_map(|line| {
        let (before, after) = line.split_once(" - ")?;
        let (mut before, mut after) = (before.split(' ').skip(3), after.split(' '));
        let (kind, options) = (after.next()?, after.nth(1)?);
        (kind == "cgroup" && has_cpu(options)).then_some((before.next()?, before.next()?))
    });
    let (Some(path), Some((top, mounted))) = (path, mount) else { return Vec::new() };
    // Groups above the mounted one cannot be read.
    let Ok(below) = Path::new(path).strip_prefix(top) else { return Vec::new() };
    if below.components().any(|part| part == Component::ParentDir) {
        return Vec::new();
    }
    let mut groups: Vec<&Path> = below.ancestors().collect();
    groups.reverse();
    groups.into_iter().map(|group| Path::new(mounted).join(group).join("cpu.rt_runtime_us")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const MOUNTS: &str = "31 23 0:28 / /sys/fs/cgroup rw - tmpfs tmpfs rw\n\
                          32 31 0:29 / /sys/fs/cgroup/cpu rw,relatime shared:9 - cgroup cgroup rw,cpu,cpuacct\n\
                          33 31 0:31 / /sys/fs/cgroup/cpuset rw - cgroup cgroup rw,cpuset\n";

    fn machine(cgroups: &str, budgets: &[(&str, &str)]) -> tempfile::TempDir {
        let root = tempfile::tempdir().unwrap();
        let write = |path: &str, text: &str| {
            let path = root.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        };
        write("proc/self/cgroup", cgroups);
        write("proc/self/mountinfo", MOUNTS);
        budgets.iter().for_each(|(group, text)| write(&format!("sys/fs/cgroup/cpu/{group}cpu.rt_runtime_us"), text));
        root
    }

    #[test]
    fn an_empty_budget_is_found_in_every_group_that_has_one() {
        let budgets = [("", "950000\n"), ("a/", "0\n"), ("a/b/", "0\n")];
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
            let _ = find(cgroups, mounts);
        }
    }
}

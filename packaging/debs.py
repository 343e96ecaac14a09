"""Unpacks Debian's packages for any architecture, without privileges and without installing them."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

# Lists and packages of its own, from the sources that apt is configured with.
CONFIGURATION = """\
Dir::State::Lists "{apt}/lists";
Dir::State::status "{apt}/status";
Dir::Cache "{apt}/cache";
APT::Architecture "{architecture}";
APT::Architectures {{ "{architecture}"; }};
APT::Sandbox::User "";
Acquire::Languages "none";
"""


def must(*command, **options):
    """Runs a command; its failure ends the script."""
    done = subprocess.run(command, **options)
    if done.returncode != 0:
        sys.exit(f"packaging: `{' '.join(map(str, command))}` failed with exit code {done.returncode}")
    return done.stdout


def unpack(directory, architecture, package, needed=".*", also=()):
    """Unpacks a package, those of its dependencies whose names match `needed`, and further packages into a new directory."""
    unpacked = directory.with_name(f"{directory.name}.unpacked")
    apt = directory.with_name(f"{directory.name}.apt")
    for old in [unpacked, apt]:
        shutil.rmtree(old, ignore_errors=True)
    for name in ["lists/partial", "cache/archives/partial", "debs"]:
        (apt / name).mkdir(parents=True)
    (apt / "status").touch()
    (apt / "apt.conf").write_text(CONFIGURATION.format(apt=apt, architecture=architecture))
    options = {"env": os.environ | {"APT_CONFIG": str(apt / "apt.conf")}, "cwd": apt / "debs"}
    must("apt-get", "update", "-qq", **options)
    words = ["apt-cache", "depends", "--recurse", "--important", package]
    depends = must(*words, stdout=subprocess.PIPE, text=True, **options).split()
    # Words in angle brackets are names that other packages provide.
    names = {name for name in depends if re.fullmatch(r"[a-z0-9][a-z0-9.+-]+", name) and re.fullmatch(needed, name)}
    must("apt-get", "download", "-qq", *sorted(names), *also, **options)
    for deb in sorted((apt / "debs").glob("*.deb")):
        must("dpkg-deb", "-x", deb, unpacked)
    shutil.rmtree(apt)
    unpacked.rename(directory)

"""The package: documented examples, the command line, the pytest fixture, and leftover files."""

import doctest
import os
import subprocess
import sys

import numpy as np
import pytest

import corotate
import corotate.inputs
import corotate.logs
import corotate.run
import corotate.seat
from conftest import euler

RUN = sys.modules["corotate.run"]


@pytest.mark.parametrize("module", [corotate, RUN, *(sys.modules[f"corotate.{name}"] for name in ("inputs", "seat", "logs"))])
def test_documented_examples_run(module, tmp_path):
    found = doctest.testmod(module, extraglobs={"tmp": tmp_path, "np": np, "euler": euler, "corotate": corotate})
    assert found.attempted > 0 and found.failed == 0


def test_the_module_has_the_command_line_of_the_program(tmp_path):
    module = [sys.executable, "-m", "corotate"]
    done = subprocess.run([*module, "run", "rigid-pair", "--clock", "lockstep", "--out", str(tmp_path / "run")], capture_output=True, text=True)
    assert done.returncode == 0 and "PASS" in done.stdout, done
    assert subprocess.run([*module, "run", "rigid-pear"], capture_output=True).returncode == 2
    assert "Usage: corotate" in subprocess.run([*module, "--help"], capture_output=True, text=True).stdout


def test_a_run_leaves_no_files_in_the_runtime_directory(tmp_path):
    corotate.run("rigid-pair", set={"duration_s": 1, "accept": {}}, out=tmp_path / "run")
    left = os.path.join(os.environ["XDG_RUNTIME_DIR"], "corotate")
    assert not os.path.exists(left) or not os.listdir(left)


def test_the_fixture_runs_scenarios_and_reports_failures(pytester):
    pytester.makepyfile("""
        def test_holds(corotate_run):
            assert corotate_run("rigid-pair", clock="in-process").accepted

        def test_fails(corotate_run):
            assert not corotate_run("rigid-pair", clock="in-process").accepted
    """)
    result = pytester.runpytest_subprocess("--junitxml=junit.xml")
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["*report.html*"])
    assert "corotate.hash" in (pytester.path / "junit.xml").read_text()

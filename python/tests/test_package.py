"""The package itself: examples in the documentation, the command line, the fixture, what is left behind."""

import doctest
import os
import subprocess
import sys

import numpy as np
import pytest

import corotate
import corotate.logs
import corotate.run
import corotate.seat
from conftest import euler

RUN = sys.modules["corotate.run"]


@pytest.mark.parametrize("module", [corotate, RUN, sys.modules["corotate.seat"], sys.modules["corotate.logs"]])
def test_the_examples_run(module, tmp_path):
    found = doctest.testmod(module, extraglobs={"tmp": tmp_path, "np": np, "euler": euler, "corotate": corotate})
    assert found.attempted > 0 and found.failed == 0


def test_the_command_line_is_the_program_s(tmp_path):
    line = [sys.executable, "-m", "corotate"]
    told = subprocess.run([*line, "run", "rigid-pair", "--clock", "lockstep", "--out", str(tmp_path / "run")], capture_output=True, text=True)
    assert told.returncode == 0 and "PASS" in told.stdout, told
    assert subprocess.run([*line, "run", "rigid-pear"], capture_output=True).returncode == 2
    assert "Usage: corotate" in subprocess.run([*line, "--help"], capture_output=True, text=True).stdout


def test_nothing_is_left_behind(tmp_path):
    corotate.run("rigid-pair", set={"duration_s": 1, "accept": {}}, out=tmp_path / "run")
    left = os.path.join(os.environ["XDG_RUNTIME_DIR"], "corotate")
    assert not os.path.exists(left) or not os.listdir(left)


def test_the_fixture_gives_runs_and_the_report_of_what_fails(pytester):
    pytester.makepyfile("""
        def test_holds(corotate_run):
            assert corotate_run("rigid-pair", clock="in-process").accepted

        def test_fails(corotate_run):
            assert not corotate_run("rigid-pair", clock="in-process").accepted
    """)
    result = pytester.runpytest_subprocess("--junitxml=junit.xml")
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["*corotate: its report is *report.html*"])
    assert "corotate.hash" in (pytester.path / "junit.xml").read_text()

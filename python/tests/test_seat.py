"""A role as a Python loop that joins a run of another process."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest

import corotate


def start(tmp_path, *options):
    command = [sys.executable, "-m", "corotate", "run", "rigid-pair", "--external", "controller", "--events", "--out", str(tmp_path / "run"),
            "--set", "accept={}", *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)


def events(run):
    with run.stdout:
        return [json.loads(line) for line in run.stdout]


def test_a_python_loop_can_be_the_controller(tmp_path, law):
    reference = corotate.run("rigid-pair", clock="lockstep", set={"duration_s": 3, "accept": {}}, record=True, out=tmp_path / "ref")
    run = start(tmp_path, "--clock", "lockstep", "--duration", "3", "--record")
    seat = json.loads(run.stdout.readline())["seats"]["controller"]
    ticks = 0
    for tick, inputs, outputs in corotate.Seat(seat, "controller"):
        law(tick, inputs, outputs)
        ticks += 1
    received = events(run)
    assert run.wait() == 0 and ticks == 3001
    assert [event["event"] for event in received] == ["running", "results", "verdict"]
    assert received[-1]["exit"] == 0 and received[1]["directory"] == str(tmp_path / "run")
    name = "follower/command.acceleration_rad_s2"
    assert np.array_equal(corotate.Recording(tmp_path / "run").array(name), reference.recording.array(name))


def test_a_run_is_found_by_its_results_directory(tmp_path):
    run = start(tmp_path, "--clock", "realtime", "--tick-hz", "100", "--duration", "1")
    assert sum(1 for _ in corotate.Seat(tmp_path / "run", "controller")) > 10
    assert events(run)[-1]["event"] == "verdict" and run.wait() == 0


def test_leaving_the_loop_early_is_an_incident(tmp_path):
    run = start(tmp_path, "--clock", "lockstep", "--duration", "1000")
    for tick, inputs, outputs in corotate.Seat(tmp_path / "run", "controller"):
        if tick == 50:
            break
    received = events(run)
    assert run.wait() == 4 and received[2]["event"] == "incident", received
    assert received[2]["incident"]["role"] == "controller"


def test_joining_without_a_run_raises(tmp_path):
    from corotate import seat
    with pytest.raises(corotate.CorotateError, match=re.escape(str(tmp_path))):
        seat._domain(tmp_path, wait_s=0.1)
    reads, writes = seat.layout("rigid-trio", "controller")
    assert [signal for _, signal, _ in writes] == ["command"] * 2 and [signal for _, signal, _ in reads][0] == "estimate"

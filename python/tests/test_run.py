"""Runs: verdicts, bits, roles in Python, and errors."""

import os
import signal
import threading
import time

import numpy as np
import pytest

import controllers
import corotate

SHORT = {"duration_s": 3, "accept": {}}


def commands(run):
    return run.recording.array("follower/command.acceleration_rad_s2")


def test_a_run_has_the_same_bits_by_every_clock(tmp_path):
    runs = [corotate.run("rigid-pair", clock=clock, out=tmp_path / clock) for clock in ("in-process", "lockstep")]
    assert [run.accepted for run in runs] == [True, True]
    assert runs[0].hash == runs[1].hash
    assert runs[0].metrics["sync_error_rad_s"]["settled_max"] < 1e-9
    assert "accepted" in repr(runs[0]) and (tmp_path / "lockstep/summary.json").exists()


def test_a_controller_in_python_has_the_bits_of_the_built_in_controller(tmp_path, law):
    built_in = corotate.run("rigid-pair", clock="lockstep", set=SHORT, record=True, out=tmp_path / "built-in")
    for where, function in (("thread", law), ("process", controllers.controller)):
        own = corotate.run("rigid-pair", clock="lockstep", set=SHORT, record=True, roles={"controller": function}, roles_in=where,
                           out=tmp_path / where)
        assert np.array_equal(commands(own), commands(built_in)), where
        for signal_name in ("leader/estimate", "follower/truth"):
            rates, expected = (run.recording.array(f"{signal_name}.omega_rad_s") for run in (own, built_in))
            assert np.array_equal(rates, expected)
        assert own.summary["books"]["balanced"] and own.summary["books"]["roles"]["controller"]["executed"] == 3001
    stepped = corotate.run("rigid-pair", clock="in-process", set=SHORT, roles={"controller": law}, out=tmp_path / "stepped")
    assert stepped.hash == own.hash
    assert stepped.metrics["sync_error_rad_s"]["last"] == built_in.metrics["sync_error_rad_s"]["last"]


def test_a_run_in_real_time_has_late_ticks(tmp_path):
    # Every tick is late.
    run = corotate.run("rigid-pair", clock="realtime", set={**SHORT, "duration_s": 1, "realtime.late_us": 0}, out=tmp_path / "late")
    assert run.summary["late"]["examined"] == sum(late["ticks"] for late in run.late) > 100
    assert {late["role"] for late in run.late} <= {"leader", "observer", "controller", "follower"}
    times = [late["time_s"] for late in run.late]
    assert times == sorted(times)
    for late in run.late:
        assert late["kind"] in ("late", "missed", "starved") and late["time_s"] == pytest.approx(late["tick"] / 1000)
        assert sum(cause["us"] for cause in late["causes"]) <= late["late_us"] * 1.001
        assert all(cause["kind"] and cause["words"] for cause in late["causes"])
    worst = max(run.late, key=lambda late: late["late_us"])
    assert worst["late_us"] == run.summary["late"]["ticks"][0]["late_us"]

    off = corotate.run("rigid-pair", clock="realtime", set={**SHORT, "duration_s": 0.5, "realtime.trace": "off"}, out=tmp_path / "off")
    lockstep = corotate.run("rigid-pair", clock="lockstep", set={**SHORT, "duration_s": 0.5}, out=tmp_path / "lockstep")
    assert off.late is None and lockstep.late is None


def test_an_observer_and_a_body_can_be_in_python(tmp_path):
    def observer(tick, inputs, outputs):
        # A constant guess of the hidden component.
        if inputs.measurement is not None:
            outputs.estimate.omega_rad_s = [*inputs.measurement.omega_rad_s[:2], 0.8]

    def follower(tick, inputs, outputs):
        if inputs.command is not None:
            state[:] += 1e-3 * inputs.command.acceleration_rad_s2
        outputs.measurement.omega_rad_s = state

    run = corotate.run("rigid-pair", clock="lockstep", set=SHORT, record=True, roles={"observer": observer}, out=tmp_path / "observer")
    estimates = run.recording.array("leader/estimate.omega_rad_s")
    assert len(estimates) == 3001 and (estimates[:, 2] == 0.8).all()
    state = np.array([-0.3, 0.5, 0.2])
    run = corotate.run("rigid-pair", clock="lockstep", set={**SHORT, "limits": {}}, record=True, roles={"follower": follower},
                       out=tmp_path / "follower")
    truth, measured = (run.recording.array(f"follower/{signal}.omega_rad_s") for signal in ("truth", "measurement"))
    assert np.array_equal(truth, measured), "truth defaults to the measurement"
    assert run.metrics["sync_error_rad_s"]["last"] < 0.1


def test_ticks_missed_by_python_are_counted_in_real_time(tmp_path, law):
    run = corotate.run("rigid-pair", clock="realtime", set={**SHORT, "tick_hz": 100}, roles={"controller": law}, out=tmp_path / "rt")
    counters = run.summary["books"]["roles"]["controller"]
    assert run.summary["books"]["balanced"] and counters["executed"] + counters["missed"] == counters["elapsed"]
    assert counters["executed"] > 100


def test_an_output_is_read_only_after_its_tick_and_inputs_are_copies(tmp_path):
    kept = []

    def controller(tick, inputs, outputs):
        if kept:
            with pytest.raises(ValueError, match="read-only"):
                kept[-1][1].command.acceleration_rad_s2 = 1.0
        kept.append((inputs, outputs))

    corotate.run("rigid-pair", clock="in-process", set={"duration_s": 0.05, "accept": {}}, roles={"controller": controller},
                 out=tmp_path / "kept")
    first, last = kept[0][0].estimate.omega_rad_s, kept[-1][0].estimate.omega_rad_s
    assert not np.array_equal(first, last) and not first.flags.writeable


def test_wrong_arguments_raise_with_their_name(tmp_path):
    for scenario, options, name in [
        ("rigid-pear", {}, "rigid-pear"),
        (tmp_path / "none.toml", {}, "none.toml"),
        ("rigid-pair", {"set": {"leader.measured_axis": [1]}}, "measured_axis"),
        ("rigid-pair", {"set": {"duration_s": -1}}, "duration_s"),
        ("rigid-pair", {"clock": "wall"}, "wall"),
        ("rigid-pair", {"roles": {"pilot": print}}, "pilot"),
        ("rigid-pair", {"clock": "in-process", "roles": {"observer": print}}, "clock='lockstep'"),
        ({"rig": "rigid-body"}, {}, "duration_s"),
    ]:
        with pytest.raises(ValueError, match=name):
            corotate.run(scenario, out=tmp_path / "mistake", **options)


def test_a_scenario_may_be_a_dictionary(tmp_path):
    import tomllib
    text = corotate.run("rigid-pair", clock="in-process", record=True, out=tmp_path / "a").recording.toml
    run = corotate.run({**tomllib.loads(text), "clock": "in-process"}, clock="in-process", out=tmp_path / "b")
    assert run.accepted


def test_a_timeout_and_ctrl_c_end_a_run_in_order(tmp_path):
    with pytest.raises(TimeoutError):
        corotate.run("rigid-pair", set={"duration_s": 100_000, "accept": {}}, timeout_s=1, out=tmp_path / "late")
    left = os.path.join(os.environ["XDG_RUNTIME_DIR"], "corotate")
    assert not os.path.exists(left) or not os.listdir(left)
    # A process that a shell starts in the background ignores SIGINT.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        threading.Timer(1.0, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
        began = time.monotonic()
        with pytest.raises(KeyboardInterrupt):
            corotate.run("rigid-pair", set={"duration_s": 100_000, "accept": {}}, out=tmp_path / "ctrl-c")
    finally:
        signal.signal(signal.SIGINT, before)
    assert time.monotonic() - began < 60
    assert (tmp_path / "ctrl-c/summary.json").exists()


def test_the_certificate_of_a_loop_has_its_rate():
    [certificate] = corotate.certificate("rigid-pair")
    assert certificate["body"] == "follower" and 3.9 < certificate["loop_rate_per_s"] < 4.1
    assert corotate.certificate("inertia") == []

"""Inputs that change while a loop runs: from another thread, in stepped loops, and the frequency response that they show."""

import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import corotate

OFFSET, DISTURBANCE, GAIN = "follower.0.offset_rad_s", "follower.0.disturbance_rad_s2", "controller.gain_per_s"
# The leader rests, so that the loop about each axis is linear.
AT_REST = {"leader.initial_rate_rad_s": [0, 0, 0], "follower.0.initial_rate_rad_s": [0, 0, 0], "observer.initial_guess_rad_s": 0,
           "limits.rate_rad_s": 1.0, "accept": {}}


@contextmanager
def started(scenario, clock, out):
    """Runs a scenario without end in another process."""
    command = [sys.executable, "-m", "corotate", "run", scenario, "--clock", clock, "--duration", "100000", "--set", "accept={}",
               "--set", "realtime.trace=\"off\"", "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as run:
        try:
            yield
        finally:
            run.terminate()


@pytest.fixture(params=["realtime", "lockstep"])
def running(request, tmp_path):
    """The results directory of a running run."""
    with started("rigid-pair", request.param, tmp_path / "run"):
        yield tmp_path / "run"


def code_of(call, *arguments, **options):
    with pytest.raises(corotate.CorotateError) as refused:
        call(*arguments, **options)
    assert str(refused.value)
    return refused.value.code


def test_set_changes_a_running_loop_and_get_returns_its_values(running):
    values = corotate.get(running, wait_s=30)
    assert values[GAIN] == [4.0, 4.0, 4.0] and values["actuator.safe"] is False and OFFSET in values
    first = corotate.set({GAIN: np.array([6, 5, 4.5]), "actuator.safe": np.bool_(True)}, running)
    assert first.time_s == pytest.approx(first.tick * 1e-3)
    later = corotate.set({"follower[0].offset_rad_s": [0, 0, 0.1]}, at_tick=first.tick + 200_000, ramp_s=0.5)
    assert later.tick == first.tick + 200_000
    while (values := corotate.get())[GAIN] == [4.0, 4.0, 4.0]:
        pass
    assert values[GAIN] == [6.0, 5.0, 4.5] and values["actuator.safe"] is True and values[OFFSET] == [0.0, 0.0, 0.0]
    # In real time a change acts soon.
    assert first.delay_ms is None or 0 <= first.delay_ms < 1000


def test_a_refused_change_raises_with_its_code(running):
    corotate.get(running, wait_s=30)
    for values, options, code in [
        ({"leader.inertia_kg_m2": [1, 2, 3]}, {}, "not-tunable"),
        ({GAIN: [1, 2]}, {}, "wrong-length"),
        ({GAIN: [1, 2, float("nan")]}, {}, "not-finite"),
        ({GAIN: [1, 2, 1500]}, {}, "unstable-loop"),
        ({OFFSET: [0, 0, 1e6]}, {}, "out-of-range"),
        ({OFFSET: [0, 0, 0.1]}, {"ramp_s": float("inf")}, "out-of-range"),
        ({OFFSET: [0, 0, 0.1]}, {"ramp_s": -1}, "out-of-range"),
        ({"actuator.safe": 1}, {}, "wrong-type"),
        ({"actuator.safe": True}, {"ramp_s": 1}, "wrong-shape"),
        ({GAIN: [5, 5, 5]}, {"at_tick": 0}, "too-early"),
        ({GAIN: [5, 5, 5]}, {"at_tick": 10**12}, "after-end"),
        ({}, {}, "no-change"),
        # All or none.
        ({GAIN: [6, 6, 6], "observer.decay_rate_per_s": -1}, {}, "not-positive"),
    ]:
        assert code_of(corotate.set, values, running, **options) == code, values
    assert corotate.get(running)[GAIN] == [4.0, 4.0, 4.0]
    assert code_of(corotate.set, {GAIN: [1, 2, 1500]}, running, force=True) == "unstable-loop", "no scenario may have it"


def test_force_sets_gains_with_which_the_loop_does_not_converge(tmp_path):
    key = "controller.gain.radial_per_s"
    with started("orbit-hold", "realtime", tmp_path / "run"):
        corotate.get(tmp_path / "run", wait_s=30)
        assert code_of(corotate.set, {key: 300.0}, tmp_path / "run") == "unstable-loop"
        change = corotate.set({key: 300.0}, tmp_path / "run", force=True)
        assert change.delay_ms > 0


def test_without_a_running_run_the_error_has_a_code(tmp_path):
    assert code_of(corotate.get) == code_of(corotate.set, {GAIN: [5, 5, 5]}) == "no-run"
    assert code_of(corotate.get, tmp_path) == "not-a-domain"
    corotate.run("rigid-pair", clock="in-process", set={"duration_s": 0.1, "accept": {}}, out=tmp_path / "over")
    assert code_of(corotate.get, tmp_path / "over", wait_s=0.1) == "run-over"
    assert corotate.CorotateError("other").code is None


def test_a_received_change_is_in_the_results_and_has_the_bits_of_a_scripted_one(tmp_path):
    def controller(tick, inputs, outputs):
        # In lockstep the run waits for this function, and so for the change.
        if tick == 100:
            changes.append(corotate.set({DISTURBANCE: [0, 0, 0.05]}, tmp_path / "run", wait_s=30))

    changes = []
    with ThreadPoolExecutor() as pool:
        ended = pool.submit(corotate.run, "rigid-pair", set={"duration_s": 2, "accept": {}}, roles={"controller": controller},
                            record=True, out=tmp_path / "run")
        run = ended.result()
    [change], [listed] = changes, run.summary["inputs"]
    assert (listed["tick"], listed["key"], listed["value"], listed["received"]) == (change.tick, DISTURBANCE, [0.0, 0.0, 0.05], True)
    scripted = {"duration_s": 2, "accept": {}, "input": [{"at_s": change.time_s, "key": DISTURBANCE, "value": [0.0, 0.0, 0.05]}]}
    again = corotate.run("rigid-pair", clock="in-process", set=scripted, roles={"controller": lambda *_: None}, out=tmp_path / "again")
    assert again.hash == run.hash


def test_an_environment_changes_its_inputs():
    pytest.importorskip("gymnasium")
    env = corotate.Env("rigid-pair", set={**AT_REST, "duration_s": 1})
    with pytest.raises(RuntimeError, match=r"\breset\(\)"):
        env.set_input(DISTURBANCE, [0, 0, 0.5])
    rate = env.observation_names.index("follower/measurement.omega_rad_s[2]")
    for _ in range(2):
        # A new episode begins with the values of the scenario.
        rates = [env.reset(seed=1)[0][rate]]
        for tick in range(100):
            if tick == 10:
                assert env.set_input(DISTURBANCE, np.array([0, 0, 0.5])) == 11
            if tick == 60:
                assert env.set_input("follower[0].disturbance_rad_s2", [0, 0, 0]) == 61
            rates.append(env.step(np.zeros(3))[0][rate])
        # The disturbance acts on the motion from tick 11 to tick 12 on, for 50 ticks.
        expected = 0.5e-3 * np.clip(np.arange(101) - 11, 0, 50)
        assert np.allclose(rates, expected, rtol=0, atol=1e-12)
    for key, value, code in [("leader.inertia_kg_m2", [1, 2, 3], "not-tunable"), (DISTURBANCE, [1, 2], "wrong-type"),
                             (DISTURBANCE, [0, 0, 1e9], "out-of-range"), (GAIN, [5, 5, 5], "external-role")]:
        assert code_of(env.set_input, key, value) == code
    summary = env.summary()
    assert [(change["tick"], change["received"]) for change in summary["inputs"]] == [(11, True), (61, True)]
    scripted = [{"at_s": at_s, "key": DISTURBANCE, "value": value} for at_s, value in ((0.011, [0.0, 0.0, 0.5]), (0.061, [0.0, 0.0, 0.0]))]
    again = corotate.Env("rigid-pair", set={**AT_REST, "duration_s": 1, "input": scripted})
    again.reset(seed=1)
    for _ in range(100):
        again.step(np.zeros(3))
    assert again.summary()["state"]["hash"] == summary["state"]["hash"]


def test_an_environment_follows_a_new_set_point_in_its_reward():
    pytest.importorskip("gymnasium")
    env = corotate.Env("rigid-pair", set={**AT_REST, "duration_s": 0.01})
    env.reset()
    assert env.step(np.zeros(3))[1] == 0
    assert env.set_input(OFFSET, [0, 0, 0.3]) == 2
    assert [env.step(np.zeros(3))[1] for _ in range(2)] == [0, -0.3]
    while not env.step(np.zeros(3))[3]:
        # The last change comes after the last tick.
        env.set_input(OFFSET, [0, 0, 0.2])
    assert code_of(env.set_input, OFFSET, [0, 0, 0.1]) is None
    for _ in range(2):
        env.reset()
        assert env.step(np.zeros(3))[1] == 0


def test_an_episode_takes_a_limited_number_of_changes():
    pytest.importorskip("gymnasium")
    env = corotate.Env("rigid-pair")
    env.reset()
    for _ in range(4096):
        env.set_input(DISTURBANCE, [0, 0, 0])
    assert code_of(env.set_input, DISTURBANCE, [0, 0, 0]) == "too-many"
    env.reset()
    env.set_input(DISTURBANCE, [0, 0, 0])


def chirp(n, ticks, frequency, end_frequency):
    """Returns a sine whose frequency, in cycles per tick, changes linearly."""
    return np.sin(2 * np.pi * (frequency * n + 0.5 * (end_frequency - frequency) / ticks * n**2))


def mix(z):
    """Returns the finaliser of SplitMix64."""
    z = (z + 0x9E3779B97F4A7C15) % 2**64
    z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9 % 2**64
    z = (z ^ z >> 27) * 0x94D049BB133111EB % 2**64
    return z ^ z >> 31


def binary_sequence(n, hold_ticks, seed):
    """Returns plus or minus one, by the first bit of a number for each value that is held."""
    signs = [-1.0 if mix(mix(seed) ^ index << 32) >> 63 else 1.0 for index in range(len(n) // hold_ticks)]
    return np.repeat(signs, hold_ticks)


@pytest.mark.parametrize("shape, values", [
    ({"shape": "chirp", "frequency_hz": 0.1, "end_frequency_hz": 30.0}, lambda n: chirp(n, len(n), 0.1e-3, 30e-3)),
    ({"shape": "prbs", "hold_s": 0.01, "seed": 7}, lambda n: binary_sequence(n, 10, 7))], ids=["chirp", "prbs"])
def test_the_frequency_response_is_that_of_the_difference_equation(tmp_path, shape, values):
    control = pytest.importorskip("control")
    tick_s, gain_per_s, begin, ticks = 1e-3, 4.0, 1000, 60_000
    excitation = {"at_s": begin * tick_s, "key": OFFSET, "value": [0.0, 0.0, 0.2], "duration_s": ticks * tick_s, **shape}
    run = corotate.run("rigid-pair", clock="in-process", set={**AT_REST, "duration_s": 80, "input": [excitation]}, record=True,
                       out=tmp_path / "run")
    rates = run.recording.array("follower/truth.omega_rad_s")[:, 2]
    set_points = np.zeros(len(rates))
    set_points[begin:begin + ticks] = 0.2 * values(np.arange(ticks))
    # The run begins and ends at rest, so the quotient of the two spectra is the response, without leakage.
    frequencies = np.fft.rfftfreq(len(rates), tick_s)
    excited = (frequencies >= 0.2) & (frequencies <= 25.0)
    measured = (np.fft.rfft(rates) / np.fft.rfft(set_points))[excited]
    # p(k + 1) = p(k) + h u(k - 1), u(k) = -g (p(k) - r(k)).
    loop = control.tf([gain_per_s * tick_s], [1, -1, gain_per_s * tick_s], tick_s)
    expected = control.frequency_response(loop, 2 * np.pi * frequencies[excited]).complex
    assert excited.sum() > 1900
    assert np.abs(np.abs(measured / expected) - 1).max() < 1e-9
    assert np.abs(np.angle(measured / expected)).max() < 1e-9


def test_the_example_of_the_manual_runs(tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs/python.md").read_text()
    section = page.split("## Change inputs while it runs", 1)[1].split("\n## ", 1)[0]
    monkeypatch.chdir(tmp_path)
    names = {"corotate": corotate}
    for example in re.findall(r"```python\n(.*?)```", section, re.S):
        exec(example, names)
    assert names["run"].summary["inputs"]

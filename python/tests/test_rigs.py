"""Roles in Python at rigs that this package does not know: examples/cart-pole and examples/motor-pair, in every clock."""

import json
import subprocess
import sys
import time
import traceback
from pathlib import Path

import numpy as np
import pytest

import corotate
from controllers import FRICTION_N_M_S, GAIN, INERTIA_KG_M2, SOON_S, Fails, cart_pole, feedback, motor_pair

ROOT = Path(__file__).resolve().parents[2]
CONTROLLERS = {"cart-pole": cart_pole, "motor-pair": motor_pair}
# The slowest mode of cart-pole at its equilibrium, 1/s, as in tests/runs/one_plant.rs.
RATE_PER_S = 2.029456
EVERYWHERE = pytest.mark.parametrize("clock, where", [
    ("in-process", "thread"), ("lockstep", "thread"), ("lockstep", "process"), ("realtime", "thread"), ("realtime", "process")])


def program(name):
    return ROOT / "target/release" / name


def run(name, tmp_path, **options):
    return corotate.run(name, program=program(name), out=tmp_path / "run", **options)


def start(tmp_path, clock, *options):
    """Starts cart-pole, which waits for its controller."""
    command = [program("cart-pole"), "run", "cart-pole", "--external", "controller", "--clock", clock, "--json", "--out", tmp_path / "run"]
    return subprocess.Popen([*command, *options], stdout=subprocess.PIPE, text=True)


@pytest.fixture
def example(tmp_path):
    """The example's controller as a process, at the run that the test starts."""
    return lambda: subprocess.Popen([sys.executable, ROOT / "examples/python/cart_pole.py", tmp_path / "run"])


def test_the_example_has_the_hash_of_the_law_in_rust(tmp_path, example):
    built_in = corotate.run("cart-pole", program=program("cart-pole"), clock="in-process", out=tmp_path / "built-in")
    waiting, controller = start(tmp_path, "lockstep"), example()
    summary = json.loads(waiting.communicate()[0])
    assert (waiting.returncode, controller.wait()) == (0, 0)
    assert summary["state"]["hash"] == built_in.hash and summary["accepted"] is True and built_in.accepted is True


def test_the_example_balances_the_pole_in_real_time(tmp_path, example):
    waiting, controller = start(tmp_path, "realtime", "--set", "accept={}", "--set", "input=[]", "--duration", "11"), example()
    summary = json.loads(waiting.communicate()[0])
    assert (waiting.returncode, controller.wait()) == (0, 0)
    # A loaded machine may miss ticks.
    assert summary["state"]["elapsed_ticks"] == 1101 and summary["books"]["roles"]["controller"]["executed"] > 500
    last = {metric["name"]: metric["last"] for metric in summary["score"]["metrics"]}
    assert last["position_error_m"] < 0.1 and last["angle_rad"] < 0.1, last


@EVERYWHERE
@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_function_has_the_hash_of_the_law_in_rust(tmp_path, name, clock, where):
    brief = {"duration_s": 2, "accept": {}}
    own = run(name, tmp_path, clock=clock, set=brief, roles={"controller": CONTROLLERS[name]}, roles_in=where)
    assert own.summary["incidents"] == [] and own.summary["books"]["balanced"]
    if clock != "realtime":
        assert own.hash == corotate.run(name, program=program(name), clock="in-process", set=brief, out=tmp_path / "built-in").hash


@EVERYWHERE
@pytest.mark.parametrize("name", CONTROLLERS)
@pytest.mark.parametrize("tick", [0, 1, 60])
def test_an_exception_at_any_tick_is_raised_soon(tmp_path, name, clock, where, tick):
    patient = {"tick_hz": 100, "duration_s": 60, "accept": {}, "supervision.heartbeat_timeout_s": 3600.0}
    with pytest.raises(AttributeError) as caught:
        run(name, tmp_path, clock=clock, set=patient, roles={"controller": Fails("typo", tick, tmp_path / "at")}, roles_in=where)
    took_s = time.time() - float((tmp_path / "at").read_text().split()[1])
    assert took_s < SOON_S, took_s
    text = "".join(traceback.format_exception(caught.value))
    assert "in typo" in text and "controllers.py" in text
    if clock != "in-process":
        [incident] = caught.value.run.summary["incidents"]
        assert incident["role"] == "controller" and "in typo" in incident["last_words"]


@pytest.mark.parametrize("clock", ["lockstep", "realtime"])
def test_a_loop_over_a_seat_that_raises_ends_its_run_soon(tmp_path, clock):
    waiting = start(tmp_path, clock, "--set", "supervision.heartbeat_timeout_s=3600", "--set", "accept={}", "--duration", "1000")
    with pytest.raises(ZeroDivisionError):
        for tick, _, _ in corotate.Seat(tmp_path / "run", "controller"):
            raised_s = time.monotonic()
            tick / 0
    summary = json.loads(waiting.communicate()[0])
    assert time.monotonic() - raised_s < SOON_S
    assert waiting.returncode == 4 and summary["incidents"][0]["role"] == "controller"


def test_an_environment_observes_the_reference(tmp_path):
    env = corotate.Env("cart-pole", program=program("cart-pole"))
    assert env.observation_names[-1] == "reference.position_m"
    names = [f"cart/estimate.{name}" for name in ("position_m", "speed_m_s", "angle_rad", "rate_rad_s")]
    seen = [env.observation_names.index(name) for name in names]
    observation, truncated, tick = env.reset(seed=1)[0], False, 0
    while not truncated:
        assert observation[-1] == 0.5 * (tick >= 500), tick
        observation, _, _, truncated, _ = env.step([feedback(observation[seen], observation[-1])])
        tick += 1
    summary = env.summary()
    assert summary["accepted"] is True and len(summary["criteria"]) >= 3
    built_in = corotate.run("cart-pole", program=program("cart-pole"), clock="in-process", set={"seed": 1}, out=tmp_path / "built-in")
    assert summary["state"]["hash"] == built_in.hash
    env.reset()
    assert env.set_input("reference.position_m", 0.2) == 1 and env.step([0.0])[0][-1] == 0.2
    env.close()


@pytest.mark.parametrize("clock", ["in-process", "lockstep"])
def test_a_role_sees_the_inputs_that_it_uses(tmp_path, clock):
    change = {"at_s": 0.5, "key": "controller.gain_per_s", "value": [6.0, 5.0, 4.5]}
    seen = []

    def watches(tick, inputs, outputs):
        seen.append(inputs.value("controller.gain_per_s").tolist())
        if tick == 0:
            with pytest.raises(KeyError, match="controller.gain_per_s"):
                inputs.value("seed")

    corotate.run("rigid-pair", clock=clock, set={"duration_s": 1, "accept": {}, "limits": {}, "input": [change]},
                 roles={"controller": watches}, out=tmp_path / "run")
    assert seen[0] == seen[499] == [4.0, 4.0, 4.0] and seen[500] == seen[1000] == [6.0, 5.0, 4.5]


def test_the_linearised_loop_has_the_rate_that_was_computed_independently():
    control = pytest.importorskip("control")
    system = corotate.to_control("cart-pole", program=program("cart-pole"), tick=490)
    linear = control.linearize(system, system.x0, system.u0)
    outputs = [system.output_labels.index(f"cart/estimate {name}") for name in ("position_m", "speed_m_s", "angle_rad", "rate_rad_s")]
    feedback_row = np.zeros((1, system.noutputs))
    feedback_row[0, outputs] = GAIN
    # The command is on its way for a tick, so D is zero.
    closed = linear.A - linear.B @ feedback_row @ linear.C
    rates = -np.log(np.abs(np.linalg.eigvals(closed)[np.abs(np.linalg.eigvals(closed)) > 1e-6])) / system.dt
    assert np.abs(linear.D).max() == 0 and rates.min() == pytest.approx(RATE_PER_S, rel=1e-4)


def test_a_slower_controller_makes_longer_steps():
    control = pytest.importorskip("control")
    slow = {"controller.every_ticks": 4, "accept": {}}
    system = corotate.to_control("motor-pair", program=program("motor-pair"), set=slow, tick=2000)
    assert system.dt == pytest.approx(4e-3)
    linear = control.linearize(system, system.x0, system.u0)
    follower = system.state_labels.index("follower[0]")
    # Four ticks of the motor's decay.
    assert linear.A[follower, follower] == pytest.approx(np.exp(-FRICTION_N_M_S / INERTIA_KG_M2 * 4e-3), rel=1e-6)
    with pytest.raises(ValueError, match=r"\b4\b"):
        corotate.to_control("motor-pair", program=program("motor-pair"), set=slow, tick=2001)


def test_a_tick_after_the_last_one_is_refused():
    pytest.importorskip("control")
    with pytest.raises(ValueError, match="duration_s"):
        corotate.to_control("motor-pair", program=program("motor-pair"), tick=10_002)


def test_a_loop_without_a_state_is_refused(monkeypatch):
    pytest.importorskip("control")
    from corotate.steps import Steps
    monkeypatch.setattr(Steps, "state", lambda self: np.full(len(self.state_names), np.nan))
    with pytest.raises(ValueError, match="persist_fields"):
        corotate.to_control("cart-pole", program=program("cart-pole"))

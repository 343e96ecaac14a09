"""Any program built on corotate: examples/motor-pair, whose rig this package does not know."""

import copy
import os
import re
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import corotate

PROGRAM = Path(__file__).resolve().parents[2] / "target/release/motor-pair"
# Parameters of the shipped scenario; its tick, s.
J, B, K, DECAY, GAIN, H = 1e-3, 2e-3, 5e-2, 4.0, 10.0, 1e-3
ENDLESS = {"duration_s": 100_000, "accept": {}}


def law(speed, estimate_speed, rise):
    """The law of motor-pair, in the order of its operations."""
    return (J * (rise - GAIN * (speed - estimate_speed)) + B * speed) / K


def controller(tick, inputs, outputs):
    estimate, own = inputs.estimate, inputs.measurement
    if estimate is not None and own is not None:
        outputs.command.current_a = law(own.speed_rad_s, estimate.speed_rad_s, estimate.rise_rad_s2)


def run(tmp_path, **options):
    return corotate.run("motor-pair", program=PROGRAM, out=tmp_path / "run", **options)


def test_a_run_of_another_program_has_its_verdict_and_recording(tmp_path):
    hashes = set()
    for clock in ("in-process", "lockstep"):
        made = run(tmp_path, clock=clock, record=True, overwrite=True)
        assert made.accepted is True and made.metrics["speed_error_rad_s"]["settled_max"] < 1e-9
        hashes.add(made.hash)
    assert len(hashes) == 1
    recording = made.recording
    assert recording.signals["leader/estimate"]["load_n_m"] == 1 and 'rig = "motor-pair"' in recording.toml
    assert recording.array("leader/estimate.load_n_m")[-1] == pytest.approx(0.02)
    assert len(recording.frame("follower/truth")) == 10_001


def test_a_stepped_controller_has_the_hash_of_the_built_in_one(tmp_path):
    built_in = run(tmp_path, clock="in-process", set={"duration_s": 9})
    own = corotate.run("motor-pair", program=PROGRAM, clock="in-process", set={"duration_s": 9}, roles={"controller": controller},
                       out=tmp_path / "own")
    assert own.hash == built_in.hash and own.accepted is True and (tmp_path / "own/summary.json").exists()
    env = corotate.Env("motor-pair", program=PROGRAM, set={"duration_s": 9})
    names = {name: index for index, name in enumerate(env.observation_names)}
    seen = [names[name] for name in ("follower/measurement.speed_rad_s", "leader/estimate.speed_rad_s", "leader/estimate.rise_rad_s2")]
    observation, truncated = env.reset()[0], False
    while not truncated:
        observation, reward, _, truncated, _ = env.step([law(*observation[seen])])
    summary = env.summary()
    assert summary["state"]["hash"] == built_in.hash and summary["accepted"] is True and summary["criteria"]
    env.close()


def test_an_environment_of_another_program_has_inputs_and_ends_its_process():
    env = corotate.Env("motor-pair", program=PROGRAM, set={"duration_s": 1})
    env.reset(seed=3)
    assert env.set_input("motor.leader_load_n_m", 0.05) == 1
    with pytest.raises(corotate.CorotateError) as caught:
        env.set_input("motor.gain_per_s", 5.0)
    assert caught.value.code == "external-role"
    info = env.step([0.5])[4]
    assert info["applied"].tolist() == [0.5] and (info["rejected"], info["missed"]) == (0, 0)
    with pytest.raises(ValueError, match=r"\b1\b.*\b2\b"):
        env.step([1, 2])
    process = env._session._process
    assert copy.deepcopy(env)._session is None
    env.close()
    assert process.returncode == 0
    env.reset()
    env._session._process.kill()
    with pytest.raises(corotate.CorotateError, match="signal 9"):
        env.step([0.0])
    assert env.reset()[0].shape == (5,)
    env.close()


@pytest.mark.parametrize("scenario, options, code", [
    ("motor-pear", {}, "unknown-scenario"),
    ("none.toml", {}, "cannot-read-scenario"),
    ("motor-pair", {"set": {"duration_s": -1}}, "out-of-range"),
    ("motor-pair", {"set": {"motor.gain": 1}}, "unknown-key"),
    ({"rig": "rigid-body", "tick_hz": 1000.0, "duration_s": 1.0, "name": "other"}, {}, "unknown-rig"),
])
def test_an_invalid_scenario_raises_with_its_code(tmp_path, scenario, options, code):
    makes = [lambda: corotate.run(scenario, program=PROGRAM, out=tmp_path / "run", **options)]
    makes += [lambda: corotate.Env(scenario, program=PROGRAM, **options)]
    for make in makes:
        with pytest.raises(ValueError) as caught:
            make()
        assert caught.value.code == code, caught.value


def test_a_program_that_is_missing_or_not_ours_raises(tmp_path):
    with pytest.raises(FileNotFoundError, match="cart-pole"):
        corotate.run("cart-pole", program=tmp_path / "cart-pole")
    with pytest.raises(corotate.CorotateError, match="exit code 1"):
        corotate.run("x", program="/bin/false")
    with pytest.raises(corotate.CorotateError):
        corotate.Env("x", program="/bin/false")


def test_results_are_not_overwritten_and_a_scenario_may_be_a_dictionary(tmp_path):
    import tomllib
    made = run(tmp_path, clock="in-process", record=True, set={"duration_s": 0.5, "accept": {}})
    with pytest.raises(corotate.CorotateError) as caught:
        run(tmp_path, clock="in-process", set={"duration_s": 0.5, "accept": {}})
    assert caught.value.code == "earlier-run"
    again = corotate.run(tomllib.loads(made.recording.toml), program=PROGRAM, clock="in-process", out=tmp_path / "again")
    assert again.hash == made.hash


def test_ctrl_c_and_a_timeout_end_a_run_of_another_program_in_order(tmp_path):
    with pytest.raises(TimeoutError):
        run(tmp_path, timeout_s=1, set=ENDLESS)
    assert (tmp_path / "run/summary.json").exists()
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        threading.Timer(1.0, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
        began = time.monotonic()
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path, overwrite=True, set=ENDLESS)
    finally:
        signal.signal(signal.SIGINT, before)
    assert time.monotonic() - began < 30
    left = Path(os.environ["XDG_RUNTIME_DIR"]) / "corotate"
    assert not left.exists() or not os.listdir(left)


def analytic():
    """The loop of motor-pair, linearised by hand: bodies with speed, load and current; the filter, and the last measurement."""
    e = np.exp(-B / J * H)
    drift, act = -(1 - e) / B, K * (1 - e) / B
    body = np.array([[e, drift, act], [0, 1, 0], [0, 0, 1]])
    a, c = np.zeros((10, 10)), np.zeros((5, 10))
    a[:3, :3] = body
    # The command on its way replaces the current before the body moves.
    a[3:6, 3:5], a[3:6, 9] = body[:, :2], [act, 0, 1]
    decay = np.exp(-DECAY * H)
    # The load is the filter's answer to the potential of one step, whose measurements are the last one and this one.
    weight = (1 - decay) / H
    load = np.zeros(10)
    load[0], load[6], load[7], load[8] = weight * (-B * H / 2 - J), decay, weight * (-B * H / 2 + J), weight * K * H
    a[6], a[7, 0], a[8, 2] = load, 1, 1
    speed, current = np.eye(10)[0], np.eye(10)[2]
    c[0], c[1], c[2] = speed, load, (K * current - B * speed - load) / J
    c[3], c[4] = np.eye(10)[3], np.eye(10)[9]
    return a, np.eye(10)[:, 9:], c


def test_the_linearisation_of_a_loop_is_the_analytic_one():
    control = pytest.importorskip("control")
    system = corotate.to_control("motor-pair", program=PROGRAM, tick=2000)
    assert system.state_labels[6] == "observer[0]" and system.x0[1] == 0.02 and system.dt == H
    linear = control.linearize(system, system.x0, system.u0)
    a, b, c = analytic()
    for found, expected in ((linear.A, a), (linear.B, b), (linear.C, c), (linear.D, np.zeros((5, 1)))):
        scale = 1 if found is not linear.C else 1e3
        assert np.abs(found - expected).max() < 1e-6 * scale, np.abs(found - expected).max()


def test_the_linearisation_of_a_rotating_body_is_the_analytic_one():
    control = pytest.importorskip("control")
    system = corotate.to_control("rigid-pair", tick=1500)
    linear = control.linearize(system, system.x0, system.u0)
    w, (i1, i2, i3) = system.x0[:3], (1.0, 2.0, 2.5)
    p, q, r = (i2 - i3) / i1, (i3 - i1) / i2, (i1 - i2) / i3
    generator = np.array([[0, p * w[2], p * w[1]], [q * w[2], 0, q * w[0]], [r * w[1], r * w[0], 0]])
    flow = np.eye(3) + generator * H + generator @ generator * H**2 / 2
    # The rates change by about 1e-3 in a tick, so that the constant generator is right to 1e-6.
    assert np.abs(linear.A[:3, :3] - flow).max() < 1e-6
    follower = [system.state_labels.index(f"follower[{index}]") for index in range(3)]
    sent = [system.state_labels.index(f"sent follower/command acceleration_rad_s2[{index}]") for index in range(3)]
    assert np.abs(linear.A[np.ix_(follower, sent)] - H * np.eye(3)).max() < 1e-6


def test_a_time_that_was_not_simulated_is_refused():
    control = pytest.importorskip("control")
    system = corotate.to_control("motor-pair", program=PROGRAM)
    with pytest.raises(NotImplementedError, match="tick=5"):
        control.linearize(system, system.x0, system.u0, t=5 * H)
    times = np.arange(20) * H
    response = control.input_output_response(system, times, np.full((1, 20), 0.7), system.x0)
    assert control.linearize(system, response.states[:, 5], [0.7], t=5 * H).A.shape == (10, 10)


def test_a_layout_comes_from_the_program():
    from corotate import seat
    reads, writes = seat.layout("motor-pair", "controller", program=PROGRAM)
    assert [f"{body}/{signal}" for body, signal, _ in reads] == ["leader/estimate", "follower/measurement"]
    assert writes[0][2].names == ("current_a",)
    with pytest.raises(ValueError, match=re.escape("unknown-scenario")):
        seat.layout("motor-pear", "controller", program=PROGRAM)


def test_a_seat_is_served_by_the_run_s_own_program(tmp_path):
    """The frames of `serve-seat`, from a program in Python, which ends as it is asked to."""
    import sys
    server = tmp_path / "server.py"
    server.write_text('''
import socket, struct, sys
line = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET, fileno=int(sys.argv[sys.argv.index("--fd") + 1]))
assert sys.argv[1] == "serve-seat" and sys.argv[3] == "controller", sys.argv
line.send(struct.pack("=QQQ", 1, 1, 2)); line.send(struct.pack("=Q", 2) + b"{}")
for tick, present in enumerate([3, 1, 3]):
    line.send(struct.pack("=QQQ8d", 3, tick, present, *range(8)))
    kind, answered, *rest = struct.unpack("=QQ", line.recv(1 << 17)[:16])
    assert answered == tick, (answered, tick)
    if kind == 2:
        line.send(struct.pack("=Q", 4) + b"computed-role-failed\\nit raised")
        sys.exit(1)
line.send(struct.pack("=Q", 4))
''')

    def signal_of(body, name, *fields):
        stamp = [{"name": name, "kind": "u64", "count": 1, "offset": 8 * index} for index, name in enumerate("tgos")]
        fields = [{"name": field, "kind": "f64", "count": 1, "offset": 32 + 8 * index} for index, field in enumerate(fields)]
        return {"service": f"corotate/x/{body}/{name}", "signal": name, "fields": stamp + fields}

    seat = {"program": [sys.executable, str(server)], "period_ns": 1_000_000, "writes": [signal_of("follower", "command", "current_a")],
            "reads": [signal_of("leader", "estimate", "a", "b", "c"), signal_of("follower", "measurement", "d", "e")], "valid": 1,
            "values": [{"key": "gain", "index": 0, "count": 2}, {"key": "set.point", "index": 2, "count": 1}]}
    from corotate import seat as module
    samples = module.Samples(seat)
    process = module.SeatProcess(seat, str(tmp_path), "controller", samples)
    asked, answer = [], None
    while (tick := process.next(answer)) is not None:
        asked.append(tick)
        answer = [np.float64(1.0).tobytes()]
    assert [number for number, *_ in asked] == [0, 1, 2] and asked[1][1][1] is None and process._process.returncode == 0
    inputs = samples.inputs(*asked[0][1:3])
    assert inputs.measurement.e == 4.0 and inputs.value("gain").tolist() == [5, 6] and inputs.value("set.point") == 7
    with pytest.raises(KeyError, match=re.escape("set.point")):
        inputs.value("other")
    process = module.SeatProcess(seat, str(tmp_path), "controller", samples)
    process.next(None)
    process.fail("Traceback: it raised")
    process.close()
    assert process._process.returncode == 1
    process = module.SeatProcess(seat, str(tmp_path), "controller", samples)
    process.next(None)
    process._process.kill()
    with pytest.raises(corotate.CorotateError):
        process.next([b""])

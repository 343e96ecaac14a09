"""A loop that is stepped: gymnasium's rules, and the bits of a run."""

import warnings

import numpy as np
import pytest

import corotate

gymnasium = pytest.importorskip("gymnasium")


def test_gymnasium_accepts_it():
    from gymnasium.utils.env_checker import check_env
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(corotate.Env("rigid-pair", set={"duration_s": 0.5}), skip_render_check=True)


def test_the_bits_are_those_of_a_run_with_the_same_commands(tmp_path):
    law = corotate.Synchronizer([1.0, 2.0, 2.5], gain=4.0)
    env = corotate.Env("rigid-pair", set={"duration_s": 2})
    at = {name: index for index, name in enumerate(env.observation_names)}
    where = [[at[f"{signal}[{axis}]"] for axis in range(3)] for signal in
             ("leader/estimate.omega_rad_s", "follower/measurement.omega_rad_s", "follower/measurement.applied_rad_s2")]
    observation, over, reward = env.reset()[0], False, 0.0
    while not over:
        observation, reward, _, over, _ = env.step(law.command(*(observation[place] for place in where)))
    summary = env.summary()

    def controller(tick, inputs, outputs):
        outputs.command.acceleration_rad_s2 = law.command(inputs.estimate.omega_rad_s, inputs.measurement.omega_rad_s,
                                                          inputs.measurement.applied_rad_s2)

    run = corotate.run("rigid-pair", clock="lockstep", set={"duration_s": 2, "accept": {}}, roles={"controller": controller},
                       out=tmp_path / "run")
    assert summary["state"]["hash"] == run.hash
    assert reward == -run.metrics["sync_error_rad_s"]["last"]


def test_a_seed_is_the_noise_s(tmp_path):
    env = corotate.Env("noisy-pair", set={"duration_s": 1})
    first, again, other = (env.reset(seed=seed)[0] for seed in (1, 1, 2))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_what_is_wrong_is_told():
    env = corotate.Env("rigid-pair", set={"duration_s": 0.01})
    with pytest.raises(RuntimeError, match="reset"):
        env.step(np.zeros(3))
    env.reset()
    with pytest.raises(ValueError, match="3 numbers"):
        env.step(np.zeros(2))
    while not env.step(np.zeros(3))[3]:
        pass
    with pytest.raises(corotate.CorotateError, match="over"):
        env.step(np.zeros(3))
    with pytest.raises(corotate.CorotateError, match="no controller"):
        corotate.Env("inertia")


def test_python_control_simulates_it():
    control = pytest.importorskip("control")
    system = corotate.to_control("rigid-pair", set={"duration_s": 1})
    assert system.dt == 1e-3 and system.ninputs == 3
    times = np.arange(200) * system.dt
    response = control.input_output_response(system, times, np.zeros((3, 200)))
    env = corotate.Env("rigid-pair", set={"duration_s": 1})
    seen = [env.reset()[0]] + [env.step(np.zeros(3))[0] for _ in range(199)]
    assert np.allclose(response.outputs.T, seen)

"""Stepped loops: the rules of gymnasium, and the same bits as a run."""

import copy
import pickle
import warnings

import numpy as np
import pytest

import corotate

from corotate.environments import SCENARIOS

gymnasium = pytest.importorskip("gymnasium")


def test_gymnasium_accepts_the_environment():
    from gymnasium.utils.env_checker import check_env
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(corotate.Env("rigid-pair", set={"duration_s": 0.5}), skip_render_check=True)


def test_an_episode_has_the_bits_of_a_run_with_the_same_commands(tmp_path):
    law = corotate.Synchronizer([1.0, 2.0, 2.5], gain=4.0)
    env = corotate.Env("rigid-pair", set={"duration_s": 2})
    index = {name: number for number, name in enumerate(env.observation_names)}
    arguments = [[index[f"{signal}[{axis}]"] for axis in range(3)] for signal in
                 ("leader/estimate.omega_rad_s", "follower/measurement.omega_rad_s", "follower/measurement.applied_rad_s2")]
    observation, truncated, reward = env.reset()[0], False, 0.0
    while not truncated:
        observation, reward, _, truncated, _ = env.step(law.command(*(observation[indexes] for indexes in arguments)))
    summary = env.summary()

    def controller(tick, inputs, outputs):
        outputs.command.acceleration_rad_s2 = law.command(inputs.estimate.omega_rad_s, inputs.measurement.omega_rad_s,
                                                          inputs.measurement.applied_rad_s2)

    run = corotate.run("rigid-pair", clock="lockstep", set={"duration_s": 2, "accept": {}}, roles={"controller": controller},
                       out=tmp_path / "run")
    assert summary["state"]["hash"] == run.hash
    assert reward == -run.metrics["sync_error_rad_s"]["last"]


def test_the_seed_determines_the_noise(tmp_path):
    env = corotate.Env("noisy-pair", set={"duration_s": 1})
    first, again, second = (env.reset(seed=seed)[0] for seed in (1, 1, 2))
    assert np.array_equal(first, again) and not np.array_equal(first, second)


def test_wrong_calls_raise():
    env = corotate.Env("rigid-pair", set={"duration_s": 0.01})
    with pytest.raises(RuntimeError, match=r"\breset\(\)"):
        env.step(np.zeros(3))
    env.reset()
    with pytest.raises(ValueError, match=r"\b3\b.*\b2\b"):
        env.step(np.zeros(2))
    while not env.step(np.zeros(3))[3]:
        pass
    with pytest.raises(corotate.CorotateError, match=r"\breset\(\)"):
        env.step(np.zeros(3))
    with pytest.raises(corotate.CorotateError, match=r"\bcontroller\b"):
        corotate.Env("inertia")


def test_python_control_simulates_a_loop():
    control = pytest.importorskip("control")
    system = corotate.to_control("rigid-pair", set={"duration_s": 1})
    assert system.dt == 1e-3 and system.ninputs == 3
    times = np.arange(200) * system.dt
    response = control.input_output_response(system, times, np.zeros((3, 200)), system.x0)
    env = corotate.Env("rigid-pair", set={"duration_s": 1})
    seen = [env.reset()[0]] + [env.step(np.zeros(3))[0] for _ in range(199)]
    assert np.allclose(response.outputs.T, seen)


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_gymnasium_makes_every_registered_scenario(scenario):
    env = gymnasium.make(f"corotate/{scenario}-v0")
    assert env.unwrapped.action_names == corotate.Env(scenario).action_names
    observation, info = env.reset(seed=3)
    assert observation in env.observation_space and info == {"seed": 3}


def test_every_scenario_that_can_be_stepped_is_registered():
    def can_be_stepped(name):
        try:
            return bool(corotate.Env(name))
        except corotate.CorotateError as error:
            assert "stepped" in str(error)

    assert [name for name in corotate.shipped() if can_be_stepped(name)] == [name for name in corotate.shipped() if name in SCENARIOS]
    assert not set(SCENARIOS) - set(corotate.shipped())


def noise(env, count, **first):
    """Returns the first observation of each of `count` episodes."""
    return [env.reset(**(first if episode == 0 else {}))[0].tobytes() for episode in range(count)]


def test_every_episode_has_its_own_noise_and_a_seed_repeats_it():
    env, second = (corotate.Env("noisy-pair", set={"duration_s": 1}) for _ in range(2))
    episodes = noise(env, 4, seed=123)
    assert len(set(episodes)) == 4 and episodes == noise(second, 4, seed=123) == noise(env, 4, seed=np.int64(123))
    assert not set(episodes) & set(noise(corotate.Env("noisy-pair"), 4)), "the seed is random by default"
    from_scenario = [noise(corotate.Env("noisy-pair", set={"seed": 123}), 2) for _ in range(2)]
    assert from_scenario[0] == from_scenario[1] == episodes[:2]
    env.reset(seed=5)
    state = env.np_random.bit_generator.state
    seeds = [env.reset()[1]["seed"] for _ in range(2)]
    env.np_random.bit_generator.state = state
    assert [env.reset()[1]["seed"] for _ in range(2)] == seeds


@pytest.mark.parametrize("kind", ["sync", "async"])
def test_environments_of_a_vector_have_their_own_noise(kind):
    envs = gymnasium.make_vec("corotate/noisy-pair-v0", num_envs=3, vectorization_mode=kind)
    try:
        for seed in (None, 7):
            observations, info = envs.reset(seed=seed)
            assert len({row.tobytes() for row in observations}) == 3 and len(set(info["seed"])) == 3
        _, _, _, _, info = envs.step(np.zeros((3, 3)))
        assert info["applied"].shape == (3, 3) and (info["missed"] == 0).all()
    finally:
        envs.close()


@pytest.mark.parametrize("seed", [2**63, -1, 1.5, "one", np.uint64(2**63), 2**200])
def test_an_invalid_seed_is_refused_everywhere(seed):
    for refuse in (lambda: corotate.Env().reset(seed=seed), lambda: corotate.Env(set={"seed": seed}),
                   lambda: corotate.run("rigid-pair", clock="in-process", set={"seed": seed})):
        with pytest.raises(ValueError, match="2\\*\\*63"):
            refuse()
    assert corotate.Env().reset(seed=2**63 - 1)[1]["seed"] == 2**63 - 1


def test_an_episode_ends_where_a_body_leaves_its_model():
    env, steps, terminated = corotate.Env("orbit-hold"), 0, False
    env.reset(seed=1)
    while not terminated:
        observation, reward, terminated, truncated, info = env.step([-0.5, -0.5])
        steps += 1
        assert np.isfinite(reward) and np.isfinite(observation).all() and not truncated
        assert terminated == ("reason" in info)
    assert info["reason"] == "spacecraft meets the central body" and steps < 10_000
    with pytest.raises(corotate.CorotateError, match=r"\breset\(\)"):
        env.step([0.0, 0.0])
    assert env.summary()["accepted"] is False
    env.reset()
    assert env.step([0.0, 0.0])[4] == {"applied": pytest.approx([0, 0]), "rejected": 0, "missed": 0}


def test_a_step_reports_applied_rejected_and_missed_commands():
    env = corotate.Env("rigid-pair", set={"actuator.command_timeout_ticks": 3})
    env.reset()

    def step(*action):
        _, reward, _, _, info = env.step(action)
        assert np.isfinite(reward)
        return info["applied"].tolist(), info["rejected"], info["missed"]

    assert step(1, 2, 3) == ([1, 2, 3], 0, 0)
    assert step(np.nan, 0, 0) == ([1, 2, 3], 1, 1), "the last command is held"
    assert step(1e9, 0, 0) == ([1, 2, 3], 1, 1)
    assert step(np.inf, 0, 0) == ([0, 0, 0], 1, 1), "the follower is safe"
    assert step(4, 5, 6) == ([4, 5, 6], 0, 0)
    trio = corotate.Env("rigid-trio")
    trio.reset()
    info = trio.step([1, 2, 3, np.nan, 5, 6])[4]
    assert info["applied"].tolist() == [1, 2, 3, 0, 0, 0] and (info["rejected"], info["missed"]) == (1, 1)


def test_actions_can_be_normalised_and_have_the_bounds_of_the_guards():
    plain, normal = corotate.Env("orbit-hold"), corotate.Env("orbit-hold", normalize_actions=True)
    assert plain.action_space.high.tolist() == [0.5, 0.5] and normal.action_space.high.tolist() == [1, 1]
    for env, action in ((plain, [0.25, -0.5]), (normal, [0.5, -1])):
        env.reset(seed=1)
        _, _, _, _, info = env.step(action)
        assert info["applied"].tolist() == action
    assert np.array_equal(plain.step([0.1, 0.1])[0], normal.step([0.2, 0.2])[0])
    half = corotate.Env("orbit-hold", normalize_actions=True, action_bound=0.25)
    half.reset()
    assert half.step([1, 1])[4]["applied"].tolist() == [1, 1]
    high = dict(zip(plain.observation_names, plain.observation_space.high))
    assert high["spacecraft/measurement.applied_du_s2[1]"] == 0.5 and high["spacecraft/measurement.radius_du"] == np.inf
    assert 0 < high["spacecraft/measurement.velocity_du_s[0]"] <= high["spacecraft/estimate.velocity_du_s[0]"] < np.inf


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_an_environment_is_copied_without_its_episode(copied):
    env = corotate.Env("noisy-pair", set={"duration_s": 1})
    env.reset(seed=1)
    env.step(np.zeros(3))
    copy_of_env = copied(env)
    with pytest.raises(RuntimeError, match=r"\breset\(\)"):
        copy_of_env.step(np.zeros(3))
    assert noise(copy_of_env, 2) == noise(env, 2), "the generator is copied"


def test_the_summary_of_an_episode_has_the_scenario_s_criteria():
    env = corotate.Env("rigid-pair", set={"duration_s": 9})
    with pytest.raises(RuntimeError, match=r"\breset\(\)"):
        env.summary()
    env.reset(seed=1)
    while not env.step(np.zeros(3))[3]:
        pass
    summary = env.summary()
    run = corotate.run("rigid-pair", clock="in-process", set={"duration_s": 9, "seed": 1}, roles={"controller": lambda *_: None})
    assert summary["accepted"] is run.accepted is False and env.summary() == summary
    assert [(each["name"], each["limit"]) for each in summary["criteria"]] == [(each["name"], each["limit"]) for each in run.summary["criteria"]]
    assert len(summary["criteria"]) > 1 and summary["state"]["hash"] == run.hash and summary["books"]["balanced"]
    with pytest.raises(RuntimeError, match=r"\breset\(\)"):
        env.step(np.zeros(3))
    # An unfinished episode has no verdict.
    env.reset()
    env.step(np.zeros(3))
    unfinished = env.summary()
    assert unfinished["accepted"] is None and unfinished["books"]["balanced"] and len(unfinished["criteria"]) > 1


def test_a_loop_can_be_part_of_a_larger_system():
    control = pytest.importorskip("control")
    system = corotate.to_control("rigid-pair", set={"duration_s": 1})
    gain = control.ss([], [], [], np.eye(3), dt=system.dt, inputs=["a", "b", "c"], outputs=system.input_labels)
    both = control.interconnect([gain, system], inputs=["a", "b", "c"], outputs=system.output_labels)
    times = np.arange(50) * system.dt
    commands = np.ones((3, 50))
    together = control.input_output_response(both, times, commands, system.x0).outputs
    assert np.array_equal(together, control.input_output_response(system, times, commands, system.x0).outputs)


def test_an_environment_may_be_used_and_dropped_by_another_thread():
    import threading
    env = corotate.Env("rigid-pair", set={"duration_s": 0.1})
    env.reset()
    seen = []

    def use(held):
        seen.append(held.pop().step(np.zeros(3))[0])

    held = [env]
    del env
    thread = threading.Thread(target=use, args=(held,))
    thread.start()
    thread.join()
    assert len(seen) == 1 and not held

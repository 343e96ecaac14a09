"""A loop that is stepped: gymnasium's rules, and the bits of a run."""

import copy
import pickle
import warnings

import numpy as np
import pytest

import corotate

from corotate.environments import SCENARIOS

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


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_gymnasium_knows_its_names(scenario):
    env = gymnasium.make(f"corotate/{scenario}-v0")
    assert env.unwrapped.action_names == corotate.Env(scenario).action_names
    observation, info = env.reset(seed=3)
    assert observation in env.observation_space and info == {"seed": 3}


def test_every_scenario_that_can_be_stepped_has_a_name():
    def steps(name):
        try:
            return bool(corotate.Env(name))
        except corotate.CorotateError as error:
            assert "cannot be stepped" in str(error)

    assert [name for name in corotate.shipped() if steps(name)] == [name for name in corotate.shipped() if name in SCENARIOS]
    assert not set(SCENARIOS) - set(corotate.shipped())


def noise(env, count, **first):
    """The first observations of so many episodes."""
    return [env.reset(**(first if episode == 0 else {}))[0].tobytes() for episode in range(count)]


def test_every_episode_has_its_own_noise_and_the_same_after_the_same_seed():
    env, other = (corotate.Env("noisy-pair", set={"duration_s": 1}) for _ in range(2))
    episodes = noise(env, 4, seed=123)
    assert len(set(episodes)) == 4 and episodes == noise(other, 4, seed=123) == noise(env, 4, seed=np.int64(123))
    assert not set(episodes) & set(noise(corotate.Env("noisy-pair"), 4)), "without a seed there is another one"
    of_set = [noise(corotate.Env("noisy-pair", set={"seed": 123}), 2) for _ in range(2)]
    assert of_set[0] == of_set[1] == episodes[:2]
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
def test_what_is_no_seed_is_refused_everywhere(seed):
    for refuse in (lambda: corotate.Env().reset(seed=seed), lambda: corotate.Env(set={"seed": seed}),
                   lambda: corotate.run("rigid-pair", clock="in-process", set={"seed": seed})):
        with pytest.raises(ValueError, match="2\\*\\*63"):
            refuse()
    assert corotate.Env().reset(seed=2**63 - 1)[1]["seed"] == 2**63 - 1


def test_an_episode_ends_where_a_body_meets_the_end_of_its_model():
    env, steps, over = corotate.Env("orbit-hold"), 0, False
    env.reset(seed=1)
    while not over:
        observation, reward, over, truncated, info = env.step([-0.5, -0.5])
        steps += 1
        assert np.isfinite(reward) and np.isfinite(observation).all() and not truncated
        assert over == ("reason" in info)
    assert info["reason"] == "spacecraft meets the central body" and steps < 10_000
    with pytest.raises(corotate.CorotateError, match="over"):
        env.step([0.0, 0.0])
    assert env.summary()["accepted"] is False, "a lost body is not accepted"
    env.reset()
    assert env.step([0.0, 0.0])[4] == {"applied": pytest.approx([0, 0]), "rejected": 0, "missed": 0}


def test_what_became_of_an_action_is_told():
    env = corotate.Env("rigid-pair", set={"actuator.command_timeout_ticks": 3})
    env.reset()

    def step(*action):
        _, reward, _, _, info = env.step(action)
        assert np.isfinite(reward)
        return info["applied"].tolist(), info["rejected"], info["missed"]

    assert step(1, 2, 3) == ([1, 2, 3], 0, 0)
    assert step(np.nan, 0, 0) == ([1, 2, 3], 1, 1), "the last one is held"
    assert step(1e9, 0, 0) == ([1, 2, 3], 1, 1)
    assert step(np.inf, 0, 0) == ([0, 0, 0], 1, 1), "the follower is safe"
    assert step(4, 5, 6) == ([4, 5, 6], 0, 0)
    trio = corotate.Env("rigid-trio")
    trio.reset()
    info = trio.step([1, 2, 3, np.nan, 5, 6])[4]
    assert info["applied"].tolist() == [1, 2, 3, 0, 0, 0] and (info["rejected"], info["missed"]) == (1, 1)


def test_actions_can_be_normalised_and_bounds_are_those_of_the_guards():
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
    other = copied(env)
    with pytest.raises(RuntimeError, match="reset"):
        other.step(np.zeros(3))
    assert noise(other, 2) == noise(env, 2), "the generator is copied"


def test_an_episode_is_summed_up_by_the_scenario_s_criteria():
    env = corotate.Env("rigid-pair", set={"duration_s": 9})
    with pytest.raises(RuntimeError, match="reset"):
        env.summary()
    env.reset(seed=1)
    while not env.step(np.zeros(3))[3]:
        pass
    summary = env.summary()
    run = corotate.run("rigid-pair", clock="in-process", set={"duration_s": 9, "seed": 1}, roles={"controller": lambda *_: None})
    assert summary["accepted"] is run.accepted is False and env.summary() == summary
    assert [(each["name"], each["limit"]) for each in summary["criteria"]] == [(each["name"], each["limit"]) for each in run.summary["criteria"]]
    assert len(summary["criteria"]) > 1 and summary["state"]["hash"] == run.hash and summary["books"]["balanced"]
    with pytest.raises(RuntimeError, match="reset"):
        env.step(np.zeros(3))
    # One that was left is no failure of what came after.
    env.reset()
    env.step(np.zeros(3))
    left = env.summary()
    assert left["accepted"] is None and left["books"]["balanced"] and len(left["criteria"]) > 1


def test_python_control_does_not_linearise_it():
    control = pytest.importorskip("control")
    system = corotate.to_control("rigid-pair", set={"duration_s": 1})
    for state in (np.zeros(0), np.zeros(1)):
        with pytest.raises(NotImplementedError, match="certificate"):
            control.linearize(system, state, np.zeros(3))
    gain = control.ss([], [], [], np.eye(3), dt=system.dt, inputs=["a", "b", "c"], outputs=system.input_labels)
    both = control.interconnect([gain, system], inputs=["a", "b", "c"], outputs=system.output_labels)
    with pytest.raises(NotImplementedError, match="certificate"):
        control.linearize(both, np.zeros(1), np.zeros(3))
    times = np.arange(50) * system.dt
    commands = np.ones((3, 50))
    together = control.input_output_response(both, times, commands).outputs
    assert np.array_equal(together, control.input_output_response(system, times, commands).outputs)

"""A loop as an environment of gymnasium: the caller is the controller."""

import gymnasium
import numpy as np

from . import _corotate
from .program import Program
from .scenario import given, seed_of, toml
from .steps import Steps, session

# The fields that the guards of the shipped rigs bound: of measurements and estimates, and of commands that act.
RATES, APPLIED = ("omega_", "velocity_"), "applied_"


def _bounds(limits):
    """Returns a function of a number's name, which returns the largest magnitude that the guards accept."""
    # A rig of a program bounds fields by their names.
    named = {name.strip("|"): bound for name, bound in limits if name.startswith("|")}
    measured, estimated, commanded = [bound for _, bound in limits] if limits and not named else [np.inf] * 3

    def bound(name):
        signal, _, field = name.partition("/")[2].partition(".")
        if signal == "command" or field.startswith(APPLIED):
            known = commanded
        else:
            known = (estimated if signal == "estimate" else measured) if field.startswith(RATES) else np.inf
        return named.get(field.partition("[")[0], known)

    return bound


class Env(gymnasium.Env):
    """A scenario in one thread. The bits are those of a run with the same commands and the same seed.

    An observation has every number of the estimate, then of each driven body's measurement, then of their own estimates, then the reference,
    if there is one (`observation_names`), bounded by what the guards accept; a number stays where its sample is missing. An action is the first field of
    each command (`action_names`), bounded by `action_bound` or else by what the command guard accepts; with `normalize_actions` it is
    from -1 to 1 of that. The reward is minus the scenario's first metric.

    An episode is truncated at the scenario's last tick. It is terminated where a body's motion has met the end of its model:
    `info["reason"]` says how. Each step's `info` has `applied`, the command that acts from then on, in the unit of an action; and how many
    commands that were due then were `rejected` by the guards and `missed` (absent, late or rejected; the body holds the last one or is
    safe). The step into the truncation has no tick after it, and none of these.

    A copied or pickled environment has the settings and the random generator, and no episode: `reset` begins one. With `program` the
    scenario is one of a program built on corotate, which steps it in a process of its own until `close`.
    """

    metadata = {"render_modes": []}

    def __init__(self, scenario="rigid-pair", *, program=None, set={}, action_bound=None, normalize_actions=False):
        self._given, self._program, self._changes = given(scenario), None if program is None else Program(program), dict(set)
        self._session = None
        steps = self._begin({})
        self.observation_names, self.action_names = steps.observation_names, steps.action_names
        bounds = _bounds(steps.limits)
        bound = bounds(self.action_names[0]) if action_bound is None else float(action_bound)
        if normalize_actions and not np.isfinite(bound):
            raise ValueError("normalize_actions=True: the scenario does not bound its commands; give action_bound")
        self._scale, largest = (bound, 1.0) if normalize_actions else (1.0, bound)
        most = np.array([bounds(name) for name in self.observation_names])
        self.observation_space = gymnasium.spaces.Box(-most, most, dtype=np.float64)
        self.action_space = gymnasium.spaces.Box(-largest, largest, (len(self.action_names),), np.float64)
        self._steps = self._summary = None
        self._seeded = self._over = False

    def _begin(self, more):
        changes = {**self._changes, **more}
        # The process of a program may have died.
        if self._session is None or getattr(self._session, "closed", False):
            self._session = session(self._program)
        try:
            return Steps(self._session, *self._given, changes).observe()
        except ValueError as error:
            refused = error
        # The criteria may need a longer run than is asked for.
        try:
            return Steps(self._session, *self._given, {"accept": {}, **changes}).observe()
        except ValueError:
            raise refused from None

    def __getstate__(self):
        return {**self.__dict__, "_session": None, "_steps": None, "_summary": None}

    def close(self):
        """Ends the episode, and the process of a program; `reset` begins another."""
        if self._session is not None:
            self._session.close()
        self._session = self._steps = self._summary = None

    def reset(self, *, seed=None, options=None):
        """Begins an episode. `seed` is the scenario's, of all noise; without one it is drawn from `np_random`, so that every episode has
        its own. The first episode without one has the seed of `set`, if that has one. `info["seed"]` is the seed.
        """
        if seed is None and not self._seeded and "seed" in self._changes:
            seed = self._changes["seed"]
        seed = None if seed is None else seed_of(seed)
        super().reset(seed=seed)
        self._seeded = True
        seed = int(self.np_random.integers(2**63)) if seed is None else seed
        self._steps = self._summary = None
        self._steps, self._over = self._begin({"seed": seed}), False
        return self._steps.observation, {"seed": seed}

    def step(self, action):
        """Acts for one tick. An action that is not finite, or out of bounds, is given to the loop as it is: see `rejected`."""
        if self._steps is None:
            raise RuntimeError("there is no episode: call reset() first")
        if self._over:
            raise _corotate.CorotateError("the episode is over: call reset() to begin another")
        steps = self._steps
        steps.step(np.asarray(action, dtype=np.float64) * self._scale)
        if steps.over:
            self._over = True
            return steps.observation, -steps.metric, False, True, {}
        info = {"applied": steps.applied / self._scale, "rejected": steps.rejected, "missed": steps.missed}
        if steps.loss is not None:
            self._over = True
            info["reason"] = steps.loss
        return steps.observation, -steps.metric, self._over, False, info

    def set_input(self, key, value):
        """Changes an input of the episode, such as a disturbance or a set point, and returns the tick from which it acts: the next one.

        `reset` restores the value of the scenario. The caller is the controller: its gains cannot change, and it must follow a set point
        itself, from which the reward then counts. An episode takes 4096 changes. A CorotateError has the `code` of a refusal.
        """
        if self._steps is None:
            raise RuntimeError("there is no episode: call reset() first")
        if self._over:
            raise _corotate.CorotateError("the episode is over: call reset() to begin another")
        return self._steps.set_input(key, toml(value))

    def summary(self):
        """Ends the episode and returns its summary, judged by the scenario's criteria, as `Run.summary`; again the same until `reset`."""
        if self._summary is None:
            if self._steps is None:
                raise RuntimeError("there is no episode to sum up: call reset() first")
            self._summary, self._steps = self._steps.finish()[0], None
        return self._summary

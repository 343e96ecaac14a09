"""A loop as an environment of gymnasium: whoever steps it is the controller."""

import json

import gymnasium
import numpy as np

from . import _corotate
from .scenario import given, overrides
from .seat import Samples


class Env(gymnasium.Env):
    """A scenario in one thread. The bits are those of a run with the same commands.

    Nothing is judged unless `set` has an `accept`. An observation has every number of the estimate, then of each driven body's measurement, in SI units (`observation_names`); an
    action is the first field of each command (`action_names`), bounded by what the command guard believes. The reward is minus the scenario's first metric. An episode is
    truncated at the scenario's last tick.
    """

    metadata = {"render_modes": []}

    def __init__(self, scenario="rigid-pair", *, set={}, action_bound=None):
        self._given, self._changes = given(scenario), dict(set)
        steps = self._begin({})
        samples = Samples(*steps.seat())
        names = [f"{body}/{signal}.{name}" for body, signal, dtype in samples.reads for name in self._numbers(dtype)]
        self.observation_names = names
        firsts = [(body, signal, dtype.names[0], int(np.prod(dtype[0].shape))) for body, signal, dtype in samples.writes]
        self.action_names = [f"{body}/{signal}.{name}[{index}]" for body, signal, name, count in firsts for index in range(count)]
        # The last of a rig's bounds is that of its commands.
        limits = steps.limits()
        bound = float(action_bound) if action_bound is not None else limits[-1][1] if limits else np.inf
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (len(steps.observation()),), np.float64)
        self.action_space = gymnasium.spaces.Box(-bound, bound, (len(self.action_names),), np.float64)
        self._steps = None

    @staticmethod
    def _numbers(dtype):
        for name in dtype.names:
            base, shape = dtype[name].subdtype or (dtype[name], ())
            if base == np.float64:
                yield from [f"{name}[{index}]" for index in range(shape[0])] if shape else [name]

    def _begin(self, more):
        return _corotate.Steps(*self._given, overrides({"accept": {}, **self._changes, "clock": "in-process", **more}))

    def reset(self, *, seed=None, options=None):
        """Begins the run anew; `seed` is the scenario's, of all noise."""
        super().reset(seed=seed)
        self._steps = self._begin({} if seed is None else {"seed": int(seed)})
        return self._steps.observation(), {}

    def step(self, action):
        """Acts for one tick."""
        if self._steps is None:
            raise RuntimeError("call reset() first")
        observation, metric, over = self._steps.step(np.ascontiguousarray(action, dtype=np.float64))
        return observation, -metric, False, over, {}

    def summary(self):
        """Ends the run and gives its summary, as `Run.summary`."""
        summary, _ = self._steps.finish(False, None)
        self._steps = None
        return json.loads(summary)

"""A loop as a system of python-control."""

import control
import numpy as np

from . import _corotate
from .scenario import given, overrides


def to_control(scenario, *, set={}):
    """The plants and the observer of a scenario as a discrete `NonlinearIOSystem` without a state of its own: the inputs are the
    commands, the outputs what the controller observes, named as those of `Env` with a space for each dot. It is the loop's production code, so it goes forward only:
    simulate it from t = 0 on, tick by tick (`control.input_output_response` with `solve_ivp_method=None`).
    """
    text, changes = given(scenario), overrides({"accept": {}, **set, "clock": "in-process"})
    steps = _corotate.Steps(*text, changes)
    from .env import Env
    env = Env(scenario, set=set)
    tick_s = _corotate.describe(*text, "controller")[2]
    at = {"tick": 0, "steps": steps, "seen": steps.observation()}

    def outputs(time, state, commands, params):
        tick = int(round(time / tick_s))
        if tick < at["tick"]:
            at.update(tick=0, steps=_corotate.Steps(*text, changes))
            at["seen"] = at["steps"].observation()
        while at["tick"] < tick:
            at["seen"], _, _ = at["steps"].step(np.ascontiguousarray(at.get("held", np.zeros(len(env.action_names)))))
            at["tick"] += 1
        at["held"] = np.array(commands, dtype=float)
        return at["seen"]

    # No dot may be in a name there.
    inputs, seen = ([name.replace(".", " ") for name in names] for names in (env.action_names, env.observation_names))
    name = "corotate" if isinstance(scenario, dict) else str(scenario).replace(".", " ")
    return control.NonlinearIOSystem(None, outputs, inputs=inputs, outputs=seen, dt=tick_s, name=name)

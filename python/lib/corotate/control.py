"""A loop as a system of python-control."""

import control
import numpy as np

from . import _corotate
from .env import Env
from .scenario import given, overrides

NOT_LINEAR = "a corotate loop keeps its state to itself, so it cannot be linearised or solved for an equilibrium here; simulate it, or see" \
    " corotate.certificate for the rate at which its error falls"


class _Loop(control.NonlinearIOSystem):
    """A system that refuses to be linearised."""

    def linearize(self, *arguments, **options):
        raise NotImplementedError(NOT_LINEAR)


def to_control(scenario, *, set={}):
    """The plants and the observer of a scenario as a discrete `NonlinearIOSystem`: the inputs are the commands, the outputs what the
    controller observes, named as those of `Env` with a space for each dot. It is the loop's production code, which keeps its state to itself: the system's only
    state is the tick. So it goes forward only: simulate it from tick 0 on (`control.input_output_response`). `control.linearize` is
    refused.
    """
    text, changes = given(scenario), overrides({"accept": {}, **set, "clock": "in-process"})
    env, tick_s = Env(scenario, set=set), _corotate.describe(*text, "controller")[2]
    steps, seen, held = None, [], []

    def begin():
        nonlocal steps
        steps = _corotate.Steps(*text, changes)
        seen[:], held[:] = [steps.observation()], []

    def tick_of(state):
        tick = round(float(state[0]))
        if abs(state[0] - tick) > 1e-9 or not 0 <= tick <= len(held):
            raise NotImplementedError(NOT_LINEAR)
        return tick

    def update(time, state, commands, params):
        tick = tick_of(state)
        if tick == 0:
            begin()
        if len(seen) <= tick + 1:
            held[tick:] = [np.array(commands, dtype=float)]
        elif not np.array_equal(held[tick], commands, equal_nan=True):
            raise NotImplementedError(NOT_LINEAR)
        return [tick + 1]

    def outputs(time, state, commands, params):
        tick = tick_of(state)
        while len(seen) <= tick:
            seen.append(steps.step(held[len(seen) - 1])[0])
        return seen[tick]

    begin()
    # No dot may be in a name there.
    inputs, outs = ([name.replace(".", " ") for name in names] for names in (env.action_names, env.observation_names))
    name = "corotate" if isinstance(scenario, dict) else str(scenario).replace(".", " ")
    return _Loop(update, outputs, inputs=inputs, outputs=outs, states=["tick"], dt=tick_s, name=name)

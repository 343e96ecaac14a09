"""A loop as a system of python-control."""

import control
import numpy as np

from .program import Program
from .scenario import given
from .steps import Steps, session

NO_STATE = ("the loop has no state at tick {tick}: its bodies and its observer keep no number that is finite there; begin at a later tick, "
            "or list the fields that change in the rig's persist_fields!")
NOT_KNOWN = "the loop has not been simulated to tick {tick}: simulate it from t = 0 on, or begin there with to_control(…, tick={tick})"


class Loop(control.NonlinearIOSystem):
    """A loop from a tick on: `x0` is the state there, `u0` the command of that tick."""


class _Stepper:
    """Computes a tick of a loop from any state: counters, flags and noise are those after the commands before it. Ticks are those of
    the controller, which may be slower than the bodies.
    """

    def __init__(self, program, text, kind, changes):
        self._begin = lambda: Steps(self._session, text, kind, changes, ideal=True)
        self._session = session(program)
        self.steps = self._begin()
        # The commands of the ticks so far; the next tick; what was computed last.
        self.commands, self._tick, self._last = [], 0, (None, None, None)
        self.initial = np.concatenate([self.steps.state(), np.zeros(len(self.steps.action_names))])

    def _advance(self, command):
        """Runs the next tick, with the command of the one before."""
        if self._tick == 0:
            self.steps.observe()
        else:
            self.steps.step(command)
        self._tick += 1

    def _go_to(self, tick):
        """Runs a loop up to a tick, with the commands before it."""
        if len(self.commands) < tick:
            raise NotImplementedError(NOT_KNOWN.format(tick=tick * self.steps.every_ticks))
        self.steps, self._tick = self._begin(), 0
        for command in [None, *self.commands[:max(tick - 1, 0)]][:tick]:
            self._advance(command)

    def compute(self, tick, state):
        """Returns observation and state after a tick that begins in a state: the loop's numbers, and the command on its way."""
        if self._last[0] != (key := (tick, state.tobytes())):
            numbers, sent = np.split(state, [len(state) - len(self.steps.action_names)])
            if self._tick != tick or not np.array_equal(numbers, self.steps.state(), equal_nan=True):
                self._go_to(tick)
                self.steps.set_state(numbers)
            self._advance(sent)
            self._last = key, self.steps.observation, self.steps.state()
        return self._last[1:]


def to_control(scenario, *, program=None, set={}, tick=0):
    """The bodies and the observer of a scenario, from a tick on, as a discrete `NonlinearIOSystem`.

    The inputs are the first field of each command, the outputs what the controller observes, named as those of `Env` with a space for
    each dot. It is the loop's production code. Its states are the loop's own numbers, in the order in which the roles keep them, as
    `leader[0]`, and the command that is on its way to the bodies. To `tick` the loop is run with the scenario's controller: `x0` is the
    state there, `u0` the command of that tick. So `control.linearize(system, system.x0, system.u0)` is the loop at that tick. Time 0 of
    the system is that tick, and a later time is computed for loops that were simulated to it (`control.input_output_response`).

    Counters, flags, the memory of guards, and noise are no states: they are those of the loop at that tick. A rig that declares its
    `ideal` is without noise and rounding here. Noise of another one is the same for every state, so that a linearisation is that of the
    loop without noise; quantisation has no derivative.

    A controller with `every_ticks = n` makes a step of the system n ticks long, and `tick` a multiple of n. A loop without a state
    raises ValueError.
    """
    text, kind = given(scenario)
    changes = {"accept": {}, **set, "clock": "in-process"}
    stepper = _Stepper(None if program is None else Program(program), text, kind, changes)
    steps, every = stepper.steps, stepper.steps.every_ticks
    if tick % every:
        raise ValueError(f"tick={tick}: the controller computes at every {every}. tick; give a multiple of {every}")
    first, step_s = tick // every, steps.tick_s * every
    u0 = np.zeros(len(steps.action_names))
    x0 = stepper.initial
    if first:
        stepper.commands = list(steps.own_commands(first + 1))
        if len(stepper.commands) <= first:
            raise ValueError(f"tick={tick}: it is after the last tick of the scenario; take an earlier one, or a longer duration_s")
        stepper._go_to(first)
        x0, u0 = np.concatenate([stepper.steps.state(), stepper.commands[first - 1]]), stepper.commands[first]
    # A number that is not finite is unused so far: no state.
    used = np.isfinite(x0)
    if not used[:len(x0) - len(u0)].any():
        raise ValueError(NO_STATE.format(tick=tick))

    def at(time, state):
        full = x0.copy()
        full[used] = state
        return first + round(time / step_s), full

    def update(time, state, command, params):
        now, full = at(time, state)
        after = stepper.compute(now, full)[1]
        stepper.commands[now:] = [np.array(command, dtype=float)]
        return np.concatenate([after, command])[used]

    def outputs(time, state, command, params):
        return stepper.compute(*at(time, state))[0]

    # No dot may be in a name there.
    inputs, outs = ([name.replace(".", " ") for name in names] for names in (steps.action_names, steps.observation_names))
    states = [name for name, there in zip(steps.state_names + [f"sent {name}" for name in inputs], used) if there]
    name = "corotate" if isinstance(scenario, dict) else str(scenario).replace(".", " ")
    system = Loop(update, outputs, inputs=inputs, outputs=outs, states=states, dt=step_s, name=name)
    system.x0, system.u0 = x0[used], u0
    return system

"""Changes of inputs while a loop runs: gains, set points, disturbances. Must not decide whether a change is allowed."""

import json
import os
import time
from dataclasses import dataclass
from typing import Optional

from . import _corotate
from .scenario import toml

# The codes of a run that may still begin its ticks; "refused": its launcher does not serve requests yet.
NOT_YET = ("cannot-read-scenario", "no-launcher", "no-run", "not-a-domain", "refused", "run-over")


@dataclass(frozen=True)
class Change:
    """A change that a run has accepted. It acts from `tick` on, `time_s` after the first tick; in real time `delay_ms` after the request."""

    tick: int
    time_s: float
    delay_ms: Optional[float] = None


def set(values, run=None, at_tick=None, ramp_s=0.0, force=False, *, wait_s=0.0):
    """Changes inputs of a running loop, all at the same tick, and returns this tick as a `Change`.

    Parameters
    ----------
    values : dict
        New values by key, such as `{"controller.gain_per_s": [6, 6, 6]}`. `get` returns all keys.
    run : path
        The directory for the results of a running run, or its domain; the newest running run otherwise.
    at_tick : int
        The tick from which the values act; the earliest possible one otherwise.
    ramp_s : float
        The time over which the values change linearly, s.
    force : bool
        Whether values are set with which the loop does not converge.
    wait_s : float
        The longest time to wait until the run has begun, s.

    Raises
    ------
    CorotateError
        Why nothing has changed; `code` is the stable code of the reason, such as `not-tunable` or `too-early`.

    >>> from concurrent.futures import ThreadPoolExecutor
    >>> loop = ThreadPoolExecutor().submit(corotate.run, "rigid-pair", clock="realtime", set={"duration_s": 3, "accept": {}}, out=tmp / "set")
    >>> change = corotate.set({"follower.0.offset_rad_s": [0, 0, 0.1]}, run=tmp / "set", wait_s=30)
    >>> loop.result().summary["inputs"][0]["tick"] == change.tick
    True
    """
    pairs = [(key, toml(value)) for key, value in values.items()]
    arguments = run and os.fspath(run), pairs, at_tick, float(ramp_s), force
    return Change(*_when_begun(wait_s, _corotate.set_inputs, *arguments))


def get(run=None, *, wait_s=0.0):
    """Returns the values of all inputs of a running loop by key; `run` and `wait_s` are those of `set`.

    Raises
    ------
    CorotateError
        Why there are no values, with its `code`.
    """
    return json.loads(_when_begun(wait_s, _corotate.get_inputs, run and os.fspath(run)))


def _when_begun(wait_s, ask, *arguments):
    end = time.monotonic() + wait_s
    while True:
        try:
            return ask(*arguments)
        except _corotate.CorotateError as error:
            if error.code not in NOT_YET or time.monotonic() >= end:
                raise
        time.sleep(0.02)

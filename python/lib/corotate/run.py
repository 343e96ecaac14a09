"""Runs."""

import json
import multiprocessing
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from . import _corotate
from .recording import Recording
from .scenario import given, overrides
from .seat import Samples, serve

CLOCKS = ("in-process", "lockstep", "realtime")


@dataclass(frozen=True)
class Run:
    """A run that came to its end.

    `summary` is `summary.json` as a dict; `directory` has all files.
    """

    summary: dict = field(repr=False)
    directory: Path

    @property
    def accepted(self):
        """Whether every criterion of `[accept]` holds; None if nothing was judged."""
        return self.summary["accepted"]

    @property
    def metrics(self):
        """Per metric a dict: `last`, `settled_max`, `peak`, in the unit that ends its name, and `settled_at_s`."""
        return {metric["name"]: {key: value for key, value in metric.items() if key != "name"}
                for metric in self.summary["score"]["metrics"]}

    @property
    def hash(self):
        """The hash of everything that was published."""
        return self.summary["state"]["hash"]

    @property
    def recording(self):
        """Its samples, if they were recorded."""
        path = self.directory / "run.mcap"
        if not path.exists():
            raise FileNotFoundError(f"{path} is not there: record=True keeps the samples of a run")
        return Recording(path)

    def report(self, path=None):
        """Writes the run as a page, and gives its path."""
        path = Path(path) if path else self.directory / "report.html"
        import subprocess
        import sys
        subprocess.run([sys.executable, "-m", "corotate", "report", str(self.directory), "--out", str(path)],
                       check=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        return path

    def __repr__(self):
        lasts = ", ".join(f"{name} {metric['last']:.2e}" if metric["last"] is not None else f"{name} not finite"
                          for name, metric in self.metrics.items())
        verdict = {True: "accepted", False: "NOT ACCEPTED", None: "not judged"}[self.accepted]
        summary = self.summary
        return f"<Run {summary['scenario']} {summary['clock']}: {verdict}; {lasts}; {self.directory}>"


class _Timeout:
    """Ends a run that takes too long."""

    def __init__(self, timeout_s):
        self.end = None if timeout_s is None else time.monotonic() + timeout_s
        self.timeout_s = timeout_s

    def check(self):
        if self.end is not None and time.monotonic() > self.end:
            raise TimeoutError(f"the run took longer than {self.timeout_s} s")


def run(scenario, *, clock="lockstep", set={}, roles={}, roles_in="thread", record=False, out=None, timeout_s=None,
        require_realtime=False):
    """Runs a scenario to its end.

    Parameters
    ----------
    scenario : str, path or dict
        The name of one that ships (`corotate.shipped()`), a file, or its tables.
    clock : "lockstep", "realtime" or "in-process"
        What drives the ticks; the bits are the same under each, until the first missed tick.
    set : dict
        Keys to override, such as `{"leader.measured_axes": [1, 3]}`.
    roles : dict
        Functions in the place of roles: `{"controller": f}`. `f(tick, inputs, outputs)` fills the outputs, as in a `Seat`. Not with
        the clock `in-process`, but for the controller.
    roles_in : "thread" or "process"
        Where they run. In a process of its own a function must be one that can be pickled.
    record : bool
        Whether every sample goes to `run.mcap`.
    out : path
        The directory for the results; a new one in `runs/` otherwise.
    timeout_s : float
        A run that takes longer is ended in order, and TimeoutError raised.

    Returns
    -------
    Run

    Raises
    ------
    ValueError
        What is wrong with the scenario, with file, line, key and remedy.
    CorotateError
        Why there is no result. A role that raised ends the run in order: its traceback is in the error and in the run's incident, and
        the error's `run` is the Run.

    >>> corotate.run("rigid-pair", clock="in-process", set={"duration_s": 9}, out=tmp / "repr").accepted
    True
    """
    if clock not in CLOCKS:
        raise ValueError(f"there is no clock {clock!r}; give one of {', '.join(CLOCKS)}")
    if roles_in not in ("thread", "process"):
        raise ValueError(f"roles_in={roles_in!r}: give thread or process")
    text, kind = given(scenario)
    timeout = _Timeout(timeout_s)
    if roles and clock == "in-process":
        if list(roles) != ["controller"]:
            raise ValueError("in one thread a function can only be the controller; take clock='lockstep'")
        if record:
            raise ValueError("a run that is stepped is not recorded; take clock='lockstep'")
        return _stepped(text, kind, set, roles["controller"], timeout, out)
    changes = overrides({"clock": clock, **set})
    helpers, failures = {}, []

    def tell(what, value):
        timeout.check()
        if what == "waiting" and not helpers:
            for role, function in roles.items():
                helpers[role] = _start(value, role, function, roles_in, failures)

    try:
        summary, directory = _corotate.run(text, kind, changes, list(roles), record, out and str(out), require_realtime, tell)
    finally:
        for helper in helpers.values():
            helper.join(30)
    made = Run(json.loads(summary), Path(directory))
    if failures:
        failures[0].run = made
        raise failures[0]
    return made


def _start(domain, role, function, where, failures):
    """Starts a function in a role's seat."""
    if where == "process":
        # A new interpreter: one that was forked would have this one's threads half.
        helper = multiprocessing.get_context("spawn").Process(target=serve, args=(domain, role, function), daemon=True)
    else:
        def guarded():
            try:
                serve(domain, role, function)
            except BaseException as error:  # noqa: B902: whatever it is, it ends the run
                failures.append(error)

        helper = threading.Thread(target=guarded, name=role, daemon=True)
    helper.start()
    return helper


def _stepped(text, kind, changes, function, timeout, out):
    """A run in one thread whose controller is a function."""
    steps = _corotate.Steps(text, kind, overrides({**changes, "clock": "in-process"}))
    samples = Samples(*steps.seat())
    blank = samples.blank()
    while not steps.over():
        inputs, outputs = samples.inputs(steps.inputs()), samples.outputs(blank)
        function(steps.tick(), inputs, outputs)
        steps.act(outputs.close())
        timeout.check()
    summary, directory = steps.finish(True, out and str(out))
    return Run(json.loads(summary), Path(directory))


def certificate(scenario, *, set={}):
    """What may be claimed of a scenario's loop: a dict per driven body, with `loop_rate_per_s` (1/s), `conditions`, `floors` and
    `warnings`.

    >>> corotate.certificate("rigid-pair")[0]["body"]
    'follower'
    """
    text, kind = given(scenario)
    return json.loads(_corotate.certificate(text, kind, overrides(set)))


def shipped():
    """The names of the scenarios that ship.

    >>> "rigid-pair" in corotate.shipped()
    True
    """
    return [name for name, _ in _corotate.shipped()]

"""Runs."""

import contextlib
import contextvars
import functools
import json
import logging
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from . import _corotate
from .program import Program
from .recording import Recording
from .roles import RoleProcess, RoleThread, end_thread
from .scenario import given, overrides
from .steps import Steps, session

LOG = logging.getLogger("corotate")
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
        """Whether every criterion of `[accept]` holds; None if nothing, or not all, could be judged: `summary["verdict"]` says why."""
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
    def late(self):
        """The late ticks of a run in real time, in the order of time; None with another clock or with `realtime.trace = "off"`.

        Each is a dict with the keys of `late.json`: `role`, `tick`, `ticks`, `kind`, `time_s`, `late_us`, `causes`, and `caused_by`
        if another role's late tick caused it. Each cause is a dict with `kind`, `us`, `words`, and `name` where it is known.
        """
        found = _corotate.late_ticks(str(self.directory))
        return None if found is None else json.loads(found)

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

    def left_s(self):
        """Returns how much time is left, s; None without a limit."""
        return None if self.end is None else self.end - time.monotonic()

    def check(self, tick=None):
        """Raises TimeoutError once the time is used up."""
        if self.end is not None and time.monotonic() > self.end:
            at = "" if tick is None else f"; it was at tick {tick}"
            raise TimeoutError(f"the run took longer than {self.timeout_s} s{at}")


def run(scenario, *, program=None, clock="lockstep", set={}, roles={}, roles_in="thread", record=False, out=None, timeout_s=None,
        require_realtime=False, overwrite=False):
    """Runs a scenario to its end.

    Parameters
    ----------
    scenario : str, path or dict
        The name of one that ships (`corotate.shipped()`), a file, or its tables.
    program : path
        A program built on corotate, with rigs and shipped scenarios of its own; this package otherwise.
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
        A run that takes longer is ended in order, and TimeoutError raised, also where a function hangs. In the clock `in-process`
        the function then runs in a thread. Python cannot end a thread that sleeps: it goes on until it executes Python again.
    overwrite : bool
        Whether the files of an earlier run in `out` are removed; a CorotateError otherwise.

    Returns
    -------
    Run

    Raises
    ------
    ValueError
        What is wrong with the scenario, with file, line, key and remedy.
    CorotateError
        Why there is no result, or why the run ended before its last tick.
    What a function raised
        It ends the run in order, and is raised here, whatever it is. Where it comes from a process its traceback is the cause; an
        exception that cannot be pickled is a CorotateError with its text.

    An error of a run that left results has them as `run`.

    >>> corotate.run("rigid-pair", clock="in-process", set={"duration_s": 9}, out=tmp / "repr").accepted
    True
    """
    if clock not in CLOCKS:
        raise ValueError(f"there is no clock {clock!r}; give one of {', '.join(CLOCKS)}")
    if roles_in not in ("thread", "process"):
        raise ValueError(f"roles_in={roles_in!r}: give thread or process")
    # Where pytest shows a frame it shows the docstring too.
    __tracebackhide__ = True
    text, kind = given(scenario)
    timeout, program = _Timeout(timeout_s), None if program is None else Program(program)
    if roles and clock == "in-process":
        if list(roles) != ["controller"]:
            raise ValueError("in one thread a function can only be the controller; take clock='lockstep'")
        if record:
            raise ValueError("a run that is stepped is not recorded; take clock='lockstep'")
        begin = functools.partial(Steps, text=text, kind=kind, changes={"clock": clock, **set}, keep=True, out=out, overwrite=overwrite)
        return _stepped(program, begin, roles["controller"], timeout)
    start = RoleThread if roles_in == "thread" else RoleProcess
    arguments = text, kind, overrides({"clock": clock, **set}), list(roles), record, out and str(out), overwrite, require_realtime
    return _launched(_corotate.run if program is None else program.run, arguments, roles, start, timeout)


def _launched(launch, arguments, roles, start, timeout):
    """A run in processes, with functions in the seats of some roles."""
    __tracebackhide__ = True
    helpers, wait_s = {}, 0.1

    def tell(what, value):
        timeout.check(value if what == "running" else None)
        if what == "waiting":
            for role, function in roles.items():
                # The launcher waits for ever for a role that has not come: it knows nothing of one that failed before.
                if role in helpers and helpers[role].failed():
                    raise helpers[role].error() or _corotate.CorotateError(f"the {role} ended before the first tick")
                if role not in helpers:
                    helpers[role] = start(value, role, function)
        elif what == "external":
            LOG.warning("corotate: %s", value)

    made, ended, lost = None, None, []
    try:
        summary, directory = launch(*arguments, tell)
        made = Run(json.loads(summary), Path(directory))
        lost = [incident for incident in made.summary["incidents"] if incident["action"] == "stopped"]
        # A role that hangs does not end; one that raised needs a moment to tell of it.
        wait_s = 1 if lost else 5
    except _corotate.CorotateError as error:
        ended, wait_s = error, 1
    finally:
        for helper in helpers.values():
            helper.end(wait_s)
    errors = {role: error for role, helper in helpers.items() if (error := helper.error())}
    first = lost[0]["role"] if lost else next(iter(errors), None)
    if first in errors and (lost or not made):
        ended = _with_run(errors[first], made, first)
    elif lost:
        incident = lost[0]
        last_words = f"; its last words: {incident['last_words']}" if incident["last_words"] else ""
        ended = _with_run(_corotate.CorotateError(f"the {first} failed at tick {incident['tick']}: {incident['cause']}{last_words}"), made)
    if ended is not None:
        raise ended
    return made


def _with_run(error, made, role=None):
    """Adds the run to the exception that ended it."""
    error.run = made
    if role is not None and hasattr(error, "add_note"):
        error.add_note(f"raised by the role {role}" + (f" in the run {made.directory}" if made else ""))
    return error


def _stepped(program, begin, function, timeout):
    """A run in one thread whose controller is a function. With a limit of time this thread watches another one."""
    __tracebackhide__ = True
    made, errors, left = [], [], threading.Event()

    def step():
        with contextlib.closing(session(program)) as opened:
            steps = begin(opened).observe()
            while not steps.over and not left.is_set():
                outputs = steps.outputs()
                function(steps.tick, steps.inputs(), outputs)
                steps.act(outputs.close())
            if not left.is_set():
                summary, directory = steps.finish()
                made.append(Run(summary, Path(directory)))

    def guarded():
        try:
            step()
        except BaseException as error:  # Whatever the function raises is its caller's.
            errors.append(error)

    if timeout.end is None:
        step()
        return made[0]
    thread = threading.Thread(target=contextvars.copy_context().run, args=(guarded,), name="controller", daemon=True)
    thread.start()
    try:
        while thread.is_alive():
            timeout.check()
            thread.join(max(timeout.left_s(), 1e-3))
    finally:
        left.set()
        if thread.is_alive():
            end_thread(thread)
    if errors:
        raise errors[0]
    return made[0]


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

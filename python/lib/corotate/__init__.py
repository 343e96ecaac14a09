"""Control loops over shared memory: run a scenario, read a recording, be a role, step a loop.

>>> import corotate
>>> run = corotate.run("rigid-pair", clock="in-process", set={"duration_s": 9}, out=tmp / "run")
>>> run.accepted
True
>>> sorted(run.metrics)
['estimate_error_rad_s', 'sync_error_rad_s']
"""

import sys as _sys

from . import _corotate, environments as _environments
from ._corotate import CorotateError, __version__
from .inputs import Change, get, set
from .logs import HiddenRate, Identified, OrbitHold, Synchronizer, identify
from .recording import Recording
from .run import Run, certificate, run, shipped
from .seat import Seat
from .sweep import Sweep, sweep

__all__ = [
    "Change", "CorotateError", "Env", "HiddenRate", "Identified", "OrbitHold", "Recording", "Run", "Seat", "Sweep", "Synchronizer",
    "__version__", "certificate", "get", "identify", "run", "set", "shipped", "sweep", "to_control",
]

# Roles of a run are processes of this interpreter with this package.
_corotate.started_by(_sys.executable, ["-m", "corotate"])

_environments.register_with_gymnasium()


def __getattr__(name):
    # What needs packages that few have.
    if name == "Env":
        from .env import Env
        return Env
    if name == "to_control":
        from .control import to_control
        return to_control
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

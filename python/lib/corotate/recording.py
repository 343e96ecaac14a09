"""Recordings as arrays."""

import os

import numpy as np

from . import _corotate

# The bits of a sample's status word.
STATUS = ("holding", "safe", "initial", "unobservable", "unusable", "learning", "axis_lost", "degraded", "not_excited", "fault",
          "rejected")


class Recording:
    """A recording of a run, by its path or its directory.

    One that is not complete is refused unless `accept_incomplete`. A signal is read when it is first asked for; `load` reads many.
    """

    def __init__(self, path, accept_incomplete=False):
        path = os.fspath(path)
        self.path = os.path.join(path, "run.mcap") if os.path.isdir(path) else path
        self._recording = _corotate.Recording(self.path, accept_incomplete)
        self.scenario, self.clock, period_ns, self.toml = self._recording.info()
        self.tick_s = period_ns * 1e-9
        self._fields = {f"{body}/{signal}": fields for body, signal, fields in self._recording.signals()}
        self._words = {}

    @property
    def signals(self):
        """Per signal, `"body/signal"`, its fields: name to number of elements."""
        return {signal: {name: count for name, _, count in fields} for signal, fields in self._fields.items()}

    def _all(self, signal):
        """All samples of a signal as an array of (n, words), read once."""
        if signal not in self._fields:
            raise KeyError(f"the recording has no signal {signal!r}; it has {', '.join(self._fields)}")
        if signal not in self._words:
            self.load(signal)
        return self._words[signal]

    def load(self, *signals):
        """Reads signals, or all of them, in one pass over the file: what is asked for one by one is read one by one."""
        wanted = [signal for signal in signals or self._fields if signal not in self._words]
        for signal, (words, each) in zip(wanted, self._recording.words([tuple(signal.split("/")) for signal in wanted])):
            words.flags.writeable = False
            self._words[signal] = words.reshape(-1, each)
        return self

    def array(self, name):
        """A field of a signal, `"leader/estimate.omega_rad_s"`: (n, elements), or (n,) for a single element; of a fleet
        (n, bodies, 3). A view of what was read, not a copy; row k is the k-th sample, whose tick `ticks` tells.
        """
        signal, _, wanted = name.partition(".")
        words, at = self._all(signal), 0
        for field, kind, count in self._fields[signal]:
            if field == wanted:
                view = words[:, at:at + count].view(np.float64 if kind == "f8" else np.uint64)
                return self._shaped(signal, view)
            at += count
        raise KeyError(f"{signal} has no field {wanted!r}; it has {', '.join(self.signals[signal])}")

    def _shaped(self, signal, view):
        if view.shape[1] == 1:
            return view[:, 0]
        bodies = self._bodies(signal)
        # A fleet has one component of all bodies after the other.
        components = view.shape[1] // bodies if bodies else 0
        return view.reshape(len(view), components, bodies).transpose(0, 2, 1) if components > 1 else view

    def _bodies(self, signal):
        """How many bodies a fleet's signal tells of; 0 of a single body's."""
        names = [field for field, _, _ in self._fields[signal]]
        if "bodies" not in names or not len(self._all(signal)):
            return 0
        return int(self._all(signal)[0, sum(count for _, _, count in self._fields[signal][:names.index("bodies")])])

    def ticks(self, signal):
        """The tick of each sample, (n,)."""
        return self.array(f"{signal}.tick")

    def time_s(self, signal):
        """When each sample was due, s from the first tick, (n,)."""
        return self.ticks(signal) * self.tick_s

    def columns(self, signal):
        """Every number of a signal as a column: name to (n,). Status bits are columns of their own, as bool."""
        columns = {"tick": self.ticks(signal)}
        for field, _, count in self._fields[signal]:
            if field in ("tick", "generation", "origin_ns", "sent_ns"):
                continue
            array = self.array(f"{signal}.{field}")
            if field == "status":
                columns.update({name: (array >> np.uint64(bit) & np.uint64(1)).astype(bool) for bit, name in enumerate(STATUS)})
            elif count == 1:
                columns[field] = array
            else:
                flat = array.reshape(len(array), -1)
                columns.update({f"{field}[{index}]": flat[:, index] for index in range(flat.shape[1])})
        return columns

    def frame(self, signal):
        """A signal as a pandas DataFrame on `time_s`."""
        import pandas
        return pandas.DataFrame(self.columns(signal), index=pandas.Index(self.time_s(signal), name="time_s"))

    def arrow(self, signal):
        """A signal as a pyarrow Table with `time_s`; `polars.from_arrow` takes it."""
        import pyarrow
        columns = {"time_s": self.time_s(signal), **self.columns(signal)}
        return pyarrow.table({name: np.ascontiguousarray(column) for name, column in columns.items()})

    def __repr__(self):
        return f"<Recording {self.scenario} {self.clock}: {', '.join(self._fields)}; {self.path}>"

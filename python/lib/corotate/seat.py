"""Being a role: the loop over its ticks, with its samples as numpy arrays.

A sample has its fields as attributes; each is an array of float64 or uint64. An input is a snapshot: it stays what it was. An output
belongs to its tick: to write to it afterwards is an error.
"""

import os
import time

import numpy as np

from . import _corotate
from .scenario import given


class Sample:
    """The fields of a sample, by name."""

    def __init__(self, array, names):
        self._array, self._names = array, names

    def __getattr__(self, name):
        try:
            return self._array[name][0]
        except (KeyError, ValueError):
            raise AttributeError(f"there is no field {name!r}; it has {', '.join(self._names)}") from None

    def __setattr__(self, name, value):
        if name.startswith("_"):
            return super().__setattr__(name, value)
        if name not in self._names:
            raise AttributeError(f"there is no field {name!r}; it has {', '.join(self._names)}")
        self._array[name][0] = value

    def __getitem__(self, name):
        return getattr(self, name)

    def __repr__(self):
        return ", ".join(f"{name}={getattr(self, name)}" for name in self._names)


class Group:
    """The samples of a role: by signal where there is one of it, and by body."""

    def __init__(self, entries):
        self._entries = entries

    def __getattr__(self, name):
        of_signal = [sample for body, signal, sample in self._entries if signal == name]
        if len(of_signal) == 1:
            return of_signal[0]
        of_body = [(signal, sample) for body, signal, sample in self._entries if body == name]
        if of_body:
            return Group([(signal, signal, sample) for signal, sample in of_body])
        known = ", ".join(f"{body}.{signal}" for body, signal, _ in self._entries)
        raise AttributeError(f"there is no {name!r} here; there are {known}")

    def __getitem__(self, name):
        """The sample of a body and a signal, by `"body/signal"`; or as the attribute."""
        for body, signal, sample in self._entries:
            if f"{body}/{signal}" == name:
                return sample
        return getattr(self, name)

    def __iter__(self):
        """All samples, in the order of the seat."""
        return iter(sample for _, _, sample in self._entries)

    def close(self):
        """Ends what may be written; gives the bytes."""
        for sample in self:
            sample._array.flags.writeable = False
        return [sample._array.tobytes() for sample in self]


def _dtype(fields):
    names, formats, offsets = [], [], []
    for name, kind, count, offset in fields:
        names.append(name)
        formats.append(f"={kind}" if count == 1 else (f"={kind}", (count,)))
        offsets.append(offset)
    return np.dtype({"names": names, "formats": formats, "offsets": offsets})


class Samples:
    """The layouts of what a role reads and writes."""

    def __init__(self, reads, writes):
        self.reads = [(body, signal, _dtype(fields)) for body, signal, fields in reads]
        self.writes = [(body, signal, _dtype(fields)) for body, signal, fields in writes]

    def inputs(self, given):
        """What was read: None where a sample is missing."""
        return Group([(body, signal, None if raw is None else Sample(np.frombuffer(raw, dtype), dtype.names))
                      for (body, signal, dtype), raw in zip(self.reads, given)])

    def outputs(self, given):
        """What is to be written."""
        return Group([(body, signal, Sample(np.frombuffer(bytearray(raw), dtype), dtype.names))
                      for (body, signal, dtype), raw in zip(self.writes, given)])

    def blank(self):
        """Outputs of zeros, as bytes."""
        return [bytes(dtype.itemsize) for _, _, dtype in self.writes]


def serve(domain, role, function):
    """Serves a role's seat with `function(tick, inputs, outputs)` to the end of the run.

    `domain` is as the `run` of a `Seat`.
    """
    __tracebackhide__ = True
    domain = _domain(domain)
    samples = Samples(*_corotate.describe(domain, "domain", role)[:2])

    def tick(number, inputs, blank):
        __tracebackhide__ = True
        outputs = samples.outputs(blank)
        function(number, samples.inputs(inputs), outputs)
        return outputs.close()

    _corotate.serve(domain, role, tick)


def _domain(path, wait_s=10.0):
    """The domain of a run: by itself, by a seat file in it, or by the directory that the run's results go to. It is waited for."""
    path = os.fspath(path)
    path = os.path.dirname(path) if path.endswith(".seat.json") else path
    end = time.monotonic() + wait_s
    while (domain := _corotate.domain_of(path)) is None:
        if time.monotonic() > end:
            raise _corotate.CorotateError(f"{path} is not a current run: give its domain, its seat file, or the directory given to --out")
        time.sleep(0.02)
    return str(domain)


class Seat:
    """A role of a run that waits for it: a loop over its ticks.

    `run` is the path of the seat file, which `corotate run --external ROLE` prints, or the directory that the run's results go to
    (`--out`); a run that is not there yet is waited for, for 10 s. Warm-up, heartbeat, counters, what is late and the report at the end are inside. `tick_s` is the period, s.

        for tick, inputs, outputs in corotate.Seat(path, "controller"):
            outputs.command.acceleration_rad_s2[:] = law(inputs.estimate, inputs.measurement)
    """

    def __init__(self, run, role):
        self._domain_path = _domain(run)
        reads, writes, self.tick_s = _corotate.describe(self._domain_path, "domain", role)
        self._samples, self.role = Samples(reads, writes), role

    def __iter__(self):
        ticks = _corotate.Ticks(self._domain_path, self.role)
        answer = None
        try:
            while (asked := ticks.next(answer)) is not None:
                number, inputs, blank = asked
                outputs = self._samples.outputs(blank)
                yield number, self._samples.inputs(inputs), outputs
                answer = outputs.close()
        finally:
            ticks.close()


def layout(scenario, role):
    """What a role of a scenario reads and writes: two lists of (body, signal, numpy dtype).

    >>> corotate.seat.layout("rigid-pair", "controller")[1][0][:2]
    ('follower', 'command')
    """
    samples = Samples(*_corotate.describe(*given(scenario), role)[:2])
    return samples.reads, samples.writes

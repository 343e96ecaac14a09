"""Being a role: the loop over its ticks, with its samples as numpy arrays.

A sample has its fields as attributes; each is an array of float64 or uint64. An input is a snapshot: it stays what it was. An output
belongs to its tick: to write to it afterwards is an error.
"""

import contextlib
import json
import os
import socket
import struct
import subprocess
import sys
import time
import traceback

import numpy as np

from . import _corotate
from .program import Program
from .scenario import given


# The number of fields of a stamp, which is at the begin of every sample; each has eight bytes.
STAMP_FIELDS = 4
# Kinds of frames to and from a process that serves a seat, and limits of their lengths, bytes.
TICK, END, OUTPUTS, FAILURE = 3, 4, 1, 2
FRAME_BYTES, TEXT_BYTES = 160 << 10, 32 << 10


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


class Inputs(Group):
    """What a role reads at a tick: samples, and the values of the scenario's inputs that it uses."""

    def __init__(self, entries, values, places):
        super().__init__(entries)
        self._values, self._places = values, places

    def value(self, key):
        """Returns an input of the scenario at this tick, such as `"reference.position_m"` or a gain: a number, or an array."""
        try:
            index, count = self._places[key]
        except KeyError:
            raise KeyError(f"the role uses no input {key!r}; it uses {', '.join(self._places) or 'no input'}") from None
        return float(self._values[index]) if count == 1 else np.array(self._values[index:index + count], dtype=np.float64)


def _layout(signal):
    """Returns body, signal and layout without the stamp of a signal in a seat."""
    fields = signal["fields"][STAMP_FIELDS:]
    formats = [f"={field['kind'][0]}8" if field["count"] == 1 else (f"={field['kind'][0]}8", (field["count"],)) for field in fields]
    dtype = np.dtype({"names": [field["name"] for field in fields], "formats": formats,
                      "offsets": [field["offset"] - 8 * STAMP_FIELDS for field in fields]})
    return signal["service"].split("/")[-2], signal["signal"], dtype


class Samples:
    """The layouts of what a role reads and writes, from its seat. `values` has the place and the length of each input of the scenario
    that it uses, by key.
    """

    def __init__(self, seat):
        self.reads, self.writes = ([_layout(signal) for signal in seat[key]] for key in ("reads", "writes"))
        self.values = {value["key"]: (value["index"], value["count"]) for value in seat["values"]}

    def inputs(self, given, values):
        """What was read: None where a sample is missing."""
        return Inputs([(body, signal, None if raw is None else Sample(np.frombuffer(raw, dtype), dtype.names))
                       for (body, signal, dtype), raw in zip(self.reads, given)], values, self.values)

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
    seat = _seat(domain, role)
    samples = Samples(seat)

    def tick(number, inputs, values, blank):
        __tracebackhide__ = True
        outputs = samples.outputs(blank)
        function(number, samples.inputs(inputs, values), outputs)
        return outputs.close()

    if not _is_foreign(seat):
        return _corotate.serve(domain, role, tick)
    with contextlib.closing(SeatProcess(seat, domain, role, samples)) as process:
        answer = None
        while (asked := process.next(answer)) is not None:
            try:
                answer = tick(*asked)
            except BaseException:
                process.fail(traceback.format_exc().rstrip())
                raise


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

    `run` is the path of the seat file, which `run --external ROLE` prints, or the directory that the run's results go to (`--out`); a
    run that is not there yet is waited for, for 10 s. The run may be that of any program built on corotate. Warm-up, heartbeat,
    counters, what is late and the report at the end are inside. `tick_s` is the period, s; `scenario` has the tables of the scenario.

        for tick, inputs, outputs in corotate.Seat(path, "controller"):
            outputs.command.acceleration_rad_s2[:] = law(inputs.estimate, inputs.measurement)
    """

    def __init__(self, run, role):
        self._domain_path = _domain(run)
        self._description = seat = _seat(self._domain_path, role)
        self._samples, self.role, self.tick_s = Samples(seat), role, seat["period_ns"] * 1e-9
        self.scenario = seat["scenario"]

    def __iter__(self):
        if _is_foreign(self._description):
            ticks = SeatProcess(self._description, self._domain_path, self.role, self._samples)
        else:
            ticks = _corotate.Ticks(self._domain_path, self.role)
        answer = None
        try:
            while (asked := ticks.next(answer)) is not None:
                number, inputs, values, blank = asked
                outputs = self._samples.outputs(blank)
                yield number, self._samples.inputs(inputs, values), outputs
                answer = outputs.close()
        finally:
            ticks.close()


def _is_foreign(seat):
    """Returns true if the run is that of another program, whose rigs only that program knows."""
    return seat.get("program") is not None and seat["program"] != [sys.executable, "-m", "corotate"]


def _seat(domain, role):
    """Returns the seat of a role for which the run in a domain waits."""
    try:
        with open(os.path.join(domain, f"{role}.seat.json"), encoding="utf-8") as file:
            return json.load(file)
    except FileNotFoundError:
        error = f"the run in {domain} does not wait for {role}: start it with --external {role}"
        raise _corotate.CorotateError(error) from None


def _blank(dtype, valid):
    """Returns a sample of zeros but for the bits of its `valid`, as bytes."""
    blank = np.zeros(1, dtype)
    if "valid" in dtype.names:
        blank["valid"] = valid
    return blank.tobytes()


class SeatProcess:
    """A role in a process of the run's own program, which asks this one for every tick; see `crates/runtime/src/seat/server.rs`."""

    def __init__(self, seat, domain, role, samples):
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._reads, self._frame = [dtype.itemsize for _, _, dtype in samples.reads], bytearray(FRAME_BYTES)
        self._present = -(-len(self._reads) // 64) or 1
        self._blank, self._tick = [_blank(dtype, seat["valid"]) for _, _, dtype in samples.writes], None
        with theirs:
            command = [*seat["program"], "serve-seat", domain, role, "--fd", str(theirs.fileno())]
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=2, pass_fds=[theirs.fileno()], start_new_session=True)

    def next(self, outputs):
        """Gives the outputs of the tick before, if there was one, and waits for the next: its number, inputs, values and blank
        outputs. None at the end of the run.
        """
        if outputs is not None:
            self._send(struct.pack("=QQ", OUTPUTS, self._tick) + b"".join(outputs))
        while True:
            try:
                length = self._socket.recv_into(self._frame)
            except ConnectionError:
                length = 0
            kind = struct.unpack_from("=Q", self._frame)[0] if length else None
            if kind == TICK:
                return self._asked(bytes(self._frame[:length]))
            if kind == END:
                return self._ended(self._frame[8:length].decode(errors="replace"))
            if kind is None:
                self.close()
                raise _corotate.CorotateError(f"the process that serves the seat ended with exit code {self._process.returncode}")

    def _asked(self, frame):
        self._tick, *present = struct.unpack_from(f"={1 + self._present}Q", frame, 8)
        inputs, at = [], 16 + 8 * self._present
        for index, size in enumerate(self._reads):
            inputs.append(frame[at:at + size] if present[index // 64] >> index % 64 & 1 else None)
            at += size
        return self._tick, inputs, np.frombuffer(frame, np.float64, offset=at), self._blank

    def _ended(self, text):
        self.close()
        if not text:
            return None
        code, _, reason = text.partition("\n")
        error = _corotate.CorotateError(reason)
        error.code = code
        raise error

    def fail(self, text):
        """Ends the role, and with it the run, for a reason."""
        self._send(struct.pack("=QQ", FAILURE, self._tick) + text.encode()[-TEXT_BYTES:])
        # Closed before it has read the reason, the process would report a lost program instead.
        self._socket.settimeout(5)
        with contextlib.suppress(OSError):
            while self._socket.recv(FRAME_BYTES):
                pass

    def _send(self, frame):
        try:
            self._socket.send(frame)
        except OSError:
            pass  # The process has ended: its last frame has the reason.

    def close(self):
        """Leaves the seat."""
        self._socket.close()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def layout(scenario, role, *, program=None):
    """What a role of a scenario reads and writes: two lists of (body, signal, numpy dtype). The scenario is one of `program`, if
    that is given.

    >>> corotate.seat.layout("rigid-pair", "controller")[1][0][:2]
    ('follower', 'command')
    """
    seat = _corotate.seat if program is None else Program(program).seat
    samples = Samples(json.loads(seat(*given(scenario), role)))
    return samples.reads, samples.writes

"""A loop in one thread that its caller steps, of this package or of another program. Must not decide anything for the controller."""

import json
import struct

import numpy as np

from . import _corotate
from .program import error_of
from .scenario import overrides
from .seat import Samples

# At the begin of what is observed: over, tick, metric, rejected, missed, number of applied components.
HEAD = struct.Struct("=QQdQQQ")


class Steps:
    """A run by requests of a session; a session has one run at a time."""

    def __init__(self, session, text, kind, changes, keep=False, out=None, overwrite=False, ideal=False):
        self._session = session
        self._request = {"scenario": text, "kind": kind, "set": overrides({**changes, "clock": "in-process"}), "keep": keep,
                         "out": None if out is None else str(out), "overwrite": overwrite, "ideal": ideal}
        description = json.loads(self._ask(b"b", json.dumps(self._request).encode()))
        seat = description["seat"]
        self.samples, self.tick_s, self.every_ticks = Samples(seat), seat["period_ns"] * 1e-9, seat["every_ticks"]
        self.limits = description["limits"]
        self.state_names = [f"{role}[{index}]" for role, count in description["state"] for index in range(count)]
        reads, writes = self.samples.reads, self.samples.writes
        self._sizes = [dtype.itemsize for _, _, dtype in reads]
        numbers = _columns(reads, _number_fields)
        # The reference follows: its values come after the samples, and none is missing.
        first = sum(self._sizes) // 8
        for key, (index, count) in self.samples.values.items():
            if key.startswith("reference."):
                names = [key] if count == 1 else [f"{key}[{component}]" for component in range(count)]
                numbers += [(name, first + index + component, len(reads)) for component, name in enumerate(names)]
        self._values = sum(count for _, count in self.samples.values.values())
        self.observation_names, self._numbers = [name for name, _, _ in numbers], np.array([word for _, word, _ in numbers], dtype=int)
        self._owners, self.observation = np.array([signal for _, _, signal in numbers], dtype=int), np.zeros(len(numbers))
        actions = _columns(writes, lambda dtype: dtype.names[:1])
        self.action_names, self._actions = [name for name, _, _ in actions], [word for _, word, _ in actions]
        self._commands = np.zeros(sum(dtype.itemsize for _, _, dtype in writes) // 8)
        self.over, self.tick = False, 0

    def _ask(self, operation, content=b""):
        answer = self._session.request(operation + content)
        if answer[0]:
            errors = json.loads(answer[1:])
            raise error_of(errors["errors"], errors["invalid"])
        return answer[1:]

    def observe(self):
        """Observes the first tick."""
        self._take(self._ask(b"o"))
        return self

    def step(self, action):
        """Acts with the first field of each command, zero in the others, and observes the next tick."""
        if len(action) != len(self._actions):
            raise ValueError(f"an action has {len(self._actions)} numbers, not {len(action)}")
        self._commands[self._actions] = action
        self.act([self._commands.tobytes()])

    def act(self, commands):
        """Acts with whole commands, as bytes, and observes the next tick."""
        self._take(self._ask(b"a", b"".join(commands)))

    def _take(self, seen):
        over, self.tick, self.metric, self.rejected, self.missed, applied = HEAD.unpack_from(seen)
        self.over, at = bool(over), HEAD.size
        self.applied = np.frombuffer(seen, np.float64, applied, at)
        at += 8 * applied
        present = struct.unpack_from(f"={len(self._sizes)}Q", seen, at)
        at += 8 * len(present)
        words = np.frombuffer(seen, np.float64, sum(self._sizes) // 8 + self._values, at)
        # A number stays where its sample is missing.
        self.observation = words[self._numbers] if all(present) else np.where(
            np.array([*present, 1], dtype=bool)[self._owners], words[self._numbers], self.observation)
        self._raw = []
        for size, there in zip(self._sizes, present):
            self._raw.append(seen[at:at + size] if there else None)
            at += size
        self.values, at = words[len(words) - self._values:], at + 8 * self._values
        self.loss = seen[at:].decode() or None

    def inputs(self):
        """Returns the samples that the controller has."""
        return self.samples.inputs(self._raw, self.values)

    def outputs(self):
        """Returns samples for the controller to fill."""
        return self.samples.outputs(self.samples.blank())

    def state(self):
        """Returns the numbers of the loop's state."""
        return np.frombuffer(self._ask(b"s"))

    def set_state(self, state):
        """Replaces the numbers of the loop's state."""
        self._ask(b"r", np.ascontiguousarray(state, dtype=np.float64).tobytes())

    def set_input(self, key, text):
        """Changes an input to a value in TOML; returns the tick from which it acts."""
        return json.loads(self._ask(b"i", json.dumps([key, text]).encode()))

    def own_commands(self, turns):
        """Returns the actions of the scenario's own controller at its first turns, in a run of its own: (turns, numbers)."""
        words = self._ask(b"c", json.dumps({"begin": self._request, "turns": turns}).encode())
        return np.frombuffer(words).reshape(-1, len(self._commands))[:, self._actions]

    def finish(self):
        """Ends the run; returns its summary and the directory of its results, if they are kept."""
        done = json.loads(self._ask(b"f"))
        return done["summary"], done["directory"]


def session(program):
    """Returns a session that steps runs: of this package, or of a program."""
    return _corotate.Session() if program is None else program.session()


def _number_fields(dtype):
    return [name for name in dtype.names if (dtype[name].subdtype or (dtype[name],))[0] == np.float64]


def _columns(signals, fields_of):
    """Returns name, word and number of the signal for each component of these fields of signals, whose words follow one another."""
    columns, start = [], 0
    for number, (body, signal, dtype) in enumerate(signals):
        for field in fields_of(dtype):
            shape, first = dtype[field].shape, start + dtype.fields[field][1] // 8
            names = [f"{field}[{index}]" for index in range(shape[0])] if shape else [field]
            columns += [(f"{body}/{signal}.{name}", first + index, number) for index, name in enumerate(names)]
        start += dtype.itemsize // 8
    return columns

"""Programs built on corotate, by their command lines. Must not know what a rig is."""

import json
import os
import queue
import shutil
import signal
import socket
import struct
import subprocess
import threading
from pathlib import Path

from . import _corotate

# Between two looks at a run, s.
LOOK_S = 0.05


def error_of(errors, invalid=False):
    """Returns the exception for errors with text and code: a ValueError if the scenario is invalid."""
    error = (ValueError if invalid else _corotate.CorotateError)("\n".join(each["text"] for each in errors))
    error.code = errors[0]["code"] if errors else None
    return error


def _ended(path, code, last_words=""):
    how = f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
    error = _corotate.CorotateError(f"{path} {how}: {last_words.strip() or 'its error output says more'}")
    error.code = "exited"
    return error


class Program:
    """A program by its path, or by its name in PATH."""

    def __init__(self, path):
        path = os.fspath(path)
        self.path = shutil.which(path)
        if self.path is None:
            raise FileNotFoundError(f"there is no program {path}: build it, or check its path")

    def __repr__(self):
        return self.path

    def seat(self, text, kind, role):
        """Returns the seat of a role of a scenario as JSON."""
        command = [self.path, "seat", *_argument(text, kind), role, "--clock", "lockstep"]
        done = subprocess.run(command, input=text if kind == "text" else "", capture_output=True, text=True)
        if done.returncode == 0:
            return done.stdout
        error = _ended(self.path, done.returncode, done.stderr)
        raise ValueError(str(error)) if done.returncode == 2 else error

    def run(self, text, kind, changes, external, record, out, overwrite, require_realtime, tell):
        """Runs a scenario. Calls `tell` as `_corotate.run` does, and returns the same."""
        command = [self.path, "run", *_argument(text, kind), "--events", "--quiet", "--parent", str(os.getpid())]
        command += [word for change in changes for word in ("--set", change)]
        command += [word for role in external for word in ("--external", role)]
        command += ["--record"] * record + ["--out", out] * bool(out) + ["--overwrite"] * overwrite + ["--require-rt"] * require_realtime
        # In a session of its own: Ctrl-C reaches this process alone, which ends the run in order.
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True)
        lines = queue.SimpleQueue()
        reader = threading.Thread(target=_read, args=(process.stdout, lines), daemon=True)
        try:
            reader.start()
            with process.stdin:
                process.stdin.write(text if kind == "text" else "")
            directory, errors = _follow(lines, tell)
        finally:
            # Also after an exception of `tell`: the run writes its results and ends its roles.
            _end(process)
            reader.join()
            process.stdout.close()
        if errors is not None:
            raise error_of(errors["errors"], errors["invalid"])
        if directory is None:
            raise _ended(self.path, process.returncode)
        return (Path(directory) / "summary.json").read_text(encoding="utf-8"), directory

    def session(self):
        """Starts a process that steps runs."""
        return StepProcess(self.path)


def _argument(text, kind):
    """Returns a scenario as arguments; that of a text is standard input."""
    if kind == "path" and "/" not in text and not text.endswith(".toml"):
        text = f"./{text}"
    return ["-" if kind == "text" else text]


def _read(stream, lines):
    for line in stream:
        lines.put(line)
    lines.put(None)


def _follow(lines, tell):
    """Follows a run's events to their end. Returns the directory of the results, and the event of errors."""
    state, directory, errors = None, None, None
    while True:
        try:
            line = lines.get(timeout=LOOK_S)
        except queue.Empty:
            line = ""
        if line is None:
            return directory, errors
        try:
            event = json.loads(line) if line else {}
        except ValueError:
            event = {}  # A rig has printed it.
        kind = event.get("event") if isinstance(event, dict) and event.get("schema") == "corotate/event/v1" else None
        if kind == "waiting":
            state = kind, event["domain"]
        elif kind == "running":
            state = kind, None
        elif kind == "notice":
            tell("external", event["text"])
        elif kind == "results":
            directory = event["directory"]
        elif kind == "error":
            errors = event
        if state is not None:
            tell(*state)


def _end(process):
    """Ends a run that has not ended."""
    try:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        process.wait()
    except BaseException:
        process.kill()
        process.wait()
        raise


class StepProcess:
    """A program that steps runs: each request has an answer."""

    def __init__(self, path):
        self._path, self.closed = path, False
        self._socket, theirs = socket.socketpair()
        with theirs:
            # What a rig prints goes to the error output.
            self._process = subprocess.Popen([path, "step"], stdin=theirs, stdout=2, start_new_session=True)
        self._answers = self._socket.makefile("rb")

    def request(self, message):
        """Returns the answer to a request; see `src/launch/session.rs`."""
        answer = None
        try:
            self._socket.sendall(struct.pack("=I", len(message)) + message)
            answer = self._read(struct.unpack("=I", self._read(4))[0])
        except OSError:
            pass
        finally:
            # Also if this was interrupted: the next answer would be that of this request.
            if answer is None:
                self.close()
        if answer is None:
            raise _ended(self._path, self._process.returncode)
        return answer

    def _read(self, length):
        data = self._answers.read(length)
        if len(data) < length:
            raise ConnectionResetError
        return data

    def close(self):
        """Ends the process."""
        self.closed = True
        self._answers.close()
        self._socket.close()
        try:
            self._process.wait(1)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def __del__(self):
        if hasattr(self, "_answers"):
            self.close()

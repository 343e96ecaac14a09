"""Functions in the seats of roles: each in a thread, or in a process of its own. Must not start or judge a run."""

import atexit
import ctypes
import multiprocessing
import pickle
import threading
import traceback
from multiprocessing.reduction import ForkingPickler

from ._corotate import CorotateError
from .seat import serve


class RemoteTraceback(Exception):
    """The traceback of a role's process, as text: the cause of the exception that its role raised."""

    def __str__(self):
        return f"\n{self.args[0]}"


class RoleThread:
    """A function that serves a role's seat in a thread."""

    def __init__(self, domain, role, function):
        self._error = None
        self._thread = threading.Thread(target=self._serve, args=(domain, role, function), name=role, daemon=True)
        self._thread.start()

    def _serve(self, domain, role, function):
        __tracebackhide__ = True
        try:
            serve(domain, role, function)
        except BaseException as error:  # Whatever the function raises is its caller's.
            self._error = error

    def failed(self):
        """Returns true if the role has ended with an exception."""
        return self._error is not None

    def error(self):
        """Returns the exception that the role ended with, if any."""
        return self._error

    def end(self, wait_s):
        """Waits for the role to end; one that hangs is asked to end as soon as it executes Python again."""
        self._thread.join(wait_s)
        if self._thread.is_alive():
            end_thread(self._thread)


class RoleProcess:
    """A function that serves a role's seat in a process of its own."""

    def __init__(self, domain, role, function):
        # A new interpreter: one that was forked would have this one's threads half.
        context = multiprocessing.get_context("spawn")
        self._role, self._error = role, None
        self._errors, errors = context.Pipe(duplex=False)
        function = bytes(ForkingPickler.dumps(function))
        self._process = context.Process(target=_serve_remote, args=(errors, domain, role, function), name=role, daemon=True)
        self._process.start()
        errors.close()

    def failed(self):
        """Returns true if the process has ended: before the run does, that is a failure."""
        return self._error is not None or not self._process.is_alive()

    def error(self):
        """Returns the exception that the role ended with, if any."""
        if self._error is None:
            try:
                self._error = _received(self._role, *pickle.loads(self._errors.recv_bytes())) if self._errors.poll() else None
            except EOFError:
                self._process.join(1)
                if code := self._process.exitcode:
                    how = f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
                    self._error = CorotateError(f"the process of the {self._role} {how}; its error output says more")
        return self._error

    def end(self, wait_s):
        """Waits for the process to end; one that hangs is killed."""
        self._process.join(wait_s)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def end_thread(thread):
    """Raises SystemExit in a thread that does not end by itself. It acts once the thread executes Python again."""
    # The interpreter must not go while the thread puts its seat away.
    atexit.register(thread.join, 2)
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident), ctypes.py_object(SystemExit))


def _serve_remote(errors, domain, role, function):
    try:
        serve(domain, role, pickle.loads(function))
    except BaseException as error:  # Whatever the function raises is sent to its caller.
        errors.send_bytes(pickle.dumps((traceback.format_exc(), _portable(error))))


def _portable(error):
    """Returns an exception as bytes; None where it cannot be pickled, or not be restored."""
    try:
        data = pickle.dumps(error)
        return data if isinstance(pickle.loads(data), type(error)) else None
    except Exception:
        return None


def _received(role, text, data):
    """Returns the exception that a process has sent, with its traceback as the cause."""
    try:
        error = pickle.loads(data)
    except Exception:
        # It exists in its own process alone: its text is left.
        error = CorotateError(f"the {role} raised {text.strip().splitlines()[-1]}")
    error.__cause__ = RemoteTraceback(text)
    return error

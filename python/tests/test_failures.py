"""Roles in Python that raise, hang, die or are slow: the exception that the caller gets, and when."""

import io
import os
import pdb
import subprocess
import sys
import textwrap
import threading
import time
import traceback
from pathlib import Path

import pytest

import corotate
from controllers import SOON_S, Fails, Unpicklable

EVERYWHERE = pytest.mark.parametrize("clock, where", [
    ("in-process", "thread"), ("lockstep", "thread"), ("lockstep", "process"), ("realtime", "thread"), ("realtime", "process")])
# Does not end before its functions fail. Python keeps up with this rate on any machine.
ENDLESS = {"duration_s": 60, "tick_hz": 100, "accept": {}}
# The launcher must notice the failure without a heartbeat timeout.
PATIENT = {"supervision.heartbeat_timeout_s": 3600.0}


def run(tmp_path, clock, where, function, **options):
    changes = {**ENDLESS, **options.pop("set", {})}
    return corotate.run("rigid-pair", clock=clock, set=changes, roles={"controller": function}, roles_in=where, out=tmp_path / "run", **options)


def lines(error):
    """Returns an exception with its causes as the user sees it."""
    return "".join(traceback.format_exception(error))


@EVERYWHERE
@pytest.mark.parametrize("how, tick, raises", [("shape", 0, ValueError), ("typo", 3, AttributeError)])
def test_an_exception_of_a_role_ends_the_run_and_reaches_the_caller(tmp_path, clock, where, how, tick, raises):
    function = Fails(how, tick, tmp_path / "at")
    with pytest.raises(raises) as caught:
        run(tmp_path, clock, where, function, set=PATIENT)
    raised_at, raised_s = (tmp_path / "at").read_text().split()
    assert time.time() - float(raised_s) < 300, "the launcher must not wait for a timeout"
    assert f"in {how}" in lines(caught.value) and "controllers.py" in lines(caught.value)
    if clock == "in-process":
        return
    ended = caught.value.run
    [incident] = ended.summary["incidents"]
    assert ended.accepted is False and ended.summary["verdict"] != "accepted"
    assert incident["role"] == "controller" and f"in {how}" in incident["last_words"]
    # In real time, missed ticks just before this one may not be committed: the incident then has an earlier tick.
    assert incident["tick"] == int(raised_at) if clock == "lockstep" else incident["tick"] <= int(raised_at)


@EVERYWHERE
@pytest.mark.parametrize("role", ["controller", "observer", "follower"])
@pytest.mark.parametrize("tick", [0, 1, 50, 99])
def test_an_exception_at_any_tick_of_any_role_is_raised_soon(tmp_path, clock, where, role, tick):
    if clock == "in-process" and role != "controller":
        pytest.skip("in one thread a function can only be the controller")
    # In real time the ticks 99 and 100 may be missed.
    duration_s = 2 if clock == "realtime" else 1
    with pytest.raises(ValueError) as caught:
        corotate.run("rigid-pair", clock=clock, set={**ENDLESS, **PATIENT, "duration_s": duration_s, "limits": {}}, roles={role: Fails("shape", tick, tmp_path / "at", role)},
                     roles_in=where, out=tmp_path / "run")
    took_s = time.time() - float((tmp_path / "at").read_text().split()[1])
    assert took_s < SOON_S, took_s
    assert "in shape" in lines(caught.value)


@pytest.mark.parametrize("where", ["thread", "process"])
@pytest.mark.parametrize("how, raises", [("interrupt", KeyboardInterrupt), ("leave", SystemExit), ("unpicklable", Unpicklable)])
def test_exit_interrupt_and_unpicklable_exceptions_reach_the_caller(tmp_path, where, how, raises):
    # An exception that cannot be pickled travels as text.
    raises = corotate.CorotateError if (where, how) == ("process", "unpicklable") else raises
    with pytest.raises(raises) as caught:
        run(tmp_path, "lockstep", where, Fails(how, 5))
    assert f"in {how}" in lines(caught.value) and caught.value.run.accepted is False


def test_a_dead_role_process_raises_with_its_exit_code(tmp_path):
    with pytest.raises(corotate.CorotateError, match=r"\bcontroller\b.*\b7\b") as caught:
        run(tmp_path, "lockstep", "process", Fails("die", 5))
    [incident] = caught.value.run.summary["incidents"]
    assert (incident["role"], incident["tick"], incident["action"]) == ("controller", 5, "stopped")


def test_a_function_that_cannot_be_pickled_raises(tmp_path):
    with pytest.raises(Exception, match="pickle"):
        run(tmp_path, "lockstep", "process", lambda tick, inputs, outputs: None)


@EVERYWHERE
@pytest.mark.parametrize("how", ["sleep", "loop"])
def test_the_timeout_ends_a_run_with_a_hanging_function(tmp_path, clock, where, how):
    # In a separate process: a sleeping function would continue in a thread of this one.
    program = f"""
        import sys, time, corotate
        from controllers import Fails
        if __name__ == "__main__":
            began = time.monotonic()
            try:
                corotate.run("rigid-pair", clock={clock!r}, set={ENDLESS | PATIENT!r}, roles={{"controller": Fails({how!r}, 7)}}, roles_in={where!r},
                             out={str(tmp_path / "run")!r}, timeout_s=5)
            except TimeoutError:
                print(time.monotonic() - began)
    """
    path = tmp_path / "program.py"
    path.write_text(textwrap.dedent(program))
    done = subprocess.run([sys.executable, str(path)], env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)}, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    # No upper limit: a loaded machine may end processes slowly. The function would sleep for an hour.
    assert float(done.stdout) >= 5, done


def test_lockstep_waits_for_a_function_in_pdb(tmp_path):
    class SlowUser(io.StringIO):
        def readline(self):
            time.sleep(3)
            return "continue\n"

    def debugged(tick, inputs, outputs):
        if tick == 5:
            pdb.Pdb(stdin=SlowUser(), stdout=io.StringIO(), nosigint=True).set_trace()

    ended = run(tmp_path, "lockstep", "thread", debugged, set={"supervision.heartbeat_timeout_s": 0.5, "duration_s": 0.5})
    assert ended.summary["incidents"] == [] and ended.summary["books"]["roles"]["controller"]["executed"] == 51


def test_lockstep_waits_for_a_slow_function_up_to_the_external_timeout(tmp_path):
    def slow(tick, inputs, outputs, pause_s=3):
        if tick == 5:
            over.wait(pause_s)

    over = threading.Event()
    brief = {"supervision.heartbeat_timeout_s": 0.5, "duration_s": 0.5}
    ended = run(tmp_path, "lockstep", "thread", slow, set=brief)
    assert ended.summary["incidents"] == [] and ended.summary["books"]["roles"]["controller"]["executed"] == 51
    # The time in which the function must connect, too.
    limited = {**brief, "launch.external_timeout_s": SOON_S}
    endless = lambda *tick: slow(*tick, pause_s=300)
    with pytest.raises(corotate.CorotateError, match=rf"\b{SOON_S} s\b") as caught:
        corotate.run("rigid-pair", set={**ENDLESS, **limited}, roles={"controller": endless}, out=tmp_path / "limited")
    over.set()
    [incident] = caught.value.run.summary["incidents"]
    assert (incident["role"], incident["tick"], incident["code"]) == ("controller", 5, "waited-too-long")
    assert caught.value.run.accepted is False


def test_the_incident_of_a_silent_function_has_its_current_tick(tmp_path):
    def hangs(tick, inputs, outputs):
        seen.append(tick)
        if tick >= 20:
            time.sleep(30)

    seen = []
    with pytest.raises(corotate.CorotateError, match="controller") as caught:
        run(tmp_path, "realtime", "thread", hangs, set={"supervision.heartbeat_timeout_s": 3.0})
    [incident] = caught.value.run.summary["incidents"]
    assert (incident["role"], incident["code"], incident["action"]) == ("controller", "silent", "stopped")
    # Ticks missed between the last two calls are not finished either.
    finished, began = seen[-2:]
    assert finished < incident["tick"] <= began


def test_a_run_that_lost_a_built_in_role_raises(tmp_path):
    kill = {"supervision.on_failure": "stop", "fault": [{"kind": "kill", "role": "observer", "from_tick": 50}]}
    with pytest.raises(corotate.CorotateError, match="observer") as caught:
        corotate.run("rigid-pair", set={**ENDLESS, **kill}, out=tmp_path / "run")
    [incident] = caught.value.run.summary["incidents"]
    assert (incident["role"], incident["code"], incident["action"]) == ("observer", "killed", "stopped")
    assert caught.value.run.accepted is False


def test_a_traceback_in_pytest_is_short(pytester):
    pytester.makepyfile("""
        def test(corotate_run):
            corotate_run("rigid-pair", set={"duration_s": 1.0, "accept": {}}, roles={"controller": lambda tick, inputs, outputs: outputs.comand})
        def test_mistake(corotate_run):
            corotate_run("rigid-pear")
    """)
    done = pytester.runpytest_subprocess("-p", "no:cacheprovider", "--junitxml=junit.xml")
    done.assert_outcomes(failed=2)
    text = done.stdout.str()
    assert "Parameters" not in text and "record_property" not in text, text
    # The launcher's line about the incident is captured too.
    assert "'comand'" in text and "rigid-pear" in text

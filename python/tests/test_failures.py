"""Functions in the seats of roles that raise, hang, die or are slow: what their caller gets, and when."""

import io
import os
import pdb
import subprocess
import sys
import textwrap
import time
import traceback
from pathlib import Path

import pytest

import corotate
from controllers import Fails, Unpicklable

WHERE = pytest.mark.parametrize("clock, where", [
    ("in-process", "thread"), ("lockstep", "thread"), ("lockstep", "process"), ("realtime", "thread"), ("realtime", "process")])
# Long enough not to end by itself before its functions fail; a rate that Python keeps up with anywhere.
ENDLESS = {"duration_s": 60, "tick_hz": 100, "accept": {}}
# The launcher must not find out by silence.
PATIENT = {"supervision.heartbeat_timeout_s": 3600.0}


def run(tmp_path, clock, where, function, **options):
    changes = {**ENDLESS, **options.pop("set", {})}
    return corotate.run("rigid-pair", clock=clock, set=changes, roles={"controller": function}, roles_in=where, out=tmp_path / "run", **options)


def lines(error):
    """An exception with its causes as text: what a user sees."""
    return "".join(traceback.format_exception(error))


@WHERE
@pytest.mark.parametrize("how, tick, raises", [("shape", 0, ValueError), ("typo", 3, AttributeError)])
def test_a_function_that_raises_ends_the_run_with_its_own_exception(tmp_path, clock, where, how, tick, raises):
    function = Fails(how, tick, tmp_path / "at")
    with pytest.raises(raises) as caught:
        run(tmp_path, clock, where, function, set=PATIENT)
    raised_at, raised_s = (tmp_path / "at").read_text().split()
    assert time.time() - float(raised_s) < 300, "the launcher is told, and does not wait for silence"
    assert f"in {how}" in lines(caught.value) and "controllers.py" in lines(caught.value)
    if clock == "in-process":
        return
    made = caught.value.run
    [incident] = made.summary["incidents"]
    assert made.accepted is False and made.summary["verdict"] != "accepted"
    assert incident["role"] == "controller" and f"in {how}" in incident["last_words"]
    # In real time the tick before may not be committed where that one was missed.
    assert incident["tick"] == int(raised_at) if clock == "lockstep" else incident["tick"] <= int(raised_at)


@pytest.mark.parametrize("where", ["thread", "process"])
@pytest.mark.parametrize("how, raises", [("interrupt", KeyboardInterrupt), ("leave", SystemExit), ("unpicklable", Unpicklable)])
def test_whatever_it_is_that_a_function_raises(tmp_path, where, how, raises):
    # An exception that cannot be pickled travels as text.
    raises = corotate.CorotateError if (where, how) == ("process", "unpicklable") else raises
    with pytest.raises(raises) as caught:
        run(tmp_path, "lockstep", where, Fails(how, 5))
    assert f"in {how}" in lines(caught.value) and caught.value.run.accepted is False


def test_a_process_that_dies_is_told(tmp_path):
    with pytest.raises(corotate.CorotateError, match="exit code 7") as caught:
        run(tmp_path, "lockstep", "process", Fails("die", 5))
    assert caught.value.run.summary["incidents"][0]["tick"] == 5


def test_a_function_that_cannot_be_sent_or_received_is_told(tmp_path):
    with pytest.raises(Exception, match="pickle"):
        run(tmp_path, "lockstep", "process", lambda tick, inputs, outputs: None)


@WHERE
@pytest.mark.parametrize("how", ["sleep", "loop"])
def test_a_function_that_hangs_is_left_in_time(tmp_path, clock, where, how):
    # In a process of its own: a function that sleeps goes on for as long as this one lives.
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
    # Within a second where nothing else runs; a loaded machine takes its time to end processes, though not an hour.
    assert float(done.stdout) >= 5, done


def test_a_function_in_pdb_is_waited_for_in_lockstep(tmp_path):
    class Typed(io.StringIO):
        def readline(self):
            time.sleep(3)
            return "continue\n"

    def debugged(tick, inputs, outputs):
        if tick == 5:
            pdb.Pdb(stdin=Typed(), stdout=io.StringIO(), nosigint=True).set_trace()

    made = run(tmp_path, "lockstep", "thread", debugged, set={"supervision.heartbeat_timeout_s": 0.5, "duration_s": 0.5})
    assert made.summary["incidents"] == [] and made.summary["books"]["roles"]["controller"]["executed"] == 51


def test_a_function_that_is_slow_once_is_waited_for_in_lockstep(tmp_path):
    def slow(tick, inputs, outputs):
        if tick == 5:
            time.sleep(3)

    brief = {"supervision.heartbeat_timeout_s": 0.5, "duration_s": 0.5}
    made = run(tmp_path, "lockstep", "thread", slow, set=brief)
    assert made.summary["incidents"] == [] and made.summary["books"]["roles"]["controller"]["executed"] == 51
    limited = {**brief, "launch.external_timeout_s": 0.5}
    with pytest.raises(corotate.CorotateError, match="kept the run waiting for 0.5 s") as caught:
        corotate.run("rigid-pair", set={**ENDLESS, **limited}, roles={"controller": slow}, out=tmp_path / "limited")
    [incident] = caught.value.run.summary["incidents"]
    assert incident["tick"] == 5 and caught.value.run.accepted is False


def test_a_silent_function_is_told_by_the_tick_that_it_is_at(tmp_path):
    def hangs(tick, inputs, outputs):
        seen.append(tick)
        if tick >= 20:
            time.sleep(30)

    seen = []
    with pytest.raises(corotate.CorotateError, match="said nothing") as caught:
        run(tmp_path, "realtime", "thread", hangs, set={"supervision.heartbeat_timeout_s": 3.0})
    [incident] = caught.value.run.summary["incidents"]
    # Ticks that were missed before it began the last one are not finished either.
    finished, began = seen[-2:]
    assert finished < incident["tick"] <= began


def test_a_run_that_lost_a_role_of_its_own_raises(tmp_path):
    lost = {"supervision.on_failure": "stop", "fault": [{"kind": "kill", "role": "observer", "from_tick": 50}]}
    with pytest.raises(corotate.CorotateError, match="observer failed at tick") as caught:
        corotate.run("rigid-pair", set={**ENDLESS, **lost}, out=tmp_path / "run")
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
    # The launcher's own line about the incident is captured beside it.
    assert "no 'comand' here" in text and "rigid-pear" in text

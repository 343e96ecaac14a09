"""Campaigns: in this process, and by workers of an executor."""

import concurrent.futures
import multiprocessing
import os
import re
import signal

import distributed
import pytest

import corotate

CAMPAIGN = {
    "name": "gains", "base": "rigid-pair", "set": {"duration_s": 9.0},
    "axis": [
        {"key": "controller.gain_per_s", "range": {"from": 0.5, "to": 8.0, "points": 8, "log": True}},
        {"key": "leader.initial_rate_rad_s.0", "values": [0.3, 0.6, 0.9, 1.2]},
    ],
    "margin": [{"find": "largest", "key": "controller.gain_per_s", "such_that": "accepted", "from": 0.5, "to": 3000.0, "tolerance": 50.0}],
}
FILES = "cases.csv", "summary.json"


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    return corotate.sweep(CAMPAIGN, out=tmp_path_factory.mktemp("local"))


def same_files(first, second):
    return all((first.directory / name).read_bytes() == (second.directory / name).read_bytes() for name in FILES)


def test_a_row_of_the_frame_equals_a_single_run(local, tmp_path):
    frame = local.frame()
    assert len(frame) == local.counts["rows"] == 32 and frame["accepted"].sum() == local.counts["accepted"] > 0
    row = frame.loc[13]
    run = corotate.run("rigid-pair", clock="in-process", out=tmp_path / "run", set={
        "duration_s": 9.0, "seed": int(row["seed"]), "controller.gain_per_s": [row["controller.gain_per_s"]] * 3,
        "leader.initial_rate_rad_s.0": row["leader.initial_rate_rad_s.0"]})
    assert run.hash == row["hash"] and run.accepted == row["accepted"]
    assert len(local.margins[0]["points"]) == 4 and "gains" in repr(local)


def processes():
    # A forked process would inherit locks that threads of this one hold.
    return concurrent.futures.ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn"))


def test_processes_give_the_same_table(local, tmp_path):
    progress = []
    with processes() as executor:
        swept = corotate.sweep(CAMPAIGN, out=tmp_path, executor=executor, chunk=3, progress=lambda *numbers: progress.append(numbers))
    assert same_files(swept, local) and progress[-1] == (36, 36) and len(progress) == 12


def test_a_killed_pool_worker_loses_no_case(local, tmp_path):
    with processes() as executor:
        killed = []

        def kill(done, every):
            if not killed:
                killed.append(next(iter(executor._processes)))
                os.kill(killed[0], signal.SIGKILL)

        with pytest.warns(RuntimeWarning, match="executor"):
            swept = corotate.sweep(CAMPAIGN, out=tmp_path, executor=executor, chunk=1, progress=kill)
    assert same_files(swept, local)


class LosingExecutor(concurrent.futures.ThreadPoolExecutor):
    """Loses the result of the first task, as Dask may if its worker dies: the future fails although the task did not."""

    lost = 0

    def submit(self, task, *arguments):
        future = super().submit(task, *arguments)
        if not self.lost:
            self.lost += 1
            future.result()
            future = concurrent.futures.Future()
            future.set_exception(ValueError("not enough values to unpack (expected 3, got 1)"))
        return future


def test_a_task_with_a_lost_result_is_repeated(local, tmp_path):
    with LosingExecutor(2) as executor:
        swept = corotate.sweep(CAMPAIGN, out=tmp_path, executor=executor, chunk=3)
    assert executor.lost == 1 and same_files(swept, local)


class FailingExecutor(concurrent.futures.ThreadPoolExecutor):
    """Fails every task."""

    tries = 0

    def submit(self, task, *arguments):
        self.tries += 1
        return super().submit(lambda: 1 / 0)


def test_a_task_that_fails_twice_raises(tmp_path):
    with FailingExecutor(1) as executor, pytest.raises(ZeroDivisionError):
        corotate.sweep(CAMPAIGN, out=tmp_path, executor=executor, chunk=1000)
    assert executor.tries == 2


def test_dask_gives_the_same_table_even_if_a_worker_is_killed(local, tmp_path):
    cluster = distributed.LocalCluster(n_workers=3, threads_per_worker=1, dashboard_address=None, local_directory=str(tmp_path / "dask"))
    with cluster, distributed.Client(cluster) as client:
        workers, killed = client.run(os.getpid), []

        def kill(done, every):
            if not killed:
                killed.append(next(iter(workers.values())))
                os.kill(killed[0], signal.SIGKILL)

        swept = corotate.sweep(CAMPAIGN, out=tmp_path / "out", executor=client.get_executor(), chunk=1, progress=kill)
        assert killed and killed[0] not in client.run(os.getpid).values()
    assert same_files(swept, local)


def test_an_interrupted_campaign_is_resumed(local, tmp_path):
    def interrupt(done, every):
        if done > 10:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        corotate.sweep(CAMPAIGN, out=tmp_path, threads=1, progress=interrupt)
    assert not (tmp_path / "cases.csv").exists()
    progress = []
    swept = corotate.sweep(CAMPAIGN, out=tmp_path, progress=lambda *numbers: progress.append(numbers))
    assert progress[0][0] > 10 and same_files(swept, local)


def test_wrong_campaigns_raise(tmp_path):
    with pytest.raises(ValueError, match="timing-mop"):
        corotate.sweep("timing-mop")
    with pytest.raises(ValueError, match="gian"):
        corotate.sweep(CAMPAIGN | {"axis": [{"key": "controller.gian", "values": [1.0]}]}, out=tmp_path)
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "file").touch()
    with pytest.raises(corotate.CorotateError, match=re.escape(str(tmp_path / "used"))):
        corotate.sweep(CAMPAIGN, out=tmp_path / "used")

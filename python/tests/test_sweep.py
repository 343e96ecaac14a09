"""Campaigns: here, and by workers of others."""

import concurrent.futures
import multiprocessing
import os
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


def the_same(one, other):
    return all((one.directory / name).read_bytes() == (other.directory / name).read_bytes() for name in FILES)


def test_the_table_is_a_frame_and_a_case_is_a_run(local, tmp_path):
    frame = local.frame()
    assert len(frame) == local.counts["rows"] == 32 and frame["accepted"].sum() == local.counts["accepted"] > 0
    row = frame.loc[13]
    run = corotate.run("rigid-pair", clock="in-process", out=tmp_path / "run", set={
        "duration_s": 9.0, "seed": int(row["seed"]), "controller.gain_per_s": [row["controller.gain_per_s"]] * 3,
        "leader.initial_rate_rad_s.0": row["leader.initial_rate_rad_s.0"]})
    assert run.hash == row["hash"] and run.accepted == row["accepted"]
    assert len(local.margins[0]["points"]) == 4 and "gains" in repr(local)


def processes():
    # A copy of this process would have its threads' locks as they are.
    return concurrent.futures.ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn"))


def test_processes_give_the_same_table(local, tmp_path):
    told = []
    with processes() as executor:
        swept = corotate.sweep(CAMPAIGN, out=tmp_path, executor=executor, chunk=3, progress=lambda *numbers: told.append(numbers))
    assert the_same(swept, local) and told[-1] == (36, 36) and len(told) == 12


def test_a_pool_whose_worker_is_killed_costs_no_case(local, tmp_path):
    with processes() as executor:
        killed = []

        def kill(done, every):
            if not killed:
                killed.append(next(iter(executor._processes)))
                os.kill(killed[0], signal.SIGKILL)

        with pytest.warns(RuntimeWarning, match="the executor broke"):
            swept = corotate.sweep(CAMPAIGN, out=tmp_path, executor=executor, chunk=1, progress=kill)
    assert the_same(swept, local)


class Loses(concurrent.futures.ThreadPoolExecutor):
    """Loses the result of the first task, as Dask may with the worker that had it: the future fails, and not by the work."""

    lost = 0

    def submit(self, task, *arguments):
        future = super().submit(task, *arguments)
        if not self.lost:
            self.lost += 1
            future.result()
            future = concurrent.futures.Future()
            future.set_exception(ValueError("not enough values to unpack (expected 3, got 1)"))
        return future


def test_a_lost_result_is_made_again(local, tmp_path):
    with Loses(2) as executor:
        swept = corotate.sweep(CAMPAIGN, out=tmp_path, executor=executor, chunk=3)
    assert executor.lost == 1 and the_same(swept, local)


class Fails(concurrent.futures.ThreadPoolExecutor):
    tries = 0

    def submit(self, task, *arguments):
        self.tries += 1
        return super().submit(lambda: 1 / 0)


def test_work_that_fails_again_is_an_error(tmp_path):
    with Fails(1) as executor, pytest.raises(ZeroDivisionError):
        corotate.sweep(CAMPAIGN, out=tmp_path, executor=executor, chunk=1000)
    assert executor.tries == 2


def test_dask_gives_the_same_table_also_when_a_worker_is_killed(local, tmp_path):
    cluster = distributed.LocalCluster(n_workers=3, threads_per_worker=1, dashboard_address=None, local_directory=str(tmp_path / "dask"))
    with cluster, distributed.Client(cluster) as client:
        workers, killed = client.run(os.getpid), []

        def kill(done, every):
            if not killed:
                killed.append(next(iter(workers.values())))
                os.kill(killed[0], signal.SIGKILL)

        swept = corotate.sweep(CAMPAIGN, out=tmp_path / "out", executor=client.get_executor(), chunk=1, progress=kill)
        assert killed and killed[0] not in client.run(os.getpid).values()
    assert the_same(swept, local)


def test_what_was_ended_is_gone_on_with(local, tmp_path):
    def end(done, every):
        if done > 10:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        corotate.sweep(CAMPAIGN, out=tmp_path, threads=1, progress=end)
    assert not (tmp_path / "cases.csv").exists()
    told = []
    swept = corotate.sweep(CAMPAIGN, out=tmp_path, progress=lambda *numbers: told.append(numbers))
    assert told[0][0] > 10 and the_same(swept, local)


def test_mistakes_are_told(tmp_path):
    with pytest.raises(ValueError, match="no campaign `timing-mop`"):
        corotate.sweep("timing-mop")
    with pytest.raises(ValueError, match="gian"):
        corotate.sweep(CAMPAIGN | {"axis": [{"key": "controller.gian", "values": [1.0]}]}, out=tmp_path)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").touch()
    with pytest.raises(corotate.CorotateError, match="is not empty"):
        corotate.sweep(CAMPAIGN, out=tmp_path / "other")

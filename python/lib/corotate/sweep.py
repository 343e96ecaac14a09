"""Campaigns: one scenario run many times, here or wherever there is room."""

import concurrent.futures
import functools
import json
import os
import warnings
from dataclasses import dataclass, field
from pathlib import Path

from . import _corotate
from .scenario import given, overrides


@dataclass(frozen=True)
class Sweep:
    """A campaign that has been run. `summary` is `summary.json` as a dict: counts, axes, margins; `directory` has all files."""

    summary: dict = field(repr=False)
    directory: Path

    @property
    def counts(self):
        """Rows, how many are accepted, not accepted and not judged, and how the cases ended."""
        return self.summary["counts"]

    @property
    def margins(self):
        """Per margin a dict with its key and its points."""
        return self.summary["margins"]

    def frame(self):
        """The table as a pandas frame, a row per case."""
        import pandas
        return pandas.read_csv(self.directory / "cases.csv", index_col="case", dtype={"hash": str})

    def __repr__(self):
        counts = self.counts
        return f"<Sweep {self.summary['name']}: {counts['accepted']} of {counts['rows']} cases accepted; {self.directory}>"


@functools.lru_cache(maxsize=4)
def _campaign(text, identity):
    campaign = _corotate.Campaign(text, "text", [])
    if campaign.identity() != identity:
        raise RuntimeError("this worker reads the campaign differently: give it the same version of corotate")
    return campaign


def _work(text, identity, build, pieces):
    """Runs some pieces of a campaign's work: the task of a worker."""
    if build != _corotate.build:
        raise RuntimeError(f"this worker has corotate {_corotate.build}, and the campaign was begun with {build}; install the same")
    return _campaign(text, identity).work(pieces)


def sweep(campaign, *, set={}, out=None, executor=None, threads=None, chunk=16, progress=None):
    """Runs a campaign, or what is left of it in `out`, to its end.

    `campaign` is a path, the name of one that ships, or a dict. `set` changes keys of the scenario in every case. Without
    `executor` it runs on `threads` threads of this process (one per core). With one (`concurrent.futures`, Dask's
    `client.get_executor()`) its workers get `chunk` pieces of work at a time; the table is the same, to the last bit, if they have the
    same version and processors that compute alike. `progress` is called with how many pieces are done, and how many there are.

    What has come is in the journal at once: a sweep that was ended is gone on with by the same call with the same `out`.
    """
    cases = _corotate.Campaign(*given(campaign), overrides(set))
    directory = Path(cases.directory(None if out is None else str(out)))
    if executor is None or not _elsewhere(cases, directory, executor, chunk, progress):
        if not cases.sweep(str(directory), threads or len(os.sched_getaffinity(0)), progress):
            raise RuntimeError(f"the campaign was not run to its end; what is done is in {directory}")
    return Sweep(json.loads((directory / "summary.json").read_text()), directory)


def _elsewhere(cases, directory, executor, chunk, progress):
    """Hands the work out; whether all of it was done. What a broken executor leaves is done by the caller."""
    results = cases.collect(str(directory))
    left, every = results.left(), cases.pieces()
    task = functools.partial(_work, cases.text(), cases.identity(), _corotate.build)
    done, futures = every - len(left), {}

    def submit(pieces, again):
        futures[executor.submit(task, pieces)] = pieces, again

    try:
        for at in range(0, len(left), chunk):
            submit(left[at:at + chunk], True)
        while futures:
            for future in concurrent.futures.wait(futures, return_when=concurrent.futures.FIRST_COMPLETED).done:
                pieces, again = futures.pop(future)
                try:
                    entries = future.result()
                except concurrent.futures.BrokenExecutor:
                    raise
                except Exception:
                    # A scheduler that lost a worker may lose its results too; what the work itself says, it says twice.
                    if not again:
                        raise
                    submit(pieces, False)
                    continue
                for entry in entries:
                    results.add(entry)
                    done += 1
                if progress is not None:
                    progress(done, every)
        results.finish()
        return True
    except concurrent.futures.BrokenExecutor as error:
        warnings.warn(f"the executor broke ({error}): {every - done} of {every} pieces of work are done in this process", RuntimeWarning)
        return False
    finally:
        # Without effect on those that have come.
        for future in futures:
            future.cancel()
        results.close()

"""Recordings as arrays."""

import numpy as np
import pytest

import corotate


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    out = tmp_path_factory.mktemp("recording") / "run"
    return corotate.run("rigid-pair", clock="in-process", record=True, out=out).recording


def test_a_field_is_one_read_only_array(recording):
    rates = recording.array("leader/estimate.omega_rad_s")
    assert rates.shape == (10_001, 3) and rates.dtype == np.float64
    assert np.shares_memory(rates, recording.array("leader/estimate.omega_rad_s")) and not rates.flags.writeable
    assert recording.array("leader/estimate.status").shape == (10_001,)
    assert np.array_equal(recording.ticks("leader/estimate"), np.arange(10_001))
    assert recording.time_s("leader/truth")[-1] == pytest.approx(10.0)
    assert recording.signals["follower/command"]["acceleration_rad_s2"] == 3


def test_many_signals_are_read_in_one_pass(recording):
    loaded = corotate.Recording(recording.path).load()
    for name in ("leader/truth.omega_rad_s", "follower/command.acceleration_rad_s2"):
        assert np.array_equal(loaded.array(name), recording.array(name))
    assert loaded.load("leader/truth") is loaded


def test_values_equal_the_exported_ones(recording, tmp_path):
    import csv
    import subprocess
    import sys
    subprocess.run([sys.executable, "-m", "corotate", "export", recording.path, "--csv", str(tmp_path)], check=True, capture_output=True)
    [path] = [path for path in tmp_path.iterdir() if "estimate" in path.name]
    with open(path, encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    column = next(name for name in rows[0] if name.startswith("omega_rad_s") and "2" in name)
    assert np.array_equal([float(row[column]) for row in rows], recording.array("leader/estimate.omega_rad_s")[:, 2])


def test_status_bits_are_columns(recording):
    frame = recording.frame("leader/estimate")
    assert frame.index.name == "time_s" and frame["initial"].dtype == bool and frame["initial"].iloc[0]
    assert "omega_rad_s[2]" in frame.columns and "status" not in frame.columns
    table = recording.arrow("follower/truth")
    assert table.num_rows == 10_001 and "time_s" in table.column_names


def test_a_fleet_s_array_has_an_axis_of_bodies(tmp_path):
    run = corotate.run("rigid-fleet", clock="in-process", set={"duration_s": 0.2, "accept": {}}, record=True, out=tmp_path / "fleet")
    recording = run.recording
    signal = next(name for name in recording.signals if name.endswith("/truth") and not name.startswith("leader"))
    rates = recording.array(f"{signal}.omega_rad_s")
    assert rates.ndim == 3 and rates.shape[2] == 3 and rates.shape[1] > 1


def test_an_unknown_signal_field_or_file_raises(recording, tmp_path):
    with pytest.raises(KeyError, match=r"leader/estimat\b.*leader/estimate\b"):
        recording.array("leader/estimat.omega_rad_s")
    with pytest.raises(KeyError, match=r"leader/estimate\b.*\bomega\b.*\bomega_rad_s\b"):
        recording.array("leader/estimate.omega")
    with pytest.raises(corotate.CorotateError):
        corotate.Recording(tmp_path / "none.mcap")

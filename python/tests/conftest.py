"""Fixtures: a private runtime directory per test, and the law of rigid-pair's controller. The motion of a free body."""

import tempfile

import numpy as np
import pytest

pytest_plugins = ["pytester"]


def euler(moments, rate, t):
    """Returns the free motion of a body, by classical Runge-Kutta steps: (n, 3) rad/s."""
    a, b, c = moments
    slope = lambda w: np.array([(b - c) / a * w[1] * w[2], (c - a) / b * w[2] * w[0], (a - b) / c * w[0] * w[1]])
    rates, w = [], np.array(rate, dtype=float)
    for step in np.diff(t, append=2 * t[-1] - t[-2]):
        rates.append(w)
        k1 = slope(w)
        k2 = slope(w + step / 2 * k1)
        k3 = slope(w + step / 2 * k2)
        w = w + step / 6 * (k1 + 2 * k2 + 2 * k3 + slope(w + step * k3))
    return np.array(rates)


@pytest.fixture(autouse=True)
def own_runtime(monkeypatch):
    # A short path: socket names are limited in length.
    with tempfile.TemporaryDirectory(prefix="ct", dir="/tmp") as directory:
        monkeypatch.setenv("XDG_RUNTIME_DIR", directory)
        yield


@pytest.fixture
def law():
    """A controller with the law of rigid-pair's."""
    import corotate
    law = corotate.Synchronizer([1.0, 2.0, 2.5], gain=4.0)

    def controller(tick, inputs, outputs):
        if inputs.estimate is not None and inputs.measurement is not None:
            measured = inputs.measurement
            outputs.command.acceleration_rad_s2 = law.command(inputs.estimate.omega_rad_s, measured.omega_rad_s, measured.applied_rad_s2)

    return controller

"""Identification, observers and control laws on arrays."""

import numpy as np
import pytest

import corotate
from conftest import euler

BODY = [1.0, 2.0, 2.5]
T = np.arange(0, 20, 0.01)


def test_inertia_is_found_up_to_scale():
    found = corotate.identify(T, euler(BODY, [0.6, -0.4, 0.8], T), damping=False)
    assert np.allclose(found.moments, np.array(BODY) / 2.5, atol=1e-3) and abs(found.closure) < 1e-3
    assert np.allclose(np.abs(found.axes), np.eye(3), atol=0.02) and found.r_squared.min() > 0.99


def test_segments_are_identified_separately():
    twice = np.vstack([euler(BODY, rate, T) for rate in ([0.6, -0.4, 0.8], [0.2, 0.7, -0.5])])
    labels = np.repeat(["a", "b"], len(T))
    found = corotate.identify(np.concatenate([T, T]), twice, segments=labels, damping=False)
    assert np.allclose(found.moments, np.array(BODY) / 2.5, atol=1e-3)


@pytest.mark.parametrize("hidden", [1, 2, 3])
@pytest.mark.parametrize("filter", [{"decay": 5.0}, {"bandwidth": 8.0}])
def test_a_hidden_rate_is_reconstructed(hidden, filter):
    w = euler(BODY, [0.6, -0.4, 0.8], T)
    seen = w.copy()
    seen[:, hidden - 1] = np.nan
    rate, observed = corotate.HiddenRate(BODY, hidden, **filter).filter(T, seen)
    assert rate.shape == (len(T),) and observed.dtype == bool
    assert np.abs(rate - w[:, hidden - 1])[len(T) // 2:].max() < 5e-3


def test_wrong_arguments_raise():
    with pytest.raises(ValueError, match=r"\bdecay\b.*\bbandwidth\b"):
        corotate.HiddenRate(BODY)
    with pytest.raises(corotate.CorotateError):
        corotate.HiddenRate([1, 1, 5], decay=1.0).filter(T, np.zeros((len(T), 3)))
    with pytest.raises(ValueError, match=r"\(n, 3\)"):
        corotate.identify(T, np.zeros((len(T), 2)))
    with pytest.raises(ValueError, match=rf"\b{T[0]:g} s\b.*\bfinite\b"):
        corotate.identify(T, np.full((len(T), 3), np.nan))
    w = euler(BODY, [0.6, -0.4, 0.8], T)
    for index, value in ((5, T[4]), (5, T[3]), (5, np.nan), (0, np.inf)):
        t = T.copy()
        t[index] = value
        for call in (corotate.identify, corotate.HiddenRate(BODY, decay=4.0).filter):
            with pytest.raises(ValueError, match=rf"\bsample {index}\b"):
                call(t, w)
    w[7, 0] = np.nan
    with pytest.raises(ValueError, match=r"\bx of sample 7\b"):
        corotate.HiddenRate(BODY, decay=4.0).filter(T, w)


def test_dates_are_times():
    w = euler(BODY, [0.6, -0.4, 0.8], T)
    dates = np.datetime64("2026-11-28T12:00:00") + (T * 1e9).round().astype("timedelta64[ns]")
    rate, _ = corotate.HiddenRate(BODY, decay=5.0).filter(dates, w)
    expected, _ = corotate.HiddenRate(BODY, decay=5.0).filter(T, w)
    assert np.nanmax(np.abs(rate - expected)) < 1e-6
    assert np.allclose(corotate.identify(dates, w, damping=False).moments, np.array(BODY) / 2.5, atol=1e-3)


def test_a_motion_that_is_not_free_or_in_another_unit_gives_no_body():
    driven = np.stack([np.sin(3 * T), np.cos(2 * T) + 1, 0.5 * T], 1)
    with pytest.raises(ValueError, match="free rigid body"):
        corotate.identify(T, driven)
    with pytest.raises(ValueError, match="unit"):
        corotate.identify(T, np.degrees(euler(BODY, [0.6, -0.4, 0.8], T)))


@pytest.mark.parametrize("name, body, target, damping", [("orbit-hold", "spacecraft", 1.3, 1.8), ("orbit-rendezvous", "follower", None, 2.0)])
def test_the_orbit_law_equals_that_of_a_run(tmp_path, name, body, target, damping):
    run = corotate.run(name, clock="in-process", set={"duration_s": 1, "controller.predict": True, "accept": {}}, record=True, out=tmp_path / "run")
    observed = "leader" if target is None else body
    law = corotate.OrbitHold((1.0, damping, 1.0), thrust_max=0.5, lead_s=1e-3)

    def state(signal, tick):
        parts = [run.recording.array(f"{signal}.{field}")[tick] for field in ("radius_du", "angle_rad", "velocity_du_s")]
        return np.hstack(parts)

    for tick in (0, 1, 500):
        estimate = state(f"{observed}/estimate", tick)
        own = state(f"{body}/measurement", tick) if target is None else estimate
        applied = run.recording.array(f"{body}/measurement.applied_du_s2")[tick]
        thrust = law.command(own, estimate if target is None else target, applied)
        assert np.array_equal(thrust, run.recording.array(f"{body}/command.thrust_du_s2")[tick]), tick
    with pytest.raises(ValueError, match=r"\b2\b.*\(r, theta, vr, vtheta\)"):
        law.command(own, [1.0, 2.0])

"""The observers on arrays."""

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


def test_segments_are_held_apart():
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


def test_mistakes_are_told():
    with pytest.raises(ValueError, match="decay"):
        corotate.HiddenRate(BODY)
    with pytest.raises(corotate.CorotateError):
        corotate.HiddenRate([1, 1, 5], decay=1.0).filter(T, np.zeros((len(T), 3)))
    with pytest.raises(ValueError, match=r"\(n, 3\)"):
        corotate.identify(T, np.zeros((len(T), 2)))
    with pytest.raises(ValueError, match="not finite"):
        corotate.identify(T, np.full((len(T), 3), np.nan))

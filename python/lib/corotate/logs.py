"""The papers' observers on arrays: a body's inertia, a rate that is not measured, and the law."""

import json
from dataclasses import dataclass

import numpy as np

from . import _corotate


def _log(t, w, segments):
    t = np.asarray(t)
    if np.issubdtype(t.dtype, np.datetime64):
        # Seconds since the first one: a float has no room for nanoseconds since 1970.
        t = (t - t[:1]) / np.timedelta64(1, "s")
    elif np.issubdtype(t.dtype, np.timedelta64):
        t = t / np.timedelta64(1, "s")
    t = np.ascontiguousarray(t, dtype=float)
    w = np.ascontiguousarray(w, dtype=float)
    labels = np.zeros(len(t), dtype=np.int64) if segments is None else np.unique(np.asarray(segments), return_inverse=True)[1]
    return t, w, np.ascontiguousarray(labels, dtype=np.int64).reshape(-1)


@dataclass(frozen=True)
class Identified:
    """A body's inertia up to scale, the largest moment being 1.

    `moments` are about the sensor's axes, (3,); `tensor_moments` and `axes`, (3, 3) with the principal axes as columns, are of the
    whole tensor. `coefficients` are those of Euler's equations, each axis by itself, and `closure` their identity, zero for every
    body. Deviations are standard deviations by resampling, None if there is too little. `findings` says what the log cannot tell.
    `moments`, or `tensor_moments` and `axes`, are None if the log contradicts such a body.
    """

    coefficients: np.ndarray
    coefficients_deviation: np.ndarray
    closure: float
    r_squared: np.ndarray
    moments: np.ndarray
    moments_deviation: np.ndarray
    damping_per_s: float
    tensor_moments: np.ndarray
    tensor_deviation: np.ndarray
    axes: np.ndarray
    findings: list


def identify(t, w, *, segments=None, damping=True):
    """The inertia of a body from a log of its angular velocity.

    Parameters
    ----------
    t : (n,) s, or datetime64
    w : (n, 3) rad/s
    segments : (n,) labels
        Where a label changes, the motion was not free in between.
    damping : bool
        True to fit the torque of the air too.

    Raises
    ------
    ValueError
        if no free rigid body moves so, a value is not finite, or a time is not after the one before.

    >>> t = np.arange(0, 20, 0.01)
    >>> w = euler([1.0, 2.0, 2.5], [0.6, -0.4, 0.8], t)
    >>> corotate.identify(t, w, damping=False).moments.round(3)
    array([0.4, 0.8, 1. ])
    """
    found = json.loads(_corotate.identify(*_log(t, w, segments), damping))
    arrays = {key: np.array(value) if isinstance(value, list) and key != "findings" else value for key, value in found.items()}
    return Identified(**arrays)


class HiddenRate:
    """The rate about one axis from the other two, by the method of invariant relations.

    Parameters
    ----------
    inertia : (3,) any unit
    hidden : 1, 2 or 3
    decay : 1/s
        Decay rate of the error (first order).
    bandwidth : rad/s
        Instead of decay, a filter of second order.
    damping : 1/s
        Damping by the air; 0 without.
    guess : rad/s
        The first estimate of every segment; without one, that of the first step.
    floor : rad/s
        Smallest measured rate that carries information.

    >>> t = np.arange(0, 20, 0.01)
    >>> w = euler([1.0, 2.0, 2.5], [0.6, -0.4, 0.8], t)
    >>> z, observed = corotate.HiddenRate([1.0, 2.0, 2.5], hidden=3, decay=4.0).filter(t, w)
    >>> bool(abs(z[-1] - w[-1, 2]) < 1e-3)
    True
    """

    def __init__(self, inertia, hidden=3, decay=None, *, bandwidth=None, damping=0.0, guess=None, floor=1e-3):
        if (decay is None) == (bandwidth is None):
            raise ValueError("give decay (first order) or bandwidth (second order)")
        self._filter = ("first", float(decay)) if bandwidth is None else ("second", float(bandwidth))
        self._body, self._rest = list(map(float, inertia)), (float(damping), guess, float(floor))
        self.hidden = hidden

    def filter(self, t, w, *, segments=None):
        """Estimates the hidden rate along a log: (n,) rad/s, nan before the first information; and (n,) bool, true where a step was informative.

        `t` is (n,) s, or datetime64, and rises within a segment; `w` is (n, 3) rad/s. The hidden column is not read and may hold
        anything; other values must be finite (ValueError).
        """
        t, w, labels = _log(t, w, segments)
        return _corotate.reconstruct(t, w, labels, self._body, self.hidden, *self._filter, *self._rest)


class Synchronizer:
    """The law that makes a follower turn as its leader does: `inertia` (3,), `gain` 1/s, `lead_s` how far both are predicted."""

    def __init__(self, inertia, gain, lead_s=0.0):
        self._body, self._lead = list(map(float, inertia)), float(lead_s)
        self._gain = list(map(float, np.broadcast_to(gain, 3)))

    def command(self, leader, follower, applied=(0.0, 0.0, 0.0)):
        """The acceleration to apply, (3,) rad/s²: of both rates, rad/s, and what the actuators apply now, rad/s²."""
        vectors = [list(map(float, vector)) for vector in (leader, follower, applied)]
        return np.array(_corotate.command(self._body, self._gain, self._lead, *vectors))


class OrbitHold:
    """The law that takes a body to an orbit: `gain` (radius 1/s², radial 1/s, transverse 1/s), each component of the thrust within
    `thrust_max` du/s²; `mu` du³/s² of the centre, `radii` du between which its field holds, `lead_s` how far motions are predicted."""

    def __init__(self, gain, thrust_max, mu=1.0, *, radii=(0.05, 10.0), lead_s=0.0):
        self._rest = (float(mu), list(map(float, radii)), list(map(float, gain)), float(thrust_max), float(lead_s))

    def command(self, body, target, applied=(0.0, 0.0)):
        """The thrust to apply, (2,) du/s², radial and transverse: of the `body`'s state (r, θ, Vr, Vθ), du, rad and du/s, the radius
        of a circle or a leader's state as `target`, and the thrust that acts now, du/s²."""
        body, target, applied = (list(map(float, np.atleast_1d(vector))) for vector in (body, target, applied))
        return np.array(_corotate.thrust(*self._rest, body, target, applied))

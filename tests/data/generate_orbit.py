"""The closed loop of orbit-hold, computed independently of the project and of its method. Needs nothing but Python.

    python3 generate_orbit.py    # writes let_orbit_hold_100hz.csv beside this script

The plant is integrated in Cartesian coordinates. The observer is the paper's own (15), (16), with its auxiliary variables z,
as an ordinary differential equation along the true motion: no invariant relation, no increments, no exact discretisation.
"""
import csv
from math import atan2, hypot, sqrt

MU, TARGET, K_R, K_V, K_T, U_MAX, L = 1.0, 1.3, 1.0, 1.8, 1.0, 0.5, -4.0
TICK_S, TICKS, SUBSTEPS = 0.01, 1000, 64


def rhs(s, u):
    x, y, vx, vy, z1, z2 = s
    r = hypot(x, y)
    cos, sin = x / r, y / r
    gamma1 = (-MU / r**2 + u[0]) * cos - u[1] * sin
    gamma2 = (-MU / r**2 + u[0]) * sin + u[1] * cos
    return [vx, vy, gamma1, gamma2, L * L * x + L * z1 - gamma1, L * L * y + L * z2 - gamma2]


def rk4(s, u, h):
    def ahead(k, part):
        return [a + part * b for a, b in zip(s, k)]

    k1 = rhs(s, u)
    k2 = rhs(ahead(k1, h / 2), u)
    k3 = rhs(ahead(k2, h / 2), u)
    k4 = rhs(ahead(k3, h), u)
    return [a + h / 6 * (p + 2 * q + 2 * v + w) for a, p, q, v, w in zip(s, k1, k2, k3, k4)]


def polar(s, v1, v2):
    angle = atan2(s[1], s[0])
    r = hypot(s[0], s[1])
    return r, angle, (v1 * s[0] + v2 * s[1]) / r, (v2 * s[0] - v1 * s[1]) / r


def command(r, vr, vt):
    ur = -(vt * vt / r - MU / r**2) - K_R * (r - TARGET) - K_V * vr
    ut = vr * vt / r - K_T * (vt - sqrt(MU / TARGET))
    return [min(max(value, -U_MAX), U_MAX) for value in (ur, ut)]


def main():
    # phi-hat = -L (x, y) - z is zero at first.
    s, u, rows = [1.0, 0.0, 0.1, 0.95, -L * 1.0, 0.0], [0.0, 0.0], []
    for tick in range(TICKS + 1):
        r, _, vr, vt = polar(s, s[2], s[3])
        _, _, vr_estimate, vt_estimate = polar(s, -L * s[0] - s[4], -L * s[1] - s[5])
        rows.append([tick, tick * TICK_S, r, vr, vt, vr_estimate, vt_estimate, *u])
        following = command(r, vr_estimate, vt_estimate)
        for _ in range(SUBSTEPS):
            s = rk4(s, u, TICK_S / SUBSTEPS)
        u = following
    header = ["tick", "time_s", "r_du", "vr_du_s", "vtheta_du_s", "vr_estimate_du_s", "vtheta_estimate_du_s",
              "ur_applied_du_s2", "utheta_applied_du_s2"]
    with open("let_orbit_hold_100hz.csv", "w", newline="") as f:
        writer = csv.writer(f)
        writer.writerow(header)
        writer.writerows([repr(float(value)) for value in row] for row in rows)


if __name__ == "__main__":
    main()

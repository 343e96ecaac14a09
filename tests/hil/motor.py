"""A foreign follower for examples/motor-pair, with the links of follower.py, which do not depend on the rig.

Must not know more of the motor than the scenario in the seat contains.
"""

import math
import sys

import follower


class Motor:
    """J dw/dt = k i - b w, under a constant current."""

    RIG = "motor-pair"

    def __init__(self, scenario, _name):
        motor = scenario["motor"]
        self.gain = motor["torque_n_m_per_a"] / motor["friction_n_m_s"]
        self.rate = motor["friction_n_m_s"] / motor["inertia_kg_m2"]
        self.speed, self.current = 0.0, 0.0

    def accepts(self, command):
        return math.isfinite(command.current_a)

    def apply(self, command):
        self.current = command.current_a

    def apply_safe(self):
        self.current = 0.0

    def measured(self):
        return {"speed_rad_s": self.speed, "current_a": self.current}

    def truth(self):
        return {**self.measured(), "load_n_m": 0.0}

    def flow(self, dt_s):
        steady_speed = self.gain * self.current
        self.speed = steady_speed + (self.speed - steady_speed) * math.exp(-self.rate * dt_s)


if __name__ == "__main__":
    sys.exit(follower.main(Motor))

"""Controller functions that can be pickled, as role processes need them."""

import os
import sys
import time

import corotate

LAW = corotate.Synchronizer([1.0, 2.0, 2.5], gain=4.0)


def controller(tick, inputs, outputs):
    measured = inputs.measurement
    if inputs.estimate is not None and measured is not None:
        outputs.command.acceleration_rad_s2 = LAW.command(inputs.estimate.omega_rad_s, measured.omega_rad_s, measured.applied_rad_s2)


# Time in which a failure ends a run even on a busy machine, s: 0.2 on an idle one, 2.05 at a load of 25. All timeouts that tests set are longer.
SOON_S = 10
# Parameters of the scenarios of examples/cart-pole and examples/motor-pair.
GAIN = (-9.213, -9.695, -56.31, -12.66)
INERTIA_KG_M2, FRICTION_N_M_S, TORQUE_N_M_PER_A = 1e-3, 2e-3, 5e-2


def feedback(state, reference_m):
    """Returns the force of cart-pole's law, in the order of its operations."""
    error = (state[0] - reference_m, *state[1:])
    position, speed, angle, rate = (gain * value for gain, value in zip(GAIN, error))
    return -((position + angle) + (speed + rate))


def cart_pole(tick, inputs, outputs):
    estimate = inputs.estimate
    if estimate is not None:
        state = (estimate.position_m, estimate.speed_m_s, estimate.angle_rad, estimate.rate_rad_s)
        outputs.command.force_n = feedback(state, inputs.value("reference.position_m"))


def motor_pair(tick, inputs, outputs):
    leader, own = inputs.estimate, inputs.measurement
    if leader is not None and own is not None:
        rise_rad_s2 = leader.rise_rad_s2 - inputs.value("motor.gain_per_s") * (own.speed_rad_s - leader.speed_rad_s)
        outputs.command.current_a = (INERTIA_KG_M2 * rise_rad_s2 + FRICTION_N_M_S * own.speed_rad_s) / TORQUE_N_M_PER_A


class Unpicklable(Exception):
    def __init__(self, message, detail):
        # Pickle stores only the arguments of the base class, so a copy lacks the second one.
        super().__init__(message)


class Fails:
    """A controller that fails in the given way at a tick, or at the next one if that is missed."""

    def __init__(self, how, tick, marker=None, role="controller"):
        self.how, self.tick, self.marker, self.role = how, tick, marker, role

    def __call__(self, tick, inputs, outputs):
        if tick < self.tick:
            return
        if self.marker is not None and not os.path.exists(self.marker):
            with open(self.marker, "w") as marker:
                marker.write(f"{tick} {time.time()}")
        getattr(self, self.how)(outputs)

    def typo(self, outputs):
        outputs.comand

    def shape(self, outputs):
        sample = {"controller": "command", "observer": "estimate"}.get(self.role, "measurement")
        setattr(outputs[sample], "acceleration_rad_s2" if self.role == "controller" else "omega_rad_s", [1, 2])

    def interrupt(self, outputs):
        raise KeyboardInterrupt

    def leave(self, outputs):
        sys.exit(3)

    def unpicklable(self, outputs):
        raise Unpicklable("message", "detail")

    def die(self, outputs):
        os._exit(7)

    def sleep(self, outputs):
        time.sleep(3600)

    def loop(self, outputs):
        while True:
            pass

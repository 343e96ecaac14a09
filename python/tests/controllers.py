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

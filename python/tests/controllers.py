"""Functions that a process of its own can be given."""

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
    def __init__(self, one, two):
        super().__init__(one)


class Fails:
    """Fails in some way from a tick on, also if that tick itself is missed."""

    def __init__(self, how, tick, marker=None):
        self.how, self.tick, self.marker = how, tick, marker

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
        outputs.command.acceleration_rad_s2 = [1, 2]

    def interrupt(self, outputs):
        raise KeyboardInterrupt

    def leave(self, outputs):
        sys.exit(3)

    def unpicklable(self, outputs):
        raise Unpicklable("one", "two")

    def die(self, outputs):
        os._exit(7)

    def sleep(self, outputs):
        time.sleep(3600)

    def loop(self, outputs):
        while True:
            pass

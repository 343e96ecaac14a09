"""Functions that a process of its own can be given."""

import corotate

LAW = corotate.Synchronizer([1.0, 2.0, 2.5], gain=4.0)


def controller(tick, inputs, outputs):
    measured = inputs.measurement
    if inputs.estimate is not None and measured is not None:
        outputs.command.acceleration_rad_s2 = LAW.command(inputs.estimate.omega_rad_s, measured.omega_rad_s, measured.applied_rad_s2)

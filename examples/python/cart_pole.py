"""The controller of examples/cart-pole in Python: the state feedback, on the estimate of the loop's observer.

    target/release/cart-pole run cart-pole --external controller
    python examples/python/cart_pole.py DOMAIN-OR-SEAT
"""

import sys

import corotate


def main(path):
    seat = corotate.Seat(path, "controller")
    gain = seat.scenario["cart"]["gain"]
    for _tick, inputs, outputs in seat:
        estimate = inputs.estimate
        if estimate is None:
            continue  # No estimate at this tick: the force is zero.
        error_m = estimate.position_m - inputs.value("reference.position_m")
        error = (error_m, estimate.speed_m_s, estimate.angle_rad, estimate.rate_rad_s)
        position, speed, angle, rate = (factor * value for factor, value in zip(gain, error))
        # In the order of the operations of the law in Rust, for the same bits.
        outputs.command.force_n = -((position + angle) + (speed + rate))


if __name__ == "__main__":
    main(sys.argv[1])

"""A loop under test: copy this directory, name your scenario, put your controller in. `pip install corotate[test]`, then `pytest`."""

import pytest

import corotate

SCENARIO = "rigid-pair"
LAW = corotate.Synchronizer([1.0, 2.0, 2.5], gain=4.0)


def controller(tick, inputs, outputs):
    """Turns the follower as the leader turns; a sample that is missing is None."""
    estimate, measured = inputs.estimate, inputs.measurement
    if estimate is not None and measured is not None:
        outputs.command.acceleration_rad_s2 = LAW.command(estimate.omega_rad_s, measured.omega_rad_s, measured.applied_rad_s2)


def test_the_loop_settles(corotate_run):
    run = corotate_run(SCENARIO, roles={"controller": controller})
    assert run.accepted
    assert run.metrics["sync_error_rad_s"]["settled_at_s"] < 5.0


@pytest.mark.parametrize("lost", [1, 5, 20])
def test_it_survives_lost_estimates(corotate_run, lost):
    fault = {"kind": "drop", "role": "observer", "from_tick": 2000, "ticks": lost}
    run = corotate_run(SCENARIO, roles={"controller": controller}, set={"fault": [fault], "accept": {}})
    assert run.metrics["sync_error_rad_s"]["last"] < 1e-6

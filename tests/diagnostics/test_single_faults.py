"""Single faulty sensors of a robot with narrow cones: cause and sensor are right, and no other sensor is accused."""

from dataclasses import replace

import numpy as np
import pytest
from support.wandering_robot import RING, log_of, ranges, trajectory

from jaxsonar.diagnostics.check_ring import check

SENSOR = 3


def faulty(cause, rng):
    """A log of the robot whose sensor 3 has a fault."""
    pose, ring = trajectory(160), RING
    if cause == "turned":
        heading = np.array(RING.heading, dtype=np.float64)
        heading[SENSOR] += np.radians(25.0)
        ring = replace(RING, heading=heading)
    reported = ranges(pose, ring=ring)
    own = reported[:, SENSOR]
    if cause == "offset":
        own += 0.06
    elif cause == "weak":
        own[rng.random(len(own)) < 0.75] = np.nan
    elif cause == "dead":
        own[:] = np.nan
    elif cause == "own echo":
        own[:] = 0.3 + 0.003 * rng.standard_normal(len(own))
    elif cause == "floor echo":
        constant = 0.9 + 0.01 * rng.standard_normal(len(own))
        own[:] = np.fmin(own, np.where(rng.random(len(own)) < 0.8, constant, np.nan))
    elif cause == "stale":
        own[:] = own[np.arange(len(own)) // 5 * 5]
    elif cause == "swapped":
        reported[:, [SENSOR, 8]] = reported[:, [8, SENSOR]]
    return log_of(reported, pose)


@pytest.mark.slow
@pytest.mark.parametrize(
    "cause", ["", "offset", "turned", "weak", "dead", "own echo", "floor echo", "stale", "swapped"]
)
def test_the_cause_and_the_sensor_are_right(cause, rng):
    found = check(RING, faulty(cause, rng))
    sensors = {"": [], "swapped": [(SENSOR, 8)]}.get(cause, [(SENSOR,)])
    assert [one.cause for one in found.findings] == [cause] * bool(cause)
    assert [one.sensors for one in found.findings] == sensors
    assert {k for k, remark in enumerate(found.remarks) if remark} == {k for one in sensors for k in one}
    for one in found.findings:
        assert 0.5 <= one.confidence <= 1
        assert one.evidence
        assert one.remedy
    plain = found.as_json()
    assert plain["findings"] == [one.sentence for one in found.findings]
    assert [one["cause"] for one in plain["diagnoses"]] == [one.cause for one in found.findings]


@pytest.mark.slow
def test_a_wrong_width_of_the_cones_accuses_no_sensor():
    pose = trajectory(160)
    found = check(replace(RING, beam=1.8 * np.asarray(RING.beam)), log_of(ranges(pose), pose))
    assert [(one.cause, one.sensors) for one in found.findings] == [("beam width", ())]
    width, error = np.degrees(found.beam)
    assert abs(width - 28) < max(3 * error, 4)

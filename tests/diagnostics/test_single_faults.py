"""Single faulty sensors of several rings: cause and sensor are right, and no other sensor is accused."""

from dataclasses import replace

import numpy as np
import pytest
from support.hard_cones import simulate
from support.wandering_robot import RING, log_of, ranges, trajectory

from jaxsonar import Ring, Room
from jaxsonar.diagnostics.check_ring import check
from jaxsonar.scans.readings import without_readings

SENSOR = 3
EIGHT = Ring.circular(count=8, radius=0.15, beam=np.radians(40.0), neighbors=0, max_range=5.0)
MANY = Ring.circular(count=24, radius=0.25, beam=np.radians(24.0), neighbors=0, max_range=4.0)
DENSE = Ring.circular(count=16, radius=0.2, beam=np.radians(56.0), neighbors=1, max_range=3.0)
CORNERS = np.array([[-3.0, -2.0], [3.0, -2.0], [3.0, 2.0], [-3.0, 2.0]])
ROOM = Room(np.stack([CORNERS, np.roll(CORNERS, -1, axis=0)], axis=1))


def faulty(cause, rng, ring=RING):
    """A log of the robot whose sensor 3 has a fault."""
    pose, true = trajectory(160), ring
    if cause == "turned":
        heading = np.array(ring.heading, dtype=np.float64)
        heading[SENSOR] += np.radians(25.0)
        true = replace(ring, heading=heading)
    reported = ranges(pose, ring=true)
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


def assert_is_found(found, cause, sensors):
    """The cause and the sensors are right, and each finding says why and what to do."""
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
@pytest.mark.parametrize(
    "cause", ["", "offset", "turned", "weak", "dead", "own echo", "floor echo", "stale", "swapped"]
)
def test_the_cause_and_the_sensor_are_right(cause, rng):
    sensors = {"": [], "swapped": [(SENSOR, 8)]}.get(cause, [(SENSOR,)])
    assert_is_found(check(RING, faulty(cause, rng)), cause, sensors)


@pytest.mark.slow
@pytest.mark.parametrize(("ring", "cause"), [(EIGHT, "own echo"), (MANY, "weak")])
def test_rings_with_other_numbers_of_sensors(ring, cause, rng):
    assert_is_found(check(ring, faulty(cause, rng, ring)), cause, [(SENSOR,)])


@pytest.mark.slow
@pytest.mark.parametrize("cause", ["swapped", "weak"])
def test_rings_that_hear_their_neighbors(cause, rng):
    pose, place = trajectory(160), np.arange(DENSE.count)
    if cause == "swapped":
        place[[SENSOR, 8]] = 8, SENSOR
    true = replace(DENSE, position=np.asarray(DENSE.position)[place], heading=np.asarray(DENSE.heading)[place])
    echoes = simulate(true, ROOM, pose, sigma=0.004, dropout=0.1, max_echoes=3, seed=5)
    log = echoes.as_log(true, pose)
    if cause == "weak":
        lost = ((log.tx == SENSOR) | (log.rx == SENSOR)) & (rng.random(len(log.tx)) < 0.75)
        log = without_readings(log, lost)
    assert_is_found(check(DENSE, log), cause, [(SENSOR, 8)] if cause == "swapped" else [(SENSOR,)])


@pytest.mark.slow
def test_a_wrong_width_of_the_cones_accuses_no_sensor():
    pose = trajectory(160)
    found = check(replace(RING, beam=1.8 * np.asarray(RING.beam)), log_of(ranges(pose), pose))
    assert [(one.cause, one.sensors) for one in found.findings] == [("beam width", ())]
    width, error = np.degrees(found.beam)
    assert abs(width - 28) < max(3 * error, 4)

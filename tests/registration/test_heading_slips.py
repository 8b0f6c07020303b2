"""Heading slips of the odometry: found where they are, with their size, and nowhere else."""

from dataclasses import replace

import numpy as np
import pytest
from support.recordings import recorded
from support.wandering_robot import RING, log_of, ranges, trajectory

from jaxsonar.geometry.se2 import compose, wrap_angle
from jaxsonar.recordings.input_options import InputOptions
from jaxsonar.recordings.load_log import load_log
from jaxsonar.registration.heading_slips import HeadingSlip, find_heading_slips, slip_transform
from jaxsonar.sensors.ring_toml import load_ring
from jaxsonar.simulation.wheel_odometry import simulate_odometry

TRUE = trajectory(300)
SPARSE = replace(RING, beam=np.full(RING.count, np.radians(20.0)))


def slipped(pose, row, angle):
    """Odometry that does not report a turn by an angle after a row."""
    moved = slip_transform(pose, HeadingSlip(row, row, -angle, 0.0))
    return np.concatenate([pose[: row + 1], compose(moved, pose[row + 1 :])])


def measured(odometry, *, seed=0, sigma=0.01):
    return log_of(ranges(TRUE, sigma=sigma, seed=seed, ring=SPARSE), odometry)


@pytest.mark.parametrize(("row", "degrees"), [(110, 25.0), (190, -22.0)])
def test_a_slip_is_found_where_it_is_and_repaired(row, degrees):
    odometry = slipped(TRUE, row, np.radians(degrees))
    (slip,) = find_heading_slips(SPARSE, measured(odometry))
    assert np.degrees(slip.angle) == pytest.approx(degrees, abs=3.0)
    assert np.linalg.norm(TRUE[slip.row, :2] - TRUE[row, :2]) < 0.5
    repaired = compose(slip_transform(odometry, slip), odometry[slip.row + 1 :])
    assert np.abs(wrap_angle(repaired[:, 2] - TRUE[slip.row + 1 :, 2])).max() < np.radians(4.0)


@pytest.mark.parametrize("seed", range(4))
def test_drifting_odometry_has_no_slips(seed):
    odometry = simulate_odometry(TRUE, distance=0.02, turn=float(np.radians(1.0)), seed=seed)
    assert find_heading_slips(SPARSE, measured(odometry, seed=seed, sigma=0.02)) == ()


def test_the_frame_of_the_world_does_not_matter():
    odometry = slipped(TRUE, 110, np.radians(25.0))
    moved = compose(np.array([7.0, -3.0, 2.0]), odometry)
    (first,), (second,) = (find_heading_slips(SPARSE, measured(pose)) for pose in (odometry, moved))
    assert second.row == first.row
    assert second.angle == pytest.approx(first.angle, abs=np.radians(1.5))


def test_a_mirrored_world_has_the_opposite_slip():
    odometry = slipped(TRUE, 110, np.radians(25.0))
    log = measured(odometry)
    mirrored = replace(
        log,
        pose=odometry * [1, -1, -1],
        tx=(-log.tx) % SPARSE.count,
        rx=(-log.rx) % SPARSE.count,
    )
    (first,), (second,) = find_heading_slips(SPARSE, log), find_heading_slips(SPARSE, mirrored)
    assert second.angle == pytest.approx(-first.angle, abs=np.radians(3.0))


def test_missing_poses_and_short_logs_are_no_slips():
    odometry = slipped(TRUE, 110, np.radians(25.0))
    odometry[40:44] = np.nan
    (slip,) = find_heading_slips(SPARSE, measured(odometry))
    assert np.degrees(slip.angle) == pytest.approx(25.0, abs=3.0)
    assert find_heading_slips(SPARSE, measured(odometry)[:3]) == ()
    assert find_heading_slips(SPARSE, measured(np.full_like(TRUE, np.nan))) == ()


@pytest.mark.slow
@pytest.mark.parametrize(("run", "first", "last"), [("slip8", 165, 200), ("corridor8", 0, 0)])
def test_of_recorded_runs_only_the_one_whose_wheels_slip_has_a_slip(run, first, last):
    """By the laser, the heading of slip8 is wrong by 22 deg after scans 168 to 200; that of corridor8 never jumps."""
    ring = load_ring("corridor8")
    log = load_log(recorded(run), ring=ring, options=InputOptions(format="corridor8"))
    slips = find_heading_slips(ring, log)
    assert len(slips) == (last > 0)
    for slip in slips:
        assert first <= slip.row <= last
        assert np.degrees(slip.angle) == pytest.approx(22.5, abs=3.0)


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [-25.0, 25.0])
def test_a_slip_put_into_a_recorded_corridor_is_found(degrees):
    """Both sides of the corridor are seen before and after it."""
    ring = load_ring("corridor8")
    log = load_log(recorded("corridor8"), ring=ring, options=InputOptions(format="corridor8"))
    (slip,) = find_heading_slips(ring, replace(log, pose=slipped(log.pose, 120, np.radians(degrees))))
    assert np.degrees(slip.angle) == pytest.approx(degrees, abs=4.0)
    assert np.linalg.norm(log.pose[slip.row, :2] - log.pose[120, :2]) < 0.5

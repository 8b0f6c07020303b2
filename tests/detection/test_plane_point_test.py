"""Windows of a sparse ring in simulated corridors: walls are detected; posts and door openings are not walls."""

import numpy as np
import pytest
from support import oracles
from support.hard_cones import simulate

from jaxsonar import HoughSettings, Log, Room, SonarError, load_ring, local_models
from jaxsonar.detection.settings import SETTINGS
from jaxsonar.floor_plans.room import walls_in_robot_frame
from jaxsonar.geometry.se2 import transform_points

RING = load_ring("corridor8")
LEFT, RIGHT = [[-3.0, 0.9], [12.0, 0.9]], [[-3.0, -1.1], [12.0, -1.1]]
CORRIDOR, NOTHING = Room(np.array([LEFT, RIGHT])), Room(np.zeros((0, 2, 2)))
LENGTH = 2.0
SIGMA, STEP = 0.005, 0.01


def drive(sway=0.05, scans=97):
    """A slightly curved trajectory along the corridor."""
    x = np.linspace(0.0, 8.0, scans)
    return np.column_stack([x, sway * np.sin(x), sway * np.cos(x)])


def recorded(room, poses, seed, *, stale=True):
    """The log of a device with a range step of 10 mm, in which every second scan repeats the previous one."""
    heard = simulate(RING, room, poses, sigma=SIGMA, seed=seed, max_echoes=1).as_log(RING, poses)
    scan, tx, rx, reach = [], [], [], []
    for k in range(len(poses)):
        source = heard[k - k % 2] if stale else heard[k]
        scan += [k] * len(source.tx)
        tx, rx, reach = [*tx, *source.tx], [*rx, *source.rx], [*reach, *source.range]
    rounded = np.maximum(np.round(np.array(reach, float) / STEP) * STEP, STEP)
    rows, tx, rx = (np.array(column, int) for column in (scan, tx, rx))
    return Log.from_echoes(rows, tx, rx, rounded, stamp=heard.stamp, pose=poses)


def models_of(room, seed, poses=None, **how):
    """(pose, model) of every window of 2 m, and the log."""
    poses = drive() if poses is None else poses
    log = recorded(room, poses, seed, **how)
    return [(poses[model.scan], model) for model in local_models(RING, log, window=LENGTH)], log


def is_wall(room, pose, line):
    """For every wall of a room, whether a line is within 15 mm and 1 deg of it."""
    rho, theta = walls_in_robot_frame(room, pose)
    return (np.abs(rho - line.rho) < 0.015) & (np.abs(oracles.wrap(theta - line.theta)) < np.radians(1))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("stale", [True, False])
def test_exactly_both_walls_of_a_corridor_are_detected(seed, stale):
    room = CORRIDOR
    windows, _ = models_of(room, seed, stale=stale)
    assert len(windows) == 8
    for k, (pose, model) in enumerate(windows):
        walls = [is_wall(room, pose, line) for line in model.lines]
        assert all(sum(which) == 1 for which in walls), f"window {k}: a line elsewhere"
        times = np.sum(walls, axis=0)
        assert times.max() == 1, f"window {k}: a wall is there twice"
        assert k == 0 or times.min() == 1, f"window {k}: a wall is missing"  # the first window is only half full


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_lines_are_consistent_with_their_echoes(seed):
    """Every echo is in one line at most; lines have enough echoes and length; segments lie on their lines."""
    windows, log = models_of(CORRIDOR, seed)
    for _, model in windows:
        for line in model.lines:
            n = np.array([np.cos(line.theta), np.sin(line.theta)])
            np.testing.assert_allclose(line.segment @ n, line.rho, atol=1e-5)
            assert line.echoes >= SETTINGS.min_wall_echoes
            assert np.linalg.norm(line.segment[1] - line.segment[0]) >= SETTINGS.min_wall_extent
            assert (line.segment[1] - line.segment[0]) @ [-n[1], n[0]] > 0
            assert set(line.scans) <= set(log.scan[: model.scan + 1].tolist())
        scans = {scan for line in model.lines for scan in line.scans}
        heard = sum(len(log[scan].tx) for scan in range(min(scans), max(scans) + 1))
        assert sum(line.echoes for line in model.lines) <= heard


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("poles", [[[3.0, 0.8]], [[2.2, -0.6], [4.4, 0.9]], [[1.0, 1.2], [3.1, -1.0], [5.0, 0.7]]])
def test_poles_are_not_reported_as_walls(poles, seed):
    windows, log = models_of(Room(np.zeros((0, 2, 2)), poles=np.array(poles)), seed)
    assert len(log.tx) > 20
    assert [line for _, model in windows for line in model.lines] == []
    assert all(model.empty for _, model in windows)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("middle", [3.0, 4.3])
def test_a_door_splits_a_wall(middle, seed):
    """No segment covers the middle of an opening of 1 m, and both parts of the wall are detected."""
    left = [[[-3.0, 0.9], [middle - 0.5, 0.9]], [[middle + 0.5, 0.9], [12.0, 0.9]]]
    room = Room(np.array([*left, RIGHT]))
    windows, _ = models_of(room, seed)
    before = beyond = False
    for pose, model in windows:
        for line in model.lines:
            x, y = np.sort(transform_points(pose, line.segment), axis=0).T
            if y.mean() > 0:
                assert not x[0] < middle < x[1], f"{x} covers the door at {middle}"
                before, beyond = before or x[1] < middle, beyond or x[0] > middle
    assert before
    assert beyond


def test_lines_are_invariant_under_motions_of_the_world():
    """The same log after a motion of the world: local models are in the robot frame."""
    room, poses = CORRIDOR, drive()
    log = recorded(room, poses, 0)
    motion = np.array([3.0, -7.0, 2.0])
    elsewhere = np.column_stack([transform_points(motion, poses[:, :2]), poses[:, 2] + motion[2]])
    moved = Log.from_echoes(log.echo_scan, log.tx, log.rx, log.range, stamp=log.stamp, pose=elsewhere)
    for one, other in zip(
        local_models(RING, log, window=LENGTH), local_models(RING, moved, window=LENGTH), strict=True
    ):
        assert len(one.lines) == len(other.lines) > 0
        for here, there in zip(one.lines, other.lines, strict=True):
            assert there.rho == pytest.approx(here.rho, abs=1e-3)
            assert abs(oracles.wrap(there.theta - here.theta)) < 1e-3
            np.testing.assert_allclose(there.segment, here.segment, atol=2e-3)


def test_lines_refer_to_scans_by_their_numbers():
    """A model has the number of its window's last scan; its lines have the numbers of the scans of their echoes."""
    log = recorded(CORRIDOR, drive(), 0)
    numbers = np.arange(len(log))[::-1] * 7 + 100
    named = Log.from_echoes(log.echo_scan, log.tx, log.rx, log.range, stamp=log.stamp, pose=log.pose, scan=numbers)
    for one, other in zip(
        local_models(RING, log, window=LENGTH), local_models(RING, named, window=LENGTH), strict=True
    ):
        assert other.scan == numbers[one.scan]
        for here, there in zip(one.lines, other.lines, strict=True):
            assert list(there.scans) == numbers[list(here.scans)].tolist()
            np.testing.assert_array_equal(there.segment, here.segment)


def test_an_accumulator_must_cover_the_range_of_a_window():
    log = recorded(CORRIDOR, drive(scans=5), 0)
    local_models(RING, log, settings=HoughSettings())  # 4 m suffice for a single scan
    with pytest.raises(SonarError, match=r"rho_cells 100 x rho_cell 0\.04 m = 4 m; allowed is 5\.19\d m or more"):
        local_models(RING, log, window=LENGTH, settings=HoughSettings())


def test_no_echoes_give_no_line():
    windows, log = models_of(NOTHING, 0)
    assert len(log.tx) == 0
    assert len(windows) == 8
    assert {model.empty for _, model in windows} == {"no echo within the maximum range"}


def test_no_windows_give_no_model():
    poses = drive(scans=5)
    log = recorded(CORRIDOR, poses, 0)
    lost = Log.from_echoes(log.echo_scan, log.tx, log.rx, log.range, stamp=log.stamp, pose=np.full((5, 3), np.nan))
    assert list(local_models(RING, lost, window=LENGTH)) == []
    assert list(local_models(RING, Log.from_scans([]), window=LENGTH)) == []

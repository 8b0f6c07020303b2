"""SLAM: better than odometry, consistent, equal for a tracker and a whole log; invalid input is refused."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.hard_cones import simulate
from support.slam_scene import ODOMETRY_NOISE, RING, ROOM, SCAN_COUNT, SIGMA, log, truth

from jaxsonar import SonarError, local_models
from jaxsonar.estimation.trajectory import Trajectory
from jaxsonar.evaluation.trajectory_errors import trajectory_errors
from jaxsonar.geometry.se2 import compose, relative
from jaxsonar.graph_slam.incremental_mapper import Mapper
from jaxsonar.graph_slam.slam import Slam, slam
from jaxsonar.graph_slam.tracker import Tracker
from jaxsonar.mapping.build_map import build_map
from jaxsonar.scans.scan_log import Scan


@cache
def models():
    return tuple(local_models(RING, log()))


@cache
def tracked():
    tracker = Tracker(ring=RING, odometry_noise=ODOMETRY_NOISE)
    state, steps = tracker.start(), []
    for scan, model in zip(log(), models(), strict=True):
        state, step = tracker.step(state, scan, model=model)
        steps.append(step)
    return tracker, state, steps


def assert_accurate(found, *, fraction):
    """Errors are at most this fraction of the odometry's, and consistent with the covariances."""
    real = Trajectory(found.stamp, truth())
    own = trajectory_errors(found, real, align="first")
    wheels = trajectory_errors(Trajectory(found.stamp, np.array(log().pose)), real, align="first")
    assert own.ate < fraction * wheels.ate
    assert own.ate_heading < 0.5 * wheels.ate_heading
    assert 0.05 < own.nees < 4.0


@pytest.mark.slow
def test_the_tracker_equals_slam_without_smoothing_and_beats_odometry():
    tracker, state, _ = tracked()
    poses, covariance = tracker.poses(tracker.finish(state))
    found = slam(RING, log(), odometry_noise=ODOMETRY_NOISE, smooth=False)
    np.testing.assert_allclose(found.poses, poses, atol=1e-9)
    np.testing.assert_allclose(found.covariance, covariance, atol=1e-9)
    assert isinstance(found, Slam)
    assert not len(found.left_out)
    assert len(found.world) >= 6
    np.testing.assert_array_equal(found.odometry, log().pose)
    assert found.smoothed is None
    assert len(found.step_ms) == SCAN_COUNT
    assert_accurate(found.trajectory, fraction=0.2)


@pytest.mark.slow
def test_a_step_does_not_change_its_input_state():
    """Two continuations of one state; and the first pose is that of the odometry."""
    tracker, _, steps = tracked()
    state = tracker.start()
    for scan, model in zip(log()[:6], models()[:6], strict=True):
        state, _ = tracker.step(state, scan, model=model)
    before = [
        state.submap.pose.copy(),
        state.submap.belief.covariance.copy(),
        state.graph.poses.copy(),
        state.scan_count,
    ]
    one, _ = tracker.step(state, log()[6], model=models()[6])
    tracker.step(one, log()[7], model=models()[7])
    tracker.finish(state)
    _, again = tracker.step(state, log()[6], model=models()[6])
    for earlier, now in zip(
        before,
        [state.submap.pose, state.submap.belief.covariance, state.graph.poses, state.scan_count],
        strict=True,
    ):
        np.testing.assert_array_equal(earlier, now)
    np.testing.assert_array_equal(again.pose, steps[6].pose)
    np.testing.assert_allclose(steps[0].pose, log().pose[0], atol=1e-9)
    np.testing.assert_allclose(steps[0].covariance, 0, atol=1e-12)
    assert all(np.linalg.eigvalsh(step.covariance)[0] >= -1e-15 for step in steps)


@pytest.mark.slow
def test_without_odometry_scans_are_registered():
    some = log()[:12]
    found = slam(RING, replace(some, pose=np.full((12, 3), np.nan)), smooth=False)
    known = np.isfinite(found.poses[:, 0])
    assert known.sum() >= 6
    assert np.isnan(found.covariance[~known]).all()
    first, *rest = np.flatnonzero(known)
    np.testing.assert_allclose(found.covariance[first], 0, atol=1e-8)
    assert (np.linalg.eigvalsh(found.covariance[rest]) > 0).all()
    own = trajectory_errors(Trajectory(found.stamp[known], found.poses[known]), Trajectory(found.stamp, truth()[:12]))
    assert own.ate < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("missing", [[5], [4, 5, 11]])
def test_single_scans_without_odometry_do_not_distort_the_trajectory(missing):
    """The odometry bridges them; they are registered by their echoes or have no pose."""
    some = log()[:16]
    pose = np.array(some.pose)
    pose[missing] = np.nan
    found = slam(RING, replace(some, pose=pose))
    kept = np.setdiff1d(np.arange(16), missing)
    assert np.isfinite(found.poses[kept]).all()
    known = np.isfinite(found.poses[:, 0])
    own = trajectory_errors(
        Trajectory(found.stamp[known], found.poses[known], found.covariance[known]),
        Trajectory(found.stamp, truth()[:16]),
        align="first",
    )
    assert own.ate < 0.08  # a motion that counts twice is an error of 15 cm for all later scans
    assert own.nees < 4


@pytest.mark.slow
def test_odometry_bridges_a_scan_without_odometry():
    """Without echoes, the pose after it is that of the odometry."""
    tracker = Tracker(ring=RING, sigma=SIGMA)
    state, pose = tracker.start(), np.full(3, np.nan)
    none = np.zeros(0, dtype=np.int64)
    for x in (0.0, 0.5, np.nan, 1.5):
        scan = Scan(0, np.nan, np.array([x, 0.0 * x, 0.0 * x]), none, none, np.zeros(0), np.zeros(0))
        state, step = tracker.step(state, scan)
        pose = step.pose
    np.testing.assert_allclose(pose, [1.5, 0, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("rows", "options", "message"),
    [
        ([0, 1], {}, "odometry in 2 of 16 scans"),
        ([], {"scale": True}, "need odometry"),
        (range(16), {"scale": True, "smooth": False}, "estimated by smoothing"),
    ],
)
def test_contradictory_arguments_are_refused(rows, options, message):
    some = log()[:16]
    kept = np.full((16, 3), np.nan)
    kept[list(rows)] = some.pose[list(rows)]
    with pytest.raises(SonarError, match=message):
        slam(RING, replace(some, pose=kept), **options)


@pytest.mark.slow
def test_a_kidnapped_robot_starts_a_new_submap():
    """The odometry does not contain the motion: a new submap starts, and no pose is certain of a wrong place."""
    there = compose(np.array([1.5, 0.6, 2.0]), np.array([relative(truth()[0], one) for one in truth()[:8]]))
    poses = np.concatenate([truth()[:8], there])
    odometry = np.concatenate([truth()[:8], compose(truth()[7], np.array([relative(there[0], one) for one in there]))])
    heard = simulate(RING, ROOM, poses, sigma=SIGMA, seed=3).as_log(RING, odometry)
    tracker = Tracker(ring=RING, sigma=SIGMA)
    state, steps = tracker.start(), []
    for scan, model in zip(heard, local_models(RING, heard), strict=True):
        state, step = tracker.step(state, scan, model=model)
        steps.append(step)
    assert len(state.graph.submaps) >= 1
    assert len(state.graph.submaps[0].rows) > 8
    off = relative(poses[-1], steps[-1].pose)
    sd = np.sqrt(np.diag(steps[-1].covariance))
    assert np.hypot(*off[:2]) < 4 * max(sd[:2]) or np.hypot(*off[:2]) < 0.05


@pytest.mark.slow
def test_a_mapper_with_pose_estimation_maps_at_the_estimated_poses():
    mapper = Mapper(ring=RING, odometry_noise=ODOMETRY_NOISE)
    state, infos = mapper.start(), []
    for scan, model in zip(log()[:20], models(), strict=False):
        state, info = mapper.step(state, scan, model=model)
        infos.append(info)
    _, _, steps = tracked()
    for info, step in zip(infos, steps, strict=False):
        np.testing.assert_array_equal(info.pose, step.pose)
        np.testing.assert_array_equal(info.covariance, step.covariance)
    poses, _ = mapper.trajectory(mapper.finish(state))
    world, wanted = mapper.map(state), build_map(RING, replace(log()[:20], pose=poses))
    assert len(world) == len(wanted)
    order, other = np.lexsort(world.segments[:, 0].T.round(3)), np.lexsort(wanted.segments[:, 0].T.round(3))
    np.testing.assert_allclose(world.segments[order], wanted.segments[other], atol=1e-4)
    with pytest.raises(SonarError, match="odometry_noise"):
        Mapper(ring=RING).trajectory(Mapper(ring=RING).start())
    with pytest.raises(SonarError, match="odometry_noise"):
        Mapper(ring=RING, odometry_noise=ODOMETRY_NOISE, window=1.0)


def test_invalid_input_is_refused():
    with pytest.raises(SonarError, match="no scan"):
        slam(RING, log()[:0])
    with pytest.raises(SonarError, match="needs poses"):
        slam(RING, replace(log()[:3], pose=np.full((3, 3), np.nan)), window=1.0)
    with pytest.raises(SonarError, match="sigma"):
        Tracker(ring=RING, sigma=-1.0)
    with pytest.raises(SonarError, match="sigma"):
        slam(RING, log()[:2], sigma=float("inf"))

"""The front end: data association, start and end of submaps, detection of a kidnapped robot."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from support.hard_cones import simulate

from jaxsonar import Ring, Room, kernels, local_model
from jaxsonar.geometry.landmarks import wall_segments
from jaxsonar.geometry.se2 import unit
from jaxsonar.graph_slam.feature_association import FeatureMeasurements, associate_features
from jaxsonar.graph_slam.frontend import SubmapState, finish_submap, start_submap, update

RING = Ring.circular()
PLANE, CORNER = kernels.PLANE, kernels.CORNER
SIGMA = 0.001


@pytest.fixture(autouse=True)
def in_double_precision():
    with jax.enable_x64(True):
        yield


# Data association


def belief_with(walls, points=(), *, pose_sd=(0.05, 0.05, 0.02), own_sd=1e-3):
    """A belief with walls (distance, theta) and corners around a robot at the origin."""
    count = len(walls) + len(points)
    foot = [rho * unit(np.array(theta)) for rho, theta in walls]
    size = 3 + 2 * count
    covariance = np.eye(size) * own_sd**2
    covariance[:3, :3] = np.diag(np.square(pose_sd))
    landmarks = kernels.Landmarks(
        kind=np.array([PLANE] * len(walls) + [CORNER] * len(points), np.int32),
        parameters=np.array([(0.0, theta) for _, theta in walls] + [(0.0, 0.0)] * len(points)).reshape(-1, 2),
        anchor=np.array([*foot, *points], dtype=np.float64).reshape(-1, 2),
        extent=np.array([(-1.0, 1.0)] * len(walls) + [(0.0, 0.0)] * len(points)).reshape(-1, 2),
    )
    return kernels.Belief(np.zeros(3), landmarks, covariance)


def features_with(walls, points=(), *, sd=1e-3):
    count = len(walls) + len(points)
    segments = [
        [rho * unit(np.array(theta)) + along * unit(np.array(theta + np.pi / 2)) for along in (-0.1, 0.1)]
        for rho, theta in walls
    ]
    return FeatureMeasurements(
        kind=np.array([PLANE] * len(walls) + [CORNER] * len(points), np.int32),
        parameters=np.array([*walls, *points], dtype=np.float64).reshape(-1, 2),
        covariance=np.tile(np.eye(2) * sd**2, (count, 1, 1)),
        segment=np.array([*segments, *([p, p] for p in points)], dtype=np.float64).reshape(-1, 2, 2),
        echoes=np.full(count, 12),
        radius=np.zeros(count),
    )


def associated(belief, features):
    found = associate_features(belief, features, full_wall_echoes=12.0)
    return found.landmark.tolist(), found.is_new.tolist()


def test_only_mutual_nearest_neighbors_are_associated():
    """Two features near one wall: the nearer one is associated; the other one is not, and is too near to be new."""
    known = belief_with([(1.0, 0.0), (1.2, np.pi / 2)])
    seen = features_with([(1.02, 0.0), (1.06, 0.0), (1.21, np.pi / 2)])
    assert associated(known, seen) == ([0, -1, 1], [False, False, False])


def test_features_far_from_all_landmarks_are_new():
    known = belief_with([(1.0, 0.0)])
    assert associated(known, features_with([(1.0, 0.0), (1.4, 1.8)], [(0.3, -0.9)])) == (
        [0, -1, -1],
        [False, True, True],
    )
    assert associated(start_submap().belief, features_with([(1.0, 0.0)])) == ([-1], [True])


def test_pairs_must_be_jointly_compatible():
    """One wall implies a motion of 9 cm forward, the opposite one 9 cm back: each is possible, both are not."""
    known = belief_with([(1.0, 0.0), (1.2, -np.pi)])
    assert associated(known, features_with([(0.91, 0.0)]))[0] == [0]
    assert associated(known, features_with([(1.1, -np.pi)]))[0] == [1]
    assert associated(known, features_with([(0.91, 0.0), (1.29, -np.pi)]))[0] == [0, 1]
    assert sorted(associated(known, features_with([(0.91, 0.0), (1.10, -np.pi)]))[0]) == [-1, 0]


def test_the_two_sides_of_a_wall_are_different_landmarks():
    """The wall is 2 cm behind the robot; from its other side the normal has the opposite direction."""
    known = replace(belief_with([(0.02, 0.0)], pose_sd=(0.2, 0.2, 0.05)), pose=np.array([0.04, 0.0, 0.0]))
    assert associated(known, features_with([(0.3, 0.0)]))[0] == [-1]


def test_a_feature_beside_the_observed_part_is_another_wall():
    """The same line, two metres along it."""
    known, seen = belief_with([(1.0, 0.0)]), features_with([(1.0, 0.0)])
    beside = seen._replace(segment=seen.segment + np.array([0.0, 2.0]))
    assert associated(known, beside)[0] == [-1]


def test_corners_are_not_associated_with_walls():
    assert associated(belief_with([(1.0, 0.0)]), features_with([], [(1.0, 0.0)]))[0] == [-1]


# Submaps


@pytest.mark.slow
@pytest.mark.parametrize(("distance", "kidnapped"), [(8.0, False), (0.8, True)])
def test_only_missed_detections_of_known_walls_indicate_a_kidnapped_robot(distance, kidnapped):
    """Around a corner everything is new and is added; if known walls that face the ring cause no echo, nothing is."""
    x, y = 1.5, 1.3
    room = Room(np.array([[[x, -y], [x, y]], [[x, y], [-x, y]], [[-x, y], [-x, -y]], [[-x, -y], [x, -y]]]))
    scan = simulate(RING, room, np.zeros((1, 3)), sigma=SIGMA, seed=1).as_log(RING, np.zeros((1, 3)))[0]
    known = belief_with([(distance, 0.0), (distance, 2.0)])
    with jax.enable_x64(False):
        model = local_model(RING, scan, method="hough")
    state = update(RING, SubmapState(known, np.array([5, 5])), scan, model, row=7)
    assert state.track_loss_count == int(kidnapped)
    assert (len(state.scan_counts) == 2) == kidnapped
    assert len(state.belief.landmarks.kind) == len(state.scan_counts)


def test_a_closed_submap_has_no_landmark_of_a_single_scan():
    known = belief_with([(1.0, 0.0), (1.5, 1.0), (2.0, 2.0)])
    root = np.random.default_rng(0).standard_normal((9, 9))
    known = replace(known, covariance=root @ root.T, pose=np.array([0.5, 0.1, 0.2]))
    poses = tuple(np.full(3, 0.1 * k) for k in range(4))
    covariances = tuple(np.eye(3) * k for k in range(4))
    state = SubmapState(known, np.array([3, 1, 2]), rows=(4, 5, 6, 7), poses=poses, covariances=covariances)
    submap = finish_submap(state)
    np.testing.assert_array_equal(submap.landmarks.anchor, known.landmarks.anchor[[0, 2]])
    np.testing.assert_array_equal(
        submap.covariance, known.covariance[np.ix_([0, 1, 2, 3, 4, 7, 8], [0, 1, 2, 3, 4, 7, 8])]
    )
    np.testing.assert_array_equal(submap.exit_pose, known.pose)
    assert submap.rows.tolist() == [4, 5, 6, 7]
    np.testing.assert_array_equal(submap.poses, poses)
    lost = finish_submap(replace(state, track_loss_count=3))
    assert (np.diag(lost.covariance - submap.covariance)[:3] > 0.2).all()
    np.testing.assert_allclose(wall_segments(submap.landmarks)[0], [[1.0, -1.0], [1.0, 1.0]], atol=1e-12)


def test_the_next_submap_starts_at_its_own_origin():
    known = belief_with([(1.0, 0.0)])
    before = SubmapState(
        known, np.array([3]), rows=(0, 1), odometry=np.array([1.0, 2.0, 3.0]), sum_of_squares=4e-6, dof=4.0
    )
    after = start_submap(before)
    assert not len(after.belief.landmarks.kind)
    assert not len(after.scan_counts)
    assert not after.rows
    assert not after.pose.any()
    assert not after.pose_covariance.any()
    assert after.sigma == before.sigma == pytest.approx(0.001)

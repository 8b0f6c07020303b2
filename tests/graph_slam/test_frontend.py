"""The front end: EKF update against dense least squares, data association, start and end of submaps."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from jaxsonar import Ring, Room, kernels, local_model, simulate
from jaxsonar.geometry.landmarks import wall_segments
from jaxsonar.geometry.se2 import rotation, unit, wrap_angle
from jaxsonar.graph_slam.frontend import SubmapState, close_submap, start_submap, update
from jaxsonar.graph_slam.joint_compatibility import FeatureMeasurements, associate_features
from jaxsonar.simulation.office import load_office
from jaxsonar.simulation.traced_echoes import EchoKind

RING = Ring.circular()
PLANE, CORNER, EDGE = kernels.PLANE, kernels.CORNER, kernels.EDGE
SIGMA = 0.001
ECHOES = 60


@pytest.fixture(autouse=True)
def in_double_precision():
    with jax.enable_x64(True):
        yield


# The update


def reach_of(state, kind, anchor, ends):
    """Half the path length from tx by one landmark to rx, independent of the kernels. ``ends`` in the robot frame."""
    place = ends @ rotation(state[2]).T + state[:2]
    own = state[3:]
    if kind == PLANE:
        normal = unit(own[1])
        level = own[0] + normal @ anchor
        mirrored = place[1] + 2 * (level - normal @ place[1]) * normal
        return np.linalg.norm(place[0] - mirrored) / 2
    point = anchor + own
    if kind == CORNER:
        return np.linalg.norm(place[0] + place[1] - 2 * point) / 2
    return (np.linalg.norm(place[0] - point) + np.linalg.norm(place[1] - point)) / 2


KINDS = np.array([PLANE, CORNER, EDGE, PLANE], dtype=np.int32)
ANCHORS = np.array([[1.2, 0.3], [0.2, 1.1], [-0.9, -0.6], [0.1, -1.0]])
PARAMETERS = np.array([[0.05, 0.1], [0.03, -0.02], [0.01, 0.04], [-0.02, -1.5]])
ROWS = np.tile([0, 1, 2, 3], ECHOES // 4)


def expected_of(state, path, rows=ROWS):
    sensors = np.asarray(RING.position)[RING.paths[path]]
    pick = [np.r_[0:3, 3 + 2 * k, 4 + 2 * k] for k in rows]
    return np.array(
        [reach_of(state[p], KINDS[k], ANCHORS[k], ends) for p, k, ends in zip(pick, rows, sensors, strict=True)]
    )


def paths_of(path):
    return jax.tree.map(lambda leaf: np.asarray(leaf, dtype=np.float64)[path], RING.echo_paths)


def scene_of(parameters, kinds=KINDS, anchors=ANCHORS):
    return kernels.Landmarks(kinds, parameters, anchors, np.tile([-1.0, 1.0], (len(kinds), 1)))


@pytest.fixture
def case(rng):
    """A belief, and echoes of a true state drawn from it."""
    mean = np.concatenate([[0.02, -0.05, 0.3], PARAMETERS.ravel()])
    root = rng.standard_normal((11, 11)) * 0.002
    prior = root @ root.T + np.diag([0.02, 0.02, 0.02] + [0.01] * 8) ** 2
    truth = rng.multivariate_normal(mean, prior)
    path = rng.integers(len(RING.paths), size=ECHOES)
    ranges = expected_of(truth, path) + SIGMA * rng.standard_normal(ECHOES)
    return mean, prior, path, ranges, truth


def dense(mean, prior, path, ranges, rows=ROWS):
    """Least squares on prior and ranges with numerical derivatives; the inverse of the information matrix."""
    state, information = mean.copy(), np.linalg.inv(prior)
    whole = information
    for _ in range(8):
        steps = 1e-6 * np.eye(len(state))
        jacobian = np.stack(
            [(expected_of(state + w, path, rows) - expected_of(state - w, path, rows)) / 2e-6 for w in steps], -1
        )
        whole = information + jacobian.T @ jacobian / SIGMA**2
        gradient = jacobian.T @ (ranges - expected_of(state, path, rows)) / SIGMA**2 - information @ (state - mean)
        state = state + np.linalg.solve(whole, gradient)
    return state, np.linalg.inv(whole)


def tracked(mean, prior, path, ranges, rows=ROWS, kinds=KINDS, anchors=ANCHORS):
    belief = kernels.Belief(mean[:3], scene_of(mean[3:].reshape(-1, 2), kinds, anchors), prior)
    found = kernels.ekf_update(belief, paths_of(path), ranges, rows.astype(np.int32), np.float64(SIGMA**2))
    state = np.concatenate([found.belief.pose, np.asarray(found.belief.landmarks.parameters).ravel()])
    return state, np.asarray(found.belief.covariance), found


@pytest.mark.slow
def test_the_update_equals_dense_least_squares(case):
    mean, prior, path, ranges, truth = case
    state, covariance, found = tracked(mean, prior, path, ranges)
    wanted, wanted_cov = dense(mean, prior, path, ranges)
    assert np.asarray(found.used).all()
    sd = np.sqrt(np.diag(wanted_cov))
    np.testing.assert_array_less(np.abs(state - wanted), 0.02 * sd)  # after few iterations
    np.testing.assert_allclose(covariance / np.outer(sd, sd), wanted_cov / np.outer(sd, sd), atol=2e-3)
    off = state - truth
    assert off @ np.linalg.solve(covariance, off) < 31.3  # chi2, 11, 0.001
    np.testing.assert_allclose(found.residual, ranges - expected_of(state, path), atol=1e-12)


def test_outliers_have_no_influence(case, rng):
    """Errors of some centimetres: the result is that of the other echoes alone."""
    mean, prior, path, ranges, _ = case
    bad = rng.permutation(ECHOES)[:9]
    spoilt = ranges.copy()
    spoilt[bad] += rng.choice([-1, 1], 9) * rng.uniform(0.05, 0.3, 9)
    state, covariance, found = tracked(mean, prior, path, spoilt)
    assert sorted(np.flatnonzero(np.asarray(found.used) == 0)) == sorted(bad)
    good = np.setdiff1d(np.arange(ECHOES), bad)
    wanted, wanted_cov = dense(mean, prior, path[good], ranges[good], ROWS[good])
    np.testing.assert_array_less(np.abs(state - wanted), 0.02 * np.sqrt(np.diag(wanted_cov)))
    np.testing.assert_allclose(covariance, wanted_cov, atol=2e-3 * wanted_cov.max())


@pytest.mark.slow
def test_order_and_padding_do_not_matter(case, rng):
    mean, prior, path, ranges, _ = case
    plain, plain_cov, found = tracked(mean, prior, path, ranges)
    order = rng.permutation(ECHOES)
    # Unassigned echoes and unused landmarks.
    more_path, more_range = np.pad(path[order], (0, 20)), np.pad(ranges[order], (0, 20))
    more_rows = np.pad(ROWS[order], (0, 20), constant_values=-1)
    wide, kinds, anchors = np.zeros((15, 15)), np.append(KINDS, [-1, -1]).astype(np.int32), np.zeros((6, 2))
    wide[:11, :11], anchors[:4] = prior, ANCHORS
    state, covariance, padded = tracked(np.pad(mean, (0, 4)), wide, more_path, more_range, more_rows, kinds, anchors)
    np.testing.assert_allclose(state[:11], plain, atol=1e-10)
    np.testing.assert_allclose(covariance[:11, :11], plain_cov, atol=1e-12)
    np.testing.assert_allclose(np.asarray(padded.residual)[:ECHOES], np.asarray(found.residual)[order], atol=1e-10)
    assert not np.asarray(padded.used)[ECHOES:].any()
    predicted = kernels.expected_ranges_with_variance(padded.belief, paths_of(more_path))
    assert np.isinf(np.asarray(predicted.expected)[4:]).all()


@pytest.mark.slow
def test_a_single_wall_does_not_determine_the_position_along_it(rng):
    """The prior alone determines y, through its correlation with the heading."""
    path = rng.integers(len(RING.paths), size=40)
    prior = np.zeros((5, 5))
    prior[:3, :3] = [[4e-4, 0, 0], [0, 9e-4, 3e-4], [0, 3e-4, 4e-4]]
    mean = np.array([0.0, 0.0, 0.0, 0.0, 0.0])
    kinds, anchors, rows = np.array([PLANE], np.int32), np.array([[1.0, 0.0]]), np.zeros(40, int)
    sensors = np.asarray(RING.position)[RING.paths[path]]
    truth = np.array([0.01, 0.02, 0.015, 0, 0])
    ranges = np.array([reach_of(truth, PLANE, anchors[0], ends) for ends in sensors])
    state, cov, _ = tracked(mean, prior, path, ranges, rows, kinds, anchors)
    np.testing.assert_allclose(state[[0, 2]], truth[[0, 2]], atol=3e-4)
    slope = prior[1, 2] / prior[2, 2]
    np.testing.assert_allclose(state[1], slope * state[2], atol=1e-9)
    np.testing.assert_allclose(cov[1, 1], prior[1, 1] - slope**2 * (prior[2, 2] - cov[2, 2]), rtol=1e-9)
    np.testing.assert_allclose(cov[1, 2], slope * cov[2, 2], rtol=1e-9)
    assert cov[0, 0] < SIGMA**2


@pytest.mark.slow
def test_expected_ranges_equal_those_of_the_simulator():
    """Every first-order wall echo of the office, to the micrometre."""
    office = load_office()
    room, pose = office.room, office.poses[5]
    echoes = simulate(RING, room, pose[None], sigma=0.0)
    middle = room.walls.mean(axis=1)
    along = room.walls[:, 1] - room.walls[:, 0]
    half = np.linalg.norm(along, axis=-1) / 2
    theta = np.arctan2(along[:, 1], along[:, 0]) - np.pi / 2
    away = (unit(theta) * (middle - pose[:2])).sum(-1) > 0
    theta = wrap_angle(np.where(away, theta, theta + np.pi))
    count = len(middle)
    scene = kernels.Landmarks(
        np.full(count, PLANE, np.int32),
        np.stack([np.zeros(count), theta], -1),
        middle,
        half[:, None] * [-1.0, 1.0],
    )
    expected = np.asarray(kernels.expected_ranges(pose, scene, paths_of(np.arange(len(RING.paths)))))
    wall = echoes.kind == EchoKind.PLANE
    assert wall.sum() > 20
    np.testing.assert_allclose(expected[echoes.reflector[wall], echoes.path[wall]], echoes.range[wall], atol=2e-6)


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
    submap = close_submap(state)
    np.testing.assert_array_equal(submap.landmarks.anchor, known.landmarks.anchor[[0, 2]])
    np.testing.assert_array_equal(
        submap.covariance, known.covariance[np.ix_([0, 1, 2, 3, 4, 7, 8], [0, 1, 2, 3, 4, 7, 8])]
    )
    np.testing.assert_array_equal(submap.exit_pose, known.pose)
    assert submap.rows.tolist() == [4, 5, 6, 7]
    np.testing.assert_array_equal(submap.poses, poses)
    lost = close_submap(replace(state, track_loss_count=3))
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

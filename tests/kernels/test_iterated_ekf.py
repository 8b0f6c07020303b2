"""The EKF update equals dense least squares; outliers, order and padding have no influence; expected ranges."""

import jax
import numpy as np
import pytest
from support.hard_cones import simulate

from jaxsonar import Ring, kernels
from jaxsonar.geometry.se2 import rotation, unit, wrap_angle
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


def range_of(state, kind, anchor, ends):
    """Half the path length from tx by one landmark to rx, independent of the kernels. ``ends`` in the robot frame."""
    sensors = ends @ rotation(state[2]).T + state[:2]
    own = state[3:]
    if kind == PLANE:
        normal = unit(own[1])
        rho_at_anchor = own[0] + normal @ anchor
        mirrored = sensors[1] + 2 * (rho_at_anchor - normal @ sensors[1]) * normal
        return np.linalg.norm(sensors[0] - mirrored) / 2
    point = anchor + own
    if kind == CORNER:
        return np.linalg.norm(sensors[0] + sensors[1] - 2 * point) / 2
    return (np.linalg.norm(sensors[0] - point) + np.linalg.norm(sensors[1] - point)) / 2


KINDS = np.array([PLANE, CORNER, EDGE, PLANE], dtype=np.int32)
ANCHORS = np.array([[1.2, 0.3], [0.2, 1.1], [-0.9, -0.6], [0.1, -1.0]])
PARAMETERS = np.array([[0.05, 0.1], [0.03, -0.02], [0.01, 0.04], [-0.02, -1.5]])
ROWS = np.tile([0, 1, 2, 3], ECHOES // 4)


def expected_of(state, path, rows=ROWS):
    sensors = np.asarray(RING.position)[RING.paths[path]]
    pick = [np.r_[0:3, 3 + 2 * k, 4 + 2 * k] for k in rows]
    return np.array(
        [range_of(state[p], KINDS[k], ANCHORS[k], ends) for p, k, ends in zip(pick, rows, sensors, strict=True)]
    )


def paths_of(path):
    return jax.tree.map(lambda leaf: np.asarray(leaf, dtype=np.float64)[path], RING.echo_paths)


def landmarks_with(parameters, kinds=KINDS, anchors=ANCHORS):
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


def updated(mean, prior, path, ranges, rows=ROWS, kinds=KINDS, anchors=ANCHORS):
    belief = kernels.Belief(mean[:3], landmarks_with(mean[3:].reshape(-1, 2), kinds, anchors), prior)
    found = kernels.ekf_update(belief, paths_of(path), ranges, rows.astype(np.int32), np.float64(SIGMA**2))
    state = np.concatenate([found.belief.pose, np.asarray(found.belief.landmarks.parameters).ravel()])
    return state, np.asarray(found.belief.covariance), found


@pytest.mark.slow
def test_the_update_equals_dense_least_squares(case):
    mean, prior, path, ranges, truth = case
    state, covariance, found = updated(mean, prior, path, ranges)
    expected, expected_cov = dense(mean, prior, path, ranges)
    assert np.asarray(found.used).all()
    sd = np.sqrt(np.diag(expected_cov))
    np.testing.assert_array_less(np.abs(state - expected), 0.02 * sd)  # after few iterations
    np.testing.assert_allclose(covariance / np.outer(sd, sd), expected_cov / np.outer(sd, sd), atol=2e-3)
    off = state - truth
    assert off @ np.linalg.solve(covariance, off) < 31.3  # chi2, 11, 0.001
    np.testing.assert_allclose(found.residual, ranges - expected_of(state, path), atol=1e-12)


def test_outliers_have_no_influence(case, rng):
    """Errors of some centimetres: the result is that of the other echoes alone."""
    mean, prior, path, ranges, _ = case
    bad = rng.permutation(ECHOES)[:9]
    corrupted = ranges.copy()
    corrupted[bad] += rng.choice([-1, 1], 9) * rng.uniform(0.05, 0.3, 9)
    state, covariance, found = updated(mean, prior, path, corrupted)
    assert sorted(np.flatnonzero(np.asarray(found.used) == 0)) == sorted(bad)
    kept = np.setdiff1d(np.arange(ECHOES), bad)
    expected, expected_cov = dense(mean, prior, path[kept], ranges[kept], ROWS[kept])
    np.testing.assert_array_less(np.abs(state - expected), 0.02 * np.sqrt(np.diag(expected_cov)))
    np.testing.assert_allclose(covariance, expected_cov, atol=2e-3 * expected_cov.max())


@pytest.mark.slow
def test_order_and_padding_do_not_matter(case, rng):
    mean, prior, path, ranges, _ = case
    reference, reference_cov, found = updated(mean, prior, path, ranges)
    order = rng.permutation(ECHOES)
    # Unassigned echoes and unused landmarks.
    more_path, more_range = np.pad(path[order], (0, 20)), np.pad(ranges[order], (0, 20))
    more_rows = np.pad(ROWS[order], (0, 20), constant_values=-1)
    padded_prior, kinds, anchors = np.zeros((15, 15)), np.append(KINDS, [-1, -1]).astype(np.int32), np.zeros((6, 2))
    padded_prior[:11, :11], anchors[:4] = prior, ANCHORS
    state, covariance, padded = updated(
        np.pad(mean, (0, 4)), padded_prior, more_path, more_range, more_rows, kinds, anchors
    )
    np.testing.assert_allclose(state[:11], reference, atol=1e-10)
    np.testing.assert_allclose(covariance[:11, :11], reference_cov, atol=1e-12)
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
    ranges = np.array([range_of(truth, PLANE, anchors[0], ends) for ends in sensors])
    state, cov, _ = updated(mean, prior, path, ranges, rows, kinds, anchors)
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
    is_ahead = (unit(theta) * (middle - pose[:2])).sum(-1) > 0
    theta = wrap_angle(np.where(is_ahead, theta, theta + np.pi))
    count = len(middle)
    landmarks = kernels.Landmarks(
        np.full(count, PLANE, np.int32),
        np.stack([np.zeros(count), theta], -1),
        middle,
        half[:, None] * [-1.0, 1.0],
    )
    expected = np.asarray(kernels.expected_ranges(pose, landmarks, paths_of(np.arange(len(RING.paths)))))
    wall = echoes.kind == EchoKind.PLANE
    assert wall.sum() > 20
    np.testing.assert_allclose(expected[echoes.reflector[wall], echoes.path[wall]], echoes.range[wall], atol=2e-6)

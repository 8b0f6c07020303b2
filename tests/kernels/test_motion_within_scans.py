"""Echoes with a pose of their own within the scan: the same as scans of one echo at these poses."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.adjustment_problem import ECHOES, LANDMARKS, RING, SCANS, problem_with_truth, to_jax

from jaxsonar import kernels
from jaxsonar.geometry.se2 import compose


@pytest.fixture(autouse=True)
def double():
    """Double precision."""
    with jax.enable_x64(True):
        yield


def some_motion(rng):
    return rng.uniform(-1, 1, (SCANS, ECHOES, 3)) * (0.1, 0.1, 0.2)


def moving(rng):
    """A problem in which the robot moved within every scan, and its true unknowns."""
    problem, _, true = problem_with_truth(rng)
    motion = jnp.asarray(some_motion(rng))
    return eqx.tree_at(lambda p: p.factors.motion, problem, motion, is_leaf=lambda leaf: leaf is None), true


def one_echo_scans(problem, unknowns):
    """The same echoes, each in a scan of its own at the pose of its time."""
    motion = np.asarray(problem.factors.motion)
    poses = compose(np.asarray(unknowns.poses)[:, None], motion).reshape(-1, 3)
    factors = jax.tree.map(lambda leaf: leaf.reshape(-1, 1), eqx.tree_at(lambda f: f.motion, problem.factors, None))
    flat = eqx.tree_at(lambda p: p.factors, problem, factors)
    return flat, eqx.tree_at(lambda u: u.poses, unknowns, jnp.asarray(poses))


def test_residuals_are_those_of_scans_with_one_echo(rng):
    problem, true = moving(rng)
    flat, unknowns = one_echo_scans(problem, true)
    expected = np.asarray(kernels.residuals(flat, unknowns)).reshape(SCANS, ECHOES)
    np.testing.assert_allclose(kernels.residuals(problem, true), expected, atol=1e-12)


def test_no_motion_is_the_same_as_a_robot_at_rest(rng):
    problem, true = moving(rng)
    still = eqx.tree_at(lambda p: p.factors.motion, problem, jnp.zeros((SCANS, ECHOES, 3)))
    rest = eqx.tree_at(lambda p: p.factors.motion, problem, None)
    np.testing.assert_array_equal(kernels.residuals(still, true), kernels.residuals(rest, true))


def test_derivatives_are_those_of_the_residuals(rng):
    problem, true = moving(rng)
    scan, echo = (jnp.asarray(rows.ravel(), jnp.int32) for rows in np.indices((SCANS, ECHOES)))
    found = kernels.linearize(problem, true, scan, echo)
    by = jax.jacrev(lambda unknowns: kernels.residuals(problem, unknowns).ravel())(true)
    every = np.arange(SCANS * ECHOES)
    np.testing.assert_allclose(found.d_range_d_pose, -by.poses[every, scan], atol=1e-9)
    np.testing.assert_allclose(found.d_range_d_coordinates, -by.coordinates, atol=1e-9)


def test_associations_are_those_of_scans_with_one_echo(rng):
    count = 5
    own = np.arange(count, dtype=np.int32)
    candidates = kernels.CandidateReflections(
        kernels.Reflection(LANDMARKS.kind[:count], own, own), np.zeros(count, np.int32), own
    )
    poses, motion = rng.uniform(-0.2, 0.2, (SCANS, 3)), some_motion(rng)
    path = rng.integers(0, len(RING.paths), (SCANS, ECHOES))
    reported = rng.uniform(0.3, 1.8, (SCANS, ECHOES))

    def associated(poses, path, reported, motion):
        near = np.tile(own, (len(poses), 1))
        arrays = (poses, np.zeros(len(poses), np.int32), path.astype(np.int32), reported, near)
        given = None if motion is None else jnp.asarray(motion)
        trees = (to_jax(LANDMARKS), to_jax(candidates))
        found = kernels.associate(RING.sensors, *trees, *map(jnp.asarray, arrays), given)
        return [np.asarray(leaf).ravel() for leaf in (found.candidate, found.residual, found.competitor_gap)]

    own_scans = compose(poses[:, None], motion).reshape(-1, 3)
    expected = associated(own_scans, path.reshape(-1, 1), reported.reshape(-1, 1), None)
    found = associated(poses, path, reported, motion)
    assert (found[0] >= 0).sum() > 20
    np.testing.assert_array_equal(found[0], expected[0])
    for one, other in zip(found[1:], expected[1:], strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)


def test_directions_of_arrival_are_those_of_scans_at_the_pose_of_each_sensor(rng):
    count = 3
    own = np.arange(count, dtype=np.int32)
    candidates = to_jax(
        kernels.CandidateReflections(
            kernels.Reflection(LANDMARKS.kind[:count], own, own), np.zeros(count, np.int32), own
        )
    )
    poses, motion = rng.uniform(-0.2, 0.2, (SCANS, 3)), some_motion(rng)[:, : RING.count]

    def angles(poses, motion=None):
        index = jnp.zeros(len(poses), jnp.int32)
        given = None if motion is None else jnp.asarray(motion)
        found = kernels.off_axis_angles(RING.sensors, to_jax(LANDMARKS), candidates, jnp.asarray(poses), index, given)
        return np.asarray(found)

    found = angles(poses, motion)
    each = angles(compose(poses[:, None], motion).reshape(-1, 3)).reshape(SCANS, RING.count, count, RING.count)
    expected = np.diagonal(each, axis1=1, axis2=3)
    assert np.isfinite(found).sum() > 10
    np.testing.assert_allclose(found, expected, atol=1e-9)

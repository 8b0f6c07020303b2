"""A small bundle-adjustment problem with echoes of all kinds, and its residuals in one dense vector."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxsonar import Ring, kernels
from jaxsonar.kernels import (
    CORNER,
    EDGE,
    PLANE,
    SECOND_ORDER,
    EchoFactors,
    Landmarks,
    LeastSquaresProblem,
    Reflection,
    Unknowns,
)

RING = Ring.circular(count=6, neighbors=1, radius=0.25)
SENSORS, SCANS, ECHOES = 6, 5, 40
SIGMA = 1e-3
KIND = np.array([PLANE, PLANE, PLANE, CORNER, EDGE, -1], np.int32)
LANDMARK_COUNT = len(KIND)
LANDMARKS = Landmarks(
    kind=KIND,
    parameters=np.array([[0.01, 0.1], [-0.02, 1.7], [0.0, -2.0], [0.01, 0.02], [-0.01, 0.0], [0, 0]], np.float64),
    anchor=np.array([[1.2, 0.2], [0.1, 1.4], [-0.8, -1.1], [1.3, 1.2], [-1.0, 0.6], [0, 0]], np.float64),
    extent=np.tile([-1.0, 1.0], (LANDMARK_COUNT, 1)),
)
POSES = np.array([[0, 0, 0], [0.2, 0.05, 0.4], [0.35, -0.1, 0.9], [0.2, -0.2, 2.9], [0.0, -0.1, -2.6]], np.float64)
ODOMETRY_SD = np.array([0.004, 0.004, 0.006])


class ProblemWithTruth(NamedTuple):
    """Measurements, initial values, and the unknowns that the measurements were made with."""

    problem: LeastSquaresProblem
    start: Unknowns
    true: Unknowns


def basis_of(sensors: int, *, odometry_scale: bool = False) -> np.ndarray:
    """Offsets relative to their mean, speed of sound and all positions; two more coordinates scale the odometry."""
    size = 3 * sensors + 1
    columns = np.zeros((size + 2 * odometry_scale, size + 2 * odometry_scale))
    columns[:sensors, :sensors] = 0.02 * (np.eye(sensors) - 1 / sensors)
    columns[sensors, sensors] = 0.015
    columns[sensors + 1 : size, sensors + 1 : size] = 0.004 * np.eye(2 * sensors)
    if odometry_scale:
        columns[-2:, -2:] = 0.05 * np.eye(2)
    return columns


def problem_with_truth(
    rng: np.random.Generator, *, odometry: bool = True, odometry_scale: bool = False, missing_range: float = 0.0
) -> ProblemWithTruth:
    """Noisy echoes of all kinds; ring, poses and landmarks differ a little from their prior means.

    Args:
        rng: source of randomness.
        odometry: whether the odometry has information.
        odometry_scale: whether its scale is estimated.
        missing_range: reported range of missing echoes.
    """
    shape = (SCANS, ECHOES)
    kind = rng.choice([PLANE, PLANE, CORNER, EDGE, SECOND_ORDER], shape).astype(np.int32)
    first = np.select([kind == CORNER, kind == EDGE], [3, 4], rng.integers(0, 2, shape))
    first = np.where((kind == PLANE) & (rng.random(shape) < 0.3), 2, first).astype(np.int32)
    second = np.where(kind == SECOND_ORDER, 1 - first, first).astype(np.int32)
    missing = rng.random(shape) < 0.2
    factors = EchoFactors(
        path=jnp.asarray(rng.integers(0, len(RING.paths), shape), jnp.int32),
        reported=jnp.zeros(shape),
        reflection=to_jax(Reflection(kind, first, second)),
        weight=jnp.asarray(np.where(missing, 0, 1 / SIGMA**2)),
    )
    step = np.zeros((SCANS, 3))
    cos, sin = np.cos(POSES[:-1, 2]), np.sin(POSES[:-1, 2])
    shift = np.diff(POSES, axis=0)
    step[:-1] = np.stack(
        [cos * shift[:, 0] + sin * shift[:, 1], cos * shift[:, 1] - sin * shift[:, 0], shift[:, 2]], -1
    )
    prior_information = np.full((SCANS, 3), 1.0)
    prior_information[0] = 1e8
    # The row of the last scan must not matter, and measured rotations may be a whole turn off.
    odometry_information = np.tile(odometry / ODOMETRY_SD**2, (SCANS, 1))
    measured = step + ODOMETRY_SD * rng.standard_normal((SCANS, 3)) + np.array([0, 0, 2 * np.pi])
    columns = basis_of(SENSORS, odometry_scale=odometry_scale)
    problem = LeastSquaresProblem(
        sensors=RING.sensors,
        basis=jnp.asarray(columns),
        landmarks=to_jax(LANDMARKS),
        factors=factors,
        prior_poses=jnp.asarray(POSES),
        prior_information=jnp.asarray(prior_information),
        odometry=jnp.asarray(measured),
        odometry_information=jnp.asarray(odometry_information),
    )
    true = Unknowns(
        jnp.asarray(rng.normal(0, 0.3, columns.shape[1])),
        jnp.asarray(POSES + np.concatenate([np.zeros((1, 3)), 0.01 * rng.standard_normal((SCANS - 1, 3))])),
        jnp.asarray(LANDMARKS.parameters + 0.01 * rng.standard_normal((LANDMARK_COUNT, 2)) * (KIND >= 0)[:, None]),
    )
    noise = np.where(missing, missing_range, SIGMA * rng.standard_normal(shape))
    reported = -kernels.residuals(problem, true) + noise
    problem = eqx.tree_at(lambda p: p.factors.reported, problem, reported)
    start = Unknowns(jnp.zeros(columns.shape[1]), problem.prior_poses, problem.landmarks.parameters)
    return ProblemWithTruth(problem, start, true)


def to_jax(tree):
    return jax.tree.map(jnp.asarray, tree)


def wrap(angle):
    return (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi


def dense_residuals(unknowns: Unknowns, problem: LeastSquaresProblem) -> jax.Array:
    """The oracle: everything that is squared, weighted, in one vector; rotations as matrices."""
    out = [(jnp.sqrt(problem.factors.weight) * kernels.residuals(problem, unknowns)).ravel()]
    landmark_change = (unknowns.landmarks - problem.landmarks.parameters) / problem.landmark_prior_sd
    out += [unknowns.coordinates, landmark_change.ravel()]
    change = unknowns.poses - problem.prior_poses
    change = jnp.concatenate([change[:, :2], wrap(change[:, 2:])], 1)
    out.append((jnp.sqrt(problem.prior_information) * change).ravel())
    has_scale = len(problem.basis) > 3 * SENSORS + 1
    scale = jnp.exp(-(problem.basis @ unknowns.coordinates)[-2:]) if has_scale else jnp.ones(2)
    for k in range(len(problem.prior_poses) - 1):
        here, there = unknowns.poses[k], unknowns.poses[k + 1]
        cos, sin = jnp.cos(here[2]), jnp.sin(here[2])
        robot_from_world = jnp.stack([jnp.stack([cos, sin]), jnp.stack([-sin, cos])])
        shift = robot_from_world @ (there - here)[:2] - scale[0] * problem.odometry[k, :2]
        turn = wrap(there[2] - here[2] - scale[1] * wrap(problem.odometry[k, 2]))
        out.append(jnp.sqrt(problem.odometry_information[k]) * jnp.append(shift, turn))
    return jnp.concatenate(out)


@jax.jit
def dense_jacobian(unknowns: Unknowns, problem: LeastSquaresProblem) -> jax.Array:
    """Derivatives of ``dense_residuals``; columns: coordinates, poses, landmarks."""
    by = jax.jacfwd(dense_residuals)(unknowns, problem)
    rows = by.coordinates.shape[0]
    return jnp.concatenate([by.coordinates, by.poses.reshape(rows, -1), by.landmarks.reshape(rows, -1)], 1)


def assert_same(a, b, atol=1e-9):
    """All leaves of two trees are equal within a tolerance."""
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=atol)

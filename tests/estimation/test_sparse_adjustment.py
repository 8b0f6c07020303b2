"""The sparse solver against a dense Hessian, and the odometry residuals of a chain."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsonar import kernels
from jaxsonar.estimation.sparse_adjustment import adjust, marginal_covariances
from jaxsonar.geometry.se2 import compose, relative
from jaxsonar.simulation.office import load_office

SIGMA = 0.005


def compose_steps(poses, errors):
    """Odometry with these errors of its steps."""
    odometry = [poses[0]]
    for step in relative(poses[:-1], poses[1:]) + errors:
        odometry.append(compose(odometry[-1], step))
    return np.array(odometry)


@pytest.mark.slow
def test_covariances_are_those_of_the_dense_hessian(rng):
    """Against a dense inverse of the Hessian of the cost, by automatic differentiation."""
    ring = load_office().ring
    poses = load_office().poses[:4]
    odometry = compose_steps(poses, 0.02 * rng.standard_normal((3, 3)))
    with jax.enable_x64(True):
        count, scans = 24, 4
        kind = np.zeros((scans, count), np.int32)
        first = rng.integers(0, 3, (scans, count)).astype(np.int32)
        landmarks = kernels.Landmarks(
            kind=jnp.asarray(np.zeros(3, np.int32)),
            parameters=jnp.asarray(np.column_stack([np.zeros(3), [0.1, 1.6, -2.2]])),
            anchor=jnp.asarray([[1.4, 0.1], [0.0, 1.5], [-0.9, -1.2]]),
            extent=jnp.asarray(np.tile([-1.0, 1.0], (3, 1))),
        )
        columns = np.zeros((3 * ring.count + 3, 2))
        columns[-2:] = 0.05 * np.eye(2)
        poses = jnp.asarray(poses)
        problem = kernels.LeastSquaresProblem(
            sensors=jax.tree.map(jnp.asarray, ring.sensors),
            basis=jnp.asarray(columns),
            landmarks=landmarks,
            factors=kernels.EchoFactors(
                path=jnp.asarray(rng.integers(0, len(ring.paths), (scans, count)).astype(np.int32)),
                reported=jnp.zeros((scans, count)),
                reflection=kernels.Reflection(*(jnp.asarray(x) for x in (kind, first, first))),
                weight=jnp.full((scans, count), 1 / SIGMA**2),
            ),
            prior_poses=poses,
            prior_information=jnp.asarray(np.r_[[[1e6] * 3], np.ones((scans - 1, 3))]),
            odometry=jnp.asarray(np.r_[relative(odometry[: scans - 1], odometry[1:scans]), np.zeros((1, 3))]),
            odometry_information=jnp.full((scans, 3), 1e4),
            landmark_prior_sd=5.0,
        )
        unknowns = kernels.Unknowns(jnp.zeros(2), poses, jnp.asarray(landmarks.parameters))
        exact = -kernels.residuals(problem, unknowns)
        problem = replace(
            problem, factors=replace(problem.factors, reported=exact)
        )  # no residual: Gauss-Newton is exact
        found = adjust(problem, unknowns, poses_free=True, max_iterations=30)
        problem = replace(problem, factors=replace(problem.factors, reported=exact), prior_poses=found.unknowns.poses)
        covariances = marginal_covariances(problem, found.unknowns, poses_free=True)

        def flat(values):
            poses, coordinates, landmarks = values[:12].reshape(4, 3), values[12:14], values[14:].reshape(3, 2)
            return kernels.Unknowns(coordinates, poses, landmarks)

        def squares(values):
            now = flat(values)
            out = [jnp.sqrt(problem.factors.weight).ravel() * kernels.residuals(problem, now).ravel()]
            out += [now.coordinates, (now.landmarks - landmarks.parameters).ravel() / 5.0]
            out += [(jnp.sqrt(problem.prior_information) * (now.poses - problem.prior_poses)).ravel()]
            scale = jnp.exp(-0.05 * now.coordinates)
            for k in range(scans - 1):
                displacement, heading = (now.poses[k + 1] - now.poses[k])[:2], now.poses[k, 2]
                cos, sin = jnp.cos(heading), jnp.sin(heading)
                forward = jnp.stack(
                    [cos * displacement[0] + sin * displacement[1], cos * displacement[1] - sin * displacement[0]]
                )
                turn = now.poses[k + 1, 2] - heading - scale[1] * problem.odometry[k, 2]
                out.append(100.0 * jnp.append(forward - scale[0] * problem.odometry[k, :2], turn))
            return jnp.concatenate(out)

        at = jnp.concatenate(
            [found.unknowns.poses.ravel(), found.unknowns.coordinates, found.unknowns.landmarks.ravel()]
        )
        jacobian = np.asarray(jax.jacfwd(squares)(at))
        whole = np.linalg.inv(jacobian.T @ jacobian)
        np.testing.assert_allclose((squares(at) ** 2).sum() / 2, kernels.cost(problem, flat(at)), rtol=1e-9)
        for k in range(scans):
            own = slice(3 * k, 3 * k + 3)
            np.testing.assert_allclose(covariances.poses[k], whole[own, own], rtol=1e-7, atol=1e-14)
        np.testing.assert_allclose(covariances.coordinates, whole[12:14, 12:14], rtol=1e-7, atol=1e-14)
        landmarks = [whole[14 + 2 * k : 16 + 2 * k, 14 + 2 * k : 16 + 2 * k] for k in range(3)]
        np.testing.assert_allclose(covariances.landmarks, landmarks, rtol=1e-7, atol=1e-14)

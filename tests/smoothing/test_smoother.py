"""All poses and reflectors together: covariances of a dense inverse, odometry's noise, the office from its ranges."""

from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsonar import Log, Room, SonarError, kernels, simulate
from jaxsonar.estimation.odometry_noise import OdometryNoise, ProportionalNoise
from jaxsonar.geometry.se2 import compose, relative, wrap_angle
from jaxsonar.kernels.block_arrowhead import Arrow, covariances, eliminated, solved
from jaxsonar.simulation.office import load_office
from jaxsonar.smoothing.smoother import Smoothed, smooth

SIGMA = 0.005
POSES, SHARED = 6, 4


# Linear algebra


@pytest.fixture
def arrow(rng):
    """Normal equations of a chain of poses and shared unknowns; and the same as one matrix."""
    size = 3 * POSES + SHARED
    rows = np.zeros((60 * POSES, size))
    for k in range(POSES):
        own = slice(60 * k, 60 * k + 60)
        rows[own, 3 * k : 3 * k + 3] = rng.standard_normal((60, 3))
        rows[own, -SHARED:] = rng.standard_normal((60, SHARED))
        if k + 1 < POSES:
            rows[60 * k : 60 * k + 20, 3 * k + 3 : 3 * k + 6] = rng.standard_normal((20, 3))
    whole, side = rows.T @ rows, rng.standard_normal(size)
    with jax.enable_x64(True):
        blocks = [slice(3 * k, 3 * k + 3) for k in range(POSES)]
        following = [whole[a, b] for a, b in pairwise(blocks)] + [np.zeros((3, 3))]
        yield (
            Arrow(
                shared=jnp.asarray(whole[-SHARED:, -SHARED:]),
                shared_g=jnp.asarray(side[-SHARED:]),
                cross=jnp.asarray(np.stack([whole[own, -SHARED:] for own in blocks])),
                pose=jnp.asarray(np.stack([whole[own, own] for own in blocks])),
                pose_g=jnp.asarray(side[: 3 * POSES].reshape(POSES, 3)),
                next=jnp.asarray(np.stack(following)),
            ),
            whole,
            side,
        )


@pytest.mark.slow
def test_an_arrow_is_solved_as_the_whole_matrix(arrow):
    parts, whole, side = arrow
    for damping in (0.0, 0.1):
        shared, poses = solved(parts, jnp.asarray(damping))
        expected = np.linalg.solve(whole + damping * np.diag(np.diag(whole)), side)
        np.testing.assert_allclose(poses.ravel(), expected[: 3 * POSES], atol=1e-12)
        np.testing.assert_allclose(shared, expected[3 * POSES :], atol=1e-12)


@pytest.mark.slow
def test_covariances_are_blocks_of_the_inverse(arrow):
    parts, whole, _ = arrow
    shared, poses = covariances(parts)
    inverse = np.linalg.inv(whole)
    np.testing.assert_allclose(shared, inverse[3 * POSES :, 3 * POSES :], atol=1e-13)
    np.testing.assert_allclose(jnp.linalg.inv(eliminated(parts, jnp.asarray(0.0)).shared), shared, atol=1e-13)
    for k, found in enumerate(np.asarray(poses)):
        np.testing.assert_allclose(found, inverse[3 * k : 3 * k + 3, 3 * k : 3 * k + 3], atol=1e-13)


@pytest.mark.slow
def test_a_chain_alone_spreads_as_a_random_walk():
    """No echo, odometry only: the covariance of a pose is the sum of those of the steps."""
    with jax.enable_x64(True):
        eye = np.eye(3)
        pose = np.stack([(1e12 if k == 0 else 1) * eye + (k + 1 < POSES) * eye for k in range(POSES)])
        arrow = Arrow(
            jnp.eye(1),
            jnp.zeros(1),
            jnp.zeros((POSES, 3, 1)),
            jnp.asarray(pose),
            jnp.zeros((POSES, 3)),
            jnp.asarray(np.stack([-eye * (k + 1 < POSES) for k in range(POSES)])),
        )
        _, poses = covariances(arrow)
    np.testing.assert_allclose(poses, np.arange(POSES)[:, None, None] * eye, atol=1e-9)


# Odometry


def test_halving_the_steps_changes_no_drift(rng):
    walk = np.cumsum(rng.uniform(-0.2, 0.2, (40, 3)), axis=0)
    walk[:, 0] = np.abs(walk[:, 0]).cumsum()
    walk[:, 1:] = 0, 0.3  # on a line, so that steps divide
    noise = OdometryNoise(minimum=(1e-9, 1e-9))
    fine = noise(walk, np.arange(40))
    coarse = noise(walk, np.arange(1, 40, 2))
    np.testing.assert_allclose((fine[1:] ** 2).reshape(-1, 2, 3).sum(axis=1), coarse**2, rtol=1e-9)


def test_odometry_may_have_gaps():
    walk = np.column_stack([np.arange(5.0), np.zeros(5), np.zeros(5)])
    walk[2] = np.nan
    found = OdometryNoise(position_per_meter=0.1, heading_per_meter=0.2, minimum=(1e-9, 1e-9))(walk, np.array([0, 1, 3, 4]))
    np.testing.assert_allclose(found**2, np.outer([1, 2, 1], [0.01, 0.0025, 0.04]), rtol=1e-9)


def test_a_share_is_of_the_way_and_the_turn():
    walk = np.array([[0, 0, 0], [2.0, 0, 0.5]])
    place, turn = 0.02 * 2 + 0.0005, 0.02 * (0.5 + 0.5 * 2) + 0.001
    np.testing.assert_allclose(ProportionalNoise(0.02)(walk, np.arange(2)), [[place, place, turn]])


@pytest.mark.parametrize("wrong", [{"place": -1.0}, {"heading": float("nan")}, {"standing": (0.0, 0.1)}])
def test_noise_that_is_none_is_refused(wrong):
    with pytest.raises(SonarError, match="slip"):
        OdometryNoise(**wrong)


# The office


def drift(poses, rng, place=0.02, heading=0.0175):
    """Odometry of a random walk."""
    steps = relative(poses[:-1], poses[1:])
    root = np.sqrt(np.hypot(steps[:, 0], steps[:, 1]))[:, None]
    steps = steps + root * np.array([place, place, heading]) * rng.standard_normal(steps.shape)
    out = [poses[0]]
    for step in steps:
        out.append(compose(out[-1], step))
    return np.array(out)


@pytest.fixture(scope="module")
def heard():
    office = load_office()
    log = simulate(office.ring, office.room, office.poses, sigma=SIGMA, seed=0).as_log(office.ring, office.poses)
    return office.ring, log, drift(office.poses, np.random.default_rng(0))


@pytest.fixture(scope="module")
def found(heard):
    ring, log, odometry = heard
    start = odometry.copy()
    start[12] = np.nan  # led on by odometry
    return smooth(ring, log, start, odometry=odometry, scale=True, slip=OdometryNoise(position_per_meter=0.02, heading_per_meter=0.0175))


def error(found: Smoothed, log: Log):
    off = found.poses - log.pose
    return np.column_stack([off[:, :2], wrap_angle(off[:, 2])])


@pytest.mark.slow
def test_poses_and_walls_are_better_than_odometry_and_within_what_is_said(heard, found):
    _, log, odometry = heard
    assert len(found.left_out) == 0
    off, cov = error(found, log), found.pose_cov
    drifted = np.linalg.norm(odometry[1:, :2] - log.pose[1:, :2], axis=1)
    assert np.sqrt(np.mean(off[1:, :2] ** 2)) < 0.03
    assert np.sqrt(np.mean(off[1:, 2] ** 2)) < np.radians(1.8)
    assert np.linalg.norm(off[1:, :2], axis=1).mean() < drifted.mean() + 0.01
    nees = np.einsum("ni,nij,nj->n", off[1:], np.linalg.inv(cov[1:]), off[1:])
    assert nees.mean() < 8
    assert found.sigma == pytest.approx(SIGMA, rel=0.1)
    assert found.used > 0.7
    assert (found.heard > 10).all()
    np.testing.assert_allclose(off[0], 0, atol=1e-3)
    assert np.sqrt(cov[0, 0, 0]) < 1e-3
    np.testing.assert_array_equal(cov, np.swapaxes(cov, 1, 2))
    world = found.world
    assert len(world) >= 6
    normal = np.stack([np.cos(world.theta), np.sin(world.theta)], -1)
    np.testing.assert_allclose(
        np.einsum("nek,nk->ne", world.segments, normal), world.rho[:, None] + [[0, 0]], atol=1e-9
    )
    assert (world.rho >= 0).all()
    assert (world.sigma_rho < 0.3).all()
    assert np.isfinite(world.point_cov).all()
    for value, sd in zip(found.scale, found.scale_sd, strict=True):
        assert abs(value) < 4 * sd
        assert 0 < sd <= 0.05 * (1 + 1e-9)


@pytest.fixture(scope="module")
def corridor(heard):
    """Two walls, no odometry: nothing says how far along the robot is."""
    ring, _, _ = heard
    room = Room(walls=np.array([[[-9.0, 1.0], [9.0, 1.0]], [[-9.0, -1.0], [9.0, -1.0]]]))
    poses = np.column_stack([np.linspace(-1, 1, 9), np.zeros(9), np.zeros(9)])
    log = simulate(ring, room, poses, sigma=SIGMA, seed=1).as_log(ring, poses)
    return log, smooth(ring, log, poses)


@pytest.mark.slow
def test_without_echoes_in_one_direction_the_covariance_says_so(corridor):
    """Decimetres, not 30 m: two walls as they are estimated are no exact parallels, and a wedge has places along it."""
    log, found = corridor
    assert len(found.left_out) == 0
    sd = np.sqrt(np.diagonal(found.pose_cov, axis1=1, axis2=2))
    assert (sd[1:, 0] > 0.2).all()
    assert (sd[1:, 0] > 20 * sd[1:, 1]).all()
    assert (sd[1:, 1] < 0.03).all()
    assert (np.abs(error(found, log)[:, 1:]) < 5 * sd[:, 1:] + 1e-4).all()


@pytest.mark.slow
def test_along_a_bare_corridor_the_truth_is_within_what_is_said(corridor):
    log, found = corridor
    sd = np.sqrt(np.diagonal(found.pose_cov, axis1=1, axis2=2))
    assert (np.abs(error(found, log)[1:, 0]) < 3 * sd[1:, 0]).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"poses": np.full((17, 3), np.nan)}, "none of the 17 scans has a pose"),
        ({"poses": np.zeros((3, 3))}, r"poses of shape \(3, 3\)"),
        ({"odometry": np.zeros((2, 3))}, r"odometry of shape \(2, 3\)"),
        ({"scale": True}, "no odometry"),
        ({"sigma": -1.0}, "sigma"),
        ({"window": -1.0}, "window"),
    ],
)
def test_what_cannot_be_is_named(heard, change, message):
    ring, log, _ = heard
    with pytest.raises(SonarError, match=message):
        smooth(ring, log, **({"poses": log.pose} | change))


@pytest.mark.slow
def test_the_poses_covariance_is_that_of_all_equations(heard):
    """Against a dense inverse of the Hessian of the cost, by automatic differentiation."""
    ring, log, odometry = heard
    with jax.enable_x64(True):
        rng = np.random.default_rng(3)
        count, scans = 24, 4
        kind = np.zeros((scans, count), np.int32)
        first = rng.integers(0, 3, (scans, count)).astype(np.int32)
        scene = kernels.Landmarks(
            kind=jnp.asarray(np.zeros(3, np.int32)),
            parameters=jnp.asarray(np.column_stack([np.zeros(3), [0.1, 1.6, -2.2]])),
            anchor=jnp.asarray([[1.4, 0.1], [0.0, 1.5], [-0.9, -1.2]]),
            extent=jnp.asarray(np.tile([-1.0, 1.0], (3, 1))),
        )
        columns = np.zeros((3 * ring.count + 3, 2))
        columns[-2:] = 0.05 * np.eye(2)
        poses = jnp.asarray(log.pose[:scans])
        problem = kernels.LeastSquaresProblem(
            sensors=jax.tree.map(jnp.asarray, ring.sensors),
            basis=jnp.asarray(columns),
            landmarks=scene,
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
        unknowns = kernels.Unknowns(jnp.zeros(2), poses, jnp.asarray(scene.parameters))
        exact = -kernels.residuals(problem, unknowns)
        problem = replace(problem, factors=replace(problem.factors, reported=exact))  # no residual: Gauss-Newton is exact
        found = kernels.adjust(problem, unknowns, poses_free=True, most=30)
        problem = replace(problem, factors=replace(problem.factors, reported=exact), prior_poses=found.unknowns.poses)
        got = kernels.pose_covariances(problem, found.unknowns)

        def flat(values):
            poses, modes, scene = values[:12].reshape(4, 3), values[12:14], values[14:].reshape(3, 2)
            return kernels.Unknowns(modes, poses, scene)

        def squares(values):
            now = flat(values)
            out = [jnp.sqrt(problem.factors.weight).ravel() * kernels.residuals(problem, now).ravel()]
            out += [now.coordinates, (now.landmarks - scene.parameters).ravel() / 5.0]
            out += [(jnp.sqrt(problem.prior_information) * (now.poses - problem.prior_poses)).ravel()]
            told = jnp.exp(-0.05 * now.coordinates)
            for k in range(scans - 1):
                way, heading = (now.poses[k + 1] - now.poses[k])[:2], now.poses[k, 2]
                cos, sin = jnp.cos(heading), jnp.sin(heading)
                ahead = jnp.stack([cos * way[0] + sin * way[1], cos * way[1] - sin * way[0]])
                turn = now.poses[k + 1, 2] - heading - told[1] * problem.odometry[k, 2]
                out.append(100.0 * jnp.append(ahead - told[0] * problem.odometry[k, :2], turn))
            return jnp.concatenate(out)

        at = jnp.concatenate([found.unknowns.poses.ravel(), found.unknowns.modes, found.unknowns.scene.ravel()])
        slope = np.asarray(jax.jacfwd(squares)(at))
        whole = np.linalg.inv(slope.T @ slope)
        np.testing.assert_allclose((squares(at) ** 2).sum() / 2, kernels.cost(problem, flat(at)), rtol=1e-9)
        for k in range(scans):
            own = slice(3 * k, 3 * k + 3)
            np.testing.assert_allclose(got[k], whole[own, own], rtol=1e-7, atol=1e-14)
        np.testing.assert_allclose(found.covariance[0, 0], whole[12, 12], rtol=1e-4)

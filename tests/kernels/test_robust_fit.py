"""Robust fit of planes and points to ranges: recovery, outliers, equivariance, derivatives."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import oracles

from jaxsonar import HoughSettings, Ring, kernels
from jaxsonar.detection.arc_tables import arc_tables
from jaxsonar.detection.settings import SETTINGS
from jaxsonar.geometry.se2 import relative
from jaxsonar.kernels import robust_fit

RING = Ring.circular(count=16, beam=1.0, neighbors=2, first_heading=0.0123)
ARCS = arc_tables(RING, HoughSettings()).arcs
SLOTS, LINES = 256, 4
seeds = st.integers(0, 10_000)
fit = jax.jit(robust_fit.fit_reflector, static_argnames=("model", "tolerance"))
paths_and_ranges = jax.jit(lambda echoes: robust_fit.paths_and_ranges(ARCS, jax.tree.map(lambda leaf: leaf[0], echoes)))


def packed(echoes):
    """(1, SLOTS) echoes from a list of (pose, path, range)."""
    assert len(echoes) <= SLOTS
    path, reported = np.zeros((1, SLOTS), np.int32), np.full((1, SLOTS), np.nan, np.float32)
    pose = np.zeros((1, SLOTS, 3), np.float32)
    for k, (stood, row, reach) in enumerate(echoes):
        path[0, k], reported[0, k], pose[0, k] = row, reach, stood
    return kernels.PackedEchoes(jnp.asarray(path), jnp.asarray(reported), jnp.asarray(pose))


def fits_of(echoes, *lines):
    """Fits to the candidates (rho, theta) and to NaN: one array per field, without the axis of scans."""
    rho, theta = np.full((2, 1, LINES), np.nan, np.float32)
    rho[0, : len(lines)], theta[0, : len(lines)] = np.array(lines).T
    fits = kernels.fit_candidates(
        ARCS, packed(echoes), jnp.asarray(rho), jnp.asarray(theta), tolerance=SETTINGS.window_tolerance
    )
    return jax.tree.map(lambda leaf: np.asarray(leaf)[0], fits)


def random_poses(rng, count=8, spread=0.5):
    return np.column_stack([rng.uniform(-spread, spread, (count, 2)), rng.uniform(-3, 3, count)])


def random_plane(rng):
    """A plane (rho, theta) beyond all poses, and a first guess about one cell away."""
    rho, theta = rng.uniform(0.9, 1.2), rng.uniform(-3, 3)
    return (rho, theta), (rho + rng.uniform(-0.04, 0.04), theta + rng.uniform(-0.06, 0.06))


def echoes_of_plane(poses, plane):
    return [echo for pose in poses for echo in oracles.plane_echoes(RING, pose, *plane)][:SLOTS]


def error(fits, plane, k=0):
    """Errors of a fitted plane in rho (m) and theta (rad)."""
    return abs(fits.rho[k] - plane[0]), abs(oracles.wrap(fits.theta[k] - plane[1]))


# planes


@pytest.mark.slow
@settings(max_examples=25)
@given(seeds)
def test_a_plane_is_recovered_and_explains_its_echoes_better_than_a_point(seed):
    rng = np.random.default_rng(seed)
    plane, guess = random_plane(rng)
    echoes = echoes_of_plane(random_poses(rng), plane)
    paths = RING.paths[[path for _, path, _ in echoes]]
    assert (paths[:, 0] == paths[:, 1]).any()
    assert (paths[:, 0] != paths[:, 1]).any()
    fits = fits_of(echoes, guess)
    assert max(error(fits, plane)) < 1e-4
    assert fits.explained[0, : len(echoes)].all()
    assert not fits.explained[0, len(echoes) :].any()
    assert fits.plane_score[0] == pytest.approx(len(echoes), rel=1e-4)
    assert fits.plane_score[0] > SETTINGS.plane_to_point_ratio * fits.point_score[0]


@settings(max_examples=10)
@given(seeds)
def test_footpoints_are_those_of_the_virtual_sensors(seed):
    rng = np.random.default_rng(seed)
    plane, guess = random_plane(rng)
    echoes = echoes_of_plane(random_poses(rng), plane)
    fits = fits_of(echoes, guess)
    t = np.array([-math.sin(fits.theta[0]), math.cos(fits.theta[0])])
    for k, (pose, path, _) in enumerate(echoes):
        middle = oracles.matrix(pose) @ np.append(RING.position[RING.paths[path]].mean(axis=0), 1)
        assert fits.footpoint[0, k] == pytest.approx(middle[:2] @ t, abs=1e-5)


@settings(max_examples=25)
@given(seeds, st.sampled_from([0.1, 0.25, 0.4]))
def test_outliers_do_not_change_the_plane(seed, false):
    """Up to 40 % of all echoes: the error stays below 2 mm."""
    rng = np.random.default_rng(seed)
    poses = random_poses(rng, count=10)
    plane, guess = random_plane(rng)
    true = echoes_of_plane(poses, plane)[: int(SLOTS * (1 - false))]
    count = int(len(true) * false / (1 - false))
    lies = [
        (poses[rng.integers(len(poses))], int(rng.integers(len(RING.paths))), rng.uniform(0.2, RING.max_range))
        for _ in range(count)
    ]
    fits = fits_of(true + lies, guess)
    assert fits.explained[0, : len(true)].all()
    t = np.array([-math.sin(plane[1]), math.cos(plane[1])])
    feet = plane[0] * oracles.matrix((0, 0, plane[1]))[:2, 0] + np.outer(poses[:, :2] @ t, t)
    n = np.array([math.cos(fits.theta[0]), math.sin(fits.theta[0])])
    assert np.abs(feet @ n - fits.rho[0]).max() < 2e-3


def test_noise_is_averaged_out(rng):
    plane, guess = random_plane(rng)
    echoes = echoes_of_plane(random_poses(rng, count=16), plane)
    noisy = [(pose, path, reach + rng.normal(0, 0.005)) for pose, path, reach in echoes]
    fits = fits_of(noisy, guess)
    assert error(fits, plane)[0] < 3 * 0.005 / math.sqrt(len(echoes) / 4)
    assert fits.explained[0, : len(echoes)].all()


@settings(max_examples=25)
@given(seeds)
def test_the_fit_is_equivariant_under_rigid_motions(seed):
    rng = np.random.default_rng(seed)
    plane, guess = random_plane(rng)
    echoes = echoes_of_plane(random_poses(rng), plane)
    frame = np.append(rng.uniform(-0.5, 0.5, 2), rng.uniform(-3, 3))  # on this side of the wall
    compare_from(frame, echoes, plane, guess)


def test_a_wall_behind_the_last_pose_is_fitted(rng):
    """Through a door, for example: the last pose is beyond the wall that the earlier poses observed."""
    plane, guess = (1.0, 0.0), (1.02, 0.03)
    echoes = echoes_of_plane(random_poses(rng), plane)
    compare_from(np.array([1.5, 0.1, 0.0]), echoes, plane, guess)


def transform_line(frame, line):
    """The line (rho, theta) in the frame of a pose, in canonical form."""
    rho = line[0] - frame[0] * math.cos(line[1]) - frame[1] * math.sin(line[1])
    theta = line[1] - frame[2]
    return (rho, oracles.wrap(theta)) if rho >= 0 else (-rho, oracles.wrap(theta + math.pi))


def compare_from(frame, echoes, plane, guess):
    """Check that echoes, candidate and plane in another frame give the same fit."""
    here = fits_of(echoes, guess)
    there = fits_of(
        [(relative(frame, pose), path, reach) for pose, path, reach in echoes], transform_line(frame, guess)
    )
    np.testing.assert_array_equal(there.explained, here.explained)
    assert there.plane_score[0] == pytest.approx(here.plane_score[0], rel=1e-3)
    assert there.point_score[0] == pytest.approx(here.point_score[0], rel=0.02, abs=0.2)
    assert max(error(there, transform_line(frame, plane))) < 1e-4
    assert np.ptp(there.footpoint[0, : len(echoes)]) == pytest.approx(
        np.ptp(here.footpoint[0, : len(echoes)]), abs=1e-3
    )


def test_an_echo_from_the_front_is_not_explained_by_a_plane_behind():
    """Sensors that face away from a plane receive no echo of it."""
    before = echoes_of_plane([np.array([0.0, y, 0.0]) for y in (-0.4, -0.2, 0.0, 0.2, 0.4)], (0.9, 0.0))
    beyond = []
    for y in (-0.3, 0.3):
        pose = np.array([1.6, y, 0.0])
        sensor = (oracles.matrix(pose) @ np.append(RING.position[0], 1))[0]
        beyond += oracles.plane_echoes(RING, pose, 2 * sensor - 0.9, 0.0)[:1]  # sensor 0, as far as the plane behind it
    assert [path for _, path, _ in beyond] == [0, 0]
    fits = fits_of(before + beyond, (0.91, 0.01))
    assert fits.explained[0, : len(before)].all()
    assert not fits.explained[0, len(before) :].any()


def test_echoes_from_outside_the_cones_are_not_explained():
    poses = [np.array([0.0, y, 0.0]) for y in (-0.4, 0.0, 0.4)]
    echoes = echoes_of_plane(poses, (1.0, 0.0))
    behind = [(pose, int(RING.path_index[8, 8]), reach) for pose, path, reach in echoes if path == 0]
    assert len(behind) == 3
    fits = fits_of(echoes + behind, (1.0, 0.0))
    assert fits.explained[0, : len(echoes)].all()
    assert not fits.explained[0, len(echoes) :].any()


# points


def poses_past_a_point(rng, spread):
    """Poses along a straight trajectory that passes a point at 0.9 m, and that point."""
    along = np.linspace(-spread, spread, 12)
    return np.column_stack([along, rng.normal(0, 0.02, 12), rng.normal(0, 0.1, 12)]), np.array([0.0, 0.9])


@settings(max_examples=15)
@given(seeds, st.booleans(), st.sampled_from([0.35, 0.7, 1.0]))
def test_a_point_explains_its_echoes_better_than_a_plane(seed, corner, spread):
    """By more than the decision ratio, once the robot has passed it."""
    rng = np.random.default_rng(seed)
    poses, place = poses_past_a_point(rng, spread)
    echoes = [echo for pose in poses for echo in oracles.point_echoes(RING, pose, place, corner=corner)][:SLOTS]
    guess = 0.9 + rng.uniform(-0.04, 0.04), math.pi / 2 + rng.uniform(-0.06, 0.06)
    fits = fits_of(echoes, guess)
    assert fits.point_score[0] == pytest.approx(len(echoes), rel=1e-3)
    assert fits.point_score[0] > fits.plane_score[0]
    if spread > 0.5:
        assert fits.point_score[0] > SETTINGS.plane_to_point_ratio * fits.plane_score[0]


def float64(x):
    return jnp.asarray(x, jnp.float64)


def path_between(tx, rx):
    """ONE echo path; only its midpoint and half baseline matter."""
    zero, pair = jnp.zeros(()), jnp.zeros(2)
    midpoint, half_baseline = jnp.asarray((tx + rx) / 2), jnp.asarray((rx - tx) / 2)
    return kernels.EchoPaths(midpoint, half_baseline, zero, zero, zero, jnp.zeros((2, 2)), pair)


@pytest.mark.slow
@pytest.mark.parametrize(
    "model", [robust_fit.plane_from_both_sides, robust_fit.corner_from_midpoint, robust_fit.edge_from_midpoint]
)
def test_gradients_of_the_ranges_agree_with_finite_differences(model: Callable[..., Any], rng):
    def ranges(x, echo):
        return model(x, echo)[0]

    forward, backward = jax.jit(jax.jacfwd(ranges)), jax.jit(jax.grad(ranges))
    with jax.enable_x64(True):
        for _ in range(5):
            at = float64(rng.uniform(0.8, 1.2, 2))
            echo = path_between(*rng.uniform(-0.2, 0.2, (2, 2)))
            steps = 1e-5 * np.eye(2)
            numerical = [float(ranges(at + step, echo) - ranges(at - step, echo)) / 2e-5 for step in steps]
            for slope in (model(at, echo)[1], forward(at, echo), backward(at, echo)):
                np.testing.assert_allclose(slope, numerical, atol=1e-8)


@pytest.mark.parametrize(
    "model", [robust_fit.plane_from_both_sides, robust_fit.corner_from_midpoint, robust_fit.edge_from_midpoint]
)
def test_gradients_are_finite_if_a_sensor_is_on_the_reflector(model: Callable[..., Any]):
    here = jnp.asarray([0.5, 0.0])
    echo = path_between(here, here)
    came = jax.jit(model)(here, echo)
    for values in (*came, jax.jit(jax.grad(lambda x: model(x, echo)[0]))(here)):
        assert np.isfinite(values).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "model", [robust_fit.plane_from_both_sides, robust_fit.corner_from_midpoint, robust_fit.edge_from_midpoint]
)
def test_ranges_are_those_of_the_oracle(model: Callable[..., Any], rng):
    """Each model fitted to its own echoes leaves no residuals."""
    poses, place = poses_past_a_point(rng, 0.7)
    if model is robust_fit.plane_from_both_sides:
        truth, echoes = np.array([0.9, math.pi / 2]), echoes_of_plane(poses, (0.9, math.pi / 2))
    else:
        truth, corner = place, model is robust_fit.corner_from_midpoint
        echoes = [echo for pose in poses for echo in oracles.point_echoes(RING, pose, place, corner=corner)][:SLOTS]
    start = jnp.asarray(truth + np.array([0.03, -0.03]), jnp.float32)
    came, score = fit(model, start, *paths_and_ranges(packed(echoes)), tolerance=SETTINGS.window_tolerance)
    np.testing.assert_allclose(came, truth, atol=1e-4)
    np.testing.assert_allclose(score[: len(echoes)], 1, atol=1e-4)
    assert not np.asarray(score)[len(echoes) :].any()


# shapes and missing things


def test_unused_candidates_explain_nothing_and_do_not_affect_others(rng):
    plane, guess = random_plane(rng)
    echoes = echoes_of_plane(random_poses(rng), plane)
    alone, among = fits_of(echoes, guess), fits_of(echoes, (np.nan, np.nan), guess, (np.nan, 0.3), (0.5, np.nan))
    for name in ("rho", "theta", "explained", "footpoint", "plane_score", "point_score"):
        np.testing.assert_array_equal(getattr(among, name)[1], getattr(alone, name)[0])
        assert np.isfinite(getattr(among, name)[1]).all()
    for nobody in (0, 2, 3):
        assert not among.explained[nobody].any()
        assert among.plane_score[nobody] == 0
        assert among.point_score[nobody] == 0


def test_invalid_echoes_are_not_explained():
    """Missing, beyond the maximum range, and impossible ones, without any other echoes."""
    rows = np.array([np.nan, np.inf, 2.5, RING.max_range, 1e6])
    poses, paths = np.zeros((1, SLOTS, 3), np.float32), np.zeros((1, SLOTS), np.int32)
    reported = np.resize(rows, (1, SLOTS)).astype(np.float32)
    echoes = kernels.PackedEchoes(jnp.asarray(paths), jnp.asarray(reported), jnp.asarray(poses))
    rho, theta = (jnp.full((1, LINES), value, jnp.float32) for value in (1.0, 0.1))
    fits = kernels.fit_candidates(ARCS, echoes, rho, theta, tolerance=SETTINGS.window_tolerance)
    assert not fits.explained.any()
    assert (fits.plane_score == 0).all()
    assert (fits.point_score == 0).all()
    assert np.isfinite(fits.rho).all()
    assert np.isfinite(fits.theta).all()


def test_echoes_without_poses_are_those_of_the_identity_pose():
    echoes = packed(echoes_of_plane(np.zeros((1, 3)), (0.9, 1.0)))
    plain = kernels.PackedEchoes(echoes.path, echoes.range)
    jax.tree.map(np.testing.assert_array_equal, paths_and_ranges(echoes), paths_and_ranges(plain))


def test_lines_are_in_canonical_form(rng):
    """Candidates have rho of either sign; fitted lines have rho >= 0 and theta in [-pi, pi)."""
    poses = np.column_stack([np.full(6, -1.0), np.linspace(-0.5, 0.5, 6), np.zeros(6)])
    fits = fits_of(echoes_of_plane(poses, (-0.02, 0.0)), (0.01, 0.02), (-0.05, 0.02), (0.01, 0.02 + 2 * math.pi))
    for k in range(3):
        assert fits.rho[k] == pytest.approx(0.02, abs=1e-4)
        assert abs(oracles.wrap(fits.theta[k] - math.pi)) < 1e-4
        assert -np.float32(np.pi) <= fits.theta[k] < np.float32(np.pi)


def test_compiles_once_for_a_shape(rng):
    compiled: Any = kernels.fit_candidates
    sizes = []
    for _ in range(4):
        plane, guess = random_plane(rng)
        fits_of(echoes_of_plane(random_poses(rng, count=int(rng.integers(4, 9))), plane), guess)
        sizes.append(compiled._cache_size())
    assert sizes[0] >= 1
    assert len(set(sizes)) == 1

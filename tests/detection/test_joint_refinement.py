"""Joint refinement of reflectors: the reflectors compete for echoes, covariances contain the assignment."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsonar import HoughSettings, Ring, kernels
from jaxsonar.detection.arc_tables import arc_tables
from jaxsonar.kernels.measurement_model import EDGE, PLANE, plane_echo, point_echo
from jaxsonar.kernels.ml_detection.joint_refinement import refine_jointly
from jaxsonar.kernels.ml_detection.likelihood import refine
from jaxsonar.kernels.ml_detection.state import ScanData, SceneEstimate

RING, PRIOR, SIGMA, SLOTS = Ring.circular(), kernels.DetectionSettings(), 0.003, 64
SCENE = SceneEstimate.initial(jnp.float32(SIGMA), PRIOR)
CLUTTER = jnp.full(SLOTS, np.log(PRIOR.clutter_density), jnp.float32)
WALL, EDGE_POINT = np.array([1.0, 0.2], np.float32), np.array([0.3, -1.1], np.float32)


def scan_of(path, ranges):
    """ONE scan, padded to one shape."""
    arcs = arc_tables(RING, HoughSettings()).arcs
    paths = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), arcs.paths)
    index, measured = np.zeros(SLOTS, np.int32), np.zeros(SLOTS, np.float32)
    index[: len(path)], measured[: len(path)] = path, ranges
    own = jax.tree.map(lambda leaf: leaf[..., index], paths)
    return ScanData(
        paths=paths,
        echo_paths=own,
        path_index=jnp.asarray(index),
        ranges=jnp.asarray(measured),
        valid=jnp.asarray(measured > 0),
        max_range=arcs.max_range,
        full_wall_paths=arcs.full_wall_paths,
        measured=None,
    )


def echoes_of(model, x, rng):
    """Paths whose nominal cones receive a reflector, and its noisy ranges."""
    paths = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), arc_tables(RING, HoughSettings()).arcs.paths)
    echo = jax.vmap(model, in_axes=(None, -1), out_axes=-1)(jnp.asarray(x), paths)
    off = [np.square(np.asarray(a - b)).sum(axis=0) for a, b in zip(_directions(echo), _axes(paths), strict=True)]
    seen = np.flatnonzero((off[0] < np.asarray(paths.cone[0])) & (off[1] < np.asarray(paths.cone[1])))
    return seen, np.asarray(echo.range)[seen] + SIGMA * rng.standard_normal(len(seen))


def _directions(echo):
    return echo.departure, echo.arrival


def _axes(paths):
    return paths.axes[0], paths.axes[1]


@jax.jit
def jointly(scan, kind, start, selected):
    return refine_jointly(scan, kind, start, selected, CLUTTER, SCENE, PRIOR)


def wall_and_rows(scan, others=()):
    """Joint fit of the wall, beside other reflectors; two rows in all."""
    rows = [(PLANE, WALL), *others, (PLANE, WALL)][:2]
    kind = jnp.asarray([kind for kind, _ in rows])
    start = jnp.stack([jnp.asarray(x) for _, x in rows])
    return jointly(scan, kind, start, jnp.arange(2) < 1 + len(others))


def test_a_reflector_without_competitors_is_fitted_as_alone(rng):
    scan = scan_of(*echoes_of(plane_echo, WALL, rng))
    alone = refine(scan, plane_echo, jnp.asarray(WALL), SCENE, CLUTTER, PRIOR)
    joint = wall_and_rows(scan)
    np.testing.assert_allclose(joint.parameters[0], alone.parameters, atol=2e-5)
    # The covariance differs by echoes that may be clutter only.
    ratio = np.diag(joint.covariance[0]) / np.diag(alone.covariance)
    assert (ratio > 0.99).all()
    assert (ratio < 1.5).all()


def test_a_distant_competitor_changes_nothing_and_an_identical_one_shares_the_echoes(rng):
    path, ranges = echoes_of(plane_echo, WALL, rng)
    far, reach = echoes_of(lambda x, p: point_echo(jnp.float32(1), x, p), EDGE_POINT, rng)
    alone = wall_and_rows(scan_of(path, ranges))
    both = scan_of(np.append(path, far), np.append(ranges, reach))
    beside = wall_and_rows(both, [(EDGE, EDGE_POINT)])
    np.testing.assert_allclose(beside.parameters[0], alone.parameters[0], atol=2e-5)
    np.testing.assert_allclose(beside.covariance[0], alone.covariance[0], rtol=1e-2)
    error = np.asarray(beside.parameters[1] - EDGE_POINT, float)
    assert error @ np.linalg.solve(np.asarray(beside.covariance[1], float), error) < 16
    twice = wall_and_rows(both, [(PLANE, WALL)])
    sd = np.sqrt(np.diag(alone.covariance[0]))
    assert (np.abs(twice.parameters[0] - alone.parameters[0]) < 0.5 * sd).all()
    # Two equal reflectors explain half of each echo, and nothing tells whose it is.
    assert (np.diag(twice.covariance[0]) > 1.9 * np.diag(alone.covariance[0])).all()


def test_covariances_of_ambiguous_echoes_are_larger(rng):
    path, ranges = echoes_of(plane_echo, WALL, rng)
    off = ranges.copy()
    off[::2] += 3.5 * SIGMA * np.where(np.arange(len(off[::2])) % 2, 1, -1)
    clear, ambiguous = wall_and_rows(scan_of(path, ranges)), wall_and_rows(scan_of(path, off))
    assert np.linalg.det(ambiguous.covariance[0]) > 1.5 * np.linalg.det(clear.covariance[0])
    for fit in (clear, ambiguous):
        assert np.linalg.eigvalsh(np.asarray(fit.covariance[0], np.float64)).min() > 0


@pytest.mark.parametrize("kind", [PLANE, EDGE])
def test_a_scan_without_echoes_gives_finite_parameters(kind):
    fit = jointly(scan_of([], []), jnp.full(2, kind), jnp.asarray([WALL, EDGE_POINT]), jnp.zeros(2, bool))
    np.testing.assert_array_equal(fit.parameters, [WALL, EDGE_POINT])
    assert np.isfinite(fit.covariance).all()

"""Arcs, votes and low pass equal the NumPy oracle, plain, jitted and vmapped; symmetries; gradients."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from support import oracles

from jaxsonar import HoughSettings, Ring, kernels

angles = st.floats(-3.125, 3.125, width=32)
SMALL = HoughSettings(theta_cells=12, rho_cells=9, rho_cell=0.25)


def run_directly(kernel, *arrays):
    return kernel(*jax.tree.map(jnp.asarray, arrays))


def run_jitted(kernel, *arrays):
    return jax.jit(kernel)(*arrays)


def run_in_a_batch(kernel, *arrays):
    """Run a batch of two equal inputs, check that the results are equal, and return one of them."""
    both = jax.vmap(kernel)(*jax.tree.map(lambda a: jnp.stack([jnp.asarray(a)] * 2), arrays))
    jax.tree.map(lambda a: np.testing.assert_array_equal(a[0], a[1]), both)
    return jax.tree.map(lambda a: a[0], both)


ways = pytest.mark.parametrize("run", [run_directly, run_jitted, run_in_a_batch])


def one(value):
    return jnp.full(1, value, jnp.float32)


def one_path(ring, k):
    return jax.tree.map(lambda leaf: leaf[k], ring.echo_paths)


# geometry


@given(st.floats(-50, 50, width=32))
def test_a_wrapped_angle_is_the_same_direction_in_the_half_open_interval(angle):
    wrapped = float(kernels.wrap_angle(jnp.float32(angle)))
    assert -np.float32(np.pi) <= wrapped < np.float32(np.pi)
    assert np.cos(wrapped - angle) == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("angle", [np.pi, -np.pi, 3 * np.pi, -1e-9 + np.pi])
def test_pi_wraps_to_minus_pi(angle):
    assert float(kernels.wrap_angle(jnp.float32(angle))) == pytest.approx(-np.pi, abs=1e-6)


@given(st.floats(-3, 3, width=32, allow_subnormal=False), angles)
def test_the_canonical_form_of_a_line_is_the_same_line(rho, theta):
    folded_rho, folded_theta = (float(a) for a in kernels.fold_line(jnp.float32(rho), jnp.float32(theta)))
    assert folded_rho >= 0
    assert -np.float32(np.pi) <= folded_theta < np.float32(np.pi)
    foot = rho * np.array([np.cos(theta), np.sin(theta)])
    folded_foot = folded_rho * np.array([np.cos(folded_theta), np.sin(folded_theta)])
    np.testing.assert_allclose(folded_foot, foot, atol=1e-5)


@given(st.floats(0.5, 3), angles, st.floats(0, 0.3), st.floats(0, 0.3))
def test_the_range_of_a_plane_is_half_the_distance_from_the_image_source(rho, theta, offset, baseline):
    n = np.array([np.cos(theta), np.sin(theta)])
    tx, rx = np.array([offset, 0.1]), np.array([offset - baseline, -0.05])
    assume(min(rho - tx @ n, rho - rx @ n) > 0.05)
    image = tx + 2 * (rho - tx @ n) * n
    arguments = (np.array([rho, theta]), (tx + rx) / 2, (rx - tx) / 2)
    came = kernels.plane_range(*(jnp.asarray(a, jnp.float32) for a in arguments))
    assert float(came) == pytest.approx(np.linalg.norm(image - rx) / 2, abs=1e-5)


def test_the_range_of_a_corner_is_that_of_two_reflections_and_of_an_edge_the_mean_of_its_legs():
    tx, rx, corner = np.array([0.28, 0.1]), np.array([0.1, 0.27]), np.array([1.3, 0.8])
    twice_mirrored = 2 * corner - tx  # mirrored in both walls of a right angle, whatever its orientation
    as_arrays = [jnp.asarray(a, jnp.float32) for a in (corner, (tx + rx) / 2, (rx - tx) / 2)]
    assert float(kernels.corner_range(*as_arrays[:2])) == pytest.approx(
        np.linalg.norm(twice_mirrored - rx) / 2, abs=1e-6
    )
    way = np.linalg.norm(corner - tx) + np.linalg.norm(corner - rx)
    assert float(kernels.edge_range(*as_arrays)) == pytest.approx(way / 2, abs=1e-6)


# arcs


@pytest.mark.slow
@ways
@pytest.mark.parametrize("path", [0, 5, 30, 50, 80, 100, 130, 167])
def test_tangent_lines_of_an_arc_are_those_of_the_oracle(faw_ring, run, path):
    settings, reach = HoughSettings(), 1.234
    arc = kernels.arc(one_path(faw_ring, path), pitch=settings.point_pitch, points=60)
    tangents = partial(kernels.tangent_rho, max_range=jnp.float32(2))
    rho, counts = run(tangents, arc, jnp.float32(reach))
    folded = kernels.fold_line(rho, arc.theta)
    came = np.stack(folded, axis=-1)[np.asarray(counts)]
    tx, rx = faw_ring.paths[path]
    wanted = oracles.lines_of_echo(faw_ring, tx, rx, reach, settings.point_pitch)
    np.testing.assert_allclose(came, wanted, atol=2e-6)


@given(st.floats(0.3, 2), st.integers(0, 167), st.floats(0, 1))
def test_points_of_an_arc_have_the_path_length_and_the_tangent(reach, path, share):
    ring = Ring.circular()
    geometry = one_path(ring, path)
    theta = geometry.start + share * geometry.width
    point = np.asarray(kernels.arc_point(geometry, jnp.float32(reach), theta), np.float64)
    tx, rx = ring.position[ring.paths[path]]
    assert (np.linalg.norm(point - tx) + np.linalg.norm(point - rx)) / 2 == pytest.approx(reach, abs=1e-5)
    n = np.array([np.cos(theta), np.sin(theta)])
    assert point @ n == pytest.approx(oracles.ellipse_tangent_rho(tx, rx, reach, float(theta)), abs=1e-5)


@given(st.floats(0.4, 1.9), angles)
def test_a_wall_is_a_tangent_line_of_each_of_its_echoes(rho, theta):
    ring = Ring.circular()
    for path, reach in oracles.echoes_of_wall(ring, rho, theta):
        tx, rx = ring.position[ring.paths[path]]
        assert oracles.ellipse_tangent_rho(tx, rx, reach, theta) == pytest.approx(rho, abs=1e-9)


@pytest.mark.parametrize("reach", [np.nan, 2.0, 2.5, 0.0, -1.0, 0.05])
def test_an_invalid_range_has_no_votes(faw_ring, reach):
    """Invalid: missing, at or beyond the maximum range, impossible, or shorter than the baseline."""
    path = len(faw_ring.paths) - 1  # third neighbor: tx and rx are 0.21 m apart
    arc = kernels.arc(one_path(faw_ring, path), pitch=0.02, points=60)
    rho, counts = kernels.tangent_rho(arc, jnp.float32(reach), max_range=jnp.float32(2))
    assert not np.asarray(counts).any()
    assert np.isfinite(rho).all()


def test_points_are_equidistant_with_the_nominal_pitch(faw_ring):
    for path, wanted in [(0, 60), (24, 45), (72, 30), (120, 15)]:
        arc = kernels.arc(one_path(faw_ring, path), pitch=np.radians(1), points=60)
        theta = np.asarray(arc.theta)[np.asarray(arc.exists)]
        assert len(theta) == wanted
        np.testing.assert_allclose(np.diff(theta), np.radians(1), atol=1e-5)


def test_cones_that_do_not_overlap_have_no_arc():
    ring = Ring.circular(neighbors=5)
    arc = kernels.arc(one_path(ring, len(ring.paths) - 1), pitch=0.02, points=60)
    assert not np.asarray(arc.exists).any()


# accumulator


@pytest.mark.slow
@ways
def test_votes_are_in_the_cells_of_their_lines(rng, run):
    rho = rng.uniform(-2.5, 2.5, 400).astype(np.float32)
    theta = rng.uniform(-9, 9, 400).astype(np.float32)
    counts = rng.random(400) < 0.8

    def voting(rho, theta, counts):
        return kernels.accumulate(kernels.cell_of(rho, kernels.theta_row(theta, SMALL), counts, SMALL), SMALL)

    came = run(voting, rho, theta, counts)
    lines = zip(
        *(np.asarray(a, np.float64) for a in kernels.fold_line(jnp.asarray(rho), jnp.asarray(theta))),
        counts,
        strict=True,
    )
    cells = [oracles.cell(r, t, SMALL) for r, t, voting in lines if voting]
    np.testing.assert_array_equal(came, oracles.accumulate(cells, SMALL))


@pytest.mark.slow
@ways
@pytest.mark.parametrize("taps", [(1,), (1, 2, 1), (1, 4, 6, 4, 1), (0, 1, 0)])
def test_the_low_pass_is_that_of_the_oracle(rng, run, taps):
    settings = HoughSettings(theta_cells=12, rho_cells=9, smoothing=taps)
    votes = rng.integers(0, 50, (12, 9)).astype(np.int32)
    came = run(partial(kernels.lowpass, settings=settings), votes)
    np.testing.assert_allclose(came, oracles.lowpass(votes, settings), rtol=1e-5, atol=1e-5)


def test_the_low_pass_preserves_the_sum_of_inner_votes(rng):
    votes = rng.integers(0, 50, (12, 9)).astype(np.int32)
    votes[:, -1] = 0
    assert float(kernels.lowpass(jnp.asarray(votes), SMALL).sum()) == pytest.approx(votes.sum(), rel=1e-6)


def test_soft_votes_equal_hard_votes_at_cell_centers(rng):
    row, column = rng.integers(0, 12, 60), rng.integers(0, 9, 60)
    theta = ((row + 0.5) * SMALL.theta_cell - np.pi).astype(np.float32)
    rho = ((column + 0.5) * SMALL.rho_cell).astype(np.float32)
    soft = kernels.soft_accumulate(jnp.asarray(rho), jnp.asarray(theta), jnp.ones(60), SMALL)
    hard = oracles.accumulate(zip(row, column, strict=True), SMALL)
    np.testing.assert_allclose(soft, hard, atol=1e-4)


@pytest.mark.slow
@given(st.floats(-2, 2, width=32, allow_subnormal=False), angles, st.floats(0.125, 5, width=32))
def test_soft_votes_sum_to_the_weight_and_are_continuous_across_the_seams(rho, theta, weight):
    soft = kernels.soft_accumulate(one(rho), one(theta), one(weight), SMALL)
    assert float(soft.sum()) == pytest.approx(weight, rel=1e-4)
    folded = kernels.soft_accumulate(one(-rho), one(theta + np.pi), one(weight), SMALL)
    np.testing.assert_allclose(folded, soft, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "ring",
    [
        Ring.circular(),
        Ring.circular(beam=np.radians(15), neighbors=0),
        Ring.circular(count=32, beam=np.radians(120), neighbors=5),
        Ring(np.zeros((2, 2)), [0.3, 0.9], beam=[1.0, 0.7], neighbors=1, max_range=2.0),
    ],
)
def test_the_votes_of_a_full_wall_are_those_of_the_oracle(ring):
    settings = HoughSettings()
    came = kernels.full_wall_votes(ring.echo_paths, settings)
    assert float(came) == pytest.approx(oracles.full_wall_votes(ring, settings), rel=0.01)


def test_the_threshold_does_not_depend_on_the_point_pitch(faw_ring):
    coarse, fine = (HoughSettings(point_pitch=np.radians(p)) for p in (1.0, 0.25))
    votes = [float(kernels.full_wall_votes(faw_ring.echo_paths, s)) for s in (coarse, fine)]
    assert votes[1] == pytest.approx(4 * votes[0])


@pytest.mark.slow
@ways
def test_segment_endpoints_are_the_outermost_footpoints(rng, run):
    sensors = rng.normal(size=(7, 2)).astype(np.float32)
    involved = np.array([True, False, True, True, False, False, True])
    rho, theta = jnp.float32(1.2), jnp.float32(2.2)
    ends = np.asarray(run(kernels.segment_endpoints, rho, theta, sensors, involved))
    n, t = np.array([np.cos(2.2), np.sin(2.2)]), np.array([-np.sin(2.2), np.cos(2.2)])
    np.testing.assert_allclose(ends @ n, 1.2, atol=1e-6)
    np.testing.assert_allclose(ends @ t, [(sensors[involved] @ t).min(), (sensors[involved] @ t).max()], atol=1e-6)
    assert np.isnan(run(kernels.segment_endpoints, rho, theta, sensors, np.zeros(7, bool))).all()


# gradients


def soft_votes(ring, ranges):
    """A score of soft votes, as in the focus measure, with missing and impossible echoes among them."""
    sensors = ring.sensors
    paths = kernels.echo_paths(sensors)

    def one_echo(path, reach):
        arc = kernels.arc(path, pitch=0.05, points=21)
        reach = kernels.corrected_range(reach, range_offset=path.range_offset, range_scale=sensors.range_scale)
        rho, counts = kernels.tangent_rho(arc, reach, max_range=sensors.max_range)
        return rho, arc.theta, counts.astype(rho.dtype)

    rho, theta, weight = jax.vmap(one_echo)(paths, ranges)
    return (kernels.soft_accumulate(rho, theta, weight, HoughSettings()) ** 2).sum()


@pytest.mark.slow
def test_gradients_are_finite_everywhere(faw_ring, rng):
    ranges = rng.uniform(0.3, 1.9, 168)
    awkward = [np.nan, 0.0, 2.0, 2.5, np.inf, -1.0, *np.linalg.norm(faw_ring.echo_paths.half_baseline, axis=1)[:140:20]]
    ranges[: len(awkward)] = awkward
    ranges[160:] = np.linalg.norm(faw_ring.echo_paths.half_baseline, axis=1)[160:]  # degenerate ellipses
    ranges = jnp.asarray(ranges, jnp.float32)
    leaves = jax.tree.map(jnp.asarray, faw_ring)
    by_ring, by_range = jax.grad(soft_votes, argnums=(0, 1))(leaves, ranges)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(by_ring))
    assert np.isfinite(by_range).all()
    assert np.abs(by_range).max() > 0
    assert np.abs(by_ring.position).max() > 0


@pytest.mark.slow
def test_forward_reverse_and_numerical_gradients_agree(faw_ring):
    arc = kernels.arc(one_path(faw_ring, 60), pitch=0.05, points=9)
    with jax.enable_x64(True):
        arc = jax.tree.map(lambda a: a.astype(jnp.float64) if a.dtype == jnp.float32 else a, arc)

        def total(reach):
            return kernels.tangent_rho(arc, reach, max_range=jnp.float64(2))[0].sum()

        at = jnp.float64(1.1)
        numerical = (total(at + 1e-5) - total(at - 1e-5)) / 2e-5
        assert float(jax.grad(total)(at)) == pytest.approx(float(numerical), rel=1e-7)
        assert float(jax.jacfwd(total)(at)) == pytest.approx(float(numerical), rel=1e-7)


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("theta_cells", 99),
        ("theta_cells", 2),
        ("theta_cells", 10_002),
        ("rho_cells", 10_001),
        ("threshold", 1e308),
        ("rho_cell", 1e300),
        ("smoothing", (1e308, 1e308, 1e308)),
        ("rho_cells", 1),
        ("rho_cell", 0.0),
        ("point_pitch", -0.1),
        ("smoothing", (1, 1)),
        ("smoothing", (0, 0, 0)),
        ("smoothing", (1, -1, 1)),
        ("threshold", -0.1),
        ("min_echoes", 0),
    ],
)
def test_settings_out_of_range_are_rejected(setting, value):
    with pytest.raises(ValueError, match=f"{setting} = .*allowed"):
        HoughSettings(**{setting: value})

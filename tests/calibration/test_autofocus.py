"""Focus measure of the accumulator: derivatives, invariances, limits; and the autofocus that maximizes it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.firings import fire_in_turn
from support.hard_cones import simulate
from support.slam_scene import ROOM

from jaxsonar import HoughSettings, Ring, SonarError, kernels, random_pose, random_room
from jaxsonar.calibration.autofocus import autofocus_ring
from jaxsonar.kernels.focus_measure import blur, ring_focus_measure

RING = Ring.circular(count=8, neighbors=1)
COARSE = HoughSettings(theta_cells=60, rho_cells=64, rho_cell=0.08, point_pitch=float(np.radians(3.0)))
POINTS = kernels.points_of_widest_arc(np.asarray(RING.beam), COARSE)
PARAMETERS = ("position", "heading", "range_offset", "range_scale")


def scene(true, rng, count=20, **errors):
    """Scans of a random room with true poses."""
    room = random_room(rng)
    poses = np.stack([random_pose(rng, room) for _ in range(count)])
    return simulate(true, room, poses, seed=5, **errors).as_log(true, poses)


def packed(log, *, dtype: type = np.float32, frame=(0.0, 0.0, 0.0)):
    """All echoes of a log in one row, with their poses in another frame."""
    path = RING.path_index[log.tx, log.rx]
    x, y, turn = log.pose[log.echo_scan].T
    cos, sin = np.cos(frame[2]), np.sin(frame[2])
    pose = np.stack([frame[0] + cos * x - sin * y, frame[1] + sin * x + cos * y, turn + frame[2]], axis=-1)
    return kernels.PackedEchoes(
        jnp.asarray(path[None].astype(np.int32)), jnp.asarray(log.range[None], dtype), jnp.asarray(pose[None], dtype)
    )


def as_floats(sensors, dtype):
    return jax.tree.map(lambda x: jnp.asarray(x, dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, sensors)


def score(sensors, echoes, settings=COARSE, width=1.0):
    return ring_focus_measure(sensors, echoes, jnp.asarray(width, echoes.range.dtype), settings=settings, points=POINTS)


@pytest.mark.slow
@pytest.mark.parametrize("world", [True, False])
def test_forward_reverse_and_numerical_derivatives_agree(rng, world):
    log = scene(RING, rng, 3, sigma=0.002)
    with jax.enable_x64(True):
        echoes = packed(log, dtype=np.float64)
        if not world:
            echoes = echoes._replace(pose=None)
        sensors = as_floats(RING.sensors, np.float64)
        given = {name: getattr(sensors, name) for name in PARAMETERS}
        # Away from the edges of cells, from the symmetry of the ring, and from the edges of detection cones.
        given = {name: value + 1e-3 * rng.standard_normal(value.shape) for name, value in given.items()}

        @jax.jit
        def of(values):
            return score(dataclasses.replace(sensors, **values), echoes)

        reverse = jax.grad(of)(given)
        derivative = jax.jit(lambda direction: jax.jvp(of, (given,), (direction,))[1])
        for name in PARAMETERS:
            direction = {other: jnp.zeros_like(value) for other, value in given.items()}
            direction[name] = jnp.asarray(rng.standard_normal(given[name].shape))
            ahead, behind = (of(jax.tree.map(lambda x, dx, h=h: x + h * dx, given, direction)) for h in (1e-7, -1e-7))
            forward = derivative(direction)
            np.testing.assert_allclose(forward, jnp.sum(reverse[name] * direction[name]), rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(forward, (ahead - behind) / 2e-7, rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_single_precision_agrees_with_double_precision(rng):
    log = scene(RING, rng, 3, sigma=0.002)
    single = score(as_floats(RING.sensors, np.float32), packed(log))
    assert single.dtype == jnp.float32
    with jax.enable_x64(True):
        double = score(as_floats(RING.sensors, np.float64), packed(log, dtype=np.float64))
    np.testing.assert_allclose(single, double, rtol=1e-3)


@pytest.mark.slow
def test_the_focus_is_invariant_under_rigid_motions_of_the_world(rng):
    """Exactly for rotations by whole cells, approximately for other rotations and for translations."""
    log = scene(RING, rng, 10, sigma=0.001)
    sensors = as_floats(RING.sensors, np.float32)
    fine = dataclasses.replace(COARSE, theta_cells=180, rho_cells=256, rho_cell=0.04)
    here = score(sensors, packed(log), fine)
    np.testing.assert_allclose(score(sensors, packed(log, frame=(0.0, 0.0, np.pi / 2)), fine), here, rtol=1e-4)
    np.testing.assert_allclose(score(sensors, packed(log, frame=(0.0, 0.0, 1.0)), fine), here, rtol=0.1)
    np.testing.assert_allclose(score(sensors, packed(log, frame=(0.3, -0.2, 0.0)), fine), here, rtol=0.1)


@pytest.mark.slow
def test_order_and_padding_are_irrelevant(rng):
    log = scene(RING, rng, 3)
    echoes = packed(log)
    sensors = as_floats(RING.sensors, np.float32)
    assert echoes.pose is not None
    order = rng.permutation(echoes.path.shape[1])
    mixed = jax.tree.map(lambda x: x[:, order], echoes)
    more = kernels.PackedEchoes(
        jnp.pad(echoes.path, ((0, 0), (0, 9))),
        jnp.pad(echoes.range, ((0, 0), (0, 9)), constant_values=np.nan),
        jnp.pad(echoes.pose, ((0, 0), (0, 9), (0, 0))),
    )
    for other in (mixed, more):
        np.testing.assert_allclose(score(sensors, other), score(sensors, echoes), rtol=1e-5)


@pytest.mark.slow
def test_missing_echoes_and_lines_beyond_the_accumulator_have_finite_derivatives():
    sensors = as_floats(RING.sensors, np.float32)
    path, pose = jnp.zeros((1, 2), jnp.int32), jnp.zeros((1, 2, 3))
    tiny = dataclasses.replace(COARSE, rho_cells=6)
    slope = jax.jit(jax.value_and_grad(lambda s, e: score(s, e, tiny), allow_int=True))
    for reported in ([1.9, np.nan], [np.nan, np.nan]):
        value, slopes = slope(sensors, kernels.PackedEchoes(path, jnp.asarray([reported], jnp.float32), pose))
        assert np.isfinite(value)
        assert all(np.isfinite(getattr(slopes, name)).all() for name in PARAMETERS)
    assert float(value) == 0


@pytest.mark.slow
def test_the_low_pass_preserves_votes_across_both_seams(rng):
    votes = np.zeros((COARSE.theta_cells, COARSE.rho_cells), np.float32)
    votes[[0, 17, -1], [0, 2, 1]] = rng.uniform(1, 2, 3)
    smooth = blur(jnp.asarray(votes), jnp.asarray(1.0), COARSE)
    np.testing.assert_allclose(smooth.sum(), votes.sum(), rtol=1e-5)
    turned = blur(jnp.asarray(np.roll(votes, 7, axis=0)), jnp.asarray(1.0), COARSE)
    np.testing.assert_allclose(turned, np.roll(smooth, 7, axis=0), atol=1e-6)


# The autofocus


@pytest.fixture(scope="module")
def recovered():
    """One offset is wrong by 20 mm and the speed by 2 %: the given ring, the true one, the log, and the result."""
    rng = np.random.default_rng(7)
    given = dataclasses.replace(Ring.circular(), range_offset=0.004)
    offset = np.array(given.range_offset)
    offset[5] += 0.02
    true = dataclasses.replace(given, range_offset=offset, speed_of_sound=given.speed_of_sound * 1.02)
    log = scene(true, rng, sigma=0.001)
    return given, true, log, autofocus_ring(given, log, poses=True, speed=True)


def relative_error(ring, true):
    error = ring.range_offset - true.range_offset
    return error - error.mean()


@pytest.mark.slow
def test_a_wrong_offset_and_a_wrong_speed_are_found(recovered):
    given, true, _, found = recovered
    assert np.sqrt(np.mean(relative_error(found, true) ** 2)) < 0.003
    assert np.sqrt(np.mean(relative_error(found, true) ** 2)) < np.sqrt(np.mean(relative_error(given, true) ** 2)) / 2
    assert abs(found.speed_of_sound / true.speed_of_sound - 1) < 0.004


@pytest.mark.slow
def test_the_mean_offset_and_all_other_parameters_stay(recovered):
    given, _, _, found = recovered
    np.testing.assert_allclose(found.range_offset.mean(), given.range_offset.mean(), atol=1e-12)
    for name in ("position", "heading", "beam"):
        np.testing.assert_array_equal(getattr(found, name), getattr(given, name))
    assert (found.max_range, found.neighbors, found.name) == (given.max_range, given.neighbors, given.name)


@pytest.mark.slow
def test_the_true_ring_is_returned_unchanged_and_clutter_changes_it_within_limits(recovered):
    """Without an error, the gain does not exceed that of chance."""
    _, true, log, _ = recovered
    assert autofocus_ring(true, log, poses=True, speed=True) is true
    rng = np.random.default_rng(3)
    noise = dataclasses.replace(log, range=rng.uniform(0.3, 1.9, len(log.range)))
    assert (
        np.abs(autofocus_ring(true, noise, poses=True, speed=True).range_offset - true.range_offset).max()
        <= 0.05 + 1e-9
    )


@pytest.mark.slow
def test_the_result_is_deterministic(recovered):
    given, _, log, found = recovered
    again = autofocus_ring(given, log, poses=True, speed=True)
    np.testing.assert_array_equal(again.range_offset, found.range_offset)
    assert again.speed_of_sound == found.speed_of_sound


@pytest.mark.slow
def test_without_poses_the_speed_is_held_and_a_wrong_offset_is_found(rng):
    given = Ring.circular()
    offset = np.zeros(given.count)
    offset[3] = 0.02
    true = dataclasses.replace(given, range_offset=offset)
    log = scene(true, rng, 32, sigma=0.001)  # with half as many, the gain is smaller than the number of parameters
    unknown = dataclasses.replace(log, pose=np.full_like(log.pose, np.nan))
    found = autofocus_ring(given, unknown, poses=False, speed=False)
    assert found.speed_of_sound == given.speed_of_sound
    assert abs(relative_error(found, true)[3]) < 0.01
    np.testing.assert_allclose(found.range_offset.mean(), 0, atol=1e-12)


@pytest.mark.slow
def test_echoes_of_a_moving_robot_belong_to_the_poses_of_their_times():
    offset = 0.02 * np.sin(3 * np.arange(RING.count))
    true = dataclasses.replace(RING, range_offset=offset - offset.mean())

    def drive(time):
        return np.column_stack([1.0 + 0.5 * time, 1.7 + 0.3 * np.sin(time), 0.8 * time])

    log, _ = fire_in_turn(true, ROOM, drive, 25, sigma=0.002, seed=4)
    at_once = dataclasses.replace(log, t=np.zeros(len(log.t)), odometry=None)
    found, ignored = (autofocus_ring(RING, one, poses=True, speed=False) for one in (log, at_once))
    error, wrong = (np.sqrt(np.mean(relative_error(ring, true) ** 2)) for ring in (found, ignored))
    assert error < 0.003
    assert error < wrong / 2


def test_invalid_input_is_refused(rng):
    log = scene(RING, rng, 2)
    unknown = dataclasses.replace(log, pose=np.full_like(log.pose, np.nan))
    with pytest.raises(SonarError, match="speed=True with poses=False"):
        autofocus_ring(RING, log, poses=False, speed=True)
    with pytest.raises(SonarError, match="scans = 0"):
        autofocus_ring(RING, log, poses=True, speed=False, scans=0)
    with pytest.raises(SonarError, match="2 scans came, none with an echo of this ring's paths and a pose"):
        autofocus_ring(RING, unknown, poses=True, speed=False)

"""Evidence kernels against slow loops over cells and rays."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsonar import Ring, kernels
from jaxsonar.geometry.se2 import transform_points, wrap_angle
from jaxsonar.kernels.occupancy_evidence import _arctan, direction_index, visible_distance

RESOLUTION, SIZE = 0.05, 96
RING = Ring.circular(count=8, radius=0.2, beam=np.radians(30), neighbors=1, max_range=1.6)
POSE = np.array([2.43, 2.31, 0.37])
WALL = np.array([[[3.2, 1.0], [3.3, 4.0]]])


def seen(first_echo, walls=None, *, certain=0.6, margin=0.07):
    position = transform_points(POSE, np.asarray(RING.position))
    heading = np.asarray(RING.heading) + POSE[2]
    sensor_pose = np.concatenate([position, heading[:, None]], axis=1).astype(np.float32)
    walls = np.zeros((1, 2, 2)) if walls is None else walls
    found = kernels.seen_through(
        sensor_pose[None], np.zeros((1, 8, 2), np.int32), np.full(8, np.radians(15), np.float32),
        np.asarray(first_echo, np.float32)[None], walls[None].astype(np.float32),
        certain=np.full(8, certain * np.radians(15), np.float32),
        margin=np.float32(margin), resolution=RESOLUTION, size=SIZE, cone=SIZE, rays=40,
    )  # fmt: skip
    return np.asarray(found.directions[0]), np.asarray(found.looks[0]), sensor_pose.astype(float)


def by_loops(first_echo, sensor_pose, *, certain=0.6, margin=0.07):
    """Looks of each cell, and for each cell the directions that were certainly and possibly seen through."""
    half = np.radians(15)
    center = (np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), axis=-1) + 0.5) * RESOLUTION
    looks, sure, possible = (np.zeros((SIZE, SIZE, *shape)) for shape in ((), (12,), (12,)))
    for (x, y, heading), limit in zip(sensor_pose, first_echo, strict=True):
        dx, dy = center[..., 0] - x, center[..., 1] - y
        distance, bearing = np.hypot(dx, dy), np.arctan2(dy, dx)
        off = np.abs(wrap_angle(bearing - heading))
        clear = distance < limit - margin
        looks += np.where(clear & (off < half), 1 - (np.sin(off) / np.sin(half)) ** 2, 0)
        ahead = distance * np.cos(off)
        for slack, found in ((-1e-3, sure), (1e-3, possible)):
            beyond = distance * np.sin(off - certain * half)
            reach = (beyond <= RESOLUTION / 2**0.5 + slack) & (ahead > -RESOLUTION / 2**0.5 - slack)
            inside = (distance < limit - margin + slack) & reach
            for shift in (-1e-3, 1e-3) if slack > 0 else (0.0,):
                k = np.floor((bearing + shift) * 12 / np.pi + 0.5).astype(int) % 12
                np.put_along_axis(
                    found, k[..., None], np.maximum(np.take_along_axis(found, k[..., None], -1), inside[..., None]), -1
                )
    return looks, sure > 0, possible > 0


def test_cells_in_front_of_the_first_echoes_are_seen_through():
    first_echo = np.array([1.6, 0.9, 0.0, 1.2, 1.6, 0.5, 1.6, 0.0])
    bits, looks, sensor_pose = seen(first_echo)
    expected, sure, possible = by_loops(first_echo, sensor_pose)
    np.testing.assert_allclose(looks, expected, atol=2e-3)
    found = ((bits[..., None] >> np.arange(12)) & 1).astype(bool)
    center = (np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), axis=-1) + 0.5) * RESOLUTION
    at_sensor = np.linalg.norm(center[:, :, None] - sensor_pose[:, :2], axis=-1).min(axis=-1) < 0.06
    decided = (possible == sure) & ~at_sensor[..., None]  # a cell at a sensor has no direction
    assert decided.mean() > 0.98
    assert (found[decided] == sure[decided]).all()
    assert found[decided].sum() > 500


def test_a_wall_hides_what_is_behind_it():
    first_echo = np.full(8, 1.6)
    _, looks, _ = seen(first_echo, WALL)
    _, everywhere, _ = seen(first_echo)
    x = (np.arange(SIZE) + 0.5) * RESOLUTION
    behind = np.broadcast_to(x > 3.4, (SIZE, SIZE))
    assert everywhere[behind].sum() > 10
    assert not looks[behind].any()
    np.testing.assert_array_equal(looks[:, x < 3.0], everywhere[:, x < 3.0])


def test_a_sensor_that_did_not_measure_sees_nothing():
    bits, looks, _ = seen(np.zeros(8))
    assert not bits.any()
    assert not looks.any()


def test_visible_distance_is_that_of_the_nearest_wall_on_the_ray():
    walls = jnp.array([[[1.0, -1.0], [1.0, 1.0]], [[2.0, -1.0], [2.0, 1.0]], [[0.5, 0.5], [0.5, 0.5]]])
    angle = jnp.array([0.0, jnp.pi, jnp.pi / 4, 1.3])
    found = visible_distance(jnp.zeros(2), angle, walls, jnp.array(5.0))
    np.testing.assert_allclose(found, [1.0, 5.0, 2**0.5, 5.0], rtol=1e-6)


def test_directions_are_those_of_lines():
    angle = jnp.linspace(-3.1, 3.1, 101)
    np.testing.assert_array_equal(direction_index(angle), direction_index(angle + jnp.pi))
    assert set(np.asarray(direction_index(angle)).tolist()) == set(range(12))
    x = jnp.linspace(-1, 1, 1001)
    np.testing.assert_allclose(_arctan(x), np.arctan(x), atol=5e-4)


@pytest.mark.parametrize("tx_rx", [(2, 2), (2, 3)])
def test_cells_of_an_arc_lie_on_its_ellipse_and_weigh_as_much_as_its_length(tx_rx):
    ring = Ring.circular(count=12, radius=0.2, beam=1.0, neighbors=1)
    path = int(np.flatnonzero((ring.paths == tx_rx).all(axis=1))[0])
    distance = 1.1
    arcs = kernels.arcs_of_echoes(
        ring.echo_paths, np.array([path]), POSE[None].astype(np.float32), np.array([distance], np.float32),
        np.zeros((1, 2, 2), np.float32), resolution=RESOLUTION, points=48,
    )  # fmt: skip
    weight = np.asarray(arcs.weight[0])
    cell = np.stack([arcs.column[0], arcs.row[0]], axis=-1)[weight > 0]
    center = (cell + 0.5) * RESOLUTION
    ends = transform_points(POSE, np.asarray(ring.position))[list(tx_rx)]
    measured = np.linalg.norm(center[:, None] - ends, axis=-1).mean(axis=1)
    assert np.abs(measured - distance).max() < RESOLUTION * 1.5
    # Total weight: the length of the arc, by its gain, in cells along the axis that it is nearer to.
    width = float(np.asarray(ring.echo_paths.width)[path])
    assert weight.sum() == pytest.approx(0.75 * distance * width / RESOLUTION * 0.85, rel=0.2)
    middle = ends.mean(axis=0)
    toward = center.mean(axis=0) - middle
    across = np.array([-toward[1], toward[0]])
    wall = np.stack([middle + toward / 2 - across, middle + toward / 2 + across])
    for end, part in ((wall, 0.0), (wall + 2 * toward, 1.0)):
        behind = kernels.arcs_of_echoes(
            ring.echo_paths, np.array([path]), POSE[None].astype(np.float32), np.array([distance], np.float32),
            end[None].astype(np.float32), resolution=RESOLUTION, points=48,
        )  # fmt: skip
        assert np.asarray(behind.weight).sum() == pytest.approx(part * weight.sum())


def em(cell, weight, exposure, rounds):
    """Expectation maximization by loops over echoes."""
    reflectivity = np.full(len(exposure), 0.05)
    for _ in range(rounds):
        back = np.zeros(len(exposure))
        for cells, weights in zip(cell, weight, strict=True):
            explained = weights @ reflectivity[cells] + 0.02
            np.add.at(back, cells, weights / explained)
        reflectivity *= back / exposure
    return exposure * reflectivity


def test_expectation_maximization_gives_echoes_to_one_reflector(rng):
    cell, weight = rng.integers(0, 50, (40, 7)), rng.random((40, 7))
    exposure = 1 + rng.random(50)
    columns = cell.astype(np.int32), weight.astype(np.float32), np.ones(40, np.float32), exposure.astype(np.float32)
    found = kernels.expected_echoes(*columns, clutter=np.float32(0.02), cells=50, rounds=10)
    np.testing.assert_allclose(found, em(cell, weight, exposure, 10), rtol=1e-3)
    # Three arcs that cross in one cell: it explains them all, and the others nothing.
    arcs = np.array([[0, 1, 2, 3], [4, 5, 2, 6], [7, 8, 2, 9]], np.int32)
    flat = np.ones((3, 4), np.float32), np.ones(3, np.float32), np.ones(10, np.float32)
    crossing = np.asarray(kernels.expected_echoes(arcs, *flat, clutter=np.float32(0.02), cells=10, rounds=20))
    assert crossing[2] > 2.8
    assert np.delete(crossing, 2).max() < 0.05
    assert crossing.sum() < 3.0 + 1e-3  # no more echoes are explained than there are


def test_log_odds_of_one_cell_follow_bayes():
    """A cell alone on its arc: each echo adds log((detected + false) / false), each look takes the same away."""
    numbers = {"prior": 0.1, "detected": 0.9, "false": 0.05, "missed": 0.3}
    parameters = {name: np.float32(value) for name, value in numbers.items()}
    arc = np.zeros((2, 1), np.int32), np.ones((2, 1), np.float32), np.ones(2, np.float32)
    found = kernels.log_odds(*arc, np.array([4.0, 2.0], np.float32), cells=2, **parameters)
    np.testing.assert_allclose(found, [2 * np.log(0.95 / 0.05) - 1.2, -0.6], rtol=1e-5)
    # On a long arc, an echo says less about each cell.
    wide = (
        np.zeros((1, 8), np.int32) + np.arange(8, dtype=np.int32),
        np.ones((1, 8), np.float32),
        np.ones(1, np.float32),
    )
    shared = kernels.log_odds(*wide, np.zeros(8, np.float32), cells=8, **parameters)
    assert np.ptp(shared) < 1e-6
    assert 0 < float(shared[0]) < np.log(0.95 / 0.05) / 2

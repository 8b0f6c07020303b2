"""Echoes of one path and one reflector equal exact path tracing; detection cones; derivatives."""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.echo_paths import paths_between
from support.tracing import trace_between

from jaxsonar import Room
from jaxsonar.kernels import detection_cones, measurement_model
from jaxsonar.simulation.traced_echoes import EchoKind

PATHS = 64
FAR = 60.0  # m; walls as long as this have no ends that any path sees
seeds = st.integers(0, 10_000)
MODELS = {
    "plane": (jax.jit(jax.vmap(measurement_model.plane_echo, in_axes=(None, 0))), 1),
    "corner": (jax.jit(jax.vmap(measurement_model.corner_echo, in_axes=(None, 0))), 1),
    "edge": (jax.jit(jax.vmap(measurement_model.edge_echo, in_axes=(None, 0))), 1),
    "second order": (jax.jit(jax.vmap(measurement_model.second_order_echo, in_axes=(None, None, 0))), 2),
}
models = pytest.mark.parametrize("model", MODELS)
visibilities = jax.jit(jax.vmap(detection_cones.visibility))
off_axis_ratios = jax.jit(jax.vmap(detection_cones.off_axis_ratio))


def unit(angle):
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def direction(offset):
    return offset / np.linalg.norm(offset, axis=-1, keepdims=True)


def angle(vector):
    return np.arctan2(vector[..., 1], vector[..., 0])


def predicted(model, parameters, tx, rx, **options):
    """Echoes that a model predicts for its one or two reflectors, as NumPy arrays."""
    kernel, _ = MODELS[model]
    given = [jnp.asarray(x, jnp.float32) for x in parameters]
    return jax.tree.map(np.asarray, kernel(*given, paths_between(tx, rx, **options)))


def random_sensors(rng, spread=0.4):
    """Transmitters and receivers around the origin; every fourth path is a direct one."""
    tx, rx = rng.uniform(-spread, spread, (2, PATHS, 2))
    rx[::4] = tx[::4]
    return tx, rx


def random_reflectors(rng, model):
    """One reflector, or two walls that meet at less than 60 deg, open towards the robot."""
    theta = rng.uniform(-3.1, 3.1)
    lines = np.column_stack([rng.uniform(0.7, 2, 2), [theta, theta + math.pi + rng.uniform(-1, 1)]])
    return list(lines) if model == "second order" else [lines[0] if model == "plane" else rng.uniform(0.7, 1.5, 2)]


def traced_echoes(room, tx, rx, kind, reflector=None):
    """The oracle's existence, range, departure, arrival and first point of every path."""
    found = trace_between(room, tx, rx)
    found = found[found.kind == kind]
    if reflector is not None:
        found = found[found.reflector == reflector]
    exists = np.zeros(len(tx), bool)
    exists[found.pair] = True
    assert exists.sum() == len(found), "one path each"
    columns = np.full((len(tx), 7), np.nan)
    columns[found.pair] = np.column_stack(
        [found.length / 2, direction(found.first - tx[found.pair]), direction(found.last - rx[found.pair]), found.first]
    )
    return exists, columns[:, 0], columns[:, 1:3], columns[:, 3:5], columns[:, 5:]


def assert_agree(echo, oracle):
    exists, reach, departure, arrival, _ = oracle
    np.testing.assert_allclose(echo.range[exists], reach[exists], atol=1e-5)
    for came, wanted in ((echo.departure, departure), (echo.arrival, arrival)):
        # An angle as a distance: how far off the point is that it leads to.
        np.testing.assert_allclose(reach[exists, None] * (came - wanted)[exists], 0, atol=1e-5)


def wall_along(rho, theta):
    foot, t = rho * unit(theta), unit(theta + math.pi / 2)
    return np.stack([foot - FAR * t, foot + FAR * t])


# against exact tracing


@settings(max_examples=30)
@given(seeds)
def test_the_echo_of_a_plane_comes_from_its_image_source(seed):
    rng = np.random.default_rng(seed)
    rho, theta = rng.uniform(0.1, 2), rng.uniform(-3.1, 3.1)
    tx, rx = random_sensors(rng)
    oracle = traced_echoes(Room(wall_along(rho, theta)[None]), tx, rx, EchoKind.PLANE)
    echo = predicted("plane", [(rho, theta)], tx, rx)
    before = (tx @ unit(theta) < rho) & (rx @ unit(theta) < rho)
    np.testing.assert_array_equal(echo.exists, before)
    assert (oracle[0] | ~before).all()
    oracle = (before, *oracle[1:])
    assert_agree(echo, oracle)
    np.testing.assert_allclose(echo.footpoint[before], (oracle[-1] @ unit(theta + math.pi / 2))[before], atol=1e-4)


@settings(max_examples=30)
@given(seeds)
def test_the_echo_of_a_right_angled_corner_is_reflected_at_both_of_its_walls(seed):
    rng = np.random.default_rng(seed)
    bearing = rng.uniform(-3.1, 3.1)
    place = rng.uniform(0.9, 2) * unit(bearing)
    inward = bearing + math.pi + rng.uniform(-0.3, 0.3)
    walls = [np.stack([place, place + FAR * unit(inward + side)]) for side in (math.pi / 4, -math.pi / 4)]
    tx, rx = random_sensors(rng, spread=0.3)
    oracle = traced_echoes(Room(np.stack(walls)), tx, rx, EchoKind.CORNER)
    assert oracle[0].sum() > PATHS / 2
    echo = predicted("corner", [place], tx, rx)
    assert echo.exists.all()
    assert_agree(echo, oracle)


@settings(max_examples=30)
@given(seeds, st.booleans())
def test_the_echo_of_an_edge_or_a_pole_has_two_straight_legs(seed, pole):
    rng = np.random.default_rng(seed)
    bearing = rng.uniform(-3.1, 3.1)
    place = rng.uniform(0.7, 2) * unit(bearing)
    wall = np.stack([place, place + unit(bearing + rng.uniform(-0.5, 0.5))])
    room = Room(np.zeros((0, 2, 2)), poles=place[None]) if pole else Room(wall[None])
    tx, rx = random_sensors(rng)
    found = trace_between(room, tx, rx)
    kind = EchoKind.POLE if pole else EchoKind.EDGE
    vertex = 0 if pole else int(np.argmin(np.linalg.norm(room.junctions.vertices - place, axis=-1)))
    assert (found.kind == kind).any()
    oracle = traced_echoes(room, tx, rx, kind, reflector=vertex)
    assert oracle[0].sum() > PATHS / 2
    echo = predicted("edge", [place], tx, rx)
    assert echo.exists.all()
    assert_agree(echo, oracle)


@pytest.mark.parametrize("opening_deg", [0, 25, 50, 70, 85, 100, 120, 150])
def test_a_second_order_echo_comes_from_the_image_of_the_image(opening_deg, rng):
    """Two walls that meet at this angle, open towards the robot, in both orders; 0 is a corridor.

    At more than 90 deg there is no such path between sensors that are this close to each other.
    """
    opening, middle = math.radians(opening_deg), rng.uniform(-3.1, 3.1)
    theta = middle + np.array([1, -1]) * (math.pi - opening) / 2
    if opening_deg:
        vertex = 1.3 / math.sin(opening / 2) * unit(middle)
        rho = unit(theta) @ vertex
        along = middle + math.pi + np.array([-1, 1]) * opening / 2
        walls = np.stack([vertex + np.zeros((2, 2)), vertex + FAR * unit(along)], axis=1)
    else:
        rho = np.array([1.2, 0.9])
        walls = np.stack([wall_along(*line) for line in zip(rho, theta, strict=True)])
    walls[:, 1] += 1e-9  # no round numbers
    lines = np.column_stack([rho, theta])
    for line, wall in zip(lines, walls, strict=True):
        np.testing.assert_allclose(wall @ unit(line[1]), line[0], atol=1e-6)
    tx, rx = random_sensors(rng, spread=0.3)
    found = trace_between(Room(walls), tx, rx)
    found = found[found.kind == EchoKind.SECOND_ORDER]
    for first, second in ((0, 1), (1, 0)):
        echo = predicted("second order", [lines[first], lines[second]], tx, rx)
        # A direct path hears the same sound both ways around, and the oracle counts it once.
        ways = found[(found.reflector == first) | (tx == rx).all(axis=1)[found.pair]]
        exists = np.zeros(PATHS, bool)
        exists[ways.pair] = True
        np.testing.assert_array_equal(echo.exists, exists, err_msg=f"order {first}, {second}")
        assert exists.any() if opening_deg < 90 else opening_deg == 100 or not exists.any()
        np.testing.assert_allclose(echo.range[ways.pair], ways.length / 2, atol=1e-5)
        turned = ways.reflector != first
        ends = np.where(turned[:, None], ways.last, ways.first), np.where(turned[:, None], ways.first, ways.last)
        for came, sensor, end in ((echo.departure, tx, ends[0]), (echo.arrival, rx, ends[1])):
            np.testing.assert_allclose(came[ways.pair], direction(end - sensor[ways.pair]), atol=1e-5)


def test_a_plane_behind_a_sensor_has_no_echo():
    """Not on a path with a sensor behind it, nor on a path that it separates."""
    tx, rx = np.array([[0.0, 0], [0.5, 0], [0.5, 0], [0, 0.1]]), np.array([[0.5, 0], [0, 0], [0.6, 0], [0.2, 0]])
    assert predicted("plane", [(0.3, 0.0)], tx, rx).exists.tolist() == [False, False, False, True]


# symmetries


@models
@settings(max_examples=15)
@given(seeds)
def test_exchanging_transmitter_and_receiver_exchanges_the_directions(model, seed):
    rng = np.random.default_rng(seed)
    tx, rx = random_sensors(rng)
    given = random_reflectors(rng, model)
    there, back = predicted(model, given, tx, rx), predicted(model, given[::-1], rx, tx)
    np.testing.assert_allclose(there.range, back.range, atol=1e-5)
    np.testing.assert_array_equal(there.exists, back.exists)
    np.testing.assert_allclose(there.departure[there.exists], back.arrival[there.exists], atol=2e-5)
    np.testing.assert_allclose(there.arrival[there.exists], back.departure[there.exists], atol=2e-5)
    np.testing.assert_allclose(there.footpoint[there.exists], back.footpoint[there.exists], atol=1e-4)


@models
@settings(max_examples=15)
@given(seeds)
def test_mirroring_the_scene_mirrors_directions_and_keeps_ranges(model, seed):
    rng = np.random.default_rng(seed)
    tx, rx = random_sensors(rng)
    given = random_reflectors(rng, model)
    mirror = np.array([1, -1])
    here = predicted(model, given, tx, rx)
    there = predicted(model, [x * mirror for x in given], tx * mirror, rx * mirror)  # (rho, -theta), (x, -y)
    np.testing.assert_allclose(here.range, there.range, atol=1e-5)
    np.testing.assert_array_equal(here.exists, there.exists)
    np.testing.assert_allclose(here.departure[here.exists], (mirror * there.departure)[here.exists], atol=2e-5)
    np.testing.assert_allclose(here.footpoint[here.exists], -there.footpoint[here.exists], atol=1e-4)


# gradients


@pytest.mark.slow
@models
def test_derivatives_equal_finite_differences_and_forward_and_reverse_gradients(model, rng):
    kernel, count = MODELS[model]

    def sightings(x, path):
        return kernel(*(x[2 * k : 2 * k + 2] for k in range(count)), path)

    def ranges(x, path):
        return sightings(x, path).range

    tx, rx = random_sensors(rng, spread=0.3)
    given = np.concatenate(random_reflectors(rng, model))
    with jax.enable_x64(True):
        path = paths_between(tx, rx, dtype=jnp.float64)
        x = jnp.asarray(given, jnp.float64)
        steps = 1e-6 * np.eye(2 * count)
        numerical = np.stack([(ranges(x + step, path) - ranges(x - step, path)) / 2e-6 for step in steps], axis=-1)
        came = sightings(x, path)
        good = np.asarray(came.exists)
        assert good.sum() > PATHS / 8
        if count == 1:
            np.testing.assert_allclose(came.d_range_d_landmark[good], numerical[good], atol=1e-7)
        else:
            assert not came.d_range_d_landmark.any(), "as documented"
        for jacobian in (jax.jacfwd, jax.jacrev):
            np.testing.assert_allclose(jax.jit(jacobian(ranges))(x, path)[good], numerical[good], atol=1e-7)


@pytest.mark.slow
@models
@pytest.mark.parametrize("place", [(0.0, 0.0), (0.3, 0.0), (0.0, 0.3)])
def test_gradients_are_finite_if_a_sensor_is_on_the_reflector(model, place):
    kernel, count = MODELS[model]
    here = np.array([place, place, (0.1, 0.2)])
    path = paths_between(here, np.array([place, (0.1, 0.2), place]), heading=np.zeros((3, 2)))

    def all_of_it(x):
        echo = kernel(*(x[2 * k : 2 * k + 2] for k in range(count)), path)
        return echo.range.sum() + echo.footpoint.sum() + visibilities(echo, path).sum()

    at = np.resize(place if model in ("corner", "edge") else (0.3, 0.0), 2 * count)
    value, slope = jax.value_and_grad(all_of_it)(jnp.asarray(at, jnp.float32))
    assert np.isfinite(value)
    assert np.isfinite(slope).all()


# cones


def echoes_and_paths(departure, arrival, heading, half_beam):
    """A echo in these directions, and paths whose sensors look along the headings."""
    departure, arrival = np.broadcast_arrays(departure, arrival)
    path = paths_between(
        np.zeros((len(departure), 2)),
        np.zeros((len(departure), 2)),
        heading=np.broadcast_to(heading, (len(departure), 2)),
        half_beam=half_beam,
    )
    departure, arrival = (jnp.asarray(unit(angle), jnp.float32) for angle in (departure, arrival))
    somewhere = MODELS["corner"][0](jnp.ones(2, jnp.float32), path)
    return dataclasses.replace(somewhere, departure=departure, arrival=arrival), path


@settings(max_examples=30)
@given(seeds)
def test_the_off_axis_ratio_is_one_at_the_border_of_a_cone_and_increases(seed):
    rng = np.random.default_rng(seed)
    heading, (departure, arrival) = rng.uniform(-7, 7, 2), rng.uniform(-7, 7, (2, PATHS))
    half_beam = rng.uniform(0.1, 1.5)
    came = np.asarray(off_axis_ratios(*echoes_and_paths(departure, arrival, heading, half_beam)))
    angles = [np.arccos(np.clip(unit(d) @ unit(h), -1, 1)) for d, h in zip((departure, arrival), heading, strict=True)]
    worst = np.max(angles, axis=0)
    clear = np.abs(worst - half_beam) > 1e-3
    np.testing.assert_array_equal((came < 1)[clear], (worst < half_beam)[clear])
    order = np.argsort(worst)
    assert (np.diff(came[order]) > -1e-5).all()
    assert (came >= -1e-5).all()


@pytest.mark.parametrize("heading", [0.0, 1.2, math.pi, -math.pi, 2 * math.pi - 0.1])
@pytest.mark.parametrize("half_beam", [0.13, 0.52, 1.05])
@pytest.mark.parametrize("side", [1, -1])
def test_the_visibility_decreases_from_one_to_zero_across_the_border_of_a_cone(heading, half_beam, side):
    off = np.linspace(0, 2, 201)
    for others in (0.0, 0.5, 1.5):  # the other sensor's direction, in half cones: well inside, inside, outside
        moving, still = heading + side * off * half_beam, heading + 0 * off + others * half_beam
        for departure, arrival in ((moving, still), (still, moving)):
            share = np.asarray(visibilities(*echoes_and_paths(departure, arrival, heading, half_beam)))
            assert ((share >= 0) & (share <= 1)).all()
            assert (np.diff(share) <= 1e-6).all()
            if others > 1:
                assert not share.any()
                continue
            assert (share[off < 0.9] == 1).all()
            assert (share[off > 1.1] == 0).all()
            assert share[100] == pytest.approx(0.5, abs=0.05)  # at the border itself


@models
def test_an_echo_that_cannot_exist_is_not_visible(model, rng):
    tx, rx = random_sensors(rng)
    echo = predicted(model, random_reflectors(rng, model), tx, rx)
    path = paths_between(tx, rx, heading=np.stack([angle(echo.departure), angle(echo.arrival)], axis=-1), half_beam=1.0)
    possible = jax.tree.map(jnp.asarray, echo)
    np.testing.assert_array_equal(np.asarray(visibilities(possible, path)), np.where(echo.exists, 1, 0))
    never = dataclasses.replace(possible, exists=jnp.zeros(PATHS, bool))
    assert not np.asarray(visibilities(never, path)).any()


@pytest.mark.parametrize("half_beam", [1e-6, 1e-4, 1e-3, 1e-2, 1.5, math.pi / 2])
def test_the_visibility_is_defined_for_the_narrowest_and_the_widest_cones(half_beam):
    share = visibilities(
        *echoes_and_paths(np.array([0.0, 0.5 * half_beam, 1.5 * half_beam, 3.1]), np.zeros(4), 0.0, half_beam)
    )
    assert np.isfinite(share).all()
    assert share[0] == 1
    assert share[3] == 0


@pytest.mark.slow
def test_a_single_path_gives_the_result_of_a_batch(rng):
    """Kernels are written for one path and vmapped."""
    kernels: list[Callable[..., Any]] = [
        measurement_model.plane_echo,
        measurement_model.corner_echo,
        measurement_model.edge_echo,
    ]
    tx, rx = random_sensors(rng)
    paths = paths_between(tx, rx)
    x = jnp.asarray([1.1, 0.4], jnp.float32)
    for kernel in kernels:
        batch = jax.vmap(partial(kernel, x))(paths)
        alone = kernel(x, jax.tree.map(lambda leaf: leaf[5], paths))
        jax.tree.map(lambda one, all_: np.testing.assert_allclose(one, all_[5], atol=1e-6), alone, batch)

"""Predicted ranges of landmarks: image sources, rigid motions, both sides of a wall, derivatives."""

import dataclasses
import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.echo_paths import paths_between

from jaxsonar import kernels
from jaxsonar.kernels import CORNER, EDGE, PLANE, SECOND_ORDER, Landmarks, Reflection
from jaxsonar.kernels import measurement_model as reflectors

MANY = 200
SLACK = 0.3  # m; margin within which a wall is visible beyond its ends
KINDS = {"plane": PLANE, "corner": CORNER, "edge": EDGE, "second order": SECOND_ORDER}
kinds = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS.keys())

expected_ranges = jax.jit(jax.vmap(kernels.expected_range))
predict_reflections = jax.jit(jax.vmap(kernels.predict_reflection))
to_robot_frame = jax.jit(jax.vmap(kernels.landmark_in_robot_frame))


@pytest.fixture(autouse=True)
def double_precision():
    """Double precision, unless a test requests single precision."""
    with jax.enable_x64(True):
        yield


def unit(angle):
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def image(point, line):
    """Mirror image of a point at the line (rho, theta)."""
    n = unit(line[1])
    return point - 2 * (point @ n - line[0]) * n


def oracle(kind, first, second, tx, rx):
    """Half the path length, by mirroring the transmitter at each plane."""
    if kind == PLANE:
        return np.linalg.norm(image(tx, first) - rx) / 2
    if kind == SECOND_ORDER:
        return np.linalg.norm(image(image(tx, first), second) - rx) / 2
    if kind == CORNER:  # two walls through the corner, at a right angle, rotated anyhow
        for theta in (0.3, 0.3 + np.pi / 2):
            tx = image(tx, (first @ unit(theta), theta))
        return np.linalg.norm(tx - rx) / 2
    return (np.linalg.norm(first - tx) + np.linalg.norm(rx - first)) / 2


def random_reflectors(rng, kind, count=MANY):
    """Reflectors around a robot, and pairs of sensors; every fourth path is a direct one."""
    first = rng.uniform(-2, 2, (count, 2))
    second = rng.uniform(-2, 2, (count, 2))
    if kind in (PLANE, SECOND_ORDER):
        lines = [np.column_stack([rng.uniform(0.7, 2, count), rng.uniform(-np.pi, np.pi, count)]) for _ in "ab"]
        first, second = lines
    tx, rx = rng.uniform(-0.4, 0.4, (2, count, 2))
    rx[::4] = tx[::4]
    return first, second, tx, rx


def random_landmarks(rng, kind, count=MANY):
    """Landmarks anywhere in the world."""
    line = np.column_stack([rng.uniform(-0.1, 0.1, count), rng.uniform(-np.pi, np.pi, count)])
    return Landmarks(
        kind=np.full(count, PLANE if kind in (PLANE, SECOND_ORDER) else kind, np.int32),
        parameters=line if kind in (PLANE, SECOND_ORDER) else rng.uniform(-0.1, 0.1, (count, 2)),
        anchor=rng.uniform(-2, 2, (count, 2)),
        extent=np.column_stack([rng.uniform(-1.5, -0.2, count), rng.uniform(0.2, 1.5, count)]),
    )


def rotated(theta, points):
    cos, sin = math.cos(theta), math.sin(theta)
    return points @ np.array([[cos, sin], [-sin, cos]])


def transformed_landmarks(scene, motion):
    """The same landmarks after a rotation of the world by motion[2] and then a translation."""
    of_plane = scene.kind[:, None] == PLANE
    return dataclasses.replace(
        scene,
        parameters=np.where(
            of_plane, scene.parameters + np.array([0, motion[2]]), rotated(motion[2], scene.parameters)
        ),
        anchor=rotated(motion[2], scene.anchor) + motion[:2],
    )


def transformed_poses(poses, motion):
    return np.column_stack([rotated(motion[2], poses[:, :2]) + motion[:2], poses[:, 2] + motion[2]])


def arrays(tree):
    return jax.tree.map(jnp.asarray, tree)


def predicted(kind, poses, first, second, tx, rx, heading):
    """Range, visibility and arrival of every path, by ``predict_reflection``."""
    rows = np.arange(len(poses), dtype=np.int32)
    reflection = Reflection(np.full(len(poses), kind, np.int32), rows, rows)
    path = paths_between(tx, rx, heading=heading, half_beam=1.2)
    return [np.asarray(x) for x in predict_reflections(*arrays((poses, reflection, first, second)), path)][:3]


# Ranges


@kinds
def test_ranges_are_those_of_image_sources(rng, kind):
    first, second, tx, rx = random_reflectors(rng, kind)
    found = expected_ranges(*arrays((np.full(MANY, kind), first, second, tx, rx)))
    expected = [oracle(kind, *row) for row in zip(first, second, tx, rx, strict=True)]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


@kinds
def test_ranges_are_those_of_the_predicted_echoes(rng, kind):
    first, second, tx, rx = random_reflectors(rng, kind)
    kernel = [reflectors.plane_echo, reflectors.corner_echo, reflectors.edge_echo, reflectors.second_order_echo][kind]
    path = paths_between(tx, rx)
    lines = arrays((first, second))[: 2 if kind == SECOND_ORDER else 1]
    sighting = jax.vmap(kernel)(*lines, path)
    found = expected_ranges(*arrays((np.full(MANY, kind), first, second, tx, rx)))
    exists = np.asarray(sighting.exists)
    assert exists.mean() > 0.2
    np.testing.assert_allclose(np.asarray(found)[exists], np.asarray(sighting.range)[exists], rtol=0, atol=1e-12)


def test_the_second_order_range_of_perpendicular_walls_is_that_of_their_corner(rng):
    first, _, tx, rx = random_reflectors(rng, PLANE)
    second = np.column_stack([rng.uniform(0.7, 2, MANY), first[:, 1] + rng.choice([-1, 1], MANY) * np.pi / 2])
    both = np.stack([unit(first[:, 1]), unit(second[:, 1])], axis=1)
    place = np.linalg.solve(both, np.stack([first[:, 0], second[:, 0]], axis=-1)[..., None])[..., 0]
    wall_to_wall = expected_ranges(*arrays((np.full(MANY, SECOND_ORDER), first, second, tx, rx)))
    other_way = expected_ranges(*arrays((np.full(MANY, SECOND_ORDER), second, first, tx, rx)))
    corner = expected_ranges(*arrays((np.full(MANY, CORNER), place, place, tx, rx)))
    np.testing.assert_allclose(wall_to_wall, corner, atol=1e-12)
    np.testing.assert_allclose(other_way, corner, atol=1e-12)


@kinds
def test_exchanging_transmitter_and_receiver_keeps_the_range(rng, kind):
    first, second, tx, rx = random_reflectors(rng, kind)
    there = expected_ranges(*arrays((np.full(MANY, kind), first, second, tx, rx)))
    back = (second, first, rx, tx) if kind == SECOND_ORDER else (first, second, rx, tx)
    np.testing.assert_allclose(there, expected_ranges(*arrays((np.full(MANY, kind), *back))), atol=1e-12)


def test_an_unused_row_has_no_range_and_is_not_visible(rng):
    first, second, tx, rx = random_reflectors(rng, PLANE)
    np.testing.assert_array_equal(expected_ranges(*arrays((np.full(MANY, -1), first, second, tx, rx))), 0)
    scene = random_landmarks(rng, PLANE)
    reach, share, arrival = predicted(-1, np.zeros((MANY, 3)), scene, scene, tx, rx, np.zeros((MANY, 2)))
    np.testing.assert_array_equal(share, 0)
    assert np.isfinite(reach).all()
    assert np.isfinite(arrival).all()


@pytest.mark.parametrize("scale", [0.5, 0.97, 1.0, 1.04])
def test_reported_and_corrected_ranges_are_inverse(scale):
    for reach, offset in ((0.3, 0.05), (1.0, 0.0), (2.0, -0.03)):
        told = {"range_offset": jnp.asarray(offset), "range_scale": jnp.asarray(scale)}
        reported = kernels.reported_range(jnp.asarray(reach), **told)
        np.testing.assert_allclose(kernels.corrected_range(reported, **told), reach, rtol=1e-14)


# The world


@kinds
def test_a_rigid_motion_of_the_world_changes_nothing(rng, kind):
    first, second = random_landmarks(rng, kind), random_landmarks(rng, kind)
    poses = rng.uniform([-1, -1, -np.pi], [1, 1, np.pi], (MANY, 3))
    _, _, tx, rx = random_reflectors(rng, kind)
    heading = rng.uniform(-np.pi, np.pi, (MANY, 1)) + rng.uniform(-0.3, 0.3, (MANY, 2))
    before = predicted(kind, poses, first, second, tx, rx, heading)
    assert 0.02 < np.mean(before[1] > 0) < 0.98
    for motion in ([3.0, -5.0, 2.1], [-40.0, 20.0, -3.0]):
        worlds = (transformed_landmarks(first, motion), transformed_landmarks(second, motion))
        after = predicted(kind, transformed_poses(poses, motion), *worlds, tx, rx, heading)
        for was, now in zip(before, after, strict=True):
            np.testing.assert_allclose(now, was, atol=1e-11)


@pytest.mark.parametrize("kind", [PLANE, SECOND_ORDER], ids=["plane", "second order"])
def test_the_direction_of_the_normal_of_a_wall_does_not_matter(rng, kind):
    """Reversing the normal together with the ends gives the same wall. Half of the robots are behind it."""
    first, second = random_landmarks(rng, kind), random_landmarks(rng, kind)
    poses = rng.uniform([-1, -1, -np.pi], [1, 1, np.pi], (MANY, 3))
    _, _, tx, rx = random_reflectors(rng, kind)
    heading = rng.uniform(-np.pi, np.pi, (MANY, 1)) + rng.uniform(-0.3, 0.3, (MANY, 2))

    def about(scene):
        parameters = np.column_stack([-scene.parameters[:, 0], scene.parameters[:, 1] + np.pi])
        return dataclasses.replace(scene, parameters=parameters, extent=-scene.extent[:, ::-1])

    behind = np.asarray(to_robot_frame(*arrays((poses, first))))[:, 0] < 0
    assert 0.2 < behind.mean() < 0.8
    before = predicted(kind, poses, first, second, tx, rx, heading)
    assert (before[1][behind] > 0).any()
    for worlds in ((about(first), second), (about(first), about(second))):
        for was, now in zip(before, predicted(kind, poses, *worlds, tx, rx, heading), strict=True):
            np.testing.assert_allclose(now, was, atol=1e-11)


@kinds
def test_landmarks_in_the_robot_frame_are_the_transformed_points_of_the_world(rng, kind):
    """Points of a wall, transformed to the robot frame, are on the transformed line; so are points."""
    scene = random_landmarks(rng, kind)
    poses = rng.uniform([-5, -5, -np.pi], [5, 5, np.pi], (MANY, 3))
    seen = np.asarray(to_robot_frame(*arrays((poses, scene))))
    for pose, anchor, parameters, found in zip(poses, scene.anchor, scene.parameters, seen, strict=True):
        if kind in (PLANE, SECOND_ORDER):
            n = unit(parameters[1])
            for along in (-1.0, 0.5):
                world = anchor + parameters[0] * n + along * np.array([-n[1], n[0]])
                robot = rotated(-pose[2], world - pose[:2])
                np.testing.assert_allclose(unit(found[1]) @ robot, found[0], atol=1e-12)
        else:
            np.testing.assert_allclose(rotated(-pose[2], anchor + parameters - pose[:2]), found, atol=1e-12)


def test_a_wall_is_visible_up_to_a_margin_beyond_its_ends():
    """A sensor faces a wall of 1 m and moves along it, on either side."""
    along = np.linspace(-2, 2, 81) + 1e-3
    for turn in (0.0, np.pi):
        scene = Landmarks(
            kind=np.full(81, PLANE, np.int32),
            parameters=np.tile([0.0, turn], (81, 1)),
            anchor=np.tile([1.0, 0.0], (81, 1)),
            extent=np.tile([-0.5, 0.5], (81, 1)),
        )
        poses = np.column_stack([np.zeros(81), along, np.zeros(81)])
        sensor = np.tile([0.28, 0.0], (81, 1))
        reach, share, arrival = predicted(PLANE, poses, scene, scene, sensor, sensor, np.zeros((81, 2)))
        np.testing.assert_array_equal(share > 0, np.abs(along) < 0.5 + SLACK)
        np.testing.assert_allclose(reach, 0.72, atol=1e-12)
        np.testing.assert_allclose(arrival, np.tile([1.0, 0.0], (81, 1)), atol=1e-12)


def test_single_precision_suffices_a_kilometre_away(rng):
    """Anchors hold the large coordinates. The numbers of the test are exact in single precision."""
    count = MANY
    poses = np.float32(rng.uniform([-1, -1, -3], [1, 1, 3], (count, 3)) + np.array([1000, -2000, 0]))
    for kind in (PLANE, CORNER, EDGE):
        scene = random_landmarks(rng, kind)
        scene = dataclasses.replace(scene, anchor=scene.anchor + np.array([1000, -2000]))
        scene = jax.tree.map(lambda x: np.float32(x) if x.dtype == np.float64 else x, scene)
        with jax.enable_x64(False):
            single = np.asarray(to_robot_frame(*arrays((poses, scene))))
        assert single.dtype == np.float32
        wide = jax.tree.map(lambda x: np.float64(x) if x.dtype == np.float32 else x, (poses, scene))
        np.testing.assert_allclose(single, to_robot_frame(*arrays(wide)), atol=5e-6)


# Slopes


def chain(values, kind):
    """Expected range as a function of 11 numbers: pose, two reflectors, two sensors."""
    pose, one, other, tx, rx = values[:3], values[3:5], values[5:7], values[7:9], values[9:11]
    none = jnp.zeros(2, values.dtype)
    of = jnp.where(kind == SECOND_ORDER, PLANE, kind)
    first, second = (kernels.landmark_in_robot_frame(pose, Landmarks(of, where, none, none)) for where in (one, other))
    return kernels.expected_range(kind, first, second, tx, rx)


slopes = {
    "reverse": jax.jit(jax.vmap(jax.grad(chain), in_axes=(0, None))),
    "forward": jax.jit(jax.vmap(jax.jacfwd(chain), in_axes=(0, None))),
}


@pytest.mark.slow
@kinds
def test_forward_and_reverse_derivatives_equal_finite_differences(rng, kind):
    first, second, tx, rx = random_reflectors(rng, kind)
    values = jnp.asarray(np.column_stack([rng.uniform(-0.3, 0.3, (MANY, 3)), first, second, tx, rx]))
    of = jnp.asarray(kind)
    report = jax.jit(jax.vmap(partial(chain, kind=of)))
    steps = 1e-6 * np.eye(11)
    numerical = np.stack([(report(values + h) - report(values - h)) / 2e-6 for h in jnp.asarray(steps)[:, None]], -1)
    forward, reverse = (slopes[name](values, of) for name in ("forward", "reverse"))
    np.testing.assert_allclose(forward, reverse, rtol=0, atol=1e-12)
    np.testing.assert_allclose(reverse, numerical, rtol=1e-4, atol=1e-7)


DEGENERATE = {
    "sensor on the wall": [0, 0, 0, 0.4, 0, 0.4, 0, 0.4, 0, 0.4, 0],
    "both sensors on the wall": [0, 0, 0, 0.4, 0, 0.4, 0, 0.4, 0.1, 0.4, -0.1],
    "sensor at the point": [0, 0, 0, 0.3, 0.1, 0.3, 0.1, 0.3, 0.1, 0.3, 0.1],
    "point between the sensors": [0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.3, 0.0, -0.3, 0.0],
    "all zero": [0.0] * 11,
}


@pytest.mark.slow
@kinds
@pytest.mark.parametrize("place", DEGENERATE)
def test_derivatives_are_finite_in_singular_geometries(kind, place):
    values = jnp.asarray([DEGENERATE[place]], float)
    for slope in slopes.values():
        assert np.isfinite(slope(values, jnp.asarray(kind))).all()


@kinds
def test_single_precision_agrees_with_double_precision(rng, kind):
    first, second, tx, rx = random_reflectors(rng, kind)
    given = (np.full(MANY, kind, np.int32), first, second, tx, rx)
    double_precision = expected_ranges(*arrays(given))
    with jax.enable_x64(False):
        single = expected_ranges(*arrays(given))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, double_precision, atol=2e-6)

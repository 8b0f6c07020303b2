"""Votes of echoes with poses: equivariance under motions, and the threshold of windows of scans."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import oracles

from jaxsonar import HoughSettings, Ring, kernels
from jaxsonar.detection.arc_tables import arc_tables
from jaxsonar.geometry.se2 import relative, transform_points

RING = Ring.circular(count=32, beam=1.5, neighbors=4, first_heading=0.0123)  # no point at the border of a cell
SETTINGS = HoughSettings()
ROOM = 256
endpoints_of = jax.jit(kernels.segment_endpoints)
lines_of_scan = jax.jit(kernels.tangent_lines, static_argnames="settings")
turns = st.floats(-3, 3)
metres = st.floats(-1, 1)


def packed(echoes, *, poses=True, scans_per_row=None):
    """(1, ROOM) echoes from a list of (pose, path, range), optionally without the poses."""
    path, reported = np.zeros((1, ROOM), np.int32), np.full((1, ROOM), np.nan, np.float32)
    pose = np.zeros((1, ROOM, 3), np.float32)
    for k, (stood, row, reach) in enumerate(echoes):
        path[0, k], reported[0, k], pose[0, k] = row, reach, stood
    scans_per_row = None if scans_per_row is None else jnp.full(1, scans_per_row, jnp.float32)
    return kernels.PackedEchoes(
        jnp.asarray(path), jnp.asarray(reported), jnp.asarray(pose) if poses else None, scans_per_row
    )


def one_scan(echoes):
    return jax.tree.map(lambda leaf: leaf[0], echoes)


def mixed_echoes(rng, ring=RING, poses=((0, 0, 0),)):
    """Echoes of a wall, and as many false echoes."""
    true = [echo for pose in poses for echo in oracles.plane_echoes(ring, np.array(pose), 1.2, 0.3)]
    false = [(pose, int(rng.integers(len(ring.paths))), rng.uniform(0.4, 1.9)) for pose, _, _ in true]
    return (true + false)[:ROOM]


def composed(world_from_a, a_from_b):
    """world_from_b."""
    world = oracles.matrix(world_from_a) @ oracles.matrix(a_from_b)
    return np.array([world[0, 2], world[1, 2], math.atan2(world[1, 0], world[0, 0])])


# gathered echoes


@pytest.mark.slow
def test_identity_poses_give_the_votes_of_one_scan(rng):
    echoes = mixed_echoes(rng)
    arcs = arc_tables(RING, SETTINGS).arcs
    plain = lines_of_scan(arcs, one_scan(packed(echoes, poses=False)), settings=SETTINGS)
    posed = lines_of_scan(arcs, one_scan(packed(echoes)), settings=SETTINGS)
    jax.tree.map(np.testing.assert_array_equal, posed, plain)


@pytest.mark.slow
@settings(max_examples=15)
@given(metres, metres, turns, st.integers(0, 1000))
def test_lines_are_equivariant_under_a_motion_of_all_poses(x, y, turn, seed):
    rng = np.random.default_rng(seed)
    poses = rng.uniform(-0.3, 0.3, (3, 3))
    echoes = mixed_echoes(rng, poses=poses)
    motion = np.array([x, y, turn])
    arcs = arc_tables(RING, SETTINGS).arcs
    turned = [(composed(motion, pose), path, reach) for pose, path, reach in echoes]
    both = [one_scan(packed(seen)) for seen in (echoes, turned)]
    here, there = (lines_of_scan(arcs, seen, settings=SETTINGS) for seen in both)
    spin = oracles.matrix(motion)[:2, :2]
    count = len(echoes)
    normals = np.stack([here.normal_x, here.normal_y], axis=-1)[:count] @ spin.T
    np.testing.assert_allclose(np.stack([there.normal_x, there.normal_y], -1)[:count], normals, atol=2e-6)
    counts = np.asarray(arcs.arcs.exists)[[path for _, path, _ in echoes]]
    np.testing.assert_allclose(
        np.asarray(there.rho)[:count][counts], (np.asarray(here.rho)[:count] + normals @ [x, y])[counts], atol=5e-6
    )


@settings(max_examples=10)
@given(metres, metres, turns, st.floats(-3, 3), st.integers(0, 1000))
def test_segments_are_equivariant_under_a_motion_of_line_and_sensors(x, y, turn, theta, seed):
    sensors = np.random.default_rng(seed).uniform(-1, 1, (9, 2)).astype(np.float32)
    motion, involved = np.array([x, y, turn]), np.arange(9) % 3 > 0
    here = endpoints_of(jnp.float32(2), jnp.float32(theta), sensors, involved)
    rho = 2 + x * math.cos(theta + turn) + y * math.sin(theta + turn)
    moved_sensors = transform_points(motion, sensors.astype(float)).astype(np.float32)
    there = endpoints_of(jnp.float32(rho), jnp.float32(theta + turn), moved_sensors, involved)
    np.testing.assert_allclose(there, transform_points(motion, np.asarray(here, float)), atol=1e-5)


@pytest.mark.slow
def test_rotation_of_the_frame_by_whole_cells_shifts_the_cells(rng):
    arcs = arc_tables(RING, SETTINGS).arcs
    echoes = mixed_echoes(rng, poses=rng.uniform(-0.3, 0.3, (2, 3)))
    results = []
    for step in (0, 7, 50):
        motion = np.array([0, 0, step * SETTINGS.theta_cell])
        turned = packed([(composed(motion, pose), path, reach) for pose, path, reach in echoes], scans_per_row=2.0)
        cells = np.asarray(kernels.vote(arcs, turned, settings=SETTINGS).occupied)
        results.append(np.roll(cells[0], -step, axis=0))
    assert results[0].any()
    # A point on the border of two cells may round into the other one in single precision.
    assert max((other != results[0]).sum() for other in results[1:]) <= 2


def test_scans_of_a_moving_robot_vote_for_the_wall_in_the_frame_of_the_last_pose(rng):
    poses = [np.array([0.15 * k - 0.2, 0.1 * math.sin(k), 0.25 * k - 2.9]) for k in range(5)]
    last = poses[-1]
    rho, theta = 1.4, 2.1
    echoes = [echo for pose in poses for echo in oracles.plane_echoes(RING, pose, rho, theta)][::7]
    assert len(echoes) > 20
    wanted = oracles.accumulate(
        [
            oracles.cell(r, t, SETTINGS)
            for r, t in oracles.tangent_lines_in_frame(RING, echoes, last, SETTINGS.point_pitch)
        ],
        SETTINGS,
    )
    gathered = packed([(relative(last, pose), path, reach) for pose, path, reach in echoes], scans_per_row=5.0)
    votes, _ = kernels.accumulators(arc_tables(RING, SETTINGS).arcs, gathered, settings=SETTINGS)
    votes = np.asarray(votes[0])
    assert votes.sum() == wanted.sum()
    assert np.abs(votes - wanted).sum() <= 0.01 * wanted.sum()  # points on the border of two cells
    best = np.unravel_index(votes.argmax(), votes.shape)
    seen = oracles.cell(rho - last[0] * math.cos(theta) - last[1] * math.sin(theta), theta - last[2], SETTINGS)
    assert seen is not None
    assert max(abs(best[0] - seen[0]), abs(best[1] - seen[1])) <= 1


@pytest.mark.parametrize("times", [1, 2, 4])
def test_repeated_echoes_with_an_equal_scan_count_give_the_same_cells(rng, times):
    echoes = [*mixed_echoes(rng)][: ROOM // 4]
    arcs = arc_tables(RING, SETTINGS).arcs
    once = kernels.vote(arcs, packed(echoes, scans_per_row=1.0), settings=SETTINGS).occupied
    often = kernels.vote(arcs, packed(echoes * times, scans_per_row=float(times)), settings=SETTINGS).occupied
    assert once.any()
    np.testing.assert_array_equal(often, once)


@pytest.mark.parametrize("scans_per_row", [0.5, 1.0, 3.25])
def test_scan_count_scales_the_threshold(rng, scans_per_row):
    echoes, arcs = mixed_echoes(rng), arc_tables(RING, SETTINGS).arcs
    _, smooth = kernels.accumulators(arcs, packed(echoes, scans_per_row=scans_per_row), settings=SETTINGS)
    came = kernels.vote(arcs, packed(echoes, scans_per_row=scans_per_row), settings=SETTINGS).occupied
    np.testing.assert_array_equal(
        came, np.asarray(smooth) > np.float32(arcs.vote_threshold) * np.float32(scans_per_row)
    )

"""Which echoes a map explains, by the truth of the simulator; and the arcs of the others."""

import numpy as np
import pytest

from jaxsonar import Ring, random_pose, random_room, simulate
from jaxsonar.floor_plans.room import Room
from jaxsonar.occupancy.echo_arcs import EchoArcs, soft_paths
from jaxsonar.occupancy.echo_attribution import explained_by_map
from jaxsonar.occupancy.known_reflectors import KnownReflectors
from jaxsonar.simulation.traced_echoes import EchoKind


def simulated(ring, room, poses, **errors):
    """Echoes of a room, and the same as arcs."""
    found = simulate(ring, room, poses, **errors)
    tx, rx = ring.paths[found.path].T
    distance = np.asarray(ring.corrected(found.range, tx, rx))
    return found, EchoArcs(poses[found.scan], found.path, distance, np.ones(len(distance), int))


@pytest.mark.parametrize("seed", range(3))
def test_true_walls_explain_their_echoes_those_of_two_walls_and_crosstalk(faw_ring, seed):
    rng = np.random.default_rng(seed)
    room = random_room(rng, pole=0.0)
    poses = np.stack([random_pose(rng, room) for _ in range(8)])
    found, arcs = simulated(faw_ring, room, poses, sigma=0.003, seed=seed)
    explained = explained_by_map(KnownReflectors.of_walls(room.walls), faw_ring, arcs)
    kinds = set(found.kind.tolist())
    assert {EchoKind.PLANE, EchoKind.CORNER, EchoKind.CROSSTALK} <= kinds
    assert EchoKind.SECOND_ORDER in kinds or seed
    for kind in kinds:
        assert explained[found.kind == kind].mean() > 0.97


def test_echoes_of_an_unknown_pole_stay_unexplained(faw_ring):
    """A pole in front of one wall: few of its echoes have the range of a wall, of two walls, or of crosstalk."""
    rng = np.random.default_rng(5)
    wall = np.array([[[-3.0, 1.5], [3.0, 1.5]]])
    room = Room(wall, (), np.array([[0.1, 0.6]]))
    poses = np.column_stack([rng.uniform(-0.8, 0.8, 20), rng.uniform(-0.4, 0.0, 20), rng.uniform(-np.pi, np.pi, 20)])
    found, arcs = simulated(faw_ring, room, poses)
    explained = explained_by_map(KnownReflectors.of_walls(wall), faw_ring, arcs)
    pole = found.kind == EchoKind.POLE
    assert pole.sum() > 50
    assert explained[pole].mean() < 0.15
    assert explained[found.kind == EchoKind.PLANE].all()


def test_nothing_is_explained_without_a_map_or_by_walls_that_are_too_far(faw_ring):
    wall = np.array([[[-3.0, 1.5], [3.0, 1.5]]])
    _, arcs = simulated(faw_ring, Room(wall, (), np.zeros((0, 2))), np.zeros((1, 3)))
    assert len(arcs.path)
    for walls in (np.zeros((0, 2, 2)), wall + np.array([0.0, 0.2]), wall + np.array([0.0, 9.0])):
        assert not explained_by_map(KnownReflectors.of_walls(walls), faw_ring, arcs).any()


def test_a_faint_echo_far_off_the_axis_is_not_that_of_a_wall():
    """One sensor that looks along a wall: the wall is at a right angle to its axis."""
    ring = Ring([(0.0, 0.0)], [0.0], beam=np.radians(60), neighbors=0, max_range=4.0)
    for angle, heard in ((20.0, True), (45.0, True), (65.0, False), (100.0, False)):
        normal = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
        along = np.array([-normal[1], normal[0]])
        wall = normal + np.array([[-1.0], [1.0]]) * along
        arcs = EchoArcs(np.zeros((1, 3)), np.zeros(1, int), np.ones(1), np.ones(1, int))
        known = KnownReflectors.of_walls(wall[None])
        assert explained_by_map(known, ring, arcs).tolist() == [heard]


def test_arcs_of_cross_paths_are_as_wide_as_the_beam_around_the_middle_of_both_axes(faw_ring):
    paths, nominal = soft_paths(faw_ring), faw_ring.echo_paths
    axis = np.asarray(faw_ring.heading)[faw_ring.paths]
    middle = np.angle(np.exp(1j * axis).sum(axis=1))
    start, width = np.asarray(paths.start), np.asarray(paths.width)
    np.testing.assert_allclose(width, np.radians(60), atol=1e-5)
    np.testing.assert_allclose(np.angle(np.exp(1j * (start + width / 2 - middle))), 0, atol=1e-5)
    direct = faw_ring.paths[:, 0] == faw_ring.paths[:, 1]
    np.testing.assert_allclose(start[direct], np.asarray(nominal.start)[direct], atol=1e-6)
    assert (start <= np.asarray(nominal.start) + 1e-6).all()
    # Sensors that face away from each other have no arc.
    back = Ring([(0.1, 0.0), (-0.1, 0.0)], [0.0, np.pi], beam=1.0, neighbors=1, max_range=2.0)
    across = back.paths[:, 0] != back.paths[:, 1]
    assert not np.asarray(soft_paths(back).width)[across].any()

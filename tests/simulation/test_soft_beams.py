"""Soft beams and crosstalk: an echo is reported if and only if its amplitude reaches the threshold."""

import math
from dataclasses import fields
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.rooms import some_poses, turned
from support.tracing import trace_between

from jaxsonar import Ring, Room, random_room, simulate
from jaxsonar.hardware.errors import SonarError
from jaxsonar.simulation.acoustics import Acoustics
from jaxsonar.simulation.traced_echoes import EchoKind

RING = Ring.circular()
UNLIMITED: dict[str, Any] = {"max_echoes": 1000, "blanking": 0.0}
SMALL = Ring.circular(count=9, neighbors=1, beam=np.radians(70), radius=0.2)
"""A ring with few echoes, which a loop can list."""


def some_room(seed, scans=4):
    rng = np.random.default_rng(seed)
    room = random_room(rng, box=1.0, segment=1.0, pole=1.0)
    poses = some_poses(rng, room, scans)
    x, y, theta = poses[0]
    column = [x + 0.7 * math.cos(theta), y + 0.7 * math.sin(theta), 0.1]  # in front of sensor 0
    return Room(room.walls, (), room.poles, np.array([column])), poses


def oracle_amplitude(echo, room, tx, rx, heading_tx, heading_rx, beam):
    """Amplitude of one traced echo by scalar formulas, decibel by decibel; None behind a sensor."""
    kind = EchoKind(int(echo.kind))
    d1, d2 = math.dist(tx, echo.first), math.dist(rx, echo.last)
    loss = 1.3 * (float(echo.length) - 2)
    for place, point, heading in ((tx, echo.first, heading_tx), (rx, echo.last, heading_rx)):
        turn = math.remainder(math.atan2(point[1] - place[1], point[0] - place[0]) - heading, 2 * math.pi)
        if abs(turn) > math.pi / 2:
            return None
        loss += 6 * (turn / (beam / 2)) ** 2
    if kind in (EchoKind.EDGE, EchoKind.POLE):
        at_1m = 0.02 if kind == EchoKind.EDGE else 0.1
        loss += 10 * math.log10(d1 * d2 * (d1 + d2) / 2) - 20 * math.log10(at_1m)
    else:
        loss += 20 * math.log10(float(echo.length) / 2)
    if kind == EchoKind.CIRCLE:
        radius = room.circles[int(echo.reflector), 2]
        loss += 10 * math.log10(1 + 2 * d1 * d2 / (d1 + d2) / radius)
    return 10 ** (-loss / 20)


def loud_echoes(ring, room, poses, threshold, directed):
    """Scan, path, transmitter, kind, reflector, range, amplitude of all loud echoes, from a loop over all of them.

    Args:
        ring: the sensors.
        room: the reflectors.
        poses: of the robot.
        threshold: smallest amplitude.
        directed: transmitter, receiver and path that reports its echoes.
    """
    table = []
    for scan, (x, y, theta) in enumerate(poses):
        sensors, heading = turned(ring.position, theta, (x, y)), ring.heading + theta
        transmitter, receiver, path = np.array(directed).T
        found = trace_between(room, sensors[transmitter], sensors[receiver], max_range=ring.max_range)
        for k in range(len(found)):
            echo = SimpleNamespace(**{field.name: getattr(found, field.name)[k] for field in fields(found)})
            i, j = transmitter[echo.pair], receiver[echo.pair]
            amplitude = oracle_amplitude(echo, room, sensors[i], sensors[j], heading[i], heading[j], ring.beam[0])
            if amplitude is not None and amplitude >= threshold:
                table.append((scan, path[echo.pair], i, echo.kind, echo.reflector, echo.length / 2, amplitude))
    return np.array(table)


def table_of(heard):
    names = ("scan", "path", "transmitter", "reflector_kind", "reflector", "range", "amplitude")
    return np.column_stack([getattr(heard, name) for name in names])


def assert_same_echoes(mine, other):
    assert len(mine) == len(other)
    mine, other = (x[np.lexsort(x[:, [5, 4, 3, 2, 1, 0]].round(9).T)] for x in (mine, other))
    np.testing.assert_allclose(mine, other, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("threshold", [0.0, 0.02, 0.2])
def test_an_echo_is_reported_if_and_only_if_it_is_loud(threshold):
    room, poses = some_room(1)
    settings: dict[str, Any] = UNLIMITED | {"acoustics": Acoustics(threshold=threshold), "crosstalk": False}
    heard = simulate(SMALL, room, poses, **settings)
    expected = loud_echoes(SMALL, room, poses, threshold, [(*pair, k) for k, pair in enumerate(SMALL.paths)])
    assert_same_echoes(table_of(heard), expected)
    assert set(heard.kind) >= {EchoKind.PLANE, EchoKind.CIRCLE}


def pairs_of_crosstalk(ring):
    """Transmitter, receiver and path of all crosstalk, from the definition of the firing groups."""
    return [
        (other, rx, path)
        for group in ring.firing_groups
        for tx, other in product(group.tolist(), group.tolist())
        for path, (path_tx, rx) in enumerate(ring.paths)
        if path_tx == tx and other != tx
    ]


@pytest.mark.slow
@pytest.mark.parametrize(("count", "beam"), [(16, 1.2), (13, 2.0)])
def test_crosstalk_is_what_a_receiver_hears_of_other_transmitters_of_the_group(count, beam):
    ring = Ring.circular(count=count, neighbors=1, beam=beam)
    room, poses = some_room(2)
    settings: dict[str, Any] = UNLIMITED | {"acoustics": Acoustics(threshold=0.005)}
    heard = simulate(ring, room, poses, **settings)
    crosstalk = heard.kind == EchoKind.CROSSTALK
    directed = pairs_of_crosstalk(ring)
    assert_same_echoes(table_of(heard)[crosstalk], loud_echoes(ring, room, poses, 0.005, directed))
    assert np.count_nonzero(crosstalk) > 20
    # The other echoes are those without crosstalk, and the transmitters are those of their paths.
    quiet = simulate(ring, room, poses, crosstalk=False, **settings)
    np.testing.assert_array_equal(table_of(heard)[~crosstalk], table_of(quiet))
    np.testing.assert_array_equal(quiet.transmitter, ring.paths[quiet.path, 0])
    np.testing.assert_array_equal(quiet.kind, quiet.reflector_kind)
    group = ring.firing_group_of_sensor
    tx = ring.paths[heard.path, 0]
    np.testing.assert_array_equal(group[heard.transmitter], group[tx])
    np.testing.assert_array_equal(heard.transmitter != tx, crosstalk)


def test_soft_beams_detect_everything_that_hard_beams_detect():
    room, poses = some_room(3, scans=20)
    soft, hard = (simulate(RING, room, poses, beams=beams, crosstalk=False, **UNLIMITED) for beams in ("soft", "hard"))
    mine, other = ({tuple(row) for row in table_of(heard)} for heard in (soft, hard))
    assert other < mine
    # Those that hard beams miss come from outside of a cone: at least 6 dB are lost.
    assert max(row[-1] * row[-2] for row in mine - other if row[3] == EchoKind.PLANE) < 10 ** (-6 / 20) * 10 ** (
        2.6 / 20
    )


@pytest.mark.parametrize("beams", ["soft", "hard"])
def test_reciprocity(beams):
    room, poses = some_room(4, scans=20)
    heard = simulate(RING, room, poses, beams=beams, crosstalk=False)
    tx, rx = RING.paths.T
    back = RING.path_index[rx, tx]
    columns = np.column_stack([heard.scan, heard.path, heard.range, heard.amplitude])
    there = columns[np.lexsort((heard.range, heard.path, heard.scan))]
    columns[:, 1] = back[heard.path]
    again = columns[np.lexsort((heard.range, back[heard.path], heard.scan))]
    np.testing.assert_array_equal(there, again)


def test_hard_beams_have_no_echo_from_outside_of_the_cones_and_no_crosstalk():
    room, poses = some_room(5, scans=20)
    heard = simulate(RING, room, poses, beams="hard")
    assert EchoKind.CROSSTALK not in heard.kind
    plane = np.flatnonzero(heard.kind == EchoKind.PLANE)
    # Of a wall on the axis only 12 dB can be lost within both cones.
    r = heard.range[plane]
    on_axis = 10 ** (-1.3 * (2 * r - 2) / 20) / r
    assert (heard.amplitude[plane] >= on_axis * 10 ** (-12.0 / 20) * (1 - 1e-9)).all()
    soft = simulate(RING, room, poses)
    plane = soft.kind == EchoKind.PLANE
    assert (soft.amplitude[plane] < 10 ** (-1.3 * (2 * soft.range[plane] - 2) / 20) / soft.range[plane] / 4.0).any()


def test_crosstalk_takes_part_in_blanking_and_in_the_number_of_echoes():
    """Two walls face two sensors of one group; the sensor between them hears both."""
    ring = Ring([(0.0, 0.0)] * 4, [0.0, 0.1, 0.2, 0.3], beam=1.0, neighbors=0, max_range=4.0)
    assert [group.tolist() for group in ring.firing_groups] == [[0, 2], [1, 3]]
    room = Room(np.array([[(1.0, -3.0), (1.0, 3.0)]]))
    pose = np.zeros((1, 3))
    everything = simulate(ring, room, pose, **UNLIMITED)
    plane = np.flatnonzero(everything.reflector_kind == EchoKind.PLANE)
    # Every sensor reports the wall by its own sound and by that of its partner, at equal ranges.
    assert everything.path[plane].tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert sorted(everything.transmitter[plane][:2].tolist()) == [0, 2]
    np.testing.assert_allclose(everything.range[plane], 1.0)
    blanked = simulate(ring, room, pose, blanking=0.03)
    assert np.count_nonzero(blanked.reflector_kind == EchoKind.PLANE) == 4
    one = simulate(ring, room, pose, blanking=0.0, max_echoes=1)
    assert one.path.tolist() == [0, 1, 2, 3]


def test_range_offsets_of_crosstalk_are_those_of_its_transmitter_and_receiver(rng):
    room, poses = some_room(6)
    offset = rng.uniform(-0.02, 0.02, 24)
    shifted = Ring(RING.position, RING.heading, beam=RING.beam, neighbors=3, max_range=2.0, range_offset=offset)
    plain, moved = (simulate(ring, room, poses, **UNLIMITED) for ring in (RING, shifted))
    mine, other = (x[np.lexsort(x[:, [6, 4, 3, 2, 1, 0]].round(9).T)] for x in (table_of(plain), table_of(moved)))
    transmitter, receiver = mine[:, 2].astype(int), RING.paths[mine[:, 1].astype(int), 1]
    np.testing.assert_allclose(other[:, 5] - mine[:, 5], (offset[transmitter] + offset[receiver]) / 2, atol=1e-9)


def test_false_echoes_have_the_transmitter_of_their_path():
    room, poses = some_room(7)
    heard = simulate(RING, room, poses, clutter=0.5)
    false = heard.kind == EchoKind.CLUTTER
    assert false.any()
    np.testing.assert_array_equal(heard.transmitter[false], RING.paths[heard.path[false], 0])
    assert (heard.reflector_kind[false] == EchoKind.CLUTTER).all()


def test_unknown_beams_are_an_error():
    with pytest.raises(SonarError, match="beams 'wide'; allowed is soft or hard"):
        simulate(RING, Room(np.zeros((0, 2, 2))), np.zeros((1, 3)), beams="wide")

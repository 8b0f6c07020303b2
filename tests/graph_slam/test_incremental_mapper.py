"""Incremental mapping equals mapping all scans at once; states are immutable and bounded by the size of the place."""

import dataclasses
import math

import numpy as np
import pytest
from support.hard_cones import simulate

from jaxsonar import Log, Ring, Room, SonarError, load_ring, local_model
from jaxsonar.geometry.se2 import transform_points
from jaxsonar.graph_slam.incremental_mapper import Mapper, MapState
from jaxsonar.mapping.build_map import build_map
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.mapping.settings import SETTINGS

RING = Ring.circular()


def office_log(office, seed=0):
    echoes = simulate(office.ring, office.room, office.poses, sigma=0.003, seed=seed, stamps=office.stamps)
    return echoes.as_log(office.ring, office.poses)


def driven(mapper, scans):
    """The state after all scans, and the result of each."""
    state, infos = mapper.start(), []
    for scan in scans:
        state, info = mapper.step(state, scan)
        infos.append(info)
    return mapper.finish(state), infos


def assert_same_map(one, other, *, atol=1e-9):
    """Same walls in the same order."""
    assert len(one) == len(other)
    for name in ("segments", "rho", "theta", "sigma_rho", "sigma_theta"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=atol, rtol=1e-6)
    assert one.echoes.tolist() == other.echoes.tolist()
    assert one.scans == other.scans


def arrays_of(value):
    """All arrays within a state."""
    if isinstance(value, np.ndarray):
        yield value
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from arrays_of(getattr(value, field.name))
    elif isinstance(value, tuple | list):
        for part in value:
            yield from arrays_of(part)
    elif hasattr(value, "values"):
        for part in value.values():
            yield from arrays_of(part)


def size_of(state):
    return sum(array.nbytes for array in arrays_of(state))


@pytest.mark.slow
@pytest.mark.parametrize(("order", "merging"), [("driven", "fused"), ("shuffled", "fused"), ("shuffled", "paper")])
def test_scan_by_scan_equals_all_at_once(office, order, merging):
    log = office_log(office)
    rows = {
        "driven": np.arange(17),
        "reversed": np.arange(17)[::-1],
        "shuffled": np.random.default_rng(3).permutation(17),
    }
    mapper = Mapper(ring=RING, merging=merging)
    state, infos = driven(mapper, [log[int(row)] for row in rows[order]])
    assert_same_map(mapper.map(state), build_map(RING, log, merging=merging), atol=1e-9 if merging == "fused" else 1e-5)
    assert [info.ignored for info in infos] == [""] * 17
    assert max(map(len, mapper.map(state).scans)) <= SETTINGS.evidence.listed_scans


@pytest.mark.slow
def test_every_intermediate_map_is_that_of_the_scans_so_far(office):
    """The empty map included; old states still give their maps in the end."""
    log, mapper = office_log(office, seed=1), Mapper(ring=RING)
    states = [mapper.start()]
    for scan in log:
        states.append(mapper.step(states[-1], scan)[0])
    bytes_before = [[array.tobytes() for array in arrays_of(state)] for state in states]
    for k in (0, 1, 5, 17):
        assert_same_map(mapper.map(states[k]), build_map(RING, log[:k]))
    assert [[array.tobytes() for array in arrays_of(state)] for state in states] == bytes_before


@pytest.mark.slow
def test_two_continuations_of_one_state_are_independent(office):
    log, mapper = office_log(office), Mapper(ring=RING)
    middle, _ = driven(mapper, log[:8])
    scans = list(log)
    there, _ = mapper.step(middle, scans[8])
    elsewhere, _ = mapper.step(middle, scans[12])
    assert_same_map(mapper.map(there), build_map(RING, log[:9]))
    assert_same_map(mapper.map(elsewhere), build_map(RING, Log.from_scans([*scans[:8], scans[12]])))
    assert_same_map(mapper.map(middle), build_map(RING, log[:8]))


@pytest.mark.slow
def test_a_step_returns_the_local_model_and_its_walls(office):
    """The walls are in the world frame."""
    mapper, state = Mapper(ring=RING), Mapper(ring=RING).start()
    for scan in office_log(office)[:6]:
        state, info = mapper.step(state, scan)
        wanted = local_model(RING, scan)
        assert info.model is not None
        assert [line.rho for line in info.model.lines] == [line.rho for line in wanted.lines]
        assert info.model.scan == scan.scan
        world = np.array([transform_points(scan.pose, line.segment) for line in wanted.lines]).reshape(-1, 2, 2)
        np.testing.assert_allclose(np.sort(info.segments, axis=1), np.sort(world, axis=1), atol=1e-3)


@pytest.mark.slow
def test_scans_without_a_pose_are_ignored_with_a_reason(office):
    """For windows see below."""
    log, mapper = office_log(office), Mapper(ring=RING)
    scans = [
        dataclasses.replace(scan, pose=np.full(3, np.nan)) if k in (0, 4, 9) else scan for k, scan in enumerate(log)
    ]
    state, infos = driven(mapper, scans)
    assert [k for k, info in enumerate(infos) if info.ignored] == [0, 4, 9]
    assert {info.ignored for info in infos} == {"", "no pose"}
    assert all(not info.ignored or info.model is None for info in infos)
    assert_same_map(mapper.map(state), build_map(RING, Log.from_scans(scans)))


def test_scans_without_echoes_or_with_echoes_everywhere_are_valid():
    """Missed detections are evidence of free space; a robot enclosed on all sides claims none."""
    mapper, none = Mapper(ring=RING), np.zeros(0, int)
    at_origin = {"stamp": np.zeros(1), "pose": np.zeros((1, 3)), "asked": RING.paths}
    no_echo = Log.from_echoes(none, none, none, np.zeros(0), **at_origin)[0]
    tx = np.arange(24)
    enclosed = Log.from_echoes(tx * 0, tx, tx, np.full(24, 0.12), stamp=np.ones(1), pose=np.zeros((1, 3)))[0]
    state, info = mapper.step(mapper.start(), no_echo)
    assert info.ignored == ""
    assert info.segments.shape == (0, 2, 2)
    assert state.evidence.free_space.tiles
    state, info = mapper.step(state, enclosed)
    assert isinstance(mapper.map(state), GlobalMap)
    assert state.evidence.models == 2


def test_invalid_arguments_are_refused():
    with pytest.raises(SonarError, match=r"merging 'best'; allowed is"):
        Mapper(ring=RING, merging="best")
    with pytest.raises(SonarError, match=r"method 'best'; allowed is"):
        Mapper(ring=RING, method="best")
    with pytest.raises(SonarError, match=r"window = -1 m; allowed is"):
        Mapper(ring=RING, window=-1.0)
    stranger = Log.from_echoes(
        np.array([0]), np.array([3]), np.array([24]), np.array([1.0]), stamp=np.zeros(1), pose=np.zeros((1, 3))
    )
    with pytest.raises(SonarError, match="tx 3, rx 24; allowed are 0 to 23"):
        Mapper(ring=RING).step(Mapper(ring=RING).start(), stranger[0])


CORRIDOR = Room(
    np.array([[[-1, -0.9], [4.0, -0.9]], [[4.9, -0.9], [9, -0.9]], [[-1, 1.0], [9, 1.0]], [[9, -0.9], [9, 1.0]]])
)
"""Eight metres long, 1.9 m wide, with an open door on the right."""


def corridor_log(seed=0):
    x = np.arange(0, 5.0, 0.1)
    poses = np.column_stack([x, 0.05 * np.sin(x), 0.05 * np.cos(x)])
    poses[30:36] = poses[30]  # the robot waits
    ring = load_ring("corridor8")
    return ring, simulate(ring, CORRIDOR, poses, sigma=0.005, seed=seed).as_log(ring, poses)


@pytest.mark.slow
@pytest.mark.parametrize("lost", [(), (0, 20, 21, 44)])
def test_windows_scan_by_scan_equal_those_of_the_whole_log(lost):
    """With a robot that waits, and with missing poses."""
    ring, log = corridor_log()
    scans = [dataclasses.replace(s, pose=np.full(3, np.nan)) if k in lost else s for k, s in enumerate(log)]
    mapper = Mapper(ring=ring, window=2.0)
    state, infos = driven(mapper, scans)
    came, wanted = mapper.map(state), build_map(ring, Log.from_scans(scans), window=2.0, grow=False)
    assert len(wanted) >= 2
    assert_same_map(came, dataclasses.replace(wanted, scans=came.scans))
    for few, all_ in zip(came.scans, wanted.scans, strict=True):
        assert set(few) <= set(all_)
    assert sum(info.model is not None for info in infos) >= 3
    assert state.pending_scans == ()
    assert [k for k, info in enumerate(infos) if info.ignored] == list(lost)


@pytest.mark.slow
def test_finishing_twice_or_an_empty_run_changes_nothing():
    ring, log = corridor_log()
    mapper = Mapper(ring=ring, window=2.0)
    state, _ = driven(mapper, list(log)[:22])
    assert mapper.finish(state) is state
    assert len(mapper.map(mapper.finish(mapper.start()))) == 0
    assert mapper.finish(Mapper(ring=RING).start()).evidence.models == 0


def round_trip(number):
    """A closed trajectory through a room with small random deviations and noise."""
    room = Room(
        np.array([[[-2, -1.6], [2, -1.6]], [[2, -1.6], [2, 1.6]], [[2, 1.6], [-2, 1.6]], [[-2, 1.6], [-2, -1.6]]])
    )
    rng = np.random.default_rng(number)
    angle = 2 * math.pi * np.arange(10) / 10
    poses = np.column_stack([1.0 * np.cos(angle), 0.6 * np.sin(angle), angle + math.pi / 2])
    poses += rng.normal(0, [0.02, 0.02, 0.02], poses.shape)
    log = simulate(RING, room, poses, sigma=0.003, seed=number).as_log(RING, poses)
    return [
        dataclasses.replace(scan, scan=10 * number + k, stamp=100.0 * number + scan.stamp) for k, scan in enumerate(log)
    ]


@pytest.mark.slow
def test_repeated_round_trips_need_no_more_memory():
    """Wall segments, tiles and listed scans are bounded by the walls: ten round trips need hardly more than three."""
    mapper = Mapper(ring=RING)
    state, sizes, segments, tiles = mapper.start(), {}, {}, {}
    for number in range(10):
        for scan in round_trip(number):
            state, _ = mapper.step(state, scan)
        sizes[number + 1] = size_of(state)
        segments[number + 1] = len(state.evidence.segments)
        tiles[number + 1] = len(state.evidence.free_space.tiles)
    assert tiles[10] == tiles[1]
    assert sizes[10] < 1.5 * sizes[3]
    assert segments[10] < 2.5 * segments[3]
    assert size_of(state) - size_of(state.evidence.free_space) < 1_000_000
    assert np.bincount(state.evidence.segments.scans[0]).max() <= SETTINGS.evidence.listed_scans
    assert state.evidence.models == 100
    world = mapper.map(state)
    assert isinstance(state, MapState)
    assert len(world) == 4

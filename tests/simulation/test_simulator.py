"""Echoes of a ring in a room: symmetries, acoustics, detection and measurement errors."""

from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.rooms import loop, some_poses, turned
from support.tracing import trace_between

from jaxsonar import Room, random_room
from jaxsonar.hardware.errors import SonarError
from jaxsonar.sensors.ring import Ring
from jaxsonar.simulation.acoustics import Acoustics
from jaxsonar.simulation.simulator import Simulation, simulate
from jaxsonar.simulation.traced_echoes import EchoKind

seeds = st.integers(0, 2**32 - 1)
RING = Ring.circular()
EVERYTHING: dict[str, Any] = {
    "max_echoes": 1000,
    "blanking": 0.0,
    "acoustics": Acoustics(threshold=0.0),
    "crosstalk": False,
}
"""Settings of a detector that reports every traced echo."""


def rows(simulation: Simulation):
    """One row per echo: scan, path, range, amplitude, kind, reflector."""
    return np.column_stack([getattr(simulation, field.name) for field in fields(simulation) if field.name != "stamps"])


def by_cause(scan, path, kind, reflector, *values):
    """Rows sorted independently of rounding errors of the values."""
    table = np.column_stack([scan, path, kind, reflector, *values])
    return table[np.lexsort(table.T[4::-1])]


def causes(heard: Simulation):
    return by_cause(heard.scan, heard.path, heard.kind, heard.reflector, heard.range, heard.amplitude)


@pytest.mark.slow
@pytest.mark.parametrize("beams", ["soft", "hard"])
@settings(max_examples=8, deadline=None)
@given(seed=seeds, beam=st.floats(0.2, np.pi), neighbors=st.integers(0, 5))
def test_a_ring_receives_the_traced_echoes_within_both_cones_or_half_planes(beams, seed, beam, neighbors):
    rng = np.random.default_rng(seed)
    room = random_room(rng, box=0.7, segment=0.7, pole=0.7)
    widths = np.append(rng.uniform(0.2, np.pi, 11), beam)
    heading = np.sort(rng.uniform(-np.pi, np.pi, 12))
    position = rng.uniform(-0.2, 0.2, (12, 2))
    ring = Ring(position, heading, beam=widths, neighbors=neighbors, max_range=1.8)
    poses = some_poses(rng, room, 3)
    heard = simulate(ring, room, poses, beams=beams, **EVERYTHING)
    expected = []
    for scan, (x, y, theta) in enumerate(poses):
        sensors = turned(position, theta, (x, y))
        tx, rx = ring.paths.T
        found = trace_between(room, sensors[tx], sensors[rx])
        keep = found.length / 2 <= 1.8
        for sensor, point in ((tx[found.pair], found.first), (rx[found.pair], found.last)):
            leg = point - sensors[sensor]
            off = np.arctan2(leg[:, 1], leg[:, 0]) - theta - heading[sensor]
            keep &= (
                np.abs((off + np.pi) % (2 * np.pi) - np.pi)
                <= (widths[sensor] / 2 if beams == "hard" else np.pi / 2) + 1e-9
            )
        found = found[keep]
        expected.append(
            np.column_stack([np.full(len(found), scan), found.pair, found.kind, found.reflector, found.length / 2])
        )
    mine, other = causes(heard)[:, :5], by_cause(*np.concatenate(expected).T)
    assert mine.shape == other.shape
    assert np.allclose(mine, other, atol=1e-9)


@pytest.mark.slow
@settings(max_examples=8, deadline=None)
@given(seed=seeds, angle=st.floats(-np.pi, np.pi), x=st.floats(-50, 50), y=st.floats(-50, 50))
def test_echoes_are_invariant_under_a_common_motion_of_world_and_robot(seed, angle, x, y):
    rng = np.random.default_rng(seed)
    room = random_room(rng)
    poses = some_poses(rng, room, 4)
    moved_room = Room(turned(room.walls, angle, (x, y)), (), turned(room.poles, angle, (x, y)))
    moved = np.column_stack([turned(poses[:, :2], angle, (x, y)), poses[:, 2] + angle])
    here, there = simulate(RING, room, poses, **EVERYTHING), simulate(RING, moved_room, moved, **EVERYTHING)
    assert np.allclose(causes(here), causes(there), atol=1e-6)


@pytest.mark.slow
@settings(max_examples=8, deadline=None)
@given(seed=seeds)
def test_a_mirrored_world_gives_mirrored_echoes(seed):
    rng = np.random.default_rng(seed)
    room = random_room(rng)
    poses = some_poses(rng, room, 4)
    flip = np.array([1.0, -1.0])
    here = simulate(RING, room, poses, **EVERYTHING)
    there = simulate(RING, Room(room.walls * flip, (), room.poles * flip), poses * [1, -1, -1], **EVERYTHING)
    mirrored_path = RING.path_index[tuple((-RING.paths % RING.count).T)]
    path = mirrored_path[here.path]
    mine = by_cause(here.scan, path, here.kind, here.reflector, here.range, here.amplitude)
    assert np.allclose(mine, causes(there), atol=1e-6)


def test_both_directions_of_a_pair_give_equal_echoes(rng):
    room = random_room(rng, segment=1.0, pole=1.0)
    heard = simulate(RING, room, some_poses(rng, room, 20), crosstalk=False)
    back = RING.path_index[tuple(RING.paths[:, ::-1].T)]
    for path in range(24, 168):
        mine, other = heard.path == path, heard.path == back[path]
        assert np.array_equal(heard.scan[mine], heard.scan[other])
        assert np.array_equal(heard.range[mine], heard.range[other])
        assert np.array_equal(heard.amplitude[mine], heard.amplitude[other])


def test_an_empty_room_gives_no_echoes(rng):
    nothing = Room(np.zeros((0, 2, 2)))
    far = Room(np.array([[[50.0, -1.0], [50.0, 1.0]]]))
    for room in (nothing, far):
        assert len(simulate(RING, room, np.zeros((3, 3)), clutter=5.0, dropout=0.5).range) == 0
    heard = simulate(RING, random_room(rng), np.zeros((0, 3)), sigma=0.1, drift=0.1)
    assert heard.dense(168, 3).shape == (0, 168, 3)


# Acoustics and detection.


def sensor(beam=np.pi / 3, **options):
    return Ring([(0.0, 0.0)], [0.0], beam=beam, neighbors=0, max_range=8.0, **options)


def wall_at(distance):
    return Room(np.array([[[distance, -50.0], [distance, 50.0]]]))


def test_amplitude_of_a_wall():
    def amplitude(distance, angle=0.0, **options):
        heard = simulate(sensor(), wall_at(distance), np.array([[0.0, 0.0, angle]]), acoustics=Acoustics(**options))
        return heard.amplitude[0]

    assert np.isclose(amplitude(1.0), 1.0)
    edge = np.pi / 6 - 1e-9
    assert np.isclose(20 * np.log10(amplitude(1.0, edge)), -12.0)  # 6 dB out and 6 dB in
    assert np.isclose(20 * np.log10(amplitude(1.0, edge / 2)), -3.0)
    assert np.isclose(20 * np.log10(amplitude(4.0)), -20 * np.log10(4.0) - 6 * 1.3)
    assert np.isclose(amplitude(2.0, absorption_db_per_m=0.0, reflectivity=0.5), 0.25)


def test_amplitude_of_points_and_corners():
    still = Acoustics(absorption_db_per_m=0.0, edge_strength=0.2, pole_strength=0.3, reflectivity=0.5)
    pole = simulate(sensor(), Room(np.zeros((0, 2, 2)), (), np.array([[2.0, 0.0]])), np.zeros((1, 3)), acoustics=still)
    assert np.isclose(pole.amplitude[0], 0.3 / 2.0**1.5)
    stick = Room(np.array([[[1.5, 0.0], [3.0, 1.0]]]))
    edge = simulate(sensor(), stick, np.zeros((1, 3)), acoustics=still)
    assert edge.kind[0] == EchoKind.EDGE
    assert np.isclose(edge.amplitude[0], 0.2 / 1.5**1.5)
    corner = Room(np.array([[[2.0, 0.0], [-7.0, 9.0]], [[2.0, 0.0], [-7.0, -9.0]]]))
    heard = simulate(sensor(), corner, np.zeros((1, 3)), acoustics=still)
    assert np.isclose(heard.amplitude[heard.kind == EchoKind.CORNER], 0.5**2 / 2.0)


def test_echoes_below_the_threshold_are_not_detected(rng):
    room = random_room(rng, pole=1.0)
    poses = some_poses(rng, room, 10)
    everything = simulate(RING, room, poses, **EVERYTHING)
    options: dict[str, Any] = EVERYTHING | {"acoustics": Acoustics(threshold=0.1)}
    loud = simulate(RING, room, poses, **options)
    assert np.array_equal(rows(loud), rows(everything)[everything.amplitude >= 0.1])
    assert 0 < len(loud.range) < len(everything.range)


@pytest.mark.slow
@pytest.mark.parametrize(("blanking", "max_echoes"), [(0.0, 2), (0.03, 1), (0.03, 3), (0.3, 9)])
def test_blanking_and_the_number_of_echoes(rng, blanking, max_echoes):
    room = random_room(rng, box=1.0, segment=1.0, pole=1.0)
    poses = some_poses(rng, room, 20)
    options = EVERYTHING | {"blanking": blanking, "max_echoes": max_echoes}
    all_rows, heard = rows(simulate(RING, room, poses, **EVERYTHING)), rows(simulate(RING, room, poses, **options))
    kept, last = [], {}
    for row in all_rows:
        key = (row[0], row[1])
        before = last.setdefault(key, [])
        if len(before) < max_echoes and (not before or row[2] >= before[-1] + blanking):
            before.append(row[2])
            kept.append(row)
    assert np.array_equal(heard, np.array(kept))
    assert len(kept) < len(all_rows)


def test_echoes_are_sorted_and_in_range(rng):
    room = random_room(rng, segment=1.0)
    heard = simulate(RING, room, some_poses(rng, room, 20), clutter=0.5, sigma=0.005)
    order = np.lexsort((heard.range, heard.path, heard.scan))
    assert np.array_equal(order, np.arange(len(order)))
    assert np.unique(np.column_stack([heard.scan, heard.path]), axis=0, return_counts=True)[1].max() <= 3
    exact = simulate(RING, room, some_poses(rng, room, 20))
    assert exact.range.max() <= RING.max_range


def test_dense_contains_the_same_echoes(rng):
    room = random_room(rng)
    heard = simulate(RING, room, some_poses(rng, room, 20))
    dense = heard.dense(168, 3)
    scan, path, _ = np.nonzero(~np.isnan(dense))
    assert np.array_equal(np.column_stack([scan, path, dense[~np.isnan(dense)]]), rows(heard)[:, :3])
    assert np.array_equal(heard.dense(168, 2), dense[..., :2], equal_nan=True)


def test_the_ring_corrects_reported_ranges_to_path_lengths(rng):
    room = random_room(rng)
    poses = some_poses(rng, room, 5)
    offsets = rng.uniform(-0.02, 0.02, 24)
    warm = Ring(RING.position, RING.heading, beam=RING.beam, neighbors=3, max_range=2.0, range_offset=offsets,
                speed_of_sound=350.0)  # fmt: skip
    true, reported = (simulate(ring, room, poses, crosstalk=False) for ring in (RING, warm))
    tx, rx = warm.paths[reported.path].T
    assert np.allclose(warm.corrected(reported.range, tx, rx), true.range, atol=1e-12)
    assert not np.allclose(reported.range, true.range, atol=1e-3)
    false = simulate(warm, room, poses, clutter=5.0, dropout=1.0, max_echoes=1000)
    tx, rx = warm.paths[false.path].T
    clean = warm.corrected(false.range, tx, rx)
    assert clean.min() >= 0.1 - 1e-12
    assert clean.max() <= 2.0 + 1e-12


# Measurement errors.


def many(seed=0, scans=400, **options):
    rng = np.random.default_rng(9)
    room = random_room(rng, segment=1.0, pole=1.0)
    poses = some_poses(rng, room, 20)[np.arange(scans) % 20]
    return simulate(RING, room, poses, seed=seed, crosstalk=False, **options)


@pytest.mark.slow
def test_white_noise():
    exact, noisy = many(max_echoes=1), many(max_echoes=1, sigma=0.005)
    error = noisy.range - exact.range  # one echo per path: noise cannot change the order
    n = len(error)
    assert abs(error.mean()) < 5 * 0.005 / np.sqrt(n)
    assert abs(error.std() / 0.005 - 1) < 5 / np.sqrt(2 * n)
    assert abs(np.mean(error**4) / 0.005**4 - 3) < 5 * np.sqrt(96 / n)  # Gaussian
    assert abs(np.corrcoef(error[:-1], error[1:])[0, 1]) < 5 / np.sqrt(n)


@pytest.mark.slow
def test_drift_belongs_to_sensors_and_decorrelates_slowly():
    ring = Ring.circular(count=6, neighbors=1, beam=np.pi, radius=0.0)
    room = Room(loop([[-1, -1], [1, -1], [1, 1], [-1, 1]]))
    scans, gap, time = 4000, 2.0, 8.0
    poses, stamps = np.zeros((scans, 3)), gap * np.arange(scans)
    drifting, still = (
        simulate(ring, room, poses, drift=drift, drift_time=time, stamps=stamps, max_echoes=1) for drift in (0.004, 0.0)
    )
    error = (drifting.range - still.range).reshape(scans, 18)
    own = error[:, :6]
    tx, rx = ring.paths.T
    assert np.allclose(error, (own[:, tx] + own[:, rx]) / 2, atol=1e-12)
    samples = own.size * gap / (2 * time)  # independent ones
    assert abs(own.std() / 0.004 - 1) < 5 / np.sqrt(2 * samples)
    assert abs(own[0].std() / 0.004 - 1) < 1.5  # from the first scan on
    for lag in (1, 4, 8):
        expected = np.exp(-lag * gap / time)
        assert abs((own[lag:] * own[:-lag]).mean() / own.var() - expected) < 5 / np.sqrt(samples)
    assert abs(np.corrcoef(own.T)[0, 1]) < 5 / np.sqrt(samples / 6)


def test_drift_is_constant_at_one_stamp_and_independent_after_long_pauses():
    stamps = np.repeat([0.0, 1e6], 50)
    room, ring = wall_at(1.0), sensor()
    heard = simulate(ring, room, np.zeros((100, 3)), drift=0.01, stamps=stamps)
    assert len(np.unique(heard.range)) == 2


@pytest.mark.slow
def test_dropout_rate():
    everything, some = many(), many(dropout=0.3)
    n = len(everything.range)
    assert abs(len(some.range) / n - 0.7) < 5 * np.sqrt(0.3 * 0.7 / n)
    assert {tuple(row) for row in rows(some)} <= {tuple(row) for row in rows(everything)}
    assert len(many(dropout=1.0).range) == 0


@pytest.mark.slow
def test_clutter_statistics():
    everything, more = many(), many(clutter=0.2, max_echoes=1000)
    real = many(max_echoes=1000)
    false = more.kind == EchoKind.CLUTTER
    count = np.count_nonzero(false)
    expected = 0.2 * len(real.range)
    assert abs(count - expected) < 5 * np.sqrt(expected)
    assert np.array_equal(rows(more)[~false], rows(real))
    assert (more.reflector[false] == -1).all()
    u = (np.sort(more.range[false]) - 0.1) / 1.9
    assert np.abs(u - (np.arange(count) + 0.5) / count).max() < 2 / np.sqrt(count)  # Kolmogorov: uniform
    per_path = np.bincount(more.path[false], minlength=168)
    assert abs(per_path.var() / per_path.mean() - 1) < 5 * np.sqrt(2 / 168)  # Poisson
    assert (more.amplitude[false] >= 0.02).all()
    assert len(everything.range) <= len(real.range)


def test_clutter_only_on_paths_with_overlapping_cones():
    narrow = Ring.circular(beam=np.radians(20), neighbors=3)  # 15 deg spacing: no overlap beyond neighbors
    room = Room(loop([[-1, -1], [1, -1], [1, 1], [-1, 1]]))
    heard = simulate(narrow, room, np.zeros((50, 3)), clutter=2.0, max_echoes=1000)
    assert set(heard.path[heard.kind == EchoKind.CLUTTER].tolist()) == set(range(72))


def test_seeds_are_reproducible_and_streams_are_independent():
    options = {"sigma": 0.003, "drift": 0.002, "dropout": 0.2, "clutter": 0.2, "scans": 40}
    one, same, other = many(1, **options), many(1, **options), many(2, **options)
    assert np.array_equal(rows(one), rows(same))
    assert not np.array_equal(one.range, other.range[: len(one.range)])
    without_loss = many(1, **options | {"dropout": 0.0, "max_echoes": 1000})
    with_loss = many(1, **options | {"max_echoes": 1000})
    assert {tuple(row) for row in rows(with_loss)} <= {tuple(row) for row in rows(without_loss)}


@pytest.mark.slow
@pytest.mark.parametrize("chunk", [1, 7, 1000])
def test_result_does_not_depend_on_the_chunk_size(chunk):
    options = {"sigma": 0.003, "drift": 0.002, "dropout": 0.2, "clutter": 0.2, "scans": 40}
    assert np.array_equal(rows(many(chunk=chunk, **options)), rows(many(**options)))


def test_no_negative_ranges_are_reported():
    heard = simulate(sensor(), wall_at(0.01), np.zeros((200, 3)), sigma=0.02)
    assert heard.range.min() > 0
    assert 100 < len(heard.range) < 190


def test_progress_reaches_the_end():
    calls = []
    simulate(RING, wall_at(1.0), np.zeros((10, 3)), chunk=4, progress=lambda done, of: calls.append((done, of)))
    assert calls == [(4, 10), (8, 10), (10, 10)]


POSES = np.zeros((2, 3))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"poses": np.array([[0, 0, 0], [0, np.nan, 0]])}, "pose 1"),
        ({"sigma": -1.0}, "sigma -1"),
        ({"sigma": np.nan}, "sigma nan"),
        ({"drift": -0.1}, "drift -0.1"),
        ({"drift_time": 0.0}, "drift_time 0"),
        ({"dropout": 1.1}, "dropout 1.1"),
        ({"clutter": -0.1}, "clutter -0.1"),
        ({"clutter": np.inf}, "clutter inf"),
        ({"blanking": -0.1}, "blanking -0.1"),
        ({"max_echoes": 0}, "max_echoes 0"),
        ({"chunk": 0}, "chunk 0"),
        ({"seed": -1}, "seed -1"),
        ({"stamps": np.array([1.0, 0.0])}, "stamps"),
        ({"stamps": np.array([1.0, np.nan])}, "stamps"),
    ],
)
def test_values_out_of_range_raise_a_one_line_error(options, words):
    with pytest.raises(SonarError) as caught:
        simulate(RING, wall_at(1.0), **{"poses": POSES} | options)
    message = str(caught.value)
    assert words in message
    assert "allowed" in message
    assert "\n" not in message


@pytest.mark.parametrize("name", [field.name for field in fields(Acoustics)])
def test_acoustics_out_of_range_raise_a_named_error(name):
    with pytest.raises(SonarError, match=f"{name} -1"):
        Acoustics(**{name: -1.0})

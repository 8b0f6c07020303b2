"""Section 3 of the paper: counts, order, detection ranges, virtual sensors, firing groups, for any arrangement."""

import dataclasses

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import oracles

from jaxsonar import Ring, SonarError

BUMPER = {
    "position": [(0.2, -0.27), (0.22, -0.09), (0.22, 0.09), (0.2, 0.27)],
    "heading": np.radians([-20.0, -5.0, 5.0, 20.0]),
}


def test_the_papers_ring_has_24_direct_and_144_cross_paths(faw_ring):
    paths = faw_ring.paths
    assert paths.shape == (168, 2)
    assert (paths[:, 0] == paths[:, 1]).sum() == 24
    assert len({tuple(p) for p in paths}) == 168


@pytest.mark.parametrize(("count", "neighbors"), [(24, 3), (32, 3), (24, 7), (5, 2), (9, 0), (1, 0)])
def test_paths_have_the_documented_order(count, neighbors):
    ring = Ring.circular(count=count, neighbors=neighbors)
    assert [tuple(p) for p in ring.paths] == oracles.paths(count, neighbors)
    assert len(ring.paths) == count * (2 * neighbors + 1)


@given(st.integers(1, 12).flatmap(lambda n: st.tuples(st.just(n), st.integers(0, n - 1))))
def test_paths_are_unique_and_path_index_is_the_inverse(shape):
    ring = Ring.circular(count=shape[0], neighbors=shape[1])
    paths = ring.paths
    assert len(np.unique(paths, axis=0)) == len(paths)
    assert (ring.path_index[paths[:, 0], paths[:, 1]] == np.arange(len(paths))).all()
    assert (ring.path_index >= 0).sum() == len(paths)


@given(st.integers(1, 12).flatmap(lambda n: st.tuples(st.just(n), st.integers(0, n - 1))))
def test_an_open_array_has_the_paths_between_neighbors_in_the_list(shape):
    count, neighbors = shape
    closed = Ring.circular(count=count, neighbors=neighbors)
    paths = dataclasses.replace(closed, closed=False).paths
    pairs = [(tx, rx) for tx in range(count) for rx in range(count) if abs(tx - rx) <= neighbors]
    assert sorted(map(tuple, paths)) == pairs
    assert [tuple(p) for p in closed.paths if abs(p[0] - p[1]) <= neighbors] == [tuple(p) for p in paths]  # same order
    if 2 * neighbors < count:
        sign = np.sign(paths[:, 1] - paths[:, 0])
        order = np.lexsort((paths[:, 0], -sign, np.abs(paths[:, 1] - paths[:, 0])))
        assert (order == np.arange(len(paths))).all()


@given(st.integers(1, 50).flatmap(lambda n: st.tuples(st.just(n), st.integers(0, n - 1))))
def test_firing_groups_of_an_open_array_do_not_interfere(shape):
    count, neighbors = shape
    groups = dataclasses.replace(Ring.circular(count=count, neighbors=neighbors), closed=False).firing_groups
    assert sorted(np.concatenate(groups)) == list(range(count))
    assert len(groups) == min(count, 2 * neighbors + 2)
    for group in groups:
        assert (np.diff(group) == 2 * neighbors + 2).all()


def turned(heading_deg, radius=0.3, *, closed=None):
    heading = np.radians(heading_deg)
    position = radius * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return Ring(position, heading, beam=1.0, neighbors=1, max_range=2.0, closed=closed)


def test_the_geometry_decides_whether_an_array_is_closed(rng):
    around = np.arange(0, 360, 15.0)
    assert turned(around).closed
    assert turned(-around).closed, "clockwise"
    assert turned(np.delete(around, 7)).closed, "one sensor is missing"
    assert turned(around, radius=0.0).closed
    assert turned(np.concatenate([around, around])).closed, "two rings one above the other"
    assert turned([0.0, 120.0, 240.0]).closed
    assert not turned(around[:16]).closed, "a third of the ring is missing"
    assert not turned(np.linspace(-60, 60, 8)).closed
    assert not Ring(**BUMPER, beam=1.0, neighbors=1, max_range=3.0).closed
    for _ in range(20):
        ring = Ring.circular(neighbors=1)
        position = ring.position + 0.005 * rng.normal(size=(24, 2))
        heading = ring.heading + np.radians(3) * rng.normal(size=24)
        assert Ring(position, heading, beam=1.0, neighbors=1, max_range=3.0).closed, "a calibrated ring"


def test_the_caller_decides_whether_an_array_is_closed():
    assert not turned(np.arange(0, 360, 15.0), closed=False).closed
    bumper = Ring(**BUMPER, beam=1.0, neighbors=1, max_range=3.0, closed=True)
    assert bumper.closed
    assert (3, 0) in map(tuple, bumper.paths.tolist())
    assert dataclasses.replace(bumper, neighbors=2).closed


@pytest.mark.parametrize(("beam", "neighbors", "widths"), [(60, 3, [60, 45, 30, 15]), (120, 7, range(120, 14, -15))])
def test_detection_ranges_of_section_3(beam, neighbors, widths):
    ring = Ring.circular(beam=np.radians(beam), neighbors=neighbors)
    first, last = np.asarray(ring.detection_ranges).T
    apart = (ring.paths[:, 1] - ring.paths[:, 0] + 12) % 24 - 12
    for distance, width in enumerate(widths):
        np.testing.assert_allclose(np.degrees(last - first)[np.abs(apart) == distance], width, atol=1e-3)
    center = ring.heading[ring.paths[:, 0]] + np.radians(15) * apart / 2  # between the two headings
    np.testing.assert_allclose(np.cos((first + last) / 2 - center), 1, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "ring",
    [
        Ring(**BUMPER, beam=np.radians([40.0, 120.0, 60.0, 90.0]), neighbors=3, max_range=3.0),
        Ring.circular(count=10, beam=np.radians(150), neighbors=4),
        Ring(
            np.zeros((3, 2)),
            np.radians([170.0, -170.0, 20.0]),
            beam=np.radians([50, 180, 30.0]),
            neighbors=1,
            max_range=1.0,
        ),
    ],
)
def test_detection_ranges_are_the_intersection_of_both_cones(ring):
    first, last = np.asarray(ring.detection_ranges, dtype=np.float64).T
    for direction in np.radians(np.arange(-179.75, 180, 0.5)):
        for k, (tx, rx) in enumerate(ring.paths):
            edges = [abs(abs(oracles.wrap(direction - ring.heading[s])) - ring.beam[s] / 2) for s in (tx, rx)]
            if min(edges) < 1e-4:
                continue  # at the border of a cone
            both = all(oracles.receives(ring.heading[s], ring.beam[s], direction) for s in (tx, rx))
            assert both == ((direction - first[k]) % (2 * np.pi) < last[k] - first[k])


def test_virtual_sensors_are_midpoints(faw_ring):
    middle = faw_ring.position[faw_ring.paths].mean(axis=1)
    np.testing.assert_allclose(faw_ring.virtual_sensors, middle, atol=1e-7)


def test_every_eighth_sensor_fires_simultaneously(faw_ring):
    groups = faw_ring.firing_groups
    assert [list(g) for g in groups] == [[k, k + 8, k + 16] for k in range(8)]


@given(st.integers(1, 50).flatmap(lambda n: st.tuples(st.just(n), st.integers(0, n - 1))))
def test_firing_groups_do_not_interfere(shape):
    count, neighbors = shape
    ring = Ring.circular(count=count, neighbors=neighbors)
    groups = ring.firing_groups
    assert sorted(np.concatenate(groups)) == list(range(count))
    for group in groups:
        for a in group:
            for b in group:
                apart = min((a - b) % count, (b - a) % count)
                assert a == b or apart >= 2 * neighbors + 2
        audible = [(group[:, None] + np.arange(-neighbors, neighbors + 1)).ravel() % count]
        if len(group) > 1:
            assert len(np.unique(audible)) == len(np.ravel(audible))  # every receiver can receive one transmitter only
            gaps = np.diff(np.append(group, group[0] + count))
            between = (group + gaps // 2)[gaps == 2 * neighbors + 2] % count
            assert not np.isin(between, audible).any()  # the sensor in the middle receives nothing


def test_firing_groups_are_as_few_as_the_spacing_allows():
    assert [len(Ring.circular(count=n, neighbors=3).firing_groups) for n in (24, 32, 25, 7, 16)] == [8, 8, 9, 7, 8]


def test_ranges_are_corrected_by_offset_then_by_speed_of_sound():
    ring = Ring(**BUMPER, beam=1.0, neighbors=1, max_range=3.0, range_offset=[0.1, 0.2, 0.4, 0.0], speed_of_sound=350.0)
    corrected = ring.corrected(np.array([1.0, 2.0]), np.array([0, 2]), np.array([0, 1]))
    np.testing.assert_allclose(corrected, [(1.0 - 0.1) * 350 / 343.2, (2.0 - 0.3) * 350 / 343.2])


def test_replacing_one_field_keeps_the_others():
    ring = Ring(**BUMPER, beam=1.0, neighbors=1, max_range=3.0, range_offset=[0.1, 0.2, 0.4, 0.0], speed_of_sound=350.0)
    other = dataclasses.replace(ring, neighbors=2)
    assert other.neighbors == 2
    for ours, theirs in zip(jax.tree.leaves(ring), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert (other.max_range, other.name) == (ring.max_range, ring.name)
    with pytest.raises(SonarError, match="0 to 3"):
        dataclasses.replace(ring, neighbors=4)


def test_exact_paths_are_computed_once_and_not_copied_to_changed_rings(faw_ring):
    ring = dataclasses.replace(faw_ring, name="first")
    ring.cache["key"] = 1
    assert ring.exact_paths is ring.exact_paths
    for exact, single in zip(jax.tree.leaves(ring.exact_paths), jax.tree.leaves(ring.echo_paths), strict=True):
        assert exact.dtype == np.float64
        assert not exact.flags.writeable
        np.testing.assert_array_equal(exact, single)
    for other in (dataclasses.replace(ring, neighbors=1), jax.tree.map(lambda leaf: leaf, ring)):
        assert other.cache == {}
        assert other.exact_paths is not ring.exact_paths
    assert len(jax.tree.leaves(ring)) == 5


def test_the_leaves_of_a_ring_are_the_calibration_parameters(faw_ring):
    leaves, tree = jax.tree.flatten(faw_ring)
    assert [leaf.shape for leaf in leaves] == [(24, 2), (24,), (24,), (24,), ()]
    assert jax.tree.unflatten(tree, leaves).paths.shape == (168, 2)


@pytest.mark.parametrize(
    ("change", "allowed"),
    [
        ({"count": 0}, "1 or more"),
        ({"radius": -0.1}, "0 or more"),
        ({"radius": float("nan")}, "0 or more"),
        ({"beam": 0.0}, "more than 0 and at most 180 deg"),
        ({"beam": 3.5}, "more than 0 and at most 180 deg"),
        ({"neighbors": 24}, "0 to 23"),
        ({"neighbors": -1}, "0 to 23"),
        ({"max_range": 0.0}, "more than 0"),
        ({"max_range": float("inf")}, "more than 0"),
        ({"speed_of_sound": -1.0}, "more than 0"),
        ({"radius": 1e300}, "at most 100 m"),
        ({"max_range": 410.0}, "at most 100 m"),
        ({"first_heading": 1e6}, "at most 720 deg"),
    ],
)
def test_invalid_values_raise_an_error_with_the_allowed_range(change, allowed):
    with pytest.raises(SonarError, match=allowed) as caught:
        Ring.circular(**change)
    assert "\n" not in str(caught.value)

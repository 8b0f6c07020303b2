"""Bounds over distance: scenes, laws of scale, arrays of any kind."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from jaxsonar import Ring, load_ring
from jaxsonar.observability.ring_bounds import distances_of, foremost_sensor, ring_bounds, viewing_direction
from jaxsonar.observability.settings import SETTINGS
from jaxsonar.sensors.ring_toml import shipped_rings

FEW = replace(SETTINGS, bearings=4, trials=24, steps=6, distances=(0.6, 1.2))


@pytest.mark.parametrize(
    ("name", "direction_deg", "sensors"),
    [
        ("faw", 0, {0}),
        ("bumper4", 0, {1, 2}),
        ("corridor8", 0, {3, 4}),
        ("scitos24", -180, {0}),
        ("sew-amr", 0, {1, 2}),
    ],
)
def test_surfaces_are_where_the_array_looks(name, direction_deg, sensors):
    ring = load_ring(name)
    assert abs(math.remainder(viewing_direction(ring) - math.radians(direction_deg), 2 * math.pi)) < 1e-6
    assert foremost_sensor(ring) in sensors


def test_distances_are_within_range_and_in_front_of_the_sensors():
    assert distances_of(Ring.circular())[0] == 0.5
    assert distances_of(Ring.circular())[-1] == 2.0
    assert distances_of(Ring.circular(radius=0.4, max_range=1.0)) == [0.75, 1.0, 1.25]
    assert distances_of(Ring.circular(radius=0.01, max_range=0.25)) == [pytest.approx(0.235)]


def test_bounds_are_proportional_to_sigma_and_errors_increase_with_it():
    one, three = (ring_bounds(load_ring("bumper4"), sigma=sigma, settings=FEW) for sigma in (0.001, 0.003))
    for small, large in zip(one.shot + one.scan, three.shot + three.scan, strict=True):
        for field in ("range_sd", "bearing_sd", "radius_sd", "curvature_sd"):
            pair = [list(getattr(row, field).values()) for row in (small, large)]
            np.testing.assert_allclose(3 * np.array(pair[0]), pair[1], rtol=1e-9)
        assert small.echoes == large.echoes
        assert small.three_kinds_error <= large.three_kinds_error + 0.1


def test_a_scan_knows_more_than_a_shot():
    bounds = ring_bounds(Ring.circular(), settings=FEW)
    for shot, scan in zip(bounds.shot, bounds.scan, strict=True):
        assert shot.distance == scan.distance
        for kind in ("plane", "corner", "edge"):
            assert scan.echoes[kind] > shot.echoes[kind]
            assert scan.range_sd[kind] < shot.range_sd[kind]
            assert scan.bearing_sd[kind] < shot.bearing_sd[kind]
        assert scan.three_kinds_error < shot.three_kinds_error


def test_the_radius_follows_from_the_curvature():
    for row in ring_bounds(load_ring("bumper4"), settings=FEW).scan:
        for radius, bound in row.radius_sd.items():
            assert bound == pytest.approx(row.curvature_sd[radius] * radius**2)


def test_the_same_ring_gives_the_same_numbers_wherever_it_is_mounted():
    ring = load_ring("bumper4")
    moved = replace(ring, position=ring.position + np.array([1.0, -2.0]))
    for here, there in zip(ring_bounds(ring, settings=FEW).scan, ring_bounds(moved, settings=FEW).scan, strict=True):
        for field in ("range_sd", "bearing_sd", "radius_sd"):
            assert getattr(there, field) == pytest.approx(getattr(here, field))


@pytest.mark.parametrize(
    "ring",
    [
        *(load_ring(name) for name in shipped_rings()),
        Ring([(0.1, 0.0)], [0.3], beam=1.0, neighbors=0, max_range=2.0, name="one sensor"),
        Ring([(0.1, 0.0), (-0.1, 0.0)], [0.0, np.pi], beam=0.5, neighbors=1, max_range=2.0, name="back to back"),
        Ring.circular(beam=np.pi, neighbors=11, name="half planes"),
        Ring.circular(beam=np.radians(2), neighbors=1, name="narrow"),
    ],
    ids=lambda ring: ring.name,
)
def test_any_array_has_bounds(ring):
    done = []
    bounds = ring_bounds(ring, settings=FEW, progress=done.append)
    assert done == list(range(1, 1 + 2 * len(bounds.scan)))
    text = json.dumps(bounds.as_json(), allow_nan=False)
    assert json.loads(text)["transmitter"] == bounds.transmitter
    for row in bounds.shot + bounds.scan:
        assert math.isnan(row.three_kinds_error) or 0 <= row.three_kinds_error <= 0.9

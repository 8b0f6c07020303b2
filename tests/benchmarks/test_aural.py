"""The comparison of mono- to multi-aural measurements: its rows; its columns without noise against plain geometry."""

import math

import numpy as np
import pytest
from scipy.optimize import least_squares
from support.reflector_paths import half_path, hears, information

from benchmarks.aural.configurations import CODED, configurations
from benchmarks.aural.table import BEARING, DRAWS, FARTHEST, NEAREST, markdown, row_of, rows

PUBLISHED = {  # wall mm and deg per mm; d' of plane and corner, plane and edge, mm
    "monaural": (1.0, math.inf, 0, 0),
    "binaural, ring 73 mm": (1.02, 2.25, 0, 0),
    "triaural, ring": (0.70, 1.13, 0, 0.55),
    "triaural, ±150 mm": (0.58, 0.54, 0, 2.4),
    "multi-aural, ring 60 deg, one shot": (0.58, 1.13, 0, 0.69),
    "multi-aural, ring 120 deg, one shot": (0.39, 0.33, 0, 4.4),
    "2 tx 2 rx, ±150 mm": (0.50, 0.27, 17.5, 8.7),
    "ring 60 deg, direct only, scan": (0.51, 0.36, 2.7, 2.7),
    "ring 60 deg, scan": (0.29, 0.26, 8.9, 3.6),
    "ring 120 deg, scan": (0.14, 0.075, 80, 30),
    "bumper of four at 45 cm, one shot": (0.57, 0.118, 0, 38),
    "bumper of four at 45 cm, scan": (0.26, 0.041, 380, 214),
}


@pytest.fixture(scope="module")
def table():
    return {row.name: row for row in rows()}


def test_columns_without_noise_are_within_two_percent_of_the_design_figures(table):
    for name, expected in PUBLISHED.items():
        row = table[name]
        came = (row.wall_distance, math.degrees(row.wall_direction) / 1e3, 1e3 * row.plane_corner, 1e3 * row.plane_edge)
        for value, figure in zip(came, expected, strict=True):
            last_digit = 10.0 ** -max(len(f"{figure:g}".partition(".")[2]), 0) if figure else 1e-6
            assert value == pytest.approx(figure, rel=0.02, abs=last_digit / 2), name


def test_more_receivers_and_transmitters_make_fewer_mistakes(table):
    errors = {name: row.errors for name, row in table.items()}
    assert errors["monaural"] == errors["binaural, ring 73 mm"] == pytest.approx((2 / 3, 2 / 3))
    assert errors["triaural, ±150 mm"][0] < errors["triaural, ring"][0]
    assert errors["2 tx 2 rx, ±150 mm"][0] < 0.05 < errors["triaural, ±150 mm"][0]
    assert errors["ring 60 deg, scan"][0] < 0.1 < 0.5 < errors["multi-aural, ring 60 deg, one shot"][0]
    assert errors["bumper of four at 45 cm, one shot"] == pytest.approx((1 / 3, 1 / 3), abs=0.01)
    assert errors["bumper of four at 45 cm, scan"] == (0, 0)
    for scan, coded in CODED.items():
        assert errors[coded] == errors[scan]


def test_the_table_has_a_line_for_each_row(table):
    lines = markdown(list(table.values())).splitlines()
    assert len(lines) == 2 + len(table) == 2 + len(configurations()) + len(CODED)
    assert lines[2] == "| monaural | 1.0 | 1.00 / unobservable | 0.667 / 0.667 | 0 / 0 |"
    assert not any(word in "".join(lines) for word in ("nan", "inf"))


@pytest.mark.parametrize("name", ["binaural, ±150 mm", "multi-aural, ring 60 deg, one shot", "2 tx 2 rx, ±150 mm"])
def test_bounds_and_separations_equal_those_of_plain_geometry(name):
    configuration = next(one for one in configurations() if one.name == name)
    ring, pairs = configuration.ring, configuration.pairs
    row = row_of(configuration, np.random.default_rng(8))
    surfaces = np.random.default_rng(8).uniform([NEAREST, -BEARING], [FARTHEST, BEARING], (DRAWS, 2))
    distance, direction, separation = [], [], []
    for surface in surfaces:
        heard = [hears("plane", surface, ring, tx, rx) for tx, rx in pairs]
        covariance = np.linalg.inv(information("plane", surface, ring, pairs, heard))
        distance.append(math.sqrt(covariance[0, 0]))
        direction.append(math.sqrt(covariance[1, 1]))
        separation.append(min(distance_between(ring, pairs, surface, "plane", "edge"),
                              distance_between(ring, pairs, surface, "edge", "plane")))  # fmt: skip
    assert row.wall_distance == pytest.approx(np.median(distance), rel=1e-4)
    assert row.wall_direction == pytest.approx(np.median(direction), rel=1e-4)
    assert row.plane_edge == pytest.approx(np.median(separation), rel=1e-3, abs=1e-8)


def distance_between(ring, pairs, surface, kind, other):
    """Norm of the residuals of the best reflector of another kind to the noise-free ranges."""
    point = surface[0] * np.array([math.cos(surface[1]), math.sin(surface[1])])
    place = {"plane": surface, "edge": point}
    ends = [ring.position[pair] for pair in pairs if hears(kind, place[kind], ring, *pair)]
    ranges = [half_path(kind, place[kind], *end) for end in ends]

    def residuals(x):
        return [half_path(other, x, *end) - value for end, value in zip(ends, ranges, strict=True)]

    found = least_squares(residuals, place[other], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return math.sqrt(2 * found.cost)

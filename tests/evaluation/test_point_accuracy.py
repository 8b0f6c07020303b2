"""Points of maps against poles and circles of rooms: what is found, of which kind, and what stands there instead."""

import io
import json

import numpy as np
from rich.console import Console

from jaxsonar.evaluation.point_accuracy import evaluate_points
from jaxsonar.reports.terminal_tables import point_table

WALLS = np.array([[[0, 0], [4, 0]], [[4, 0], [4, 3]]], dtype=float)
COLUMN, POLE, LOST = [1.0, 1.0], [2.0, 2.0], [3.0, 1.0]
REFERENCE = np.array([COLUMN, POLE, LOST])
KINDS, RADII = ("circle", "pole", "circle"), np.array([0.2, 0.0, 0.3])


def compared(points, kinds, radii, segments=()):
    ends = np.array(segments, dtype=float).reshape(-1, 2, 2)
    found = np.array(points, dtype=float).reshape(-1, 2)
    return evaluate_points(found, kinds, np.array(radii, dtype=float), ends, REFERENCE, KINDS, RADII, WALLS)


def test_a_perfect_map_has_no_errors():
    result = compared(REFERENCE, ("circle", "edge", "circle"), [0.2, np.nan, 0.3])
    assert (result.recall, result.match.tolist(), result.false.tolist()) == (1.0, [0, 1, 2], [])
    assert result.right_kind.all()
    np.testing.assert_array_equal(result.position_error, 0.0)
    np.testing.assert_array_equal(result.radius_error, [0.0, np.nan, 0.0])


def test_errors_of_position_and_radius():
    result = compared([[1.03, 1.04], [2.0, 2.01]], ("circle", "edge"), [0.25, np.nan])
    np.testing.assert_allclose(result.position_error, [0.05, 0.01, np.nan])
    np.testing.assert_allclose(result.radius_error, [0.05, np.nan, np.nan])
    assert result.missing.tolist() == [False, False, True]


def test_an_undecided_point_on_the_surface_is_found_but_has_not_the_right_kind():
    result = compared([[0.8, 1.0], [2.0, 2.0]], ("undecided", "edge"), [np.nan, np.nan])
    assert result.match.tolist() == [0, 1, -1]
    assert result.right_kind.tolist() == [False, True, False]
    np.testing.assert_allclose(result.position_error[:2], 0.0, atol=1e-12)


def test_a_wall_at_a_column_is_named_and_a_wall_of_the_room_is_not():
    result = compared([], (), [], [[[0.8, 0.7], [0.8, 1.3]], [[0.0, 0.0], [4.0, 0.0]]])
    assert result.as_wall.tolist() == [True, False, False]
    assert result.missing.tolist() == [False, True, True]


def test_false_points_are_circles_anywhere_and_others_away_from_walls():
    points = [[2.0, 0.05], [2.0, 0.05], [3.9, 2.5], [2.0, 1.0]]
    result = compared(points, ("circle", "corner", "edge", "undecided"), [0.1, np.nan, np.nan, np.nan])
    assert result.false.tolist() == [0, 3]


def test_each_point_is_at_one_reference():
    result = compared([COLUMN, COLUMN], ("circle", "circle"), [0.2, 0.2])
    assert sorted(result.match.tolist()) == [-1, -1, 0] or sorted(result.match.tolist()) == [-1, -1, 1]
    assert len(result.false) == 1


def test_the_table_and_the_json_show_every_reference():
    result = compared([COLUMN], ("circle",), [0.21])
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(point_table(result))
    text = console.export_text()
    assert "recall: 0.333 of 3" in text
    assert text.count("nothing") == 2
    found = json.loads(json.dumps(result.as_json(), allow_nan=False))
    assert [one["point"] for one in found["reference_points"]] == [0, None, None]
    assert (found["matched"], found["missing"], found["false"]) == (1, 2, [])

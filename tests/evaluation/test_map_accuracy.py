"""Maps against references: invariances, covered length against shapely, degenerate and invalid input."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from jaxsonar.evaluation.map_accuracy import evaluate, union_length
from jaxsonar.hardware.errors import SonarError
from jaxsonar.reports.terminal_tables import evaluation_table

NONE = np.zeros((0, 2, 2))
seeds = st.integers(0, 2**32 - 1)
SQUARE = np.array([[[0, 0], [4, 0]], [[4, 0], [4, 3]], [[4, 3], [0, 3]], [[0, 3], [0, 0]]], dtype=float)


def scene(seed, count=6):
    """A random reference, and a map of noisy, cut or reversed parts of its walls and some false ones."""
    rng = np.random.default_rng(seed)
    reference = rng.uniform(-4, 4, (count, 2, 2))
    along = reference[:, 1] - reference[:, 0]
    share = np.sort(rng.uniform(-0.3, 1.3, (count, 2)), axis=1)
    segments = reference[:, :1] + share[..., None] * along[:, None] + rng.normal(0, 0.05, (count, 2, 2))
    flip = rng.random(count) < 0.5
    segments[flip] = segments[flip, ::-1]
    return np.concatenate([segments, rng.uniform(-4, 4, (2, 2, 2))]), reference


def moved(segments, angle=0.7, offset=(3.0, -8.0)):
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return segments @ turn.T + offset


def numbers(evaluation):
    return [
        np.asarray(getattr(evaluation, name), dtype=float)
        for name in ("segment", "reference", "overlap", "distance", "angle", "segment_matched", "reference_covered")
    ]


@pytest.mark.slow
@given(seed=seeds)
def test_evaluation_is_invariant_under_rigid_motions(seed):
    segments, reference = scene(seed)
    here, there = evaluate(segments, reference), evaluate(moved(segments), moved(reference))
    for one, two in zip(numbers(here), numbers(there), strict=True):
        np.testing.assert_allclose(one, two, atol=1e-9)


@pytest.mark.slow
@given(seed=seeds)
def test_a_map_equals_itself(seed):
    segments = np.random.default_rng(seed).uniform(-4, 4, (9, 2, 2))
    result = evaluate(segments, segments)
    np.testing.assert_allclose(result.distance, 0, atol=1e-9)
    np.testing.assert_allclose(result.angle, 0, atol=1e-9)
    assert result.precision == result.recall == 1
    assert result.precision_length == pytest.approx(1)
    assert result.recall_length == pytest.approx(1)


@pytest.mark.slow
@given(seed=seeds, share=st.floats(0.05, 0.95))
def test_splitting_segments_changes_no_length(seed, share):
    def cut(lines):
        middle = lines[:, 0] + share * (lines[:, 1] - lines[:, 0])
        return np.concatenate([np.stack([lines[:, 0], middle], 1), np.stack([middle, lines[:, 1]], 1)])

    segments, reference = scene(seed)
    whole = evaluate(segments, reference)
    for part in (evaluate(segments, cut(reference)), evaluate(cut(segments), reference)):
        assert part.reference_covered.sum() == pytest.approx(whole.reference_covered.sum(), abs=1e-6)
        assert part.segment_matched.sum() == pytest.approx(whole.segment_matched.sum(), abs=1e-6)


@pytest.mark.slow
@given(seed=seeds)
def test_reversing_segments_changes_only_signs(seed):
    segments, reference = scene(seed)
    here, there, other = evaluate(segments, reference), evaluate(segments[:, ::-1], reference), None
    other = evaluate(segments, reference[:, ::-1])
    np.testing.assert_allclose(here.distance, there.distance, atol=1e-9)
    np.testing.assert_allclose(here.distance, -other.distance, atol=1e-9)
    np.testing.assert_allclose(here.angle, there.angle, atol=1e-9)
    np.testing.assert_allclose(here.angle, other.angle, atol=1e-9)


@pytest.mark.slow
@given(seed=seeds, gate=st.floats(0.02, 0.5))
def test_covered_length_equals_shapely(seed, gate):
    shapely = pytest.importorskip("shapely")
    segments, reference = scene(seed)
    result = evaluate(segments, reference, gate_distance=gate, gate_angle=math.radians(20))
    for wall, covered in zip(reference, result.reference_covered, strict=True):
        line = shapely.LineString(wall)
        strip = line.buffer(gate, cap_style="flat")
        pieces = []
        for segment in segments:
            direction = [complex(*(ends[1] - ends[0])) for ends in (segment, wall)]
            turn = abs(np.angle(direction[0] / direction[1]))
            inside = strip.intersection(shapely.LineString(segment))
            if min(turn, math.pi - turn) < math.radians(20) and inside.length > 0:
                feet = sorted(line.project(shapely.Point(xy)) for xy in inside.coords)
                pieces.append(shapely.LineString([(feet[0], 0), (feet[-1], 0)]))
        assert covered == pytest.approx(shapely.union_all(pieces).length if pieces else 0, abs=1e-6)


def test_deviations_of_a_wall_by_hand():
    wall = np.array([[[0.0, 0.0], [4.0, 0.0]]])
    turn = math.radians(2)
    segment = np.array([[[1.0, 0.03], [3.0, 0.03 + 2 * math.tan(turn)]]])
    result = evaluate(segment, wall)
    assert result.overlap == pytest.approx(2 / math.cos(turn))
    assert result.distance == pytest.approx(0.03 + math.tan(turn))
    assert result.angle == pytest.approx(turn)
    assert result.reference_covered == pytest.approx(2)
    assert (result.recall, result.recall_length) == (1, pytest.approx(0.5))


def test_gates():
    wall = np.array([[[0.0, 0.0], [4.0, 0.0]]])
    for away, found in ((0.149, 1), (0.151, 0), (-0.149, 1)):
        assert evaluate(wall + np.array([0, away]), wall).precision == found
    for degrees, found in ((9.9, 1), (10.1, 0), (-9.9, 1), (170.1, 1)):
        turned = moved(wall / 10, math.radians(degrees), (2, 0))
        assert evaluate(turned, wall).precision == found
    assert evaluate(wall + np.array([4.0, 0.0]), wall).precision_length == 0  # end to end


def test_deviations_are_those_from_the_nearest_reference():
    wall = np.array([[[0.0, 0.0], [4.0, 0.0]]])
    faces = np.concatenate([wall, wall + np.array([0, 0.1]), wall[:, ::-1] + np.array([0, 0.1])])
    result = evaluate(wall + np.array([0, 0.02]), faces)
    np.testing.assert_array_equal(result.reference, [0])
    np.testing.assert_allclose(result.distance, [0.02])
    np.testing.assert_allclose(result.segment_matched, [4.0])  # once, though three lie on it
    np.testing.assert_allclose(result.reference_covered, [4.0, 4.0, 4.0])


def test_union_length():
    assert union_length(np.array([[3.0, 4.0], [0.0, 2.0], [1.0, 1.5], [1.0, 2.5]])) == 3.5
    assert union_length(np.zeros((0, 2))) == 0


def test_an_empty_map_or_reference():
    nothing, missing, false = evaluate(NONE, NONE), evaluate(NONE, SQUARE), evaluate(SQUARE, NONE)
    assert math.isnan(nothing.precision)
    assert math.isnan(nothing.recall)
    assert math.isnan(missing.precision)
    assert missing.recall == missing.recall_length == 0
    assert math.isnan(false.recall_length)
    assert false.precision == false.precision_length == 0
    for result in (nothing, missing, false):
        assert result.as_json()["distance_max_m"] is None
        json.dumps(result.as_json(), allow_nan=False)
        evaluation_table(result)


def test_a_segment_of_no_length_matches_nothing():
    dot = np.array([[[1.0, 0.0], [1.0, 0.0]]])
    assert evaluate(np.concatenate([SQUARE, dot]), SQUARE).precision == 0.8
    assert evaluate(SQUARE, np.concatenate([SQUARE, dot])).recall == 0.8
    assert math.isnan(evaluate(dot, dot).precision_length)


def test_json_and_table_agree():
    result = evaluate(SQUARE + np.array([0.03, 0.0]), SQUARE)
    document = json.loads(json.dumps(result.as_json(), allow_nan=False))
    assert document["distance_max_m"] == pytest.approx(0.03)
    assert document["distance_rms_m"] == pytest.approx(0.03 / math.sqrt(2))
    assert document["reference_length_m"] == 14
    assert [pair["segment"] for pair in document["pairs"]] == [0, 1, 2, 3]
    console = Console(width=100, record=True, file=None, quiet=False)
    with console.capture() as captured:
        console.print(evaluation_table(result))
    text = captured.get()
    for words in ("(m)", "(mm)", "(deg)", "30.0", "21.2", "recall: 1.000 of 4 walls"):
        assert words in text


def test_invalid_input_is_refused():
    bad = SQUARE.copy()
    bad[2, 1, 0] = np.nan
    with pytest.raises(SonarError, match="segment of the map is not finite"):
        evaluate(bad, SQUARE)
    with pytest.raises(SonarError, match="segment of the reference is not finite"):
        evaluate(SQUARE, bad)
    for gates in ({"gate_distance": 0.0}, {"gate_angle": 2.0}, {"gate_distance": math.nan}):
        with pytest.raises(SonarError, match="allowed are"):
            evaluate(SQUARE, SQUARE, **gates)

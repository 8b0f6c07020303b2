"""Tables of the demo: finite numbers, and more accurate results than the paper's method."""

import json
import math

import numpy as np
import pytest
import shapely

from jaxsonar.demo import run_demo as demo
from jaxsonar.mapping.map_geojson import load_map

CHAIR = "chair back-rest"


@pytest.mark.slow
def test_the_table_contains_finite_numbers(written):
    def refuse(constant):
        raise ValueError(f"{constant} is no JSON")

    folder, (rows, _), _ = written
    table = json.loads((folder / "table.json").read_text(), parse_constant=refuse)
    assert [row["what"] for row in table] == [name for name, _ in rows]
    assert [row["scans"] for row in table] == [1, 1, 17, 17, 17, 10, 10, 10]
    for row, (_, result) in zip(table, rows, strict=True):
        for key, value in row.items():
            if key == "what":
                continue
            missing = not len(result.rho_error) or not np.isfinite(result.rho_bound).any()
            assert missing or (isinstance(value, int | float) and math.isfinite(value)), key
        assert 0 <= row["recall"] <= 1
        assert row["walls"] > 0
        assert row["lines"] >= row["false_per_scan"] * row["scans"]
        assert len(result.rho_error) == result.lines - result.false
        if len(result.rho_error):
            assert row["rho_max_mm"] >= row["rho_rms_mm"]
            assert row["theta_max_deg"] == pytest.approx(np.degrees(np.abs(result.theta_error)).max())
    first = table[0]
    assert (first["walls"], first["recall"]) == (3, 1.0)
    # Both methods and both rings are evaluated on the same walls; the paper's ring detects more of them.
    for full, paper, usual in ((2, 3, 4), (5, 6, 7)):
        assert table[full]["walls"] == table[paper]["walls"] == table[usual]["walls"]
        assert table[full]["recall"] > table[usual]["recall"]
        assert table[full]["echoes_per_scan"] > table[usual]["echoes_per_scan"]
        # Maximum likelihood is more accurate than centers of gravity, and reports fewer corners as walls.
        assert table[full]["rho_rms_mm"] < table[paper]["rho_rms_mm"] / 3
        assert table[full]["theta_rms_deg"] < table[paper]["theta_rms_deg"] / 2
        assert table[full]["false_per_scan"] < table[paper]["false_per_scan"] / 2


@pytest.mark.slow
def test_the_map_has_one_segment_for_every_wall_in_range(written, office):
    """Exactly one segment per wall, chair back-rest included, more accurate than the single segments."""
    folder, (_, maps), _ = written
    assert json.loads((folder / "map-table.json").read_text()) == maps
    of_paper, paper, aggregated, world = maps
    assert (world["false"], world["segments"], world["walls"], world["walls_found"]) == (0, 8, 8, 8)
    # Walls that many scans heard well have many segments, so that the RMS of the latter counts the best walls most.
    assert world["rho_max_mm"] < aggregated["rho_max_mm"] < paper["rho_max_mm"]
    assert world["rho_rms_mm"] < 2 * aggregated["rho_rms_mm"] < of_paper["rho_rms_mm"] < paper["rho_rms_mm"]
    assert world["theta_rms_deg"] < aggregated["theta_rms_deg"] < of_paper["theta_rms_deg"]
    segments = load_map(folder / "map.geojson").segments
    chair = shapely.LineString(office.room.walls[office.room.wall_names.index(CHAIR)])
    assert any(shapely.LineString(segment).hausdorff_distance(chair) < 0.1 for segment in segments)


def test_the_conventional_ring_receives_direct_echoes_only(office):
    usual = demo.conventional_ring(office.ring)
    assert (usual.paths[:, 0] == usual.paths[:, 1]).all()
    np.testing.assert_allclose(np.degrees(usual.beam), 30)
    np.testing.assert_array_equal(usual.position, office.ring.position)
    assert usual.max_range == office.ring.max_range

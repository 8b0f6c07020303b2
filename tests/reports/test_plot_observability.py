"""The figure of the bounds: all curves of finite values, for arrays that see much, little and nothing."""

from dataclasses import replace

import numpy as np
import pytest

from jaxsonar import Ring, load_ring
from jaxsonar.observability.ring_bounds import ring_bounds
from jaxsonar.observability.settings import SETTINGS
from jaxsonar.reports.observability_tables import bounds_table, ring_lines
from jaxsonar.reports.plot_observability import observability_figure
from jaxsonar.reports.plot_style import render_figure

FEW = replace(SETTINGS, bearings=3, trials=12, steps=4, distances=(0.6, 1.0, 1.6))


@pytest.mark.parametrize(
    "ring",
    [
        load_ring("bumper4"),
        Ring.circular(),
        Ring([(0.1, 0.0)], [0.3], beam=1.0, neighbors=0, max_range=2.0),
        Ring.circular(beam=np.radians(2), neighbors=1),
    ],
    ids=["bumper", "ring", "one sensor", "narrow"],
)
def test_figure_and_tables_of_any_array(ring):
    bounds = ring_bounds(ring, settings=FEW)
    figure = observability_figure(ring, bounds)
    assert render_figure(figure, "svg") == render_figure(observability_figure(ring, bounds), "svg")
    for what in ("shot", "scan"):
        table = bounds_table(bounds, what)
        assert table.row_count == 3
        cells = [cell for column in table.columns for cell in column.cells]
        assert not any(word in str(cell) for cell in cells for word in ("nan", "inf"))
    assert len(ring_lines(ring)) == 4


def test_the_curves_show_the_bounds():
    bounds = ring_bounds(load_ring("bumper4"), settings=FEW)
    axes = observability_figure(load_ring("bumper4"), bounds).axes
    curves = np.array([np.asarray(line.get_xydata()) for line in axes[1].lines])
    expected = [
        [(row.distance, 1e3 * row.range_sd[kind]) for row in rows]
        for kind in ("plane", "corner", "edge")
        for rows in (bounds.shot, bounds.scan)
    ]
    np.testing.assert_allclose(curves, expected)
    assert axes[4].get_title(loc="left") == "Wrong kind (%)"

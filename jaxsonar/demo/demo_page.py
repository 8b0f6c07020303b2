"""The figures of the demo, and the HTML page with figures and tables."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxsonar.detection.local_model import LocalModel
from jaxsonar.evaluation.laser_polygonal_model import polygonal_model
from jaxsonar.floor_plans.room import laser_ranges
from jaxsonar.geometry.se2 import transform_points, unit
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.occupancy.occupancy_grid import OccupancyGrid
from jaxsonar.reports import plot_map, plot_scan
from jaxsonar.reports.html_page import Column, Picture, Section, Table, save_report
from jaxsonar.reports.plot_grid import GridPanel, grid_comparison_figure, grid_figure
from jaxsonar.reports.terminal_tables import LINE_COLUMNS, MAP_COLUMNS
from jaxsonar.scans.scan_log import Log
from jaxsonar.simulation.office import Office

LASER_BEAMS = 720
"""Number of beams of the simulated laser, over 360 deg."""
CORNER, DETAIL_RADIUS = (-1.47, -1.96), 2.5
"""The detail of figure 5: a corner of the office, and the radius around it, metres."""


def draw_figures(
    office: Office,
    log: Log,
    models: Sequence[LocalModel],
    paper_models: Sequence[LocalModel],
    world: GlobalMap,
    grids: Mapping[str, tuple[OccupancyGrid, float]],
) -> dict[str, Figure]:
    """Draw the paper's figures 1 to 7, the accumulator and the grid.

    Args:
        office: ring, floor plan and poses.
        log: the scans.
        models: local model of each scan.
        paper_models: local models by the paper's method, for the accumulator.
        world: the map.
        grids: occupancy grids by their names, with their F1 scores; the first is that of the map.

    Returns:
        Figures by the names of their files, without suffix.
    """
    ring, room, poses = office.ring, office.room, office.poses
    first = poses[0]
    bearing = np.arange(LASER_BEAMS) * (2 * np.pi / LASER_BEAMS) - np.pi
    ranges = laser_ranges(room, first, bearing)
    laser_points = transform_points(first, (ranges[:, None] * unit(bearing))[np.isfinite(ranges)])
    laser = polygonal_model(bearing, ranges).transform(first)
    panels = [
        GridPanel(f"{name}: F1 {f1:.2f}", grid.classify(), grid.resolution, grid.origin)
        for name, (grid, f1) in grids.items()
    ]
    return {
        "1-ring": plot_scan.ring_figure(ring),
        "2-reference": plot_map.laser_figure(laser, laser_points),
        "3-arcs": plot_scan.arcs_figure(ring, log[0], room=room, pose=first),
        "4-lines": plot_scan.lines_figure(ring, log[0], models[0], room=room, pose=first),
        "4-accumulator": plot_scan.accumulator_figure(ring, log[0], paper_models[0]),
        "5-modeling": plot_map.modeling_figure(
            ring, models, poses, scans=(0, 1, 2), near=CORNER, within=DETAIL_RADIUS, room=room
        ),
        "6-segments": plot_map.aggregate_figure(ring, models, poses, room=room),
        "7-map": plot_map.map_figure(
            world, aggregated=plot_map.aggregated_segments(models, poses), poses=poses, room=room
        ),
        "8-grid": grid_figure(panels[0], room=room, poses=poses),
        "9-grids": grid_comparison_figure(panels, room=room),
    }


def write_page(
    filename: str | os.PathLike[str],
    figures: Mapping[str, Figure],
    lines: Sequence[Mapping[str, Any]],
    maps: Sequence[Mapping[str, Any]],
    *,
    paper: Mapping[str, float],
) -> None:
    """Write the page with all figures and tables.

    Args:
        filename: the HTML file.
        figures: figures from ``draw_figures``.
        lines: rows of the table of detected lines (``comparison.line_summary``).
        maps: rows of the table of maps (``comparison.map_summary``).
        paper: the paper's largest deviations.
    """
    sigma = f"range noise sigma = {maps[0]['sigma_mm']:g} mm"

    def figure(name: str, caption: str) -> Picture:
        return Picture(figures[name], alt=caption, caption=caption)

    scan_parts = [
        "One sensor transmits; it and its neighbors receive. Each echo defines an arc that is tangent to a reflector.",
        figure("1-ring", "The ring, and the arcs of all paths of one transmitter (the paper's figure 1)."),
        figure("2-reference", "The model of a simulated laser: segments, pseudo segments, intersections (figure 2)."),
        figure("3-arcs", "All arcs of the first scan; paths without an echo are light arcs (figure 3)."),
        figure("4-lines", "Walls and corners detected in this scan (figure 4)."),
        figure("4-accumulator", "The paper's method: votes, low pass, components above the threshold."),
    ]
    map_parts = [
        figure(
            "5-modeling",
            "Three positions at a corner: the outermost reflection lines give the endpoints of a segment (figure 5).",
        ),
        figure("6-segments", "The segments of all 17 scans in the world frame (figure 6)."),
        figure("7-map", "The map: one segment per wall (figure 7)."),
        figure(
            "8-grid",
            "The occupancy grid of map and echoes, for Nav2 (map.yaml, map.pgm). F1: occupied cells against the "
            "parts of the true walls that were heard.",
        ),
        figure(
            "9-grids",
            "The same scans, without the map: independent cells and log-odds, and expectation maximization, in which "
            "one reflector explains each echo.",
        ),
        Table(_columns(MAP_COLUMNS), list(maps), f"Segments of the office against its true walls, simulated, {sigma}."),
    ]
    table_parts = [
        Table(
            _columns(LINE_COLUMNS),
            [*lines, {"what": "the paper, one scan", "scans": 1, "walls": 3, "lines": 3, **paper}],
            f"Detected lines against true walls, simulated, {sigma}. Recall: walls with 8 or more echoes that have a "
            "line (100 mm, 15 deg); false: lines that are not walls; CRB: Cramer-Rao bound from the wall's own echoes.",
        )
    ]
    save_report(
        filename,
        title="jaxsonar: the office",
        intro="A robot with a ring of 24 ultrasonic sensors takes 17 scans in a simulated office. This page shows "
        "the results, from the echoes of one scan to the map.",
        sections=[
            Section("One scan", scan_parts),
            Section("The map", map_parts),
            Section("Accuracy of lines", table_parts),
        ],
    )


def _columns(columns: Sequence[tuple[str, str, int]]) -> list[Column]:
    """Convert columns of a terminal table, whose unit is in brackets in the last line of the heading."""
    page = []
    for title, key, digits in columns:
        heading, _, unit_text = " ".join(title.split("\n")).partition(" (")
        page.append(Column(key, heading, unit_text.rstrip(")"), digits))
    return page

"""The figures of the demo, and the page that shows them all with the tables."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxsonar.detection.local_map import LocalModel
from jaxsonar.evaluation.laser_segments import polygonal_model
from jaxsonar.floor_plans.room import laser_ranges
from jaxsonar.geometry.se2 import transform_points, unit
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.occupancy.occupancy_grid import OccupancyGrid
from jaxsonar.reports import plot_map as figures_map
from jaxsonar.reports import plot_scan as figures_scan
from jaxsonar.reports.html_page import Column, Picture, Section, Table, save_report
from jaxsonar.reports.terminal_tables import LINE_COLUMNS, MAP_COLUMNS
from jaxsonar.scans.scan_log import Log
from jaxsonar.simulation.office import Office

BEAMS = 720
"""Beams of the simulated laser, all around."""
CORNER, AROUND = (-1.47, -1.96), 2.5
"""What figure 5 shows: this corner of the office and this far around it, metres."""


def draw(
    office: Office,
    log: Log,
    models: Sequence[LocalModel],
    paper_models: Sequence[LocalModel],
    world: GlobalMap,
    grid: OccupancyGrid,
) -> dict[str, Figure]:
    """The paper's figures 1 to 7, the accumulator and the grid, by the names of their files.

    Args:
        office: ring, room and poses.
        log: the scans.
        models: what was found in each.
        paper_models: the same by the paper's method, for the accumulator.
        world: the map.
        grid: the occupancy grid.
    """
    ring, room, poses = office.ring, office.room, office.poses
    first = poses[0]
    bearing = np.arange(BEAMS) * (2 * np.pi / BEAMS) - np.pi
    ranges = laser_ranges(room, first, bearing)
    seen = transform_points(first, (ranges[:, None] * unit(bearing))[np.isfinite(ranges)])
    laser = polygonal_model(bearing, ranges).moved(first)
    return {
        "1-ring": figures_scan.ring_figure(ring),
        "2-reference": figures_map.laser_figure(laser, seen),
        "3-arcs": figures_scan.arcs_figure(ring, log[0], room=room, pose=first),
        "4-lines": figures_scan.lines_figure(ring, log[0], models[0], room=room, pose=first),
        "4-accumulator": figures_scan.accumulator_figure(ring, log[0], paper_models[0]),
        "5-modeling": figures_map.modeling_figure(
            ring, models, poses, scans=(0, 1, 2), near=CORNER, within=AROUND, room=room
        ),
        "6-segments": figures_map.aggregate_figure(ring, models, poses, room=room),
        "7-map": figures_map.map_figure(
            world, aggregated=figures_map.aggregated_segments(models, poses), poses=poses, room=room
        ),
        "8-grid": figures_map.grid_figure(grid.classify(), resolution=grid.resolution, origin=grid.origin, world=world),
    }


def write_page(
    path: str | os.PathLike[str],
    drawn: Mapping[str, Figure],
    lines: Sequence[Mapping[str, Any]],
    maps: Sequence[Mapping[str, Any]],
    *,
    paper: Mapping[str, float],
) -> None:
    """One page with all figures and tables.

    Args:
        path: the HTML file.
        drawn: figures, as ``draw`` gives them.
        lines: rows about the lines of scans, as ``demo.summary`` gives them.
        maps: rows about segments of maps, as ``demo.map_summary`` gives them.
        paper: largest deviations that the paper reports.
    """
    sigma = f"range noise sigma = {maps[0]['sigma_mm']:g} mm"

    def picture(name: str, caption: str) -> Picture:
        return Picture(drawn[name], alt=caption, caption=caption)

    scan = [
        "One sensor fires, its neighbors listen too. Every echo says that a reflector touches an arc; the arcs vote.",
        picture("1-ring", "The ring, and the arcs of all paths of one transmitter (the paper's figure 1)."),
        picture("2-reference", "What a laser makes of the place: segments, pseudo segments, intersections (figure 2)."),
        picture("3-arcs", "All arcs of the first scan; paths without an echo are light arcs (figure 3)."),
        picture("4-lines", "The walls and corners that explain this one scan (figure 4)."),
        picture("4-accumulator", "The paper's method: votes, low pass, components above the threshold."),
    ]
    whole = [
        picture(
            "5-modeling", "Three positions before a corner: the outermost reflection lines bound a line (figure 5)."
        ),
        picture("6-segments", "The segments of all 17 scans in the world frame (figure 6)."),
        picture("7-map", "The map: one segment a wall (figure 7)."),
        picture("8-grid", "The occupancy grid from the echoes, as Nav2 reads it (map.yaml, map.pgm)."),
        Table(_columns(MAP_COLUMNS), list(maps), f"Segments of the office against its true walls, simulated, {sigma}."),
    ]
    said = [
        Table(
            _columns(LINE_COLUMNS),
            [*lines, {"what": "the paper, one scan", "scans": 1, "walls": 3, "lines": 3, **paper}],
            f"Extracted lines against true walls, simulated, {sigma}. Recall: walls with 8 or more echoes that have a "
            "line (100 mm, 15 deg); false: lines that are no wall; CRB: Cramer-Rao bound from the wall's own echoes.",
        )
    ]
    save_report(
        path,
        title="jaxsonar: the office",
        intro="A robot with a ring of 24 ultrasonic sensors takes 17 scans in a simulated office. This page shows what "
        "they tell, from the echoes of one scan to the map of the room.",
        sections=[Section("One scan", scan), Section("The map", whole), Section("Lines, scan by scan", said)],
    )


def _columns(columns: Sequence[tuple[str, str, int]]) -> list[Column]:
    """Columns of a page from those of a terminal: there the unit is the last line of the title, in brackets."""
    page = []
    for title, key, digits in columns:
        words, _, unit_ = " ".join(title.split("\n")).partition(" (")
        page.append(Column(key, words, unit_.rstrip(")"), digits))
    return page

"""Tables for a terminal: accuracy of lines and maps in the demo, a map against a reference, health of a ring."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.table import Table

from jaxsonar.diagnostics.health_report import Health
from jaxsonar.evaluation.map_accuracy import Evaluation, max_abs, rms
from jaxsonar.evaluation.point_accuracy import PointEvaluation
from jaxsonar.reports.text import fixed, with_error

LINE_COLUMNS = (
    ("", "what", 0),
    ("scans", "scans", 0),
    ("echoes\n/scan", "echoes_per_scan", 1),
    ("walls", "walls", 0),
    ("recall", "recall", 3),
    ("lines", "lines", 0),
    ("false\n/scan", "false_per_scan", 2),
    ("at\ncorners", "false_at_corners_per_scan", 2),
    ("max Δρ\n(mm)", "rho_max_mm", 1),
    ("RMS Δρ\n(mm)", "rho_rms_mm", 1),
    ("RMS Δρ\n/CRB", "rho_rms_over_crb", 1),
    ("max Δθ\n(deg)", "theta_max_deg", 2),
    ("RMS Δθ\n(deg)", "theta_rms_deg", 2),
    ("RMS Δθ\n/CRB", "theta_rms_over_crb", 2),
)
"""Columns of the table of detected lines: heading, key in ``demo.comparison.line_summary``, decimals."""
MAP_COLUMNS = (
    ("", "what", 0),
    ("segments", "segments", 0),
    ("false", "false", 0),
    ("length\n(m)", "length_m", 2),
    ("visible\nwalls", "walls", 0),
    ("detected\nwalls", "walls_found", 0),
    ("max Δρ\n(mm)", "rho_max_mm", 1),
    ("RMS Δρ\n(mm)", "rho_rms_mm", 1),
    ("max Δθ\n(deg)", "theta_max_deg", 2),
    ("RMS Δθ\n(deg)", "theta_rms_deg", 2),
)
"""Columns of the table of maps: heading, key in ``demo.comparison.map_summary``, decimals."""
HEALTH_COLUMNS = (
    "sensor",
    "direct\nechoes",
    "cross\nechoes",
    "expected\nechoes",
    "detected\n(%)",
    "offset\n(mm)",
    "residual SD\ndirect (mm)",
    "residual SD\nall (mm)",
    "repeated\n(%)",
    "beam width\n(deg)",
    "axis offset\n(deg)",
)
"""Columns of the table of a ring's health, before the remark."""


def line_accuracy_table(rows: Sequence[tuple[str, dict[str, Any]]], *, paper: dict[str, float]) -> Table:
    """Detected lines against true walls, one row per comparison; the paper's figures last.

    Args:
        rows: name of the comparison, and its ``demo.comparison.line_summary``.
        paper: the paper's largest deviations ``rho_max_mm`` and ``theta_max_deg``.
    """
    sigma = rows[0][1]["sigma_mm"]
    table = Table(
        title=f"Detected lines against true walls, simulated, range noise sigma = {sigma:g} mm",
        caption="recall: walls with 8 or more echoes in the high-resolution ring that have a line (100 mm, 15 deg)\n"
        "false: lines that are not walls; CRB: Cramer-Rao bound from the wall's own echoes",
    )
    for heading, _, _ in LINE_COLUMNS:
        table.add_column(heading, justify="right" if heading else "left")
    for name, row in rows:
        table.add_row(name, *(fixed(row.get(key), digits) for _, key, digits in LINE_COLUMNS[1:]))
    table.add_section()
    known: Mapping[str, float] = {"scans": 1, "walls": 3, "lines": 3, **paper}
    cells = (fixed(known[key], digits) if key in known else "" for _, key, digits in LINE_COLUMNS[1:])
    table.add_row("the paper, one scan", *cells)
    return table


def map_accuracy_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Segments of maps against true walls, one row per map.

    Args:
        rows: name of the map as ``what``, and its ``demo.comparison.map_summary``.
    """
    sigma = rows[0]["sigma_mm"]
    table = Table(
        title=f"Segments of the office against its true walls, simulated, range noise sigma = {sigma:g} mm",
        caption="false: no wall within 100 mm and 15 deg along half of the segment; "
        "visible: walls with 8 or more echoes in a scan",
    )
    for heading, _, _ in MAP_COLUMNS:
        table.add_column(heading, justify="right" if heading else "left")
    for row in rows:
        table.add_row(row["what"], *(fixed(row[key], digits) for _, key, digits in MAP_COLUMNS[1:]))
    return table


def evaluation_table(evaluation: Evaluation) -> Table:
    """A map against a reference: one row per matched pair, the longest first; maximum and RMS of the deviations."""
    matched, covered = evaluation.segment_matched.sum(), evaluation.reference_covered.sum()
    table = Table(
        title="Map against reference",
        caption=f"precision: {fixed(evaluation.precision, 3)} of {len(evaluation.segment_length)} segments, "
        f"{fixed(evaluation.precision_length, 3)} of their length "
        f"({matched:.2f} of {evaluation.segment_length.sum():.2f} m)\n"
        f"recall: {fixed(evaluation.recall, 3)} of {len(evaluation.reference_length)} walls, "
        f"{fixed(evaluation.recall_length, 3)} of their length "
        f"({covered:.2f} of {evaluation.reference_length.sum():.2f} m)",
    )
    for heading in ("segment\n(index)", "wall\n(index)", "overlap\n(m)", "Δ distance\n(mm)", "Δ angle\n(deg)"):
        table.add_column(heading, justify="right")
    for k in np.argsort(-evaluation.overlap, kind="stable"):
        table.add_row(
            str(evaluation.segment[k]),
            str(evaluation.reference[k]),
            f"{evaluation.overlap[k]:.2f}",
            fixed(1e3 * float(evaluation.distance[k]), 1),
            fixed(math.degrees(evaluation.angle[k]), 2),
        )
    table.add_section()
    for name, statistic in (("largest", max_abs), ("RMS", rms)):
        distance, angle = 1e3 * statistic(evaluation.distance), math.degrees(statistic(evaluation.angle))
        table.add_row(name, "", "", fixed(distance, 1), fixed(angle, 2))
    return table


def point_table(evaluation: PointEvaluation) -> Table:
    """Points of a map against the poles and circles of a reference, one row each."""
    count = len(evaluation.match)
    table = Table(
        title="Points against poles and circles of the reference",
        caption=f"recall: {fixed(evaluation.recall, 3)} of {count}; right kind: {int(evaluation.right_kind.sum())}; "
        f"walls instead: {int(evaluation.as_wall.sum())}; missing: {int(evaluation.missing.sum())}; "
        f"false points: {len(evaluation.false)}",
    )
    for heading in ("reference\n(index)", "kind", "in the map", "Δ position\n(mm)", "Δ radius\n(mm)"):
        table.add_column(heading, justify="right")
    for k in range(count):
        found = evaluation.match_kinds[k] or "nothing"
        wall = "wall" if evaluation.match[k] < 0 else f"{found}, wall"
        table.add_row(
            str(k),
            evaluation.reference_kinds[k],
            wall if evaluation.as_wall[k] else found,
            fixed(1e3 * float(evaluation.position_error[k]), 1),
            fixed(1e3 * float(evaluation.radius_error[k]), 1),
        )
    return table


def health_table(health: Health) -> Table:
    """Health of a ring, one row per sensor with a remark; findings about the whole ring are not in the table."""
    table = Table(title=f"Health of {health.ring.name}", caption=_health_caption(health))
    for heading in HEALTH_COLUMNS:
        table.add_column(heading, justify="right")
    table.add_column("remark")
    for k in range(health.ring.count):
        expected, detected = (int(column[k].sum()) for column in (health.expected, health.heard))
        table.add_row(
            str(k),
            str(health.direct[k]),
            str(health.cross[k]),
            str(expected),
            fixed(100 * detected / expected if expected else math.nan, 0),
            with_error(1e3 * float(health.offset[k]), 1e3 * float(health.offset_error[k]), digits=1),
            fixed(1e3 * float(health.spread[k, 0]), 1),
            fixed(1e3 * float(health.spread[k, 1]), 1),
            fixed(100 * float(health.repeats[k]), 0),
            with_error(*np.degrees(health.beam_each[k]).tolist(), digits=0),
            with_error(*np.degrees(health.centre[k]).tolist(), digits=0),
            health.remarks[k],
            style="bold red" if health.remarks[k] else None,
        )
    return table


def _health_caption(health: Health) -> str:
    scans = f"{health.scans} scans"
    if health.used < health.scans:
        scans += f", {health.used} of them compared with walls"
    walls = {
        "scans": f"{health.walls} walls from single scans",
        "poses": f"{health.walls} observations of walls by the poses; residuals include errors of the poses",
        "": health.empty,
    }[health.source]
    width, error = np.degrees(health.beam)
    nominal = math.degrees(health.nominal)
    cone = (
        "not enough data to measure the beam width"
        if math.isnan(width)
        else f"beam width {width:.1f} ± {error:.1f} deg"
    )
    noise = "" if math.isnan(health.sigma) else f"; range noise {1e3 * health.sigma:.1f} mm"
    unmeasured = f"not measured: {', '.join(health.unmeasured)}\n" if health.unmeasured else ""
    return (
        f"{scans}; {walls}{noise}\n{cone}, nominal {nominal:.0f} deg\n{unmeasured}"
        "expected, detected: echoes of walls well inside the cones, direct and cross; axis offset: counter-clockwise; "
        "±: one standard deviation"
    )

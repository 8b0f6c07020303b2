"""Tables for a terminal."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.table import Table

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
"""Columns of a table of extracted lines: title, key of ``demo.summary``, digits."""
MAP_COLUMNS = (
    ("", "what", 0),
    ("segments", "segments", 0),
    ("false", "false", 0),
    ("length\n(m)", "length_m", 2),
    ("walls in\nreach", "walls", 0),
    ("of them\nfound", "walls_found", 0),
    ("max Δρ\n(mm)", "rho_max_mm", 1),
    ("RMS Δρ\n(mm)", "rho_rms_mm", 1),
    ("max Δθ\n(deg)", "theta_max_deg", 2),
    ("RMS Δθ\n(deg)", "theta_rms_deg", 2),
)
"""Columns of a table of maps: title, key of ``demo.map_summary``, digits."""


def map_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Segments of maps against true walls, one row a map.

    Args:
        rows: ``what`` was compared, and ``demo.map_summary`` of it.
    """
    sigma = rows[0]["sigma_mm"]
    table = Table(
        title=f"Segments of the office against its true walls, simulated, range noise sigma = {sigma:g} mm",
        caption="false: no wall within 100 mm and 15 deg along half of it; "
        "in reach: walls with 8 or more echoes in one of the scans",
    )
    for column, _, _ in MAP_COLUMNS:
        table.add_column(column, justify="left" if not column else "right")
    for row in rows:
        shown = ("–" if row[key] is None else f"{row[key]:.{digits}f}" for _, key, digits in MAP_COLUMNS[1:])
        table.add_row(row["what"], *shown)
    return table


def deviation_table(rows: Sequence[tuple[str, dict[str, Any]]], *, paper: dict[str, float]) -> Table:
    """Extracted lines against true walls, one row a comparison, the paper's figures last.

    Args:
        rows: what was compared, and ``demo.summary`` of it.
        paper: largest deviations ``rho_max_mm`` and ``theta_max_deg`` that the paper reports.
    """
    sigma = rows[0][1]["sigma_mm"]
    table = Table(
        title=f"Extracted lines against true walls, simulated, range noise sigma = {sigma:g} mm",
        caption="recall: walls with 8 or more echoes in the high-resolution ring that have a line (100 mm, 15 deg)\n"
        "false: lines that are no wall; CRB: Cramer-Rao bound from the wall's own echoes",
    )
    for title, _, _ in LINE_COLUMNS:
        table.add_column(title, justify="right" if title else "left")

    def shown(row: Mapping[str, Any], key: str, digits: int) -> str:
        value = row.get(key)
        return "–" if value is None else f"{value:.{digits}f}"

    for name, row in rows:
        table.add_row(name, *(shown(row, key, digits) for _, key, digits in LINE_COLUMNS[1:]))
    table.add_section()
    known = {"scans": 1, "walls": 3, "lines": 3, **paper}
    blank = (shown(known, key, digits) if key in known else "" for _, key, digits in LINE_COLUMNS[1:])
    table.add_row("the paper, one scan", *blank)
    return table

"""Tables for a terminal."""

from collections.abc import Sequence
from typing import Any

from rich.table import Table


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
    for column in ("", "scans", "echoes\n/scan", "walls", "recall", "lines", "false\n/scan", "at\ncorners"):
        table.add_column(column, justify="left" if not column else "right")
    for quantity, unit in (("ρ", "mm"), ("θ", "deg")):
        for what in (f"max Δ{quantity}\n({unit})", f"RMS Δ{quantity}\n({unit})", f"RMS Δ{quantity}\n/CRB"):
            table.add_column(what, justify="right")

    def shown(value: float | None, digits: int) -> str:
        return "–" if value is None else f"{value:.{digits}f}"

    for name, row in rows:
        table.add_row(
            name,
            str(row["scans"]),
            shown(row["echoes_per_scan"], 1),
            str(row["walls"]),
            shown(row["recall"], 3),
            str(row["lines"]),
            shown(row["false_per_scan"], 2),
            shown(row["false_at_corners_per_scan"], 2),
            *(shown(row[f"rho_{what}"], 1) for what in ("max_mm", "rms_mm", "rms_over_crb")),
            *(shown(row[f"theta_{what}"], 2) for what in ("max_deg", "rms_deg", "rms_over_crb")),
        )
    table.add_section()
    table.add_row(
        "the paper, one scan", "1", "", "3", "", "3", "", "", shown(paper["rho_max_mm"], 1), "", "",
        shown(paper["theta_max_deg"], 2), "", "",
    )  # fmt: skip
    return table

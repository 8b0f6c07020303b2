"""summary."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from rich.table import Table

LOST = 1.0
"""Metres; a run that is worse than this found itself in another place."""


@dataclass(frozen=True)
class Outcome:
    """One run against the truth: metres, radians, milliseconds."""

    scenario: str
    way: str
    failed: str = ""
    """Why there is no result."""
    scans: int = 0
    metres: float = np.nan
    odometry: float = np.nan
    """Absolute trajectory errors (RMS, first poses in one place)."""
    odometry_heading: float = np.nan
    odometry_aligned: float = np.nan
    placed: float = np.nan
    """Share of the scans that got a pose."""
    ate: float = np.nan
    ate_heading: float = np.nan
    aligned: float = np.nan
    """The same of the best alignment, as evo has it."""
    relative: float = np.nan
    """Per metre of way."""
    bound: float = np.nan
    """Of the ATE, by Cramer and Rao."""
    bound_heading: float = np.nan
    nees: float = np.nan
    made: int = 0
    wrong: int = 0
    withdrawn: int = 0
    missed: float = np.nan
    """Share of the walls that were heard that the map does not have."""
    false: float = np.nan
    """Share of the map's length that is no wall."""
    walls: float = np.nan
    """Distance of the map's walls from the true ones (RMS of those within 0.15 m, 10 deg)."""
    walls_bound: float = np.nan
    p50: float = np.nan
    p99: float = np.nan
    first: float = np.nan
    """Milliseconds of the first step, compilation and all."""
    growth: float = np.nan
    """Median time of the last tenth of the steps over that of the second tenth."""
    seconds: float = np.nan


def measures(some: Sequence[Outcome]) -> dict[str, Any]:
    """Over the runs of one scenario and way; errors are root mean squares, counts sums."""
    good = [one for one in some if not one.failed]
    mean = lambda name: _mean([getattr(one, name) for one in good])  # noqa: E731
    squared = lambda name, of: _rms([getattr(one, name) for one in of])  # noqa: E731
    against = [one.ate / one.bound for one in good]
    return {
        "scenario": some[0].scenario,
        "way": some[0].way,
        "runs": len(some),
        "failed": len(some) - len(good),
        "scans": sum(one.scans for one in some),
        "metres": _mean([one.metres for one in some]),
        "odometry_mm": 1e3 * squared("odometry", some),
        "odometry_deg": float(np.degrees(squared("odometry_heading", some))),
        "placed": mean("placed"),
        "ate_mm": 1e3 * squared("ate", good),
        "ate_deg": float(np.degrees(squared("ate_heading", good))),
        "worst_mm": 1e3 * max((one.ate for one in good), default=np.nan),
        "lost": sum(bool(one.ate > LOST) for one in good),
        "tenth": sum(bool(one.ate <= one.odometry / 10) for one in good),
        "aligned_mm": 1e3 * squared("aligned", good),
        "tenth_aligned": sum(bool(one.aligned <= one.odometry_aligned / 10) for one in good),
        "ratio": squared("odometry", good) / squared("ate", good) if good else np.nan,
        "bound_mm": 1e3 * squared("bound", some),
        "bound_deg": float(np.degrees(squared("bound_heading", some))),
        "per_bound": _median(against),
        "nees": mean("nees"),
        "nees_median": _median([one.nees for one in good]),
        "made": sum(one.made for one in good),
        "wrong": sum(one.wrong for one in good),
        "withdrawn": sum(one.withdrawn for one in good),
        "walls_mm": 1e3 * squared("walls", good),
        "walls_bound_mm": 1e3 * squared("walls_bound", some),
        "missed": mean("missed"),
        "false": mean("false"),
        "p50": _median([one.p50 for one in good]),
        "p99": max((one.p99 for one in good), default=np.nan),
        "growth": mean("growth"),
        "seconds": sum(one.seconds for one in good),
        "why": next((one.failed for one in some if one.failed), ""),
        "each": [asdict(one) for one in some],
    }


def _rms(values: Sequence[float] | np.ndarray) -> float:
    known = np.asarray(values, dtype=float)
    known = known[np.isfinite(known)]
    return float(np.sqrt(np.mean(np.square(known)))) if len(known) else np.nan


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else np.nan


def _median(values: Sequence[float]) -> float:
    known = [value for value in values if not np.isnan(value)]
    return float(np.median(known)) if known else np.nan


COLUMNS = {
    "runs": ("runs", 0),
    "failed": ("failed", 0),
    "m": ("metres", 0),
    "odo. mm": ("odometry_mm", 0),
    "deg": ("odometry_deg", 2),
    "placed %": ("placed", 0),
    "ATE mm": ("ate_mm", 1),
    "deg ": ("ate_deg", 2),
    "worst": ("worst_mm", 0),
    "lost": ("lost", 0),
    "better": ("ratio", 1),
    "tenth": ("tenth", 0),
    "best mm": ("aligned_mm", 1),
    "tenth ": ("tenth_aligned", 0),
    "CRB mm": ("bound_mm", 1),
    "deg  ": ("bound_deg", 2),
    "/CRB": ("per_bound", 2),
    "NEES": ("nees", 2),
    "med.": ("nees_median", 2),
    "made": ("made", 0),
    "wrong": ("wrong", 0),
    "withdr.": ("withdrawn", 0),
    "walls mm": ("walls_mm", 1),
    "CRB": ("walls_bound_mm", 1),
    "missed %": ("missed", 0),
    "false %": ("false", 0),
    "p50 ms": ("p50", 1),
    "p99": ("p99", 1),
    "grows": ("growth", 2),
    "s": ("seconds", 0),
}
"""Heading, name in ``measures``, digits."""


def table(told: dict[str, Any]) -> Table:
    """What is printed, from what the JSON file holds."""
    v, s = told["versions"], told["settings"]
    shown = Table(
        title=f"SLAM, paper's ring, sigma {1e3 * s['sigma']:g} mm, odometry {100 * s['distance']:g} % and "
        f"{np.degrees(s['turn']):g} deg after 1 m",
        caption="ATE: RMS over scans and runs, first poses in one place; worst, lost: of the runs, lost beyond 1 m; "
        "better: odometry over ATE; tenth: runs whose ATE is at most a tenth of odometry's; best: ATE of the best "
        "alignment, and the tenth of that; CRB: what is possible; /CRB: median over the runs; NEES: over degrees of "
        "freedom, mean and median of the runs, 1 is right; closures made, wrong of these, withdrawn; walls: distance "
        "of the map's from the true ones; missed: of the walls that were heard; false: of the map's length; p99: "
        "of the slowest run; grows: last tenth of the steps over the second. Echoes alone: sigma 5 mm, no odometry, "
        "walls after the best alignment. "
        f"jax {v['jax']} on {v['device']}, {v['commit'][:10]}",
    )
    for column in ["", *COLUMNS]:
        shown.add_column(column.rstrip(), justify="right" if column else "left", no_wrap=True)
    for row in told["scenarios"]:
        cells = []
        for heading, (name, digits) in COLUMNS.items():
            value = row[name]
            scale = 100 if heading.endswith("%") else 1
            cells.append("" if value is None else f"{scale * value:.{digits}f}")
        shown.add_row(f"{row['scenario']}, {row['way']}", *cells)
    return shown

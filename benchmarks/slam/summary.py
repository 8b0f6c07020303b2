"""Results of SLAM runs compared with the truth: measures over the runs, and the table."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from rich.table import Table

from benchmarks.aggregates import mean, median, rms

LOST = 1.0
"""A run with a larger error (ATE, metres) counts as lost."""


@dataclass(frozen=True)
class Outcome:
    """One run compared with the truth: metres, radians, milliseconds."""

    scenario: str
    variant: str
    """Name in ``VARIANTS``, or ``localized``."""
    failed: str = ""
    """Error message if there is no result."""
    scans: int = 0
    metres: float = np.nan
    """Length of the trajectory."""
    odometry: float = np.nan
    """Absolute trajectory error of the odometry (RMS), first poses aligned."""
    odometry_heading: float = np.nan
    odometry_aligned: float = np.nan
    """Absolute trajectory error of the odometry after the best alignment."""
    placed: float = np.nan
    """Share of the scans with a pose."""
    ate: float = np.nan
    """Absolute trajectory error (RMS), first poses aligned."""
    ate_heading: float = np.nan
    aligned: float = np.nan
    """Absolute trajectory error after the best alignment, as in evo."""
    relative: float = np.nan
    """Relative pose error per metre."""
    bound: float = np.nan
    """Cramer-Rao bound of ``ate``."""
    bound_heading: float = np.nan
    nees: float = np.nan
    """Normalized estimation error squared per degree of freedom; 1 is consistent."""
    made: int = 0
    """Accepted loop closures."""
    wrong: int = 0
    """Accepted loop closures that contradict the truth."""
    withdrawn: int = 0
    """Withdrawn loop closures."""
    missed: float = np.nan
    """Share of the walls with echoes that are missing in the map."""
    false: float = np.nan
    """Share of the length of the map without a true wall."""
    walls: float = np.nan
    """Distance of the walls of the map from the true ones (RMS of those within 0.15 m, 10 deg)."""
    walls_bound: float = np.nan
    p50: float = np.nan
    """Median of the durations of the steps, milliseconds."""
    p99: float = np.nan
    """99th percentile of the durations of the steps, milliseconds."""
    first: float = np.nan
    """Milliseconds of the first step, with compilation."""
    growth: float = np.nan
    """Median duration of the last tenth of the steps divided by that of the second tenth."""
    seconds: float = np.nan


def measures(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Measures over the runs of one scenario and variant; errors are root mean squares, counts are sums."""
    successful = [one for one in outcomes if not one.failed]

    def mean_of(name: str) -> float:
        return mean([getattr(one, name) for one in successful])

    def rms_of(name: str, runs: Sequence[Outcome]) -> float:
        return rms([getattr(one, name) for one in runs])

    ratios = [one.ate / one.bound for one in successful]
    return {
        "scenario": outcomes[0].scenario,
        "way": outcomes[0].variant,
        "runs": len(outcomes),
        "failed": len(outcomes) - len(successful),
        "scans": sum(one.scans for one in outcomes),
        "metres": mean([one.metres for one in outcomes]),
        "odometry_mm": 1e3 * rms_of("odometry", outcomes),
        "odometry_deg": float(np.degrees(rms_of("odometry_heading", outcomes))),
        "placed": mean_of("placed"),
        "ate_mm": 1e3 * rms_of("ate", successful),
        "ate_deg": float(np.degrees(rms_of("ate_heading", successful))),
        "worst_mm": 1e3 * max((one.ate for one in successful), default=np.nan),
        "lost": sum(bool(one.ate > LOST) for one in successful),
        "tenth": sum(bool(one.ate <= one.odometry / 10) for one in successful),
        "aligned_mm": 1e3 * rms_of("aligned", successful),
        "tenth_aligned": sum(bool(one.aligned <= one.odometry_aligned / 10) for one in successful),
        "ratio": rms_of("odometry", successful) / rms_of("ate", successful) if successful else np.nan,
        "bound_mm": 1e3 * rms_of("bound", outcomes),
        "bound_deg": float(np.degrees(rms_of("bound_heading", outcomes))),
        "per_bound": median(ratios),
        "nees": mean_of("nees"),
        "nees_median": median([one.nees for one in successful]),
        "made": sum(one.made for one in successful),
        "wrong": sum(one.wrong for one in successful),
        "withdrawn": sum(one.withdrawn for one in successful),
        "walls_mm": 1e3 * rms_of("walls", successful),
        "walls_bound_mm": 1e3 * rms_of("walls_bound", outcomes),
        "missed": mean_of("missed"),
        "false": mean_of("false"),
        "p50": median([one.p50 for one in successful]),
        "p99": max((one.p99 for one in successful), default=np.nan),
        "growth": mean_of("growth"),
        "seconds": sum(one.seconds for one in successful),
        "why": next((one.failed for one in outcomes if one.failed), ""),
        "each": [asdict(one) for one in outcomes],
    }


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
"""Heading: name in ``measures``, digits."""


def table(content: dict[str, Any]) -> Table:
    """Table to print, from the content of the JSON file."""
    v, s = content["versions"], content["settings"]
    shown = Table(
        title=f"SLAM, paper's ring, sigma {1e3 * s['sigma']:g} mm, odometry {100 * s['distance']:g} % and "
        f"{np.degrees(s['turn']):g} deg after 1 m",
        caption="ATE: RMS over scans and runs, first poses aligned; worst: of the runs; lost: runs beyond 1 m; better: "
        "odometry divided by ATE; tenth: runs whose ATE is at most a tenth of the odometry's; best: ATE after the best "
        "alignment, and its tenth; CRB: Cramer-Rao bound; /CRB: median over the runs; NEES: per degree of freedom, "
        "mean and median of the runs, 1 is consistent; closures made, wrong, withdrawn; walls: distance of the "
        "map's walls from the true ones; missed: of the walls with echoes; false: of the map's length; p99: of the "
        "slowest run; grows: last tenth of the steps divided by the second. Echoes alone: sigma 5 mm, no odometry, "
        "walls after the best alignment. "
        f"jax {v['jax']} on {v['device']}, {(v['commit'] or 'no commit')[:10]}",
    )
    for column in ["", *COLUMNS]:
        shown.add_column(column.rstrip(), justify="right" if column else "left", no_wrap=True)
    for row in content["scenarios"]:
        cells = []
        for heading, (name, digits) in COLUMNS.items():
            value = row[name]
            scale = 100 if heading.endswith("%") else 1
            cells.append("" if value is None else f"{scale * value:.{digits}f}")
        shown.add_row(f"{row['scenario']}, {row['way']}", *cells)
    return shown

"""summary."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from rich.table import Table

from benchmarks.calibration.trials import (
    SCANS,
    SIGMA,
)

CONVERGED = 3.0
"""Root mean square of the errors over that of the bound, and whitened, up to which a start led to the right ring."""


@dataclass(frozen=True)
class Outcome:
    """One calibration against the truth."""

    seed: int
    failed: str = ""
    """Why there is no result."""
    rms: float = np.nan
    """Of the errors of the relative offsets, metres."""
    rms_bound: float = np.nan
    """What the bound says of that, metres."""
    whitened: float = np.nan
    """Root mean square of the errors of relative offsets and speed in directions and units in which the bound is 1: a
    sensor of which nothing is known hides nothing."""
    within: float = np.nan
    """Share of these errors within one standard deviation."""
    nees: float = np.nan
    """Of relative offsets and speed, over their degrees of freedom; 1 is right."""
    speed: float = np.nan
    """Relative error of the speed of sound."""
    speed_sd: float = np.nan
    speed_bound: float = np.nan
    mean: float = np.nan
    """Error of the mean offset, metres."""
    mean_free: bool = False
    placed: float = np.nan
    """Share of the scans that were used."""
    worlds: int = 0
    explained: float = np.nan
    """Share of the echoes that reflectors explain."""
    sigma: float = np.nan
    """Noise of the ranges as estimated, metres."""
    seconds: float = np.nan

    @property
    def converged(self) -> bool:
        """Whether this is the right ring."""
        return not self.failed and self.rms < CONVERGED * self.rms_bound and self.whitened < CONVERGED


def _rms(values: Sequence[float] | np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else np.nan


def measures(some: Sequence[Outcome]) -> dict[str, float]:
    """Over all seeds; figures other than shares are of those that gave a result."""
    good = [one for one in some if not one.failed]
    ratio = [one.rms / one.rms_bound for one in good]
    return {
        "seeds": len(some),
        "failed": len(some) - len(good),
        "converged": float(np.mean([one.converged for one in some])),
        "rms_mm": 1e3 * _median([one.rms for one in good]),
        "bound_mm": 1e3 * _median([one.rms_bound for one in good]),
        "per_bound": _rms(ratio),
        "per_bound_median": _median(ratio),
        "per_bound_worst": max(ratio, default=np.nan),
        "whitened": _rms([one.whitened for one in good]),
        "within": _mean([one.within for one in good]),
        "nees": _mean([one.nees for one in good]),
        "nees_median": _median([one.nees for one in good]),
        "nees_worst": max((one.nees for one in good), default=np.nan),
        "speed_percent": 100 * _rms([one.speed for one in good]),
        "speed_per_bound": _rms([one.speed / one.speed_bound for one in good]),
        "speed_per_sd": _rms([one.speed / one.speed_sd for one in good]),
        "mean_mm": 1e3 * _rms([one.mean for one in good]),
        "mean_free": _mean([float(one.mean_free) for one in good]),
        "placed": _mean([one.placed for one in good]),
        "explained": _mean([one.explained for one in good]),
        "seconds": _median([one.seconds for one in good]),
    }


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else np.nan


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if len(values) else np.nan


def growth(rows: Sequence[dict[str, float]]) -> list[float]:
    """Exponents of the processor's time between neighboring numbers of scans; others may use the machine, too."""
    return [float(np.log(b["processor"] / a["processor"]) / np.log(b["scans"] / a["scans"])) for a, b in pairwise(rows)]


def tables(told: dict[str, Any]) -> list[Table]:
    """What is printed, from what the JSON file holds; times where they were taken."""
    v = told["versions"]
    accuracy = Table(
        title=f"Calibration, paper's ring, sigma {1e3 * SIGMA:g} mm, {SCANS} scans in random rooms, 17 in the office",
        caption="RMS, CRB: of range offsets less their mean, median over seeds; /CRB: root mean square over seeds, and "
        "the worst; whitened: the same of all directions, speed too; 1 sd: errors within one standard deviation, 68 is "
        "right; NEES: over degrees of freedom, mean, median and worst, 1 is right; "
        f"conv.: RMS below {CONVERGED:g} CRB, whitened, too; mean: % of seeds in which the mean offset is estimated. "
        f"jax {v['jax']} on {v['device']}, {v['commit'][:10]}",
    )
    columns = ["seeds", "failed", "conv. (%)", "RMS (mm)", "CRB", "/CRB", "worst", "whitened", "1 sd (%)"]
    columns += ["NEES", "med.", "worst", "speed (%)", "/CRB", "/sd", "placed (%)", "echoes (%)", "mean", "s"]
    for column in ["", *columns]:
        accuracy.add_column(column, justify="right" if column else "left", no_wrap=True)
    for got in told["conditions"]:
        two = (_said(got[key]) for key in ("per_bound", "per_bound_worst", "whitened"))
        three = (_said(got[key]) for key in ("nees", "nees_median", "nees_worst"))
        accuracy.add_row(
            f"{got['name']}, {got['place']}",
            *(str(got[key]) for key in ("seeds", "failed")),
            _said(100 * got["converged"], 0),
            *(_said(got["rms_mm"], 3), _said(got["bound_mm"], 3), *two, _percent(got["within"]), *three),
            *(_said(got["speed_percent"], 3), _said(got["speed_per_bound"]), _said(got["speed_per_sd"])),
            *(_percent(got[key]) for key in ("placed", "explained", "mean_free")),
            _said(got["seconds"], 1),
        )
    times = Table(title="Time (s); again: a second call with the same shapes, so that nothing is compiled")
    for column in ("", "scans", "echoes", "placed (%)", "first", "again", "processor", "grows with n to the"):
        times.add_column(column, justify="right" if column else "left")
    for got in told["times"]:
        for row, power in zip(got["rows"], [None, *got["growth"]], strict=True):
            many = str(row["scans"]), str(row["echoes"]), _percent(row["placed"])
            times.add_row(
                got["name"], *many, *(_said(row[key], 1) for key in ("first", "again", "processor")), _said(power)
            )
    return [accuracy, times] if told["times"] else [accuracy]


def _said(value: float | None, digits: int = 2) -> str:
    return "" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def _percent(value: float | None) -> str:
    return "" if value is None else _said(100 * value, 0)

"""Results of calibrations compared with the truth: measures over the seeds, and tables."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from rich.table import Table

from benchmarks.aggregates import mean, median, rms
from benchmarks.calibration.trials import SCANS, SIGMA

CONVERGED = 3.0
"""Maximum ratio of RMS error and bound, and of the whitened error, of a converged calibration."""


@dataclass(frozen=True)
class Outcome:
    """One calibration compared with the truth."""

    seed: int
    """Seed of the trial."""
    failed: str = ""
    """Error message if there is no result."""
    rms: float = np.nan
    """RMS error of the relative offsets, metres."""
    rms_bound: float = np.nan
    """Cramer-Rao bound of ``rms``, metres."""
    whitened: float = np.nan
    """RMS error of relative offsets and speed after whitening with the bound, so that a sensor without information does
    not hide the errors of others."""
    within: float = np.nan
    """Share of the offset errors within one standard deviation."""
    nees: float = np.nan
    """Normalized estimation error squared of relative offsets and speed per degree of freedom; 1 is consistent."""
    speed: float = np.nan
    """Relative error of the speed of sound."""
    speed_sd: float = np.nan
    """Reported standard deviation of ``speed``."""
    speed_bound: float = np.nan
    """Cramer-Rao bound of ``speed``."""
    mean: float = np.nan
    """Error of the mean offset, metres."""
    mean_free: bool = False
    """Whether the mean offset was estimated."""
    placed: float = np.nan
    """Share of the scans that were used."""
    worlds: int = 0
    """Number of maps."""
    explained: float = np.nan
    """Share of the echoes that landmarks explain."""
    sigma: float = np.nan
    """Estimated range noise, metres."""
    seconds: float = np.nan
    """Duration of the calibration."""

    @property
    def converged(self) -> bool:
        """Whether the errors are within ``CONVERGED`` times the bound."""
        return not self.failed and self.rms < CONVERGED * self.rms_bound and self.whitened < CONVERGED


def measures(outcomes: Sequence[Outcome]) -> dict[str, float]:
    """Measures over all seeds; errors and ratios are those of the successful calibrations."""
    successful = [one for one in outcomes if not one.failed]
    ratio = [one.rms / one.rms_bound for one in successful]
    return {
        "seeds": len(outcomes),
        "failed": len(outcomes) - len(successful),
        "converged": float(np.mean([one.converged for one in outcomes])),
        "rms_mm": 1e3 * median([one.rms for one in successful]),
        "bound_mm": 1e3 * median([one.rms_bound for one in successful]),
        "per_bound": rms(ratio),
        "per_bound_median": median(ratio),
        "per_bound_worst": max(ratio, default=np.nan),
        "whitened": rms([one.whitened for one in successful]),
        "within": mean([one.within for one in successful]),
        "nees": mean([one.nees for one in successful]),
        "nees_median": median([one.nees for one in successful]),
        "nees_worst": max((one.nees for one in successful), default=np.nan),
        "speed_percent": 100 * rms([one.speed for one in successful]),
        "speed_per_bound": rms([one.speed / one.speed_bound for one in successful]),
        "speed_per_sd": rms([one.speed / one.speed_sd for one in successful]),
        "mean_mm": 1e3 * rms([one.mean for one in successful]),
        "mean_free": mean([float(one.mean_free) for one in successful]),
        "placed": mean([one.placed for one in successful]),
        "explained": mean([one.explained for one in successful]),
        "seconds": median([one.seconds for one in successful]),
    }


def growth(rows: Sequence[dict[str, float]]) -> list[float]:
    """Exponents of the CPU time between consecutive numbers of scans."""
    return [float(np.log(b["processor"] / a["processor"]) / np.log(b["scans"] / a["scans"])) for a, b in pairwise(rows)]


def tables(content: dict[str, Any]) -> list[Table]:
    """Tables to print, from the content of the JSON file."""
    v = content["versions"]
    accuracy = Table(
        title=f"Calibration, paper's ring, sigma {1e3 * SIGMA:g} mm, {SCANS} scans in random rooms, 17 in the office",
        caption="RMS, CRB: of range offsets minus their mean, median over seeds; /CRB: root mean square over seeds, "
        "and the worst; whitened: error whitened with the bound, including speed; 1 sd: errors within one standard "
        "deviation, 68 is consistent; NEES: per degree of freedom, mean, median and worst, 1 is consistent; "
        f"conv.: RMS and whitened error below {CONVERGED:g} CRB; mean: % of seeds with an estimated mean offset. "
        f"jax {v['jax']} on {v['device']}, {(v['commit'] or 'no commit')[:10]}",
    )
    columns = ["seeds", "failed", "conv. (%)", "RMS (mm)", "CRB", "/CRB", "worst", "whitened", "1 sd (%)"]
    columns += ["NEES", "med.", "worst", "speed (%)", "/CRB", "/sd", "placed (%)", "echoes (%)", "mean", "s"]
    for column in ["", *columns]:
        accuracy.add_column(column, justify="right" if column else "left", no_wrap=True)
    for values in content["conditions"]:
        two = (_number(values[key]) for key in ("per_bound", "per_bound_worst", "whitened"))
        three = (_number(values[key]) for key in ("nees", "nees_median", "nees_worst"))
        accuracy.add_row(
            f"{values['name']}, {values['place']}",
            *(str(values[key]) for key in ("seeds", "failed")),
            _number(100 * values["converged"], 0),
            *(
                _number(values["rms_mm"], 3),
                _number(values["bound_mm"], 3),
                *two,
                _percent(values["within"]),
                *three,
            ),
            *(
                _number(values["speed_percent"], 3),
                _number(values["speed_per_bound"]),
                _number(values["speed_per_sd"]),
            ),
            *(_percent(values[key]) for key in ("placed", "explained", "mean_free")),
            _number(values["seconds"], 1),
        )
    times = Table(
        title="Time (s); again: second call with the same shapes, without compilation; CPU: of the second call"
    )
    for column in ("", "scans", "echoes", "placed (%)", "first", "again", "CPU", "exponent of n"):
        times.add_column(column, justify="right" if column else "left")
    for values in content["times"]:
        for row, exponent in zip(values["rows"], [None, *values["growth"]], strict=True):
            sizes = str(row["scans"]), str(row["echoes"]), _percent(row["placed"])
            times.add_row(
                values["name"],
                *sizes,
                *(_number(row[key], 1) for key in ("first", "again", "processor")),
                _number(exponent),
            )
    return [accuracy, times] if content["times"] else [accuracy]


def _number(value: float | None, digits: int = 2) -> str:
    return "" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def _percent(value: float | None) -> str:
    return "" if value is None else _number(100 * value, 0)

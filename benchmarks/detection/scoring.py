"""Scores of a method: matches with the truth, errors over the Cramer-Rao bound, confusion matrix."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from benchmarks.detection.methods import DetectionResult
from benchmarks.detection.plots import ANSWERS, KINDS
from benchmarks.detection.scenarios import Truth
from jaxsonar.evaluation.line_accuracy import match_lines
from jaxsonar.evaluation.settings import SETTINGS as EVALUATION
from jaxsonar.geometry.se2 import wrap_angle

CLEAR_REFLECTOR = 4
"""Minimum number of echoes of a reflector in the confusion matrix."""


@dataclass(frozen=True)
class Score:
    """Score of a method over several scans. A wall counts if it has ``min_echoes`` echoes."""

    room: Int[np.ndarray, " scans"]
    """Index of the room of each scan."""
    counts: Int[np.ndarray, "scans 4"]
    """Walls, walls found, walls left undecided, false lines."""
    scan: Int[np.ndarray, " matches"]
    """Scan of each wall found."""
    error: Float[np.ndarray, "matches 2"]
    """Signed errors of rho (metres) and theta (radians)."""
    bound: Float[np.ndarray, "matches 2"]
    """Cramer-Rao bound of rho and theta."""
    cov: Float[np.ndarray, "matches 2 2"]
    """Reported covariance; NaN if none."""
    confusion: Int[np.ndarray, "kinds+1 answers"]
    """Confusion matrix: KINDS and "nothing predicted" by ANSWERS."""

    @property
    def nees(self) -> Float[np.ndarray, " reported"]:
        """Normalized estimation errors squared; the mean is 2 if the covariances are right."""
        return nees(self.error, self.cov)

    def measures(self) -> dict[str, float]:
        """All measures by name; NaN if undefined. Names with ``_se`` are standard errors."""
        own = self.room[self.scan]
        walls, found, undecided, false = self.counts.T
        squared = self.nees
        reported = own[np.isfinite(self.cov).all(axis=(1, 2))]
        measures_by_name = {"scans": len(self.room), "walls": int(walls.sum())}
        measures_by_name |= _named("recall", *ratio(found, walls, self.room))
        measures_by_name |= _named("undecided", *ratio(undecided, walls, self.room))
        measures_by_name |= _named("false_per_scan", *ratio(false, np.ones_like(false), self.room))
        for column, (name, scale) in enumerate({"rho_mm": 1e3, "theta_deg": np.degrees(1.0)}.items()):
            error, bound = self.error[:, column], self.bound[:, column]
            measures_by_name |= _named(f"rmse_{name}", *_root(*ratio(error**2, np.ones_like(error), own), scale))
            measures_by_name |= _named(f"rmse_{name}_per_crb", *_root(*ratio(error**2, bound**2, own)))
            measures_by_name[f"median_{name}"] = _quantile(np.abs(error), 0.5) * scale
            measures_by_name[f"crb_{name}"] = _root(*ratio(bound**2, np.ones_like(bound), own), scale)[0]
            measures_by_name[f"p99_{name}_per_crb"] = _quantile(np.abs(error) / bound, 0.99)
        measures_by_name |= _named("nees", *ratio(squared, np.ones_like(squared), reported))
        measures_by_name["nees_median"] = _quantile(squared, 0.5)
        return measures_by_name


def score(truth: list[Truth], reported: list[DetectionResult]) -> Score:
    """Compare the results with the truth, scan by scan."""
    counts, rows, covs = [], [np.zeros((0, 5))], [np.zeros((0, 2, 2))]
    confusion = np.zeros((len(KINDS) + 1, len(ANSWERS)), dtype=int)
    for k, (true, result) in enumerate(zip(truth, reported, strict=True)):
        plane = true.kind == 0
        walls, clear = true.polar[plane], true.echoes[plane] >= EVALUATION.lines.min_echoes
        line, wall = match_lines(result.lines, walls)
        good = clear[wall]
        missed = np.delete(walls, np.append(wall, np.flatnonzero(~clear)), axis=0)
        undecided, _ = match_lines(result.others[result.answers == ANSWERS.index("undecided")], missed)
        counts.append((clear.sum(), good.sum(), len(undecided), len(result.lines) - len(line)))
        line, wall = line[good], wall[good]
        error = result.lines[line] - walls[wall]
        error[:, 1] = wrap_angle(error[:, 1])
        rows.append(np.column_stack([np.full(len(line), k), error, true.bound[plane][wall]]))
        covs.append(result.cov[line])
        confusion += confusion_of(true, result)
    table = np.concatenate(rows)
    return Score(
        room=np.array([true.room for true in truth]),
        counts=np.array(counts),
        scan=table[:, 0].astype(int),
        error=table[:, 1:3],
        bound=table[:, 3:],
        cov=np.concatenate(covs),
        confusion=confusion,
    )


def confusion_of(true: Truth, result: DetectionResult) -> Int[np.ndarray, "kinds+1 answers"]:
    """Confusion matrix of one scan; the last row counts reports without a reflector."""
    polar = np.concatenate([result.lines, result.others])
    answer = np.append(np.zeros(len(result.lines), dtype=int), result.answers)
    table = np.zeros((len(KINDS) + 1, len(ANSWERS)), dtype=int)
    report, reflector = match_lines(polar, true.polar)
    predicted = np.full(len(true.kind), ANSWERS.index("nothing"))
    predicted[reflector] = answer[report]
    clear = true.echoes >= CLEAR_REFLECTOR
    np.add.at(table, (true.kind[clear], predicted[clear]), 1)
    np.add.at(table[len(KINDS)], np.delete(answer, report), 1)
    return table


def nees(error: Float[np.ndarray, "errors 2"], cov: Float[np.ndarray, "errors 2 2"]) -> Float[np.ndarray, " finite"]:
    """Normalized estimation errors squared (NEES) of the lines with a covariance."""
    some = np.isfinite(cov).all(axis=(1, 2))
    return np.einsum("ki,ki->k", error[some], np.linalg.solve(cov[some], error[some, :, None])[..., 0])


def ratio(top: np.ndarray, bottom: np.ndarray, group: Int[np.ndarray, " rows"]) -> tuple[float, float]:
    """Ratio of two sums, and its standard error if groups of rows are independent (linearized)."""
    if not len(group) or not bottom.sum():
        return float("nan"), float("nan")
    value = top.sum() / bottom.sum()
    rest = np.bincount(group, top - value * bottom)[np.unique(group)]
    spread = np.sqrt((rest**2).sum() * len(rest) / (len(rest) - 1)) if len(rest) > 1 else float("nan")
    return float(value), float(spread / bottom.sum())


def _root(value: float, error: float, scale: float = 1.0) -> tuple[float, float]:
    """Square root of a value, with its standard error."""
    root = float(np.sqrt(value))
    return scale * root, scale * error / (2 * root) if root else float("nan")


def _named(name: str, value: float, error: float) -> dict[str, float]:
    return {name: value, f"{name}_se": error}


def _quantile(values: np.ndarray, share: float) -> float:
    return float(np.quantile(values, share)) if len(values) else float("nan")


def answers(confusion: Int[np.ndarray, "kinds+1 answers"]) -> dict[str, float]:
    """Rates of a confusion matrix: correct among decided; undecided and missed among all reflectors."""
    table, kinds = confusion[: len(KINDS)], len(KINDS)
    decided, total = int(table[:, :kinds].sum()), int(table.sum())
    right = int(np.trace(table[:, :kinds]))
    share = right / decided if decided else float("nan")
    return {
        "reflectors": total,
        "right": share,
        "right_se": float(np.sqrt(share * (1 - share) / decided)) if decided else float("nan"),
        "undecided": int(table[:, ANSWERS.index("undecided")].sum()) / total,
        "nothing": int(table[:, ANSWERS.index("nothing")].sum()) / total,
    }


def worst_of_three(found: Score) -> dict[str, float]:
    """Quantiles of the largest deviation of three walls, over scans in which all were found."""
    full = np.flatnonzero(np.bincount(found.scan, minlength=len(found.room)) == 3)
    worst = np.abs(found.error[np.isin(found.scan, full)]).reshape(-1, 3, 2).max(axis=1)
    measures_by_name = {"scans": len(found.room), "all_found": len(full) / len(found.room)}
    for column, (name, scale) in enumerate({"rho_mm": 1e3, "theta_deg": np.degrees(1.0)}.items()):
        measures_by_name |= {f"{name}_p{share}": _quantile(worst[:, column], share / 100) * scale for share in (50, 90)}
    return measures_by_name

"""scoring."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from benchmarks.detection.methods import Reported
from benchmarks.detection.plots import ANSWERS
from benchmarks.detection.scenarios import Truth
from jaxsonar.evaluation.line_accuracy import match_lines
from jaxsonar.evaluation.settings import SETTINGS as EVALUATION
from jaxsonar.geometry.se2 import wrap_angle

CLEAR_REFLECTOR = 4
"""Echoes from which on a reflector counts in the confusion of kinds."""


@dataclass(frozen=True)
class Score:
    """What a method made of a number of scans."""

    room: Int[np.ndarray, " scans"]
    counts: Int[np.ndarray, "scans 4"]
    """Walls with CLEAR_ECHOES or more, how many of them were found, and left undecided; false lines."""
    scan: Int[np.ndarray, " matches"]
    """Of each wall found; walls with CLEAR_ECHOES or more only, here and below."""
    error: Float[np.ndarray, "matches 2"]
    """Signed, in rho (metres) and theta (radians)."""
    bound: Float[np.ndarray, "matches 2"]
    """CRB of the same."""
    cov: Float[np.ndarray, "matches 2 2"]
    """As reported; NaN where it was not."""
    confusion: Int[np.ndarray, "4 5"]
    """KINDS and nothing against ANSWERS: reflectors with CLEAR_REFLECTOR echoes or more, and reports of nothing."""

    @property
    def nees(self) -> Float[np.ndarray, " reported"]:
        """Squared errors in units of the reported covariance, both dimensions together; mean 2 if it is right."""
        return nees(self.error, self.cov)

    def measures(self) -> dict[str, float]:
        """Everything that is told of it; NaN where there is nothing to tell, _se are standard errors."""
        own = self.room[self.scan]
        walls, found, undecided, false = self.counts.T
        squared = self.nees
        reported = own[np.isfinite(self.cov).all(axis=(1, 2))]
        told = {"scans": len(self.room), "walls": int(walls.sum())}
        told |= _named("recall", *ratio(found, walls, self.room))
        told |= _named("undecided", *ratio(undecided, walls, self.room))
        told |= _named("false_per_scan", *ratio(false, np.ones_like(false), self.room))
        for column, (name, scale) in enumerate({"rho_mm": 1e3, "theta_deg": np.degrees(1.0)}.items()):
            error, bound = self.error[:, column], self.bound[:, column]
            told |= _named(f"rmse_{name}", *_root(*ratio(error**2, np.ones_like(error), own), scale))
            told |= _named(f"rmse_{name}_per_crb", *_root(*ratio(error**2, bound**2, own)))
            told[f"median_{name}"] = _quantile(np.abs(error), 0.5) * scale
            told[f"crb_{name}"] = _root(*ratio(bound**2, np.ones_like(bound), own), scale)[0]
            told[f"p99_{name}_per_crb"] = _quantile(np.abs(error) / bound, 0.99)
        told |= _named("nees", *ratio(squared, np.ones_like(squared), reported))
        told["nees_median"] = _quantile(squared, 0.5)
        return told


def score(truth: list[Truth], reported: list[Reported]) -> Score:
    """Hold what was reported against the truth, scan by scan."""
    counts, rows, covs = [], [np.zeros((0, 5))], [np.zeros((0, 2, 2))]
    confusion = np.zeros((4, 5), dtype=int)
    for k, (true, said) in enumerate(zip(truth, reported, strict=True)):
        plane = true.kind == 0
        walls, clear = true.place[plane], true.heard[plane] >= EVALUATION.lines.min_echoes
        line, wall = match_lines(said.lines, walls)
        good = clear[wall]
        missed = np.delete(walls, np.append(wall, np.flatnonzero(~clear)), axis=0)
        undecided, _ = match_lines(said.others[said.answers == ANSWERS.index("undecided")], missed)
        counts.append((clear.sum(), good.sum(), len(undecided), len(said.lines) - len(line)))
        line, wall = line[good], wall[good]
        error = said.lines[line] - walls[wall]
        error[:, 1] = wrap_angle(error[:, 1])
        rows.append(np.column_stack([np.full(len(line), k), error, true.bound[plane][wall]]))
        covs.append(said.cov[line])
        confusion += confusion_of(true, said)
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


def confusion_of(true: Truth, said: Reported) -> Int[np.ndarray, "4 5"]:
    """Kinds of one scan's reflectors (rows) against what was reported there; the last row: where there is nothing."""
    place = np.concatenate([said.lines, said.others])
    answer = np.append(np.zeros(len(said.lines), dtype=int), said.answers)
    table = np.zeros((4, 5), dtype=int)
    report, reflector = match_lines(place, true.place)
    there = np.full(len(true.kind), ANSWERS.index("nothing"))
    there[reflector] = answer[report]
    clear = true.heard >= CLEAR_REFLECTOR
    np.add.at(table, (true.kind[clear], there[clear]), 1)
    np.add.at(table[3], np.delete(answer, report), 1)
    return table


def nees(error: Float[np.ndarray, "errors 2"], cov: Float[np.ndarray, "errors 2 2"]) -> Float[np.ndarray, " finite"]:
    """Normalised estimation error squared, of those that have a covariance."""
    some = np.isfinite(cov).all(axis=(1, 2))
    return np.einsum("ki,ki->k", error[some], np.linalg.solve(cov[some], error[some, :, None])[..., 0])


def ratio(top: np.ndarray, bottom: np.ndarray, group: Int[np.ndarray, " rows"]) -> tuple[float, float]:
    """Sum over sum, and its standard error if groups of rows are independent (linearised)."""
    if not len(group) or not bottom.sum():
        return float("nan"), float("nan")
    value = top.sum() / bottom.sum()
    rest = np.bincount(group, top - value * bottom)[np.unique(group)]
    spread = np.sqrt((rest**2).sum() * len(rest) / (len(rest) - 1)) if len(rest) > 1 else float("nan")
    return float(value), float(spread / bottom.sum())


def _root(value: float, error: float, scale: float = 1.0) -> tuple[float, float]:
    """Square root of a value with its standard error."""
    root = float(np.sqrt(value))
    return scale * root, scale * error / (2 * root) if root else float("nan")


def _named(name: str, value: float, error: float) -> dict[str, float]:
    return {name: value, f"{name}_se": error}


def _quantile(values: np.ndarray, share: float) -> float:
    return float(np.quantile(values, share)) if len(values) else float("nan")


def answers(confusion: Int[np.ndarray, "4 5"]) -> dict[str, float]:
    """Shares of a table of kinds: right among decided, undecided and nothing among all reflectors."""
    table = confusion[:3]
    decided, total = int(table[:, :3].sum()), int(table.sum())
    right = int(np.trace(table[:, :3]))
    share = right / decided if decided else float("nan")
    return {
        "reflectors": total,
        "right": share,
        "right_se": float(np.sqrt(share * (1 - share) / decided)) if decided else float("nan"),
        "undecided": int(table[:, 3].sum()) / total,
        "nothing": int(table[:, 4].sum()) / total,
    }


def worst_of_three(found: Score) -> dict[str, float]:
    """Quantiles of the worst deviation of three walls, of scans in which all were found."""
    full = np.flatnonzero(np.bincount(found.scan, minlength=len(found.room)) == 3)
    worst = np.abs(found.error[np.isin(found.scan, full)]).reshape(-1, 3, 2).max(axis=1)
    told = {"scans": len(found.room), "all_found": len(full) / len(found.room)}
    for column, (name, scale) in enumerate({"rho_mm": 1e3, "theta_deg": np.degrees(1.0)}.items()):
        told |= {f"{name}_p{share}": _quantile(worst[:, column], share / 100) * scale for share in (50, 90)}
    return told

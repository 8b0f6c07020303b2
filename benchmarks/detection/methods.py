"""The methods of the detection benchmark, all with the same interface."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from benchmarks.detection.baselines import PairConsensus, PointHough, arcs_of_scans
from benchmarks.detection.plots import ANSWERS
from jaxsonar import LocalModel, Log, Ring, local_models


@dataclass(frozen=True)
class DetectionResult:
    """Result of a method for one scan, robot frame."""

    lines: Float[np.ndarray, "lines 2"]
    """(rho, theta), metres and radians."""
    cov: Float[np.ndarray, "lines 2 2"]
    """Covariances of the lines; NaN if the method gives none."""
    others: Float[np.ndarray, "others 2"]
    """Distance (metres) and direction (radians) of points and undecided reflectors; of a circle, its nearest point."""
    answers: Int[np.ndarray, " others"]
    """Class of each of them, an index into ANSWERS."""

    @classmethod
    def of_lines(cls, lines: Float[np.ndarray, "lines 2"]) -> "DetectionResult":
        """A result with lines only."""
        return cls(lines, np.full((len(lines), 2, 2), np.nan), np.zeros((0, 2)), np.zeros(0, dtype=int))

    @classmethod
    def of_model(cls, model: LocalModel) -> "DetectionResult":
        """The lines, points and undecided reflectors of a local model."""
        others = [
            (np.hypot(point.x, point.y) - np.nan_to_num(point.radius), np.arctan2(point.y, point.x))
            for point in model.points
        ]
        others += [(one.rho, one.theta) for one in model.undecided]
        answers = [ANSWERS.index(point.kind) for point in model.points]
        answers += [ANSWERS.index("undecided")] * len(model.undecided)
        unknown = np.full((2, 2), np.nan)
        return cls(
            np.array([(line.rho, line.theta) for line in model.lines]).reshape(-1, 2),
            np.array([unknown if line.cov is None else line.cov for line in model.lines]).reshape(-1, 2, 2),
            np.array(others).reshape(-1, 2),
            np.array(answers, dtype=int),
        )


Method = Callable[[Ring, Log, float], Iterator[DetectionResult]]
"""Takes a ring, a log and the true range noise (metres); gives a result per scan."""


def hough_method(ring: Ring, log: Log, sigma: float) -> Iterator[DetectionResult]:
    """The paper's method. It does not use the noise."""
    return (DetectionResult.of_model(model) for model in local_models(ring, log, method="hough"))


def ml_method(
    ring: Ring, log: Log, sigma: float, *, known: bool = True, direct: bool = False
) -> Iterator[DetectionResult]:
    """The maximum-likelihood method, with known or estimated noise, from all or only from direct echoes."""
    ring = replace(ring, neighbors=0) if direct else ring
    models = local_models(ring, log, method="ml", sigma=sigma if known else None)
    return (DetectionResult.of_model(model) for model in models)


def baseline_method(
    ring: Ring, log: Log, sigma: float, *, baseline: PointHough | PairConsensus
) -> Iterator[DetectionResult]:
    """A baseline, scan by scan."""
    return (DetectionResult.of_lines(baseline(arcs, sigma)) for arcs in arcs_of_scans(ring, log))


METHODS: dict[str, Method] = {
    "hough (paper)": hough_method,
    "ml": ml_method,
    "ml, sigma estimated": partial(ml_method, known=False),
    "ml, direct echoes only": partial(ml_method, direct=True),
    "cv2.HoughLinesPointSet": partial(baseline_method, baseline=PointHough()),
    "consensus of pairs": partial(baseline_method, baseline=PairConsensus()),
}

CLASSIFYING_METHODS = ("hough (paper)", "ml", "ml, sigma estimated")
"""Methods that classify reflectors; they run on the scans with one reflector."""

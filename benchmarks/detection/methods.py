"""methods."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from benchmarks.detection.baselines import PairConsensus, PointHough, arcs_of_scans
from benchmarks.detection.plots import ANSWERS
from jaxsonar import LocalModel, Log, Ring, local_models


@dataclass(frozen=True)
class Reported:
    """What a method says of one scan, robot frame."""

    lines: Float[np.ndarray, "lines 2"]
    """(rho, theta), metres and radians."""
    cov: Float[np.ndarray, "lines 2 2"]
    """Of those; NaN where the method gives none."""
    others: Float[np.ndarray, "others 2"]
    """Distance and direction of what is no line, or not decided."""
    answers: Int[np.ndarray, " others"]
    """Which of ANSWERS each of them is."""

    @classmethod
    def of_lines(cls, lines: Float[np.ndarray, "lines 2"]) -> "Reported":
        """Nothing but lines."""
        return cls(lines, np.full((len(lines), 2, 2), np.nan), np.zeros((0, 2)), np.zeros(0, dtype=int))

    @classmethod
    def of_model(cls, model: LocalModel) -> "Reported":
        """Lines, points and undecided reflectors of a local model."""
        others = [(np.hypot(point.x, point.y), np.arctan2(point.y, point.x)) for point in model.points]
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


Method = Callable[[Ring, Log, float], Iterator[Reported]]


def by_hough(ring: Ring, log: Log, sigma: float) -> Iterator[Reported]:
    """The paper's way; it does not use the noise."""
    return (Reported.of_model(model) for model in local_models(ring, log, method="hough"))


def by_ml(ring: Ring, log: Log, sigma: float, *, known: bool = True, direct: bool = False) -> Iterator[Reported]:
    """Most likely reflectors, with the noise or without it, from all echoes or from direct ones."""
    ring = replace(ring, neighbors=0) if direct else ring
    models = local_models(ring, log, method="ml", sigma=sigma if known else None)
    return (Reported.of_model(model) for model in models)


def by_peer(ring: Ring, log: Log, sigma: float, *, peer: PointHough | PairConsensus) -> Iterator[Reported]:
    """Lines of a peer, scan by scan."""
    return (Reported.of_lines(peer(arcs, sigma)) for arcs in arcs_of_scans(ring, log))


METHODS: dict[str, Method] = {
    "hough (paper)": by_hough,
    "ml": by_ml,
    "ml, sigma estimated": partial(by_ml, known=False),
    "ml, direct echoes only": partial(by_ml, direct=True),
    "cv2.HoughLinesPointSet": partial(by_peer, peer=PointHough()),
    "consensus of pairs": partial(by_peer, peer=PairConsensus()),
}

METHODS_THAT_TELL_KINDS = ("hough (paper)", "ml", "ml, sigma estimated")
"""Methods that single reflectors are shown to."""

"""From the echoes of a batch of scans to the reflectors that explain them best: method "ml"."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxsonar import kernels
from jaxsonar.detection.hough_detector import Lines, arcs_of, pieces_of
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.echo_batches import FlatEchoes, Step
from jaxsonar.sensors.ring import Ring

DECIDED = 0.7
"""Probability from which on a reflector is said to be a wall, a corner or an edge."""
LEAST_SIGMA = kernels.Expectations().least_sigma
"""Metres; ranges are single precision."""
KINDS = ("plane", "corner", "edge")
"""Names of ``kernels.PLANE``, ``kernels.CORNER`` and ``kernels.EDGE``."""


class Explained(NamedTuple):
    """One step's scans with their reflectors, as NumPy arrays."""

    step: Step
    found: kernels.Explanation
    """(scans, reflectors, ...); those with the most evidence first."""
    decided: np.ndarray
    """(scans, reflectors) kind that the evidence decides for; -1 where it does not, or where there is no reflector."""

    @property
    def lines(self) -> Lines:
        """The walls alone, as ``extract_lines`` gives them."""
        wall = self.decided == kernels.PLANE
        order = np.argsort(~wall, axis=1, kind="stable")[:, : int(wall.sum(axis=1).max(initial=0))]
        found, wall = self.found, np.take_along_axis(wall, order, axis=1)

        def sorted_(values: Any, filler: float | int = np.nan) -> np.ndarray:
            shape = (..., *(None,) * (values.ndim - 2))
            return np.where(wall[shape], np.take_along_axis(values, order[shape], axis=1), filler)

        rho, theta = np.moveaxis(sorted_(found.parameters), -1, 0)
        return Lines(
            rho=rho,
            theta=theta,
            votes=sorted_(found.evidence.astype(np.float64)),
            echoes=sorted_(found.involved.sum(axis=-1), 0).astype(np.int64),
            segments=sorted_(found.segment),
            cov=sorted_(found.covariance),
        )


def explained(
    ring: Ring,
    echoes: FlatEchoes,
    settings: kernels.HoughSettings,
    sigma: float | None,
    arcs: kernels.RingArcs | None = None,
) -> Iterator[Explained]:
    """The reflectors of every scan, step by step over a batch.

    Args:
        ring: the sensors.
        echoes: of single scans.
        settings: of the Hough step that gives the candidates.
        sigma: noise of the ranges, metres; estimated for each scan if None.
        arcs: of the ring's paths, where they are not those of a ring at rest.
    """
    expected = kernels.Expectations()
    arcs = arcs_of(ring, settings) if arcs is None else arcs
    noise = np.float32(np.nan if sigma is None else sigma)
    for step in echoes.steps(settings.cells, pieces=pieces_of(ring, settings), dear=True):
        found = kernels.explain(arcs, step.packed, noise, settings=settings, expected=expected)
        real = slice(0, len(step.scans))  # the rest is padding
        found = jax.tree.map(lambda leaf, rows=real: np.asarray(leaf)[rows], found)
        sure = (found.kind >= 0) & (found.probability.max(axis=-1) >= DECIDED)
        # The kind that explains most must be the likeliest one, too: its parameters are those that were fitted.
        sure &= found.probability.argmax(axis=-1) == found.kind
        # From direct echoes alone corner and edge are the same; only where walls are would tell, and that is a guess.
        cross = (found.involved & (ring.paths[step.path, 0] != ring.paths[step.path, 1])[real, None]).any(axis=-1)
        sure &= (found.kind == kernels.PLANE) | cross
        yield Explained(step, found, np.where(sure, found.kind, -1))


def check_sigma(sigma: float | None) -> None:
    """Raise a SonarError for a noise that no ring has."""
    if sigma is not None and not LEAST_SIGMA <= sigma <= 1:
        raise SonarError(f"sigma {sigma:g} m; allowed are {LEAST_SIGMA:g} to 1 m, or none for an estimate")

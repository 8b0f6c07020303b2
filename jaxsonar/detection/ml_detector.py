"""Method "ml": from the echoes of a batch of scans to the most likely reflectors."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Int

from jaxsonar import kernels
from jaxsonar.detection.arc_tables import arc_tables
from jaxsonar.detection.local_model import Lines
from jaxsonar.detection.settings import SETTINGS
from jaxsonar.scans.echo_batches import SLOW_SCANS, EchoBatch, pack
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.sensors.ring import Ring


class DetectionBatch(NamedTuple):
    """Reflectors of a batch of scans, as NumPy arrays."""

    batch: EchoBatch
    """The echoes."""
    found: kernels.Detections
    """(scans, reflectors, ...) reflectors, those with the largest log-likelihood ratio first."""
    decided: Int[np.ndarray, "scans reflectors"]
    """Kind of each reflector if its posterior probability suffices; -1 if not, or if there is no reflector."""

    @property
    def lines(self) -> Lines:
        """The walls alone, in the form of ``extract_lines``."""
        wall = self.decided == kernels.PLANE
        order = np.argsort(~wall, axis=1, kind="stable")[:, : int(wall.sum(axis=1).max(initial=0))]
        found, wall = self.found, np.take_along_axis(wall, order, axis=1)

        def ordered(values: Any, fill: float | int = np.nan) -> np.ndarray:
            shape = (..., *(None,) * (values.ndim - 2))
            return np.where(wall[shape], np.take_along_axis(values, order[shape], axis=1), fill)

        rho, theta = np.moveaxis(ordered(found.parameters), -1, 0)
        return Lines(
            rho=rho,
            theta=theta,
            votes=ordered(found.evidence.astype(np.float64)),
            echoes=ordered(found.involved.sum(axis=-1), 0).astype(np.int64),
            segments=ordered(found.segment),
            cov=ordered(found.covariance),
        )


def ml_detections(
    ring: Ring, echoes: FlatEchoes, settings: kernels.HoughSettings, sigma: float | None
) -> Iterator[DetectionBatch]:
    """Reflectors of every scan by maximum likelihood over the ranges, batch by batch.

    Args:
        ring: the sensors.
        echoes: echoes of single scans.
        settings: settings of the Hough step that gives the candidates.
        sigma: standard deviation of the ranges, metres; estimated for each scan if None.
    """
    ml_settings = kernels.DetectionSettings()
    tables = arc_tables(ring, settings)
    noise = np.float32(np.nan if sigma is None else sigma)
    for batch in pack(ring, echoes, settings.cells, pieces=tables.pieces, policy=SLOW_SCANS):
        # Candidates from the accumulator; fit each as plane, corner and edge; select by evidence. One compiled call.
        found = kernels.detect_ml(tables.arcs, batch.packed, noise, hough_settings=settings, settings=ml_settings)
        rows = slice(0, len(batch.scans))  # without padding
        found = jax.tree.map(lambda leaf, rows=rows: np.asarray(leaf)[rows], found)
        # A kind is decided if its posterior probability suffices and its parameters are those that were fitted.
        least = np.where(found.kind == kernels.PLANE, SETTINGS.min_wall_probability, SETTINGS.min_probability)
        decided = (found.kind >= 0) & (found.probability.max(axis=-1) >= least)
        likely = np.array(kernels.REFLECTOR_KINDS)[found.probability.argmax(axis=-1)]
        decided &= likely == found.kind
        # One scan decides on a circle only if it determines the radius.
        radius, variance = found.circle[..., 2], found.circle_covariance[..., 2, 2]
        decided &= (found.kind != kernels.CIRCLE) | (np.sqrt(variance) <= SETTINGS.max_radius_error * radius)
        # Direct echoes alone cannot distinguish a corner from an edge; only the prior would decide.
        cross = (found.involved & (ring.paths[batch.path, 0] != ring.paths[batch.path, 1])[rows, None]).any(axis=-1)
        decided &= (found.kind == kernels.PLANE) | cross
        yield DetectionBatch(batch, found, np.where(decided, found.kind, -1))

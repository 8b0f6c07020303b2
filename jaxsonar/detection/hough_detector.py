"""Method "hough": from the echoes of a batch of scans to straight lines (paper, section 4)."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.detection.arc_tables import arc_tables
from jaxsonar.detection.component_centroids import Centroids, component_centroids
from jaxsonar.detection.connected_components import label_components
from jaxsonar.detection.local_model import Lines
from jaxsonar.scans.echo_batches import EchoBatch, pack
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class LineCandidate:
    """One line of one scan with the echoes that contributed to it."""

    rho: float
    """Distance, metres."""
    theta: float
    """Direction of the normal, radians."""
    segment: Float[np.ndarray, "2 2"]
    """Endpoints, metres."""
    votes: int
    """Number of arc points in its component."""
    echoes: Int[np.ndarray, " echoes"]
    """Columns of the batch that hold its echoes, ascending."""


@dataclass(frozen=True)
class HoughBatch:
    """Lines of a batch of scans, filtered and sorted, with the echoes involved in each."""

    batch: EchoBatch
    """The echoes; rows beyond ``batch.scans`` are padding."""
    lines: Lines
    """Lines of each scan, strongest first."""
    involved: Bool[np.ndarray, "scans lines echoes"]
    """Echoes involved in each line."""
    components: Int[np.ndarray, " scans"]
    """Number of connected components, including those that were dropped because of too few echoes."""

    @property
    def candidates(self) -> list[list[LineCandidate]]:
        """The lines of each scan one by one, strongest first."""
        lines = self.lines
        return [
            [
                LineCandidate(
                    rho=float(lines.rho[row, k]),
                    theta=float(lines.theta[row, k]),
                    segment=lines.segments[row, k],
                    votes=int(lines.votes[row, k]),
                    echoes=np.flatnonzero(self.involved[row, k]),
                )
                for k in range(int(np.count_nonzero(lines.echoes[row])))
            ]
            for row in range(len(self.batch.scans))
        ]


def hough_detections(ring: Ring, echoes: FlatEchoes, settings: kernels.HoughSettings) -> Iterator[HoughBatch]:
    """Lines of every scan by the algorithm of the paper's section 4, batch by batch.

    Oracle: ``hough_lines`` of tests/support/oracles.py.

    Args:
        ring: the sensors.
        echoes: echoes of scans or of windows.
        settings: accumulator, low pass, threshold and smallest number of echoes.
    """
    tables = arc_tables(ring, settings)
    for batch in pack(ring, echoes, settings.cells, pieces=tables.pieces):
        # Represent each echo by equidistant points on its arc; Hough transform the tangent line of each point; count
        # the points in each cell; apply the low pass; compare with the occupancy threshold. One compiled call.
        voted = kernels.vote(tables.arcs, batch.packed, settings=settings)
        # Clusters are regions of cohesive highly occupied cells: a connected components analysis.
        labels, counts = label_components(np.asarray(voted.occupied))
        # Lines are the centers of gravity of the points in each cluster, with endpoints from the sensors involved.
        centroids = component_centroids(tables, batch, voted, labels, counts)
        lines, involved = _filter_and_sort(centroids, min_echoes=settings.min_echoes)
        yield HoughBatch(batch, lines, involved, counts[: len(batch.scans)])


def _filter_and_sort(centroids: Centroids, *, min_echoes: int) -> tuple[Lines, Bool[np.ndarray, "scans lines echoes"]]:
    """Lines with enough echoes, strongest first, and the echoes involved in each."""
    echoes = centroids.involved.sum(axis=-1)
    kept = echoes >= min_echoes
    order = np.argsort(np.where(kept, -centroids.votes, 1), axis=1, kind="stable")
    order = order[:, : int(kept.sum(axis=1).max(initial=0))]
    row = np.arange(len(order))[:, None]
    kept = kept[row, order]
    lines = Lines(
        rho=np.where(kept, centroids.rho[row, order], np.nan),
        theta=np.where(kept, centroids.theta[row, order], np.nan),
        votes=np.where(kept, centroids.votes[row, order], np.nan),
        echoes=np.where(kept, echoes[row, order], 0),
        segments=np.where(kept[..., None, None], centroids.segments[row, order], np.nan),
        cov=np.full((*kept.shape, 2, 2), np.nan, np.float32),
    )
    return lines, centroids.involved[row, order]

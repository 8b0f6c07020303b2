"""From the echoes of a batch of scans to candidate lines: the paper's section 4, a comment a step."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.detection.component_centroids import centres_of_gravity
from jaxsonar.detection.connected_components import label_components
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.echo_batches import FlatEchoes, Step
from jaxsonar.sensors.ring import Ring

WINDOW_THRESHOLD = 0.05
"""Threshold for gathered windows, where a fit to the ranges decides and a wall may be seen by one sensor alone."""


@dataclass(frozen=True)
class Lines:
    """Lines of a batch of scans in their robots' frames, strongest first; NaN (0 echoes) where a scan has fewer."""

    rho: Float[np.ndarray, "scans lines"]
    """Distance from the origin, metres, >= 0."""
    theta: Float[np.ndarray, "scans lines"]
    """Direction of the normal, radians, in [-pi, pi)."""
    votes: Float[np.ndarray, "scans lines"]
    """How strong the line is. Method hough: number of arc points in its component; ml: nats of evidence."""
    echoes: Int[np.ndarray, "scans lines"]
    """Number of echoes that have a point in the component, or that the line explains."""
    segments: Float[np.ndarray, "scans lines 2 2"]
    """Endpoints (x, y), metres (paper, section 5)."""
    cov: Float[np.ndarray, "scans lines 2 2"]
    """Covariance of (rho, theta), square metres and radians; NaN where the method gives none (hough)."""


@dataclass(frozen=True)
class Extracted:
    """Lines of one step's scans, sorted and sifted, with the echoes involved in each."""

    step: Step
    """The echoes; its rows may go on with padding."""
    lines: Lines
    involved: Bool[np.ndarray, "scans lines echoes"]
    components: Int[np.ndarray, " scans"]
    """Components of occupied cells, before those with too few echoes were dropped."""

    @property
    def candidates(self) -> list[list["Candidate"]]:
        """The lines of each scan, strongest first."""
        lines = self.lines
        return [
            [
                Candidate(
                    rho=float(lines.rho[row, k]),
                    theta=float(lines.theta[row, k]),
                    segment=lines.segments[row, k],
                    votes=int(lines.votes[row, k]),
                    echoes=np.flatnonzero(self.involved[row, k]),
                )
                for k in np.flatnonzero(lines.echoes[row])
            ]
            for row in range(len(lines.rho))
        ]


class Candidate(NamedTuple):
    """One line of one scan, robot frame."""

    rho: float
    """Distance, metres."""
    theta: float
    """Direction of the normal, radians."""
    segment: Float[np.ndarray, "2 2"]
    """Endpoints, metres."""
    votes: int
    """Arc points in its component."""
    echoes: Int[np.ndarray, " echoes"]
    """Columns of the step's row that hold its echoes."""


def extract(
    ring: Ring, echoes: FlatEchoes, settings: kernels.HoughSettings, arcs: kernels.RingArcs | None = None
) -> Iterator[Extracted]:
    """The paper's section 4 from echoes to lines, step by step over a batch of scans.

    ``arcs`` are given where they are not those of a ring at rest.
    """
    arcs = arcs_of(ring, settings) if arcs is None else arcs
    for step in echoes.steps(settings.cells, pieces=pieces_of(ring, settings)):
        # Echo arcs -> equidistant points -> tangent lines -> votes -> low pass -> threshold, in one compiled step.
        voted = kernels.vote(arcs, step.packed, settings=settings)
        # Clusters are regions of cohesive highly occupied cells.
        labels, counts = label_components(np.asarray(voted.occupied))
        # Centres of gravity of the points in each cluster, and from the sensors involved the extent of each line.
        centres = centres_of_gravity(arcs, step, voted, labels, counts)
        lines, involved = _sift(*centres, min_echoes=settings.min_echoes)
        yield Extracted(step, lines, involved, counts[: len(step.scans)])


def _sift(
    rho: Float[np.ndarray, "scans clusters"],
    theta: Float[np.ndarray, "scans clusters"],
    votes: Int[np.ndarray, "scans clusters"],
    segments: Float[np.ndarray, "scans clusters 2 2"],
    involved: Bool[np.ndarray, "scans clusters echoes"],
    *,
    min_echoes: int,
) -> tuple[Lines, Bool[np.ndarray, "scans lines echoes"]]:
    """Lines with enough echoes, strongest first, and which echoes are involved in each."""
    echoes = involved.sum(axis=-1)
    kept = echoes >= min_echoes
    order = np.argsort(np.where(kept, -votes, 1), axis=1, kind="stable")
    order = order[:, : int(kept.sum(axis=1).max(initial=0))]
    row = np.arange(len(order))[:, None]

    def sifted(values: np.ndarray) -> np.ndarray:
        return values[row, order]

    kept = sifted(kept)
    lines = Lines(
        rho=np.where(kept, sifted(rho), np.nan),
        theta=np.where(kept, sifted(theta), np.nan),
        votes=np.where(kept, sifted(votes), np.nan),
        echoes=np.where(kept, sifted(echoes), 0),
        segments=np.where(kept[..., None, None], sifted(segments), np.nan),
        cov=np.full((*kept.shape, 2, 2), np.nan, np.float32),
    )
    return lines, sifted(involved)


def settings_for(
    ring: Ring, settings: kernels.HoughSettings | None, *, window: float | None = None
) -> kernels.HoughSettings:
    """The settings themselves, or the paper's with as many cells in rho as the ring can reach, at least 100.

    Args:
        ring: the sensors.
        settings: what was asked for, if anything.
        window: length of path that is gathered into one local model, metres.

    Raises:
        SonarError: the given accumulator is too small for lines that this ring can report.
    """
    reach = float(np.linalg.norm(ring.position, axis=1).max() + ring.max_range) + (window or 0.0)
    if settings is None:
        return _reaching(reach, windows=window is not None)
    if settings.max_rho < reach:
        raise SonarError(
            f"settings: rho_cells {settings.rho_cells} x rho_cell {settings.rho_cell:g} m = {settings.max_rho:g} m; "
            f"allowed is {reach:.3f} m or more, the reach of {ring.name!r}"
        )
    return settings


@lru_cache(maxsize=8)
def _reaching(reach: float, *, windows: bool) -> kernels.HoughSettings:
    """The paper's settings for lines up to this distance, metres; asked for with every scan."""
    settings = kernels.HoughSettings(threshold=WINDOW_THRESHOLD) if windows else kernels.HoughSettings()
    return replace(settings, rho_cells=max(settings.rho_cells, int(np.ceil(reach / settings.rho_cell))))


_latest: list[tuple[Ring, kernels.HoughSettings, kernels.RingArcs, Int[np.ndarray, " paths"]]] = []


def arcs_of(ring: Ring, settings: kernels.HoughSettings) -> kernels.RingArcs:
    """Arcs of all paths of a ring; the latest ones are kept, so that a stream of single scans makes them once."""
    return _known(ring, settings)[0]


def pieces_of(ring: Ring, settings: kernels.HoughSettings) -> Int[np.ndarray, " paths"]:
    """Into how many pieces of ``kernels.PIECE`` points the arc of each path is cut; turning a path changes none."""
    return _known(ring, settings)[1]


def _known(ring: Ring, settings: kernels.HoughSettings) -> tuple[kernels.RingArcs, Int[np.ndarray, " paths"]]:
    for known_ring, known_settings, arcs, pieces in tuple(_latest):
        if known_ring is ring and known_settings == settings:
            return arcs, pieces
    points = kernels.points_of_widest_arc(np.asarray(ring.beam), settings)
    arcs = kernels.ring_arcs(ring.sensors, settings=settings, points=points)
    pieces = -(-np.asarray(arcs.arcs.counts).sum(axis=1) // kernels.PIECE)
    _latest[:] = [(ring, settings, arcs, pieces)]
    return arcs, pieces

"""Local models: the straight walls around the robot, from one scan (paper, section 4)."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.hardware.errors import SonarError

from .components import label_components
from .echoes import FlatEchoes, room_for
from .logs import Log, Scan
from .ring import Ring

METHODS = ("hough",)
"""How lines are found; hough is the paper's way."""


@dataclass(frozen=True)
class Lines:
    """Lines of a batch of scans in their robots' frames, strongest first; NaN (0 echoes) where a scan has fewer."""

    rho: Float[np.ndarray, "scans lines"]
    """Distance from the origin, metres, >= 0."""
    theta: Float[np.ndarray, "scans lines"]
    """Direction of the normal, radians, in [-pi, pi)."""
    votes: Float[np.ndarray, "scans lines"]
    """Number of arc points in the line's component."""
    echoes: Int[np.ndarray, "scans lines"]
    """Number of echoes that have a point in the component."""
    segments: Float[np.ndarray, "scans lines 2 2"]
    """Endpoints (x, y), metres (paper, section 5)."""


@dataclass(frozen=True)
class Line:
    """One wall as seen from one scan, robot frame."""

    rho: float
    """Distance from the origin, metres, >= 0."""
    theta: float
    """Direction of the normal, radians, in [-pi, pi)."""
    segment: Float[np.ndarray, "2 2"]
    """Endpoints (x, y): the outermost feet of the involved real and virtual sensors, metres."""
    votes: int
    """Number of arc points in the line's component."""
    echoes: int
    """Number of echoes that have a point in the component."""
    paths: Int[np.ndarray, "paths 2"]
    """(tx, rx) of those echoes: the involved real sensors, and virtual ones where tx and rx differ."""


@dataclass(frozen=True)
class LocalModel:
    """What one scan tells of its surroundings, robot frame."""

    scan: int
    stamp: float
    """Seconds; NaN where the log has none."""
    lines: tuple[Line, ...]
    """Strongest first."""
    empty: str = ""
    """Why there is no line; empty if there is one."""

    def as_json(self) -> dict[str, Any]:
        """One object of the JSON Lines format, plain numbers only."""
        lines = [
            {
                "rho": line.rho,
                "theta": line.theta,
                "segment": line.segment.tolist(),
                "echoes": line.echoes,
                "votes": line.votes,
                "paths": line.paths.tolist(),
            }
            for line in self.lines
        ]
        model = {"scan": self.scan, "stamp": None if np.isnan(self.stamp) else self.stamp, "lines": lines}
        return model | {"empty": self.empty} if self.empty else model


@dataclass(frozen=True)
class _Extracted:
    """Lines of one step's scans, sorted and sifted, with the echoes involved in each."""

    lines: Lines
    involved: Bool[np.ndarray, "scans lines echoes"]
    path: Int[np.ndarray, "scans echoes"]
    reported: Float[np.ndarray, "scans echoes"]
    components: Int[np.ndarray, " scans"]
    """Components of occupied cells, before those with too few echoes were dropped."""


def extract_lines(
    ring: Ring,
    ranges: Float[np.ndarray, "scans paths echoes"],
    *,
    method: str = "hough",
    settings: kernels.HoughSettings | None = None,
) -> Lines:
    """Straight lines around the robot, for a batch of scans (paper, section 4).

    Args:
        ring: the sensors; its ``paths`` give the order of the second axis.
        ranges: (scans, paths, echoes) half path lengths as a log has them, metres, NaN = no echo.
        method: "hough", the paper's way.
        settings: accumulator, low pass and threshold; the paper's, as large as the ring needs, if left out.

    Raises:
        SonarError: another shape, a range that is not positive, an unknown method.
    """
    _check_method(method)
    echoes = FlatEchoes.from_dense(ring, ranges)
    steps = [step.lines for _, step in _extract(ring, echoes, settings_for(ring, settings))]
    return _concatenate(steps)


def local_model(
    ring: Ring, scan: Scan, *, method: str = "hough", settings: kernels.HoughSettings | None = None
) -> LocalModel:
    """The walls around the robot from one scan of a log; arguments and errors as ``local_models``."""
    return next(local_models(ring, scan.as_log(), method=method, settings=settings))


def local_models(
    ring: Ring,
    log: Log,
    *,
    method: str = "hough",
    settings: kernels.HoughSettings | None = None,
    on_left_out: Callable[[int], None] | None = None,
) -> Iterator[LocalModel]:
    """The walls around the robot from every scan of a log, scan by scan, computed in batches.

    Args:
        ring: the sensors.
        log: scans; their poses are not used.
        method: "hough", the paper's way.
        settings: accumulator, low pass and threshold; the paper's, as large as the ring needs, if left out.
        on_left_out: told once how many echoes are of pairs (tx, rx) that this ring does not listen to.

    Raises:
        SonarError: a sensor number that the ring does not have, an unknown method.
    """
    _check_method(method)
    settings = settings_for(ring, settings)
    echoes, left_out = FlatEchoes.from_log(ring, log)
    if left_out and on_left_out is not None:
        on_left_out(left_out)
    return _models(ring, log, echoes, settings)


def _models(ring: Ring, log: Log, echoes: FlatEchoes, settings: kernels.HoughSettings) -> Iterator[LocalModel]:
    paths = ring.paths
    for scans, step in _extract(ring, echoes, settings):
        for row, index in enumerate(range(scans.start, scans.stop)):
            lines = tuple(
                Line(
                    rho=float(step.lines.rho[row, k]),
                    theta=float(step.lines.theta[row, k]),
                    segment=step.lines.segments[row, k],
                    votes=int(step.lines.votes[row, k]),
                    echoes=int(step.lines.echoes[row, k]),
                    paths=paths[np.unique(step.path[row][step.involved[row, k]])],
                )
                for k in np.flatnonzero(step.lines.echoes[row])
            )
            empty = ""
            if not lines:
                corrected = np.asarray(ring.corrected(step.reported[row], *paths[step.path[row]].T))
                heard = int((corrected < ring.max_range).sum())
                empty = _why_empty(heard, int(step.components[row]), settings.min_echoes)
            yield LocalModel(int(log.scan[index]), float(log.stamp[index]), lines, empty)


def settings_for(ring: Ring, settings: kernels.HoughSettings | None) -> kernels.HoughSettings:
    """The settings themselves, or the paper's with as many cells in rho as the ring can reach, at least 100.

    Raises:
        SonarError: the given accumulator is too small for lines that this ring can report.
    """
    reach = float(np.linalg.norm(ring.position, axis=1).max() + ring.max_range)
    if settings is None:
        settings = kernels.HoughSettings()
        needed = int(np.ceil(reach / settings.rho_cell))
        return replace(settings, rho_cells=max(settings.rho_cells, needed))
    if settings.max_rho < reach:
        raise SonarError(
            f"settings: rho_cells {settings.rho_cells} x rho_cell {settings.rho_cell:g} m = {settings.max_rho:g} m; "
            f"allowed is {reach:.3f} m or more, the reach of {ring.name!r}"
        )
    return settings


_latest: list[tuple[Ring, kernels.HoughSettings, kernels.RingArcs]] = []


def arcs_of(ring: Ring, settings: kernels.HoughSettings) -> kernels.RingArcs:
    """Arcs of all paths of a ring; the latest ones are kept, so that a stream of single scans makes them once."""
    for known_ring, known_settings, arcs in tuple(_latest):
        if known_ring is ring and known_settings == settings:
            return arcs
    points = kernels.points_of_widest_arc(np.asarray(ring.beam), settings)
    arcs = kernels.ring_arcs(ring.sensors, settings=settings, points=points)
    _latest[:] = [(ring, settings, arcs)]
    return arcs


def _check_method(method: str) -> None:
    if method not in METHODS:
        raise SonarError(f"method {method!r}; allowed is {' or '.join(METHODS)}")


def _extract(ring: Ring, echoes: FlatEchoes, settings: kernels.HoughSettings) -> Iterator[tuple[slice, _Extracted]]:
    """The paper's section 4 from echoes to lines, step by step over a batch of scans."""
    arcs = arcs_of(ring, settings)
    for step in echoes.steps(settings.cells):
        packed = step.packed
        # Echo arcs -> equidistant points -> tangent lines -> votes -> low pass -> threshold, in one compiled step.
        occupied = kernels.occupied_cells(arcs, packed, settings=settings)
        # Clusters are regions of cohesive highly occupied cells.
        labels, counts = label_components(np.asarray(occupied))
        # Centres of gravity of the points in each cluster, and from the sensors involved the extent of each line.
        size = room_for(int(counts.max(initial=0)), least=16)
        clusters, segments = kernels.cluster_lines(arcs, packed, jnp.asarray(labels), settings=settings, size=size)
        real = slice(0, step.scans.stop - step.scans.start)  # the rest is padding
        columns = (clusters.rho, clusters.theta, clusters.votes, segments, clusters.involved)
        lines, involved = _sift(*(np.asarray(column)[real] for column in columns), min_echoes=settings.min_echoes)
        yield step.scans, _Extracted(lines, involved, step.path[real], step.reported[real], counts[real])


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

    def sifted(values: np.ndarray) -> np.ndarray:
        return np.take_along_axis(values, order.reshape(order.shape + (1,) * (values.ndim - 2)), axis=1)

    kept = sifted(kept)
    lines = Lines(
        rho=np.where(kept, sifted(rho), np.nan),
        theta=np.where(kept, sifted(theta), np.nan),
        votes=np.where(kept, sifted(votes), np.nan),
        echoes=np.where(kept, sifted(echoes), 0),
        segments=np.where(kept[..., None, None], sifted(segments), np.nan),
    )
    return lines, sifted(involved)


def _why_empty(heard: int, components: int, min_echoes: int) -> str:
    if heard == 0:
        return "no echo within the maximum range"
    if heard < min_echoes:
        return f"fewer than {min_echoes} echoes within the maximum range"
    if components == 0:
        return "no cell above the threshold"
    return f"no component with {min_echoes} echoes"


def _concatenate(steps: list[Lines]) -> Lines:
    """One batch from several, with room for as many lines as the scan with the most, at least one."""
    empty = np.zeros((0, 1), np.float32)
    nothing = Lines(empty, empty, empty.astype(np.float64), empty.astype(np.int64), np.zeros((0, 1, 2, 2), np.float32))
    steps = [nothing, *steps]
    most = max(step.rho.shape[1] for step in steps)

    def column(name: str) -> np.ndarray:
        parts = [getattr(step, name) for step in steps]
        filler = 0 if parts[0].dtype.kind == "i" else np.nan
        room = [[(0, 0), (0, most - part.shape[1]), *[(0, 0)] * (part.ndim - 2)] for part in parts]
        wide = [np.pad(part, pad, constant_values=filler) for part, pad in zip(parts, room, strict=True)]
        return np.concatenate(wide)

    return Lines(**{field.name: column(field.name) for field in fields(Lines)})

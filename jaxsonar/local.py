"""Local models: the straight walls around the robot, from one scan (paper, section 4)."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxsonar import kernels
from jaxsonar.hardware.errors import SonarError

from .candidates import Lines as Lines
from .candidates import arcs_of as arcs_of
from .candidates import extract
from .candidates import settings_for as settings_for
from .echoes import FlatEchoes
from .logs import Log, Scan
from .ring import Ring
from .verification import verified
from .windows import Windows, check_window, gather

METHODS = ("hough",)
"""How lines are found; hough is the paper's way."""


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
    scans: tuple[int, ...]
    """Numbers of the scans that those echoes come from: one, unless scans were gathered over a window."""


@dataclass(frozen=True)
class LocalModel:
    """What one scan tells of its surroundings, robot frame."""

    scan: int
    """Number of the scan; of a window's last one, in whose frame the lines are."""
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
    check_method(method)
    echoes = FlatEchoes.from_dense(ring, ranges)
    steps = [step.lines for step in extract(ring, echoes, settings_for(ring, settings))]
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
    window: float | None = None,
    on_left_out: Callable[[int], None] | None = None,
) -> Iterator[LocalModel]:
    """The walls around the robot from every scan of a log, scan by scan, computed in batches.

    Args:
        ring: the sensors.
        log: scans; their poses are used for windows only.
        method: "hough", the paper's way.
        settings: accumulator, low pass and threshold; the paper's, as large as the ring needs, if left out.
        window: gather the scans of this length of path into one local model, metres (``windows.gather``), for rings so
            sparse that one scan cannot carry a line; every scan for itself if left out.
        on_left_out: told once how many echoes are of pairs (tx, rx) that this ring does not listen to.

    Raises:
        SonarError: a sensor number that the ring does not have, an unknown method, a window that is not positive.
    """
    check_method(method)
    check_window(window)
    settings = settings_for(ring, settings, window=window)
    if window is None:
        echoes, left_out = FlatEchoes.from_log(ring, log)
        windows = Windows.of_scans(echoes)
    else:
        windows, left_out = gather(ring, log, length=window)
    if left_out and on_left_out is not None:
        on_left_out(left_out)
    return models_of(ring, log, windows, settings)


def models_of(ring: Ring, log: Log, windows: Windows, settings: kernels.HoughSettings) -> Iterator[LocalModel]:
    """A local model of every window of a log; windows of single scans are the scans themselves."""
    paths = ring.paths
    for extracted in extract(ring, windows.echoes, settings):
        step = extracted.step
        walls = verified(ring, extracted, settings, gap=windows.gap) if windows.gap else extracted.candidates
        for row, index in enumerate(windows.last[step.scans]):
            lines = tuple(
                Line(
                    rho=wall.rho,
                    theta=wall.theta,
                    segment=wall.segment,
                    votes=wall.votes,
                    echoes=len(wall.echoes),
                    paths=paths[np.unique(step.path[row, wall.echoes])],
                    scans=tuple(log.scan[np.unique(windows.scan[step.echo[row, wall.echoes]])].tolist()),
                )
                for wall in walls[row]
            )
            empty = ""
            if not lines:
                corrected = np.asarray(ring.corrected(step.reported[row], *paths[step.path[row]].T))
                heard = int((corrected < ring.max_range).sum())
                empty = _why_empty(heard, int(extracted.components[row]), settings.min_echoes)
            yield LocalModel(int(log.scan[index]), float(log.stamp[index]), lines, empty)


def check_method(method: str) -> None:
    """Raise a SonarError for an unknown method."""
    if method not in METHODS:
        raise SonarError(f"method {method!r}; allowed is {' or '.join(METHODS)}")


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

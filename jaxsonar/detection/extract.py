"""Local models: the straight walls around the robot, from one scan (paper, section 4)."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxsonar import kernels
from jaxsonar.detection.hough_detector import Candidate, Extracted, extract
from jaxsonar.detection.hough_detector import Lines as Lines
from jaxsonar.detection.hough_detector import arcs_of as arcs_of
from jaxsonar.detection.hough_detector import settings_for as settings_for
from jaxsonar.detection.ml_detector import KINDS, Explained, check_sigma, explained
from jaxsonar.detection.plane_point_test import verified
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.echo_batches import FlatEchoes, Step, in_order
from jaxsonar.scans.scan_log import Log, Scan
from jaxsonar.scans.sliding_windows import Windows, check_window, gather
from jaxsonar.sensors.ring import Ring

METHODS = ("ml", "hough")
"""How lines are found: ml is maximum likelihood over the ranges, hough the paper's way."""


@dataclass(frozen=True)
class Line:
    """One wall as seen from one scan, robot frame."""

    rho: float
    """Distance from the origin, metres, >= 0."""
    theta: float
    """Direction of the normal, radians, in [-pi, pi)."""
    segment: Float[np.ndarray, "2 2"]
    """Endpoints (x, y): the outermost feet of the involved real and virtual sensors, metres."""
    votes: int | float
    """How strong it is. Method hough: number of arc points in its component; ml: nats of evidence."""
    echoes: int
    """Number of echoes that have a point in the component, or that the line explains."""
    paths: Int[np.ndarray, "paths 2"]
    """(tx, rx) of those echoes: the involved real sensors, and virtual ones where tx and rx differ."""
    scans: tuple[int, ...]
    """Numbers of the scans that those echoes come from: one, unless scans were gathered over a window."""
    cov: Float[np.ndarray, "2 2"] | None = None
    """Covariance of (rho, theta), square metres and radians; None: not known (method hough)."""

    def as_json(self) -> dict[str, Any]:
        """Plain numbers only."""
        line: dict[str, Any] = {"rho": self.rho, "theta": self.theta}
        strength = "votes" if self.cov is None else "evidence"
        if self.cov is not None:
            line["cov"] = self.cov.tolist()
        return line | {
            "segment": self.segment.tolist(),
            "echoes": self.echoes,
            strength: self.votes,
            "paths": self.paths.tolist(),
        }


@dataclass(frozen=True)
class Point:
    """One corner, edge or pole as seen from one scan, robot frame."""

    x: float
    """Metres."""
    y: float
    """Metres."""
    kind: str
    """"corner" (right-angled, reflects twice) or "edge" (diffracts; thin poles, too)."""
    cov: Float[np.ndarray, "2 2"]
    """Covariance of (x, y), square metres."""
    echoes: int
    """Number of echoes that it explains."""
    paths: Int[np.ndarray, "paths 2"]
    """(tx, rx) of those echoes."""
    probability: float
    """That it is of this kind."""

    def as_json(self) -> dict[str, Any]:
        """Plain numbers only."""
        return {
            "x": self.x,
            "y": self.y,
            "cov": self.cov.tolist(),
            "kind": self.kind,
            "echoes": self.echoes,
            "probability": self.probability,
            "paths": self.paths.tolist(),
        }


@dataclass(frozen=True)
class Undecided:
    """A reflector whose kind the echoes do not decide: what it is if it is a wall, and where if it is a point."""

    rho: float
    """Distance of the line that its echoes touch, metres."""
    theta: float
    """Direction of the normal of that line, radians, in [-pi, pi)."""
    x: float
    """Place of the corner or edge; of a wall the middle of what was seen, metres."""
    y: float
    """Metres."""
    probability: dict[str, float]
    """Of "plane", "corner" and "edge"."""
    echoes: int
    """Number of echoes."""
    paths: Int[np.ndarray, "paths 2"]
    """(tx, rx) of those echoes."""

    def as_json(self) -> dict[str, Any]:
        """Plain numbers only."""
        return {name: getattr(self, name) for name in ("rho", "theta", "x", "y", "probability", "echoes")} | {
            "paths": self.paths.tolist()
        }


@dataclass(frozen=True)
class LocalModel:
    """What one scan tells of its surroundings, robot frame."""

    scan: int
    """Number of the scan; of a window's last one, in whose frame the lines are."""
    stamp: float
    """Seconds; NaN where the log has none."""
    lines: tuple[Line, ...]
    """Walls, strongest first."""
    empty: str = ""
    """Why there is no line; empty if there is one."""
    points: tuple[Point, ...] = ()
    """Corners and edges, strongest first; method hough finds none."""
    undecided: tuple[Undecided, ...] = ()
    """What may be a wall or a corner or an edge; method hough takes everything for a wall."""
    sigma: float = float("nan")
    """Noise of the ranges, given or estimated from this scan, metres; NaN with method hough."""

    def as_json(self) -> dict[str, Any]:
        """One object of the JSON Lines format, plain numbers only."""
        model: dict[str, Any] = {
            "scan": self.scan,
            "stamp": None if np.isnan(self.stamp) else self.stamp,
            "lines": [line.as_json() for line in self.lines],
        }
        if not np.isnan(self.sigma):
            model["points"] = [point.as_json() for point in self.points]
            model["undecided"] = [reflector.as_json() for reflector in self.undecided]
            model["sigma"] = self.sigma
        return model | {"empty": self.empty} if self.empty else model


def extract_lines(
    ring: Ring,
    ranges: Float[np.ndarray, "scans paths echoes"],
    *,
    method: str = "ml",
    settings: kernels.HoughSettings | None = None,
    sigma: float | None = None,
) -> Lines:
    """Straight lines around the robot, for a batch of scans (paper, section 4).

    Args:
        ring: the sensors; its ``paths`` give the order of the second axis.
        ranges: (scans, paths, echoes) half path lengths as a log has them, metres, NaN = no echo.
        method: "ml", maximum likelihood over the ranges, or "hough", the paper's way.
        settings: accumulator and low pass, and for hough threshold and least echoes; the paper's, as large as the ring
            needs, if left out.
        sigma: standard deviation of the ranges, metres, for ml; estimated for each scan if left out.

    Raises:
        SonarError: another shape, a range that is not positive, an unknown method, a sigma that is not positive.
    """
    check_method(method)
    check_sigma(sigma)
    echoes, settings = FlatEchoes.from_dense(ring, ranges), settings_for(ring, settings)
    found = extract(ring, echoes, settings) if method == "hough" else explained(ring, echoes, settings, sigma)
    return _together(echoes.scans, [(step.step.scans, step.lines) for step in found])


def local_model(
    ring: Ring,
    scan: Scan,
    *,
    method: str = "ml",
    settings: kernels.HoughSettings | None = None,
    sigma: float | None = None,
    path_pose: Float[np.ndarray, "paths 3"] | None = None,
) -> LocalModel:
    """The walls around the robot from one scan of a log.

    Args:
        ring: the sensors.
        scan: what they heard.
        method: as ``local_models``.
        settings: as ``local_models``.
        sigma: as ``local_models``.
        path_pose: of a robot that moved during the scan, for each of the ring's ``paths`` where it was when the
            transmitter fired, in the frame that the walls are wanted in: x, y (m), theta (rad). It stood still if left
            out.

    Raises:
        SonarError: as ``local_models``.
    """
    if path_pose is None:
        return next(local_models(ring, scan.as_log(), method=method, settings=settings, sigma=sigma))
    check_method(method)
    check_sigma(sigma)
    log, settings = scan.as_log(), settings_for(ring, settings)
    arcs = kernels.moved_arcs(arcs_of(ring, settings), jnp.asarray(path_pose, jnp.float32), settings=settings)
    echoes, _ = FlatEchoes.from_log(ring, log)
    if method == "ml":
        return next(_explained_models(ring, log, echoes, settings, sigma, arcs))
    return next(models_of(ring, log, Windows.of_scans(echoes), settings, arcs))


def local_models(
    ring: Ring,
    log: Log,
    *,
    method: str = "ml",
    settings: kernels.HoughSettings | None = None,
    sigma: float | None = None,
    window: float | None = None,
    on_left_out: Callable[[int], None] | None = None,
) -> Iterator[LocalModel]:
    """The walls around the robot from every scan of a log, scan by scan, computed in batches.

    Args:
        ring: the sensors.
        log: scans; their poses are used for windows only.
        method: "ml": the walls, corners and edges that explain the echoes best, by maximum likelihood over the ranges;
            "hough": the paper's way, lines only.
        settings: accumulator and low pass, and for hough threshold and least echoes; the paper's, as large as the ring
            needs, if left out.
        sigma: standard deviation of the ranges, metres, for ml; estimated for each scan if left out.
        window: gather the scans of this length of path into one local model, metres (``windows.gather``), for rings so
            sparse that one scan cannot carry a line; every scan for itself if left out. Both methods then take the
            Hough step's lines that a fit to the ranges confirms (``verification``).
        on_left_out: told once how many echoes are of pairs (tx, rx) that this ring does not listen to.

    Raises:
        SonarError: a sensor number that the ring does not have, an unknown method, a window or a sigma out of range.
    """
    check_method(method)
    check_sigma(sigma)
    check_window(window)
    settings = settings_for(ring, settings, window=window)
    if window is None:
        echoes, left_out = FlatEchoes.from_log(ring, log)
        windows = Windows.of_scans(echoes)
    else:
        windows, left_out = gather(ring, log, length=window)
    if left_out and on_left_out is not None:
        on_left_out(left_out)
    if window is None and method == "ml":
        return _explained_models(ring, log, windows.echoes, settings, sigma)
    return models_of(ring, log, windows, settings)


def models_of(
    ring: Ring, log: Log, windows: Windows, settings: kernels.HoughSettings, arcs: kernels.RingArcs | None = None
) -> Iterator[LocalModel]:
    """A local model of every window of a log; windows of single scans are the scans themselves."""

    def models() -> Iterator[tuple[int, LocalModel]]:
        for extracted in extract(ring, windows.echoes, settings, arcs):
            walls = verified(ring, extracted, settings, gap=windows.gap) if windows.gap else extracted.candidates
            for row, window in enumerate(extracted.step.scans.tolist()):
                yield window, _extracted_model(ring, log, windows, extracted, row, walls[row], settings)

    return in_order(models())


def _extracted_model(
    ring: Ring,
    log: Log,
    windows: Windows,
    extracted: Extracted,
    row: int,
    walls: list[Candidate],
    settings: kernels.HoughSettings,
) -> LocalModel:
    step = extracted.step
    index = windows.last[step.scans[row]]
    paths, alone = ring.paths, () if windows.gap else (int(log.scan[index]),)
    lines = tuple(
        Line(
            rho=wall.rho,
            theta=wall.theta,
            segment=wall.segment,
            votes=wall.votes,
            echoes=len(wall.echoes),
            paths=paths[_distinct(step.path[row, wall.echoes])],
            scans=alone or tuple(log.scan[np.unique(windows.scan[step.echo[row, wall.echoes]])].tolist()),
        )
        for wall in walls
    )
    empty = ""
    if not lines:
        empty = _why_empty(_heard(ring, step, row), int(extracted.components[row]), settings.min_echoes)
    return LocalModel(int(log.scan[index]), float(log.stamp[index]), lines, empty)


def _explained_models(
    ring: Ring,
    log: Log,
    echoes: FlatEchoes,
    settings: kernels.HoughSettings,
    sigma: float | None,
    arcs: kernels.RingArcs | None = None,
) -> Iterator[LocalModel]:
    """A local model of every scan of a log by maximum likelihood."""

    def models() -> Iterator[tuple[int, LocalModel]]:
        for found in explained(ring, echoes, settings, sigma, arcs=arcs):
            for row, scan in enumerate(found.step.scans.tolist()):
                yield scan, _explained_model(ring, found, row, int(log.scan[scan]), float(log.stamp[scan]))

    return in_order(models())


def _explained_model(ring: Ring, explained: Explained, row: int, scan: int, stamp: float) -> LocalModel:
    step, found, decided, paths = explained.step, explained.found, explained.decided[row], ring.paths
    lines, points, undecided = [], [], []
    for k in np.flatnonzero(found.kind[row] >= 0):
        own = np.flatnonzero(found.involved[row, k])
        seen: dict[str, Any] = {"echoes": len(own), "paths": paths[_distinct(step.path[row, own])]}
        a, b = found.parameters[row, k].tolist()
        cov = np.asarray(found.covariance[row, k], dtype=np.float64)
        probability: dict[str, float] = dict(zip(KINDS, found.probability[row, k].tolist(), strict=True))
        segment = np.asarray(found.segment[row, k])
        if decided[k] == kernels.PLANE:
            evidence = float(found.evidence[row, k])
            lines.append(
                Line(rho=a, theta=float(wrap_angle(b)), segment=segment, votes=evidence, scans=(scan,), cov=cov, **seen)
            )
        elif decided[k] >= 0:
            kind = KINDS[decided[k]]
            points.append(Point(x=a, y=b, kind=kind, cov=cov, probability=probability[kind], **seen))
        else:
            plane = found.kind[row, k] == kernels.PLANE
            rho, theta = (a, b) if plane else (float(np.hypot(a, b)), np.arctan2(b, a))
            theta = float(wrap_angle(theta))
            x, y = segment.mean(axis=0).tolist() if plane else (a, b)
            undecided.append(Undecided(rho=rho, theta=theta, x=x, y=y, probability=probability, **seen))
    empty = ""
    if not lines:
        others = len(points) + len(undecided)
        empty = "no wall, only corners, edges and what is undecided" if others else "no reflector explains the echoes"
        empty = "no echo within the maximum range" if _heard(ring, step, row) == 0 else empty
    return LocalModel(scan, stamp, tuple(lines), empty, tuple(points), tuple(undecided), float(found.sigma[row]))


def _distinct(index: Int[np.ndarray, " some"]) -> Int[np.ndarray, " distinct"]:
    """Each of some small whole numbers once, ascending."""
    return np.flatnonzero(np.bincount(index))


def _heard(ring: Ring, step: Step, row: int) -> int:
    """Number of echoes of one scan within the maximum range."""
    corrected = np.asarray(ring.corrected(step.reported[row], *ring.paths[step.path[row]].T))
    return int((corrected < ring.max_range).sum())


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


def _together(scans: int, steps: list[tuple[Int[np.ndarray, " _"], Lines]]) -> Lines:
    """One batch from several, with room for as many lines as the scan with the most, at least one."""
    most = max([1, *(lines.rho.shape[1] for _, lines in steps)])

    def column(name: str, dtype: type, *shape: int) -> np.ndarray:
        whole = np.full((scans, most, *shape), 0 if dtype is np.int64 else np.nan, dtype)
        for rows, lines in steps:
            part = getattr(lines, name)
            whole[rows, : part.shape[1]] = part
        return whole

    return Lines(
        rho=column("rho", np.float32),
        theta=column("theta", np.float32),
        votes=column("votes", np.float64),
        echoes=column("echoes", np.int64),
        segments=column("segments", np.float32, 2, 2),
        cov=column("cov", np.float32, 2, 2),
    )

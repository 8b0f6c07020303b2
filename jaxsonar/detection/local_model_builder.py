"""Local models of scans and windows, built from the detections of a batch."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Int

from jaxsonar import kernels
from jaxsonar.detection.hough_detector import HoughBatch, LineCandidate, hough_detections
from jaxsonar.detection.local_model import KIND_NAMES, Line, LocalModel, Point, Undecided
from jaxsonar.detection.ml_detector import DetectionBatch, ml_detections
from jaxsonar.detection.plane_point_test import confirmed_walls
from jaxsonar.detection.settings import window_tolerance
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.scans.echo_batches import EchoBatch, restore_order
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.sliding_windows import Windows
from jaxsonar.sensors.ring import Ring


def hough_models(
    ring: Ring, log: Log, windows: Windows, settings: kernels.HoughSettings, *, sigma: float | None = None
) -> Iterator[LocalModel]:
    """A local model of every window of a log, in order, by method "hough".

    Args:
        ring: the sensors.
        log: the scans.
        windows: the windows; those of single scans (``Windows.of_scans``) give a model of every scan. Lines of longer
            windows must pass the test of plane against point.
        settings: accumulator, low pass, threshold and smallest number of echoes.
        sigma: standard deviation of the ranges, metres, for that test; a tolerance for unknown noise if omitted.
    """
    tolerance = window_tolerance(sigma)

    def models() -> Iterator[tuple[int, LocalModel]]:
        for found in hough_detections(ring, windows.echoes, settings):
            walls = found.candidates
            if windows.gap:
                walls = confirmed_walls(ring, found, settings, gap=windows.gap, tolerance=tolerance)
            for row, window in enumerate(found.batch.scans.tolist()):
                yield window, _hough_model(ring, log, windows, found, row, walls[row], settings)

    return restore_order(models())


def ml_models(
    ring: Ring, log: Log, echoes: FlatEchoes, settings: kernels.HoughSettings, sigma: float | None
) -> Iterator[LocalModel]:
    """A local model of every scan of a log, in order, by method "ml"; arguments as ``ml_detections``."""

    def models() -> Iterator[tuple[int, LocalModel]]:
        for found in ml_detections(ring, echoes, settings, sigma):
            for row, scan in enumerate(found.batch.scans.tolist()):
                yield scan, _ml_model(ring, found, row, int(log.scan[scan]), float(log.stamp[scan]))

    return restore_order(models())


def no_line_reason(in_range: int, components: int, min_echoes: int) -> str:
    """Reason why method "hough" found no line in a scan.

    Args:
        in_range: number of echoes within the maximum range.
        components: number of connected components.
        min_echoes: smallest number of echoes of a line.
    """
    if in_range == 0:
        return "no echo within the maximum range"
    if in_range < min_echoes:
        return f"fewer than {min_echoes} echoes within the maximum range"
    if components == 0:
        return "no cell above the threshold"
    return f"no component with {min_echoes} echoes"


def no_wall_reason(in_range: int, others: int) -> str:
    """Reason why method "ml" found no wall in a scan.

    Args:
        in_range: number of echoes within the maximum range.
        others: number of reflectors that are no walls, or whose kind is undecided.
    """
    if in_range == 0:
        return "no echo within the maximum range"
    return "no wall, only corners, edges and what is undecided" if others else "no reflector explains the echoes"


def _hough_model(
    ring: Ring,
    log: Log,
    windows: Windows,
    found: HoughBatch,
    row: int,
    walls: list[LineCandidate],
    settings: kernels.HoughSettings,
) -> LocalModel:
    """Local model of one row of a batch."""
    batch = found.batch
    last = windows.last[batch.scans[row]]
    paths, single_scan = ring.paths, () if windows.gap else (int(log.scan[last]),)
    lines = tuple(
        Line(
            rho=wall.rho,
            theta=wall.theta,
            segment=wall.segment,
            votes=wall.votes,
            echoes=len(wall.echoes),
            paths=paths[_distinct(batch.path[row, wall.echoes])],
            scans=single_scan or tuple(log.scan[np.unique(windows.scan[batch.echo[row, wall.echoes]])].tolist()),
        )
        for wall in walls
    )
    empty = ""
    if not lines:
        empty = no_line_reason(_echoes_in_range(ring, batch, row), int(found.components[row]), settings.min_echoes)
    return LocalModel(int(log.scan[last]), float(log.stamp[last]), lines, empty)


def _ml_model(ring: Ring, detections: DetectionBatch, row: int, scan: int, stamp: float) -> LocalModel:
    """Local model of one row of a batch."""
    batch, found, decided, paths = detections.batch, detections.found, detections.decided[row], ring.paths
    lines, points, undecided = [], [], []
    for k in np.flatnonzero(found.kind[row] >= 0):
        involved = np.flatnonzero(found.involved[row, k])
        support: dict[str, Any] = {"echoes": len(involved), "paths": paths[_distinct(batch.path[row, involved])]}
        a, b = found.parameters[row, k].tolist()
        cov = np.asarray(found.covariance[row, k], dtype=np.float64)
        probability: dict[str, float] = dict(zip(KIND_NAMES, found.probability[row, k].tolist(), strict=True))
        segment = np.asarray(found.segment[row, k])
        if decided[k] == kernels.PLANE:
            theta, evidence = float(wrap_angle(b)), float(found.evidence[row, k])
            lines.append(Line(rho=a, theta=theta, segment=segment, votes=evidence, scans=(scan,), cov=cov, **support))
        elif decided[k] == kernels.CIRCLE:
            x, y, radius = found.circle[row, k].tolist()
            cov = np.asarray(found.circle_covariance[row, k], dtype=np.float64)
            cov, sure = (cov + cov.T) / 2, probability["circle"]
            points.append(Point(x=x, y=y, kind="circle", cov=cov, probability=sure, radius=radius, **support))
        elif decided[k] >= 0:
            kind = KIND_NAMES[decided[k]]
            points.append(Point(x=a, y=b, kind=kind, cov=cov, probability=probability[kind], **support))
        else:
            plane = found.kind[row, k] == kernels.PLANE
            rho, theta = (a, b) if plane else (float(np.hypot(a, b)), np.arctan2(b, a))
            theta = float(wrap_angle(theta))
            x, y = segment.mean(axis=0).tolist() if plane else (a, b)
            undecided.append(Undecided(rho=rho, theta=theta, x=x, y=y, probability=probability, **support))
    empty = "" if lines else no_wall_reason(_echoes_in_range(ring, batch, row), len(points) + len(undecided))
    return LocalModel(scan, stamp, tuple(lines), empty, tuple(points), tuple(undecided), float(found.sigma[row]))


def _distinct(index: Int[np.ndarray, " some"]) -> Int[np.ndarray, " distinct"]:
    """Distinct values of small non-negative integers, ascending."""
    return np.flatnonzero(np.bincount(index))


def _echoes_in_range(ring: Ring, batch: EchoBatch, row: int) -> int:
    """Number of echoes of one scan within the maximum range."""
    corrected = np.asarray(ring.corrected(batch.reported[row], *ring.paths[batch.path[row]].T))
    return int((corrected < ring.max_range).sum())

"""Entry points of detection: lines and local models from the echoes of scans (paper, section 4)."""

from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.detection.hough_detector import hough_detections
from jaxsonar.detection.local_model import Lines, LocalModel
from jaxsonar.detection.local_model_builder import hough_models, ml_models
from jaxsonar.detection.ml_detector import ml_detections
from jaxsonar.detection.settings import check_method, check_sigma, hough_settings
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.scan_log import Log, Scan
from jaxsonar.scans.sliding_windows import Windows, check_window, gather_windows
from jaxsonar.sensors.ring import Ring


def extract_lines(
    ring: Ring,
    ranges: Float[np.ndarray, "scans paths echoes"],
    *,
    method: str = "ml",
    measured: Bool[np.ndarray, "scans paths"] | None = None,
    settings: kernels.HoughSettings | None = None,
    sigma: float | None = None,
) -> Lines:
    """Straight lines around the robot, for a batch of scans (paper, section 4).

    Args:
        ring: the sensors; ``Ring.paths`` defines the order of the second axis.
        ranges: (scans, paths, echoes) half path lengths as a log holds them, metres, NaN = no echo.
        measured: (scans, paths) paths that were measured, whether or not they heard anything; all of them if omitted.
            A path that was not measured is evidence neither for nor against a line.
        method: "ml", maximum likelihood over the ranges, or "hough", the method of the paper.
        settings: accumulator and low pass, for "hough" also threshold and smallest number of echoes; if omitted, the
            paper's values with an accumulator that is large enough for the ring.
        sigma: standard deviation of the ranges, metres, for "ml"; estimated for each scan if omitted.

    Returns:
        (scans, lines) arrays, padded with NaN, strongest first; at least one column.

    Raises:
        SonarError: a wrong shape, a range that is not positive, an echo of a path that was not measured, an unknown
            method, or a sigma out of range.
    """
    check_method(method)
    check_sigma(sigma)
    echoes, settings = FlatEchoes.from_dense(ring, ranges, measured), hough_settings(ring, settings)
    if method == "hough":
        batches = hough_detections(ring, echoes, settings)
    else:
        batches = ml_detections(ring, echoes, settings, sigma)
    return _join_batches(echoes.scan_count, [(found.batch.scans, found.lines) for found in batches])


def local_model(
    ring: Ring,
    scan: Scan,
    *,
    method: str = "ml",
    settings: kernels.HoughSettings | None = None,
    sigma: float | None = None,
    path_pose: Float[np.ndarray, "paths 3"] | None = None,
) -> LocalModel:
    """The local model of one scan.

    Args:
        ring: the sensors.
        scan: the echoes.
        method: as ``local_models``.
        settings: as ``local_models``.
        sigma: as ``local_models``.
        path_pose: for a robot that moved during the scan: model_from_robot at the time when the transmitter of each of
            ``Ring.paths`` fired, x, y (m), theta (rad). The robot did not move if omitted.

    Raises:
        SonarError: as ``local_models``.
    """
    if path_pose is None:
        return next(local_models(ring, scan.as_log(), method=method, settings=settings, sigma=sigma))
    check_method(method)
    check_sigma(sigma)
    log, settings = scan.as_log(), hough_settings(ring, settings)
    echoes, _ = FlatEchoes.from_log(ring, log, path_pose=np.asarray(path_pose)[None])
    if method == "ml":
        return next(ml_models(ring, log, echoes, settings, sigma))
    return next(hough_models(ring, log, Windows.of_scans(echoes), settings))


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
    """The local model of every scan of a log, in order, computed in batches.

    Args:
        ring: the sensors.
        log: the scans; poses are used for windows only.
        method: "ml": the walls, corners, edges and circles that explain the echoes best, by maximum likelihood;
            "hough": the method of the paper, lines only.
        settings: accumulator and low pass, for "hough" also threshold and smallest number of echoes; if omitted, the
            paper's values with an accumulator that is large enough for the ring.
        sigma: standard deviation of the ranges, metres, for "ml" and for windows; if omitted, estimated for each scan,
            or for windows a tolerance that covers rounded and old readings.
        window: gather the scans of this length of trajectory into one local model, metres (``gather_windows``). For
            rings with so few sensors that the echoes of one scan do not determine a line. Both methods then report the
            lines of the Hough step that pass the test of plane against point. No windows if omitted.
        on_left_out: called once with the number of echoes of (tx, rx) pairs that are no paths of this ring, if any.

    Raises:
        SonarError: a sensor index that the ring does not have, an unknown method, or a window or sigma out of range.
    """
    check_method(method)
    check_sigma(sigma)
    check_window(window)
    settings = hough_settings(ring, settings, window=window)
    if window is None:
        echoes, left_out = FlatEchoes.from_log(ring, log)
        windows = Windows.of_scans(echoes)
    else:
        windows, left_out = gather_windows(ring, log, length=window)
    if left_out and on_left_out is not None:
        on_left_out(left_out)
    if window is None and method == "ml":
        return ml_models(ring, log, windows.echoes, settings, sigma)
    return hough_models(ring, log, windows, settings, sigma=sigma)


def _join_batches(scan_count: int, batches: list[tuple[Int[np.ndarray, " _"], Lines]]) -> Lines:
    """Lines of all batches in the order of the scans, padded to the largest number of lines, at least one."""
    columns = max([1, *(lines.rho.shape[1] for _, lines in batches)])

    def joined(name: str, dtype: type, *shape: int) -> np.ndarray:
        whole = np.full((scan_count, columns, *shape), 0 if dtype is np.int64 else np.nan, dtype)
        for scans, lines in batches:
            part = getattr(lines, name)
            whole[scans, : part.shape[1]] = part
        return whole

    return Lines(
        rho=joined("rho", np.float32),
        theta=joined("theta", np.float32),
        votes=joined("votes", np.float64),
        echoes=joined("echoes", np.int64),
        segments=joined("segments", np.float32, 2, 2),
        cov=joined("cov", np.float32, 2, 2),
    )

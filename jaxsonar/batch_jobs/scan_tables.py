"""Detection in the scans of a log, as columns of the tables scans, lines and points."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from jaxsonar import kernels
from jaxsonar.batch_jobs.parquet_tables import PROBABILITY_COLUMNS, SCAN_COLUMNS, TABLES, Columns
from jaxsonar.detection.hough_detector import HoughBatch, hough_detections
from jaxsonar.detection.local_model import KIND_NAMES
from jaxsonar.detection.local_model_builder import no_line_reason, no_wall_reason
from jaxsonar.detection.ml_detector import DetectionBatch, ml_detections
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class _BatchColumns:
    """Columns of the tables for one batch of scans. ``row`` is the scan's row in the log, in any order."""

    lines: Columns
    points: Columns
    scans: Columns


def scan_tables(
    ring: Ring,
    log: Log,
    rows: Int[np.ndarray, " scans"],
    *,
    source: str,
    method: str,
    settings: kernels.HoughSettings,
    sigma: float | None,
) -> dict[str, Columns]:
    """The tables of some scans. The numbers are those of ``local_models``.

    Args:
        ring: the sensors.
        log: the scans; their poses are copied to the tables and not used.
        rows: rows of these scans in the complete log.
        source: name of the complete log.
        method: "ml" or "hough".
        settings: accumulator and low pass, for hough also threshold and minimum echoes.
        sigma: standard deviation of the ranges, metres, for ml; None: estimated for each scan.
    """
    echoes, _ = FlatEchoes.from_log(ring, log)
    heard = np.isfinite(log.range)
    off_paths = heard & (ring.path_index[log.tx, log.rx] < 0)
    ranges = np.minimum(echoes.reported, 1e6).astype(np.float32)  # as in the kernels
    within_range = np.asarray(ring.corrected(ranges, *ring.paths[echoes.path].T)) < ring.max_range
    in_range = np.bincount(echoes.scan[within_range], minlength=len(log))

    if method == "hough":
        batches = [_hough_columns(batch) for batch in hough_detections(ring, echoes, settings)]
    else:
        batches = [_ml_columns(batch) for batch in ml_detections(ring, echoes, settings, sigma)]
    scans, lines, points = (_concatenate([getattr(batch, name) for batch in batches], name) for name in TABLES)

    counts = {
        "echoes": np.bincount(log.echo_scan[heard], minlength=len(log)),
        "left_out": np.bincount(log.echo_scan[off_paths], minlength=len(log)),
        "in_range": in_range,
        "lines": np.bincount(lines["row"], minlength=len(log)),
        "points": np.bincount(points["row"][points["kind"] != "undecided"], minlength=len(log)),
        "undecided": np.bincount(points["row"][points["kind"] == "undecided"], minlength=len(log)),
    }
    empty = _empty_reasons(counts, scans.pop("components"), method, settings)
    scan_columns = scans | counts | {"empty": empty}

    of_scans = {"row": rows, "scan": log.scan, "stamp": log.stamp}
    of_scans |= dict(zip(("pose_x", "pose_y", "pose_theta"), log.pose.T, strict=True))

    def with_scan(table: Columns) -> Columns:
        """The table with the columns of its scans."""
        index = table["row"]
        return table | {name: values[index] for name, values in of_scans.items()} | {"source": [source] * len(index)}

    return {"scans": with_scan(scan_columns), "lines": with_scan(lines), "points": with_scan(points)}


def _hough_columns(detections: HoughBatch) -> _BatchColumns:
    """Columns of the Hough detections in one batch of scans."""
    scans, lines = detections.batch.scans, detections.lines
    row, k = np.nonzero(lines.echoes)
    segment = lines.segments[row, k]
    not_computed = np.full(len(row), np.nan)
    line_columns = {
        "row": scans[row],
        "rho": lines.rho[row, k],
        "theta": lines.theta[row, k],
        **_segment_columns(segment),
        "evidence": not_computed,
        "votes": lines.votes[row, k].astype(np.int64),
        "echoes": lines.echoes[row, k],
        "cov_rho": not_computed,
        "cov_rho_theta": not_computed,
        "cov_theta": not_computed,
    }
    scan_columns = {"row": scans, "sigma": np.full(len(scans), np.nan), "components": np.asarray(detections.components)}
    return _BatchColumns(line_columns, _empty_columns("points"), scan_columns)


def _ml_columns(detections: DetectionBatch) -> _BatchColumns:
    """Columns of the maximum-likelihood detections in one batch of scans, landmarks in order of evidence."""
    scans, reflectors = detections.batch.scans, detections.found
    row, k = np.nonzero(np.asarray(reflectors.kind) >= 0)
    decided = detections.decided[row, k]
    first, second = np.asarray(reflectors.parameters)[row, k].astype(np.float64).T
    is_circle = decided == kernels.CIRCLE
    circle = np.asarray(reflectors.circle)[row, k].astype(np.float64)
    circle_cov = np.asarray(reflectors.circle_covariance)[row, k].astype(np.float64)
    cov = np.asarray(reflectors.covariance)[row, k].astype(np.float64)
    segment = np.asarray(reflectors.segment)[row, k]
    echoes = np.asarray(reflectors.involved).sum(axis=-1)[row, k]
    is_wall = decided == kernels.PLANE
    line_columns = {
        "row": scans[row],
        "rho": first,
        "theta": wrap_angle(second),
        **_segment_columns(segment),
        "evidence": np.asarray(reflectors.evidence)[row, k],
        "votes": np.full(len(row), None),
        "echoes": echoes,
        "cov_rho": cov[:, 0, 0],
        "cov_rho_theta": cov[:, 0, 1],
        "cov_theta": cov[:, 1, 1],
    }
    is_plane = np.asarray(reflectors.kind)[row, k] == kernels.PLANE
    is_decided = decided >= 0
    middle = segment.mean(axis=1)
    undecided_line = {
        "rho": np.where(is_plane, first, np.hypot(first, second)),
        "theta": wrap_angle(np.where(is_plane, second, np.arctan2(second, first))),
    }
    point_cov = np.where(is_circle[:, None, None], circle_cov[:, :2, :2], cov)
    point_covariance = {"cov_x": point_cov[:, 0, 0], "cov_xy": point_cov[:, 0, 1], "cov_y": point_cov[:, 1, 1]}
    of_circle = {"radius": circle[:, 2], "cov_radius": circle_cov[:, 2, 2]}
    names = dict(zip(kernels.REFLECTOR_KINDS, KIND_NAMES, strict=True))
    point_columns = {
        "row": scans[row],
        "kind": np.array([names.get(one, "undecided") for one in decided.tolist()], object),
        "x": np.where(is_circle, circle[:, 0], np.where(is_plane, middle[:, 0], first)),
        "y": np.where(is_circle, circle[:, 1], np.where(is_plane, middle[:, 1], second)),
        **{name: np.where(is_circle, values, np.nan) for name, values in of_circle.items()},
        **{name: np.where(is_decided, values, np.nan) for name, values in point_covariance.items()},
        **{name: np.where(is_decided, np.nan, values) for name, values in undecided_line.items()},
        **dict(zip(PROBABILITY_COLUMNS, np.asarray(reflectors.probability)[row, k].T, strict=True)),
        "echoes": echoes,
    }
    scan_columns = {"row": scans, "sigma": np.asarray(reflectors.sigma), "components": np.zeros(len(scans), np.int64)}
    return _BatchColumns(
        {name: values[is_wall] for name, values in line_columns.items()},
        {name: values[~is_wall] for name, values in point_columns.items()},
        scan_columns,
    )


def _segment_columns(segment: np.ndarray) -> Columns:
    return {"x1": segment[:, 0, 0], "y1": segment[:, 0, 1], "x2": segment[:, 1, 0], "y2": segment[:, 1, 1]}


def _empty_columns(table: str) -> Columns:
    """The columns of a table without rows."""
    own = {name: column for name, column in TABLES[table].items() if name not in SCAN_COLUMNS}
    types = {"int64": np.int64, "float64": np.float64, "string": object}
    return {"row": np.zeros(0, np.int64)} | {name: np.zeros(0, types[column.type]) for name, column in own.items()}


def _concatenate(parts: list[Columns], table: str) -> Columns:
    """Concatenate the parts of a table and sort the rows by scan."""
    no_scans = {"row": np.zeros(0, np.int64), "sigma": np.zeros(0), "components": np.zeros(0, np.int64)}
    parts = parts or [no_scans if table == "scans" else _empty_columns(table)]
    order = np.argsort(np.concatenate([part["row"] for part in parts]), kind="stable")
    return {name: np.concatenate([part[name] for part in parts])[order] for name in parts[0]}


def _empty_reasons(counts: Columns, components: np.ndarray, method: str, settings: kernels.HoughSettings) -> np.ndarray:
    """Why a scan has no line, as in ``LocalModel.empty``; None for scans with lines."""
    reasons = np.full(len(counts["lines"]), None, object)
    others = counts["points"] + counts["undecided"]
    for k in np.flatnonzero(counts["lines"] == 0):
        in_range = int(counts["in_range"][k])
        if method == "hough":
            reasons[k] = no_line_reason(in_range, int(components[k]), settings.min_echoes)
        else:
            reasons[k] = no_wall_reason(in_range, int(others[k]))
    return reasons

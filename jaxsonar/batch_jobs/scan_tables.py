"""Scans of a log in, columns of lines, points and scans out: the one computation of a batch."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from jaxsonar import kernels
from jaxsonar.batch_jobs.parquet_tables import PROBABILITY, SCAN, TABLES, Columns
from jaxsonar.detection.hough_detector import HoughBatch, hough_detections
from jaxsonar.detection.local_map import KIND_NAMES
from jaxsonar.detection.local_map_builder import no_line_reason, no_wall_reason
from jaxsonar.detection.ml_detector import DetectionBatch, ml_detections
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class _Found:
    """Lines and points of some scans; ``row`` is that of each one's scan in the log, ascending or not."""

    lines: Columns
    points: Columns
    scans: Columns


def tables(
    ring: Ring,
    log: Log,
    rows: Int[np.ndarray, " scans"],
    *,
    source: str,
    method: str,
    settings: kernels.HoughSettings,
    sigma: float | None,
) -> dict[str, Columns]:
    """The tables of some scans: the same numbers as ``local_models``, as columns.

    Args:
        ring: the sensors.
        log: scans; their poses are handed on only.
        rows: of these scans in the log that they are part of.
        source: name of that log.
        method: "ml" or "hough".
        settings: accumulator and low pass, and for hough threshold and least echoes.
        sigma: standard deviation of the ranges, metres, for ml; estimated for each scan if None.
    """
    echoes, _ = FlatEchoes.from_log(ring, log)
    heard = np.bincount(echoes.scan, minlength=len(log))
    reach = np.minimum(echoes.reported, 1e6).astype(np.float32)  # as the kernels see them
    near = np.asarray(ring.corrected(reach, *ring.paths[echoes.path].T)) < ring.max_range
    in_range = np.bincount(echoes.scan[near], minlength=len(log))

    if method == "hough":
        steps = [_of_extracted(step) for step in hough_detections(ring, echoes, settings)]
    else:
        steps = [_of_explained(step) for step in ml_detections(ring, echoes, settings, sigma)]
    scans, lines, points = (_joined([getattr(step, name) for step in steps], name) for name in TABLES)

    counts = {
        "echoes": np.diff(log.start),
        "left_out": np.diff(log.start) - heard,
        "in_range": in_range,
        "lines": np.bincount(lines["row"], minlength=len(log)),
        "points": np.bincount(points["row"][points["kind"] != "undecided"], minlength=len(log)),
        "undecided": np.bincount(points["row"][points["kind"] == "undecided"], minlength=len(log)),
    }
    empty = _why_empty(counts, scans.pop("components"), method, settings)
    whole = scans | counts | {"empty": empty}

    known = {"row": rows, "scan": log.scan, "stamp": log.stamp}
    known |= dict(zip(("pose_x", "pose_y", "pose_theta"), log.pose.T, strict=True))

    def told(found: Columns) -> Columns:
        """A table with the columns that it has from its scans."""
        index = found["row"]
        return found | {name: values[index] for name, values in known.items()} | {"source": [source] * len(index)}

    return {"scans": told(whole), "lines": told(lines), "points": told(points)}


def _of_extracted(extracted: HoughBatch) -> _Found:
    """What the paper's method found in the scans of one step."""
    scans, lines = extracted.batch.scans, extracted.lines
    row, k = np.nonzero(lines.echoes)
    segment = lines.segments[row, k]
    none = np.full(len(row), np.nan)
    found = {
        "row": scans[row],
        "rho": lines.rho[row, k],
        "theta": lines.theta[row, k],
        **_segment(segment),
        "evidence": none,
        "votes": lines.votes[row, k].astype(np.int64),
        "echoes": lines.echoes[row, k],
        "cov_rho": none,
        "cov_rho_theta": none,
        "cov_theta": none,
    }
    whole = {"row": scans, "sigma": np.full(len(scans), np.nan), "components": np.asarray(extracted.components)}
    return _Found(found, _nothing("points"), whole)


def _of_explained(found: DetectionBatch) -> _Found:
    """What maximum likelihood found in the scans of one step, reflectors in the order of their evidence."""
    scans, all_ = found.batch.scans, found.found
    row, k = np.nonzero(np.asarray(all_.kind) >= 0)
    decided = found.decided[row, k]
    first, second = np.asarray(all_.parameters)[row, k].astype(np.float64).T
    cov = np.asarray(all_.covariance)[row, k].astype(np.float64)
    segment = np.asarray(all_.segment)[row, k]
    echoes = np.asarray(all_.involved).sum(axis=-1)[row, k]
    wall = decided == kernels.PLANE
    lines = {
        "row": scans[row],
        "rho": first,
        "theta": wrap_angle(second),
        **_segment(segment),
        "evidence": np.asarray(all_.evidence)[row, k],
        "votes": np.full(len(row), None),
        "echoes": echoes,
        "cov_rho": cov[:, 0, 0],
        "cov_rho_theta": cov[:, 0, 1],
        "cov_theta": cov[:, 1, 1],
    }
    plane = np.asarray(all_.kind)[row, k] == kernels.PLANE
    sure = decided >= 0
    middle = segment.mean(axis=1)
    unsure = {
        "rho": np.where(plane, first, np.hypot(first, second)),
        "theta": wrap_angle(np.where(plane, second, np.arctan2(second, first))),
    }
    covariance = {"cov_x": cov[:, 0, 0], "cov_xy": cov[:, 0, 1], "cov_y": cov[:, 1, 1]}
    points = {
        "row": scans[row],
        "kind": np.where(sure, np.array(KIND_NAMES, object)[decided], "undecided"),
        "x": np.where(plane, middle[:, 0], first),
        "y": np.where(plane, middle[:, 1], second),
        **{name: np.where(sure, values, np.nan) for name, values in covariance.items()},
        **{name: np.where(sure, np.nan, values) for name, values in unsure.items()},
        **dict(zip(PROBABILITY, np.asarray(all_.probability)[row, k].T, strict=True)),
        "echoes": echoes,
    }
    whole = {"row": scans, "sigma": np.asarray(all_.sigma), "components": np.zeros(len(scans), np.int64)}
    return _Found(
        {name: values[wall] for name, values in lines.items()},
        {name: values[~wall] for name, values in points.items()},
        whole,
    )


def _segment(segment: np.ndarray) -> Columns:
    return {"x1": segment[:, 0, 0], "y1": segment[:, 0, 1], "x2": segment[:, 1, 0], "y2": segment[:, 1, 1]}


def _nothing(table: str) -> Columns:
    own = {name: column for name, column in TABLES[table].items() if name not in SCAN}
    types = {"int64": np.int64, "float64": np.float64, "string": object}
    return {"row": np.zeros(0, np.int64)} | {name: np.zeros(0, types[column.type]) for name, column in own.items()}


def _joined(parts: list[Columns], table: str) -> Columns:
    """Parts of a table as one, in the order of the scans."""
    none = {"row": np.zeros(0, np.int64), "sigma": np.zeros(0), "components": np.zeros(0, np.int64)}
    parts = parts or [none if table == "scans" else _nothing(table)]
    order = np.argsort(np.concatenate([part["row"] for part in parts]), kind="stable")
    return {name: np.concatenate([part[name] for part in parts])[order] for name in parts[0]}


def _why_empty(counts: Columns, components: np.ndarray, method: str, settings: kernels.HoughSettings) -> np.ndarray:
    """Reason why a scan has no line, as in ``LocalModel.empty``; None for scans with lines."""
    reasons = np.full(len(counts["lines"]), None, object)
    others = counts["points"] + counts["undecided"]
    for k in np.flatnonzero(counts["lines"] == 0):
        in_range = counts["in_range"][k]
        if method == "hough":
            reasons[k] = no_line_reason(in_range, components[k], settings.min_echoes)
        else:
            reasons[k] = no_wall_reason(in_range, others[k])
    return reasons

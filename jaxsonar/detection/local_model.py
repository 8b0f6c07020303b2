"""Local models: the lines and points detected in one scan, in the robot frame, and their JSON Lines file."""

import json
import os
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.fileio.atomic_files import open_output

KIND_NAMES = ("plane", "corner", "edge", "circle")
"""Names of the reflector kinds, in the order of ``kernels.REFLECTOR_KINDS``."""


@dataclass(frozen=True)
class Lines:
    """Lines of a batch of scans in the robot frame, strongest first; NaN (0 echoes) where a scan has fewer lines."""

    rho: Float[np.ndarray, "scans lines"]
    """Distance from the origin, metres, >= 0."""
    theta: Float[np.ndarray, "scans lines"]
    """Direction of the normal, radians, in [-pi, pi)."""
    votes: Float[np.ndarray, "scans lines"]
    """Strength. Method hough: arc points in the component. Method ml: log-likelihood ratio to clutter, nats."""
    echoes: Int[np.ndarray, "scans lines"]
    """Number of echoes with a point in the component (hough), or explained by the line (ml)."""
    segments: Float[np.ndarray, "scans lines 2 2"]
    """Endpoints (x, y), metres (paper, section 5)."""
    cov: Float[np.ndarray, "scans lines 2 2"]
    """Covariance of (rho, theta), in metres and radians; NaN for method hough, which estimates none."""


@dataclass(frozen=True)
class Line:
    """One wall as observed in one scan, robot frame."""

    rho: float
    """Distance from the origin, metres, >= 0."""
    theta: float
    """Direction of the normal, radians, in [-pi, pi)."""
    segment: Float[np.ndarray, "2 2"]
    """Endpoints (x, y), metres: the outermost feet of the perpendiculars from the involved real and virtual sensors
    (paper, section 5)."""
    votes: int | float
    """Strength. Method hough: arc points in the component. Method ml: log-likelihood ratio to clutter, nats."""
    echoes: int
    """Number of echoes with a point in the component (hough), or explained by the line (ml)."""
    paths: Int[np.ndarray, "paths 2"]
    """(tx, rx) of those echoes: the involved real sensors, and virtual sensors where tx and rx differ."""
    scans: tuple[int, ...]
    """Numbers of the scans of those echoes: one, unless the scans of a window were gathered."""
    cov: Float[np.ndarray, "2 2"] | None = None
    """Covariance of (rho, theta), in metres and radians; None for method hough, which estimates none."""

    def as_json(self) -> dict[str, Any]:
        """The line as an object of the JSON Lines file."""
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
    """One corner, edge, pole or circle as observed in one scan, robot frame."""

    x: float
    """Metres."""
    y: float
    """Metres."""
    kind: str
    """ "corner" (right-angled, two reflections), "edge" (diffraction; also thin poles) or "circle" (a round column)."""
    cov: Float[np.ndarray, "n n"]
    """Covariance of (x, y), of a circle of (x, y, radius), square metres."""
    echoes: int
    """Number of echoes that it explains."""
    paths: Int[np.ndarray, "paths 2"]
    """(tx, rx) of those echoes."""
    probability: float
    """Posterior probability of ``kind``."""
    radius: float = float("nan")
    """Radius of a circle, metres; NaN for other kinds. The position of a circle is its center."""

    def as_json(self) -> dict[str, Any]:
        """The point as an object of the JSON Lines file."""
        return {
            "x": self.x,
            "y": self.y,
            "cov": self.cov.tolist(),
            "kind": self.kind,
            "echoes": self.echoes,
            "probability": self.probability,
            **({"radius": self.radius} if self.kind == "circle" else {}),
            "paths": self.paths.tolist(),
        }


@dataclass(frozen=True)
class Undecided:
    """A reflector of uncertain kind: its parameters both as a line and as a point, robot frame."""

    rho: float
    """Distance of the line that is tangent to its echoes, metres."""
    theta: float
    """Direction of the normal of that line, radians, in [-pi, pi)."""
    x: float
    """Position as a point (of a circle: the nearest one), metres; the middle of the observed segment if a plane is the
    most likely kind."""
    y: float
    """Metres."""
    probability: dict[str, float]
    """Posterior probability of "plane", "corner", "edge" and "circle"."""
    echoes: int
    """Number of echoes that it explains."""
    paths: Int[np.ndarray, "paths 2"]
    """(tx, rx) of those echoes."""

    def as_json(self) -> dict[str, Any]:
        """The reflector as an object of the JSON Lines file."""
        return {name: getattr(self, name) for name in ("rho", "theta", "x", "y", "probability", "echoes")} | {
            "paths": self.paths.tolist()
        }


@dataclass(frozen=True)
class LocalModel:
    """Local environment model of one scan, robot frame (paper, section 4)."""

    scan: int
    """Scan number; for a window the number of its last scan, in whose frame the lines are."""
    stamp: float
    """Seconds; NaN if the log has no stamps."""
    lines: tuple[Line, ...]
    """Walls, strongest first."""
    empty: str = ""
    """Reason why there is no line; empty if there is one."""
    points: tuple[Point, ...] = ()
    """Corners, edges and circles, strongest first; none with method hough."""
    undecided: tuple[Undecided, ...] = ()
    """Reflectors of uncertain kind; none with method hough, which takes every reflector for a wall."""
    sigma: float = float("nan")
    """Standard deviation of the ranges, given or estimated from this scan, metres; NaN with method hough."""

    def as_json(self) -> dict[str, Any]:
        """The model as one object of the JSON Lines file."""
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


def save_models(models: Iterable[LocalModel], filename: str | os.PathLike[str]) -> None:
    """Write local models as JSON Lines, one object per scan, each as soon as it is available.

    Args:
        models: the local models.
        filename: the file, which replaces an existing one once it is complete; ``-`` is standard output.
    """
    with open_output(filename) as file:
        for model in models:
            json.dump(model.as_json(), file, allow_nan=False)
            file.write("\n")

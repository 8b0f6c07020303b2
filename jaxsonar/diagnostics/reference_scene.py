"""What stands around the robot in every scan: from each scan alone, or from a map."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.detection.ml_detector import ml_detections
from jaxsonar.detection.settings import hough_settings
from jaxsonar.kernels.measurement_model import predict_all_echoes
from jaxsonar.mapping.build_map import build_map
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import REFERENCE_SPEED_OF_SOUND, Ring

BLOCK = 32
"""Scans looked at in one compiled step."""
WINDOW = 1.5
"""Metres of path gathered into one local model where single scans carry no walls."""
SUPPORT = 3
"""Echoes that a wall must rest on, of as many sensors."""


class Scene(NamedTuple):
    """What stands around the robot in every scan, robot frame."""

    kind: Int[np.ndarray, "scans reflectors"]
    """PLANE, CORNER, EDGE; -1 none."""
    parameters: Float[np.ndarray, "scans reflectors 2"]
    """(rho, theta) of planes, (x, y) of corners and edges; metres, radians."""
    solid: Bool[np.ndarray, "scans reflectors"]
    """Walls that sensors are compared with."""
    ends: Float[np.ndarray, "scans reflectors 2"]
    """Where along them walls begin and end, metres from the foot of the origin."""
    support: Int[np.ndarray, "scans reflectors"]
    """Echoes that it rests on."""
    own: Int[np.ndarray, "scans reflectors sensors"]
    """Of them, those that each sensor sent or heard."""
    sigma: Float[np.ndarray, " scans"]
    """Noise of the ranges, metres; NaN where it is not known."""
    fixed: bool
    """Walls of a map: not moved by the echoes of one scan."""

    def at(self, rows: Int[np.ndarray, " rows"]) -> "Scene":
        """Some of the scans."""
        return Scene(*(column[rows] for column in self[:-1]), fixed=self.fixed)


def evenly(count: int, most: int) -> Int[np.ndarray, " rows"]:
    """Rows of at most so many scans, evenly spread over all."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def thinned(log: Log, rows: Int[np.ndarray, " rows"]) -> Log:
    """Some of the scans of a log."""
    return log if len(rows) == len(log) else Log.from_scans([log[int(row)] for row in rows])


def scene_of_scans(ring: Ring, log: Log, sigma: float | None, progress: Callable[[int, int], None] | None) -> Scene:
    """What explains each scan for itself."""
    flat, _ = FlatEchoes.from_log(ring, log)
    parts, order = [], []
    for found in ml_detections(ring, flat, hough_settings(ring, None), sigma) if len(flat.scan) else ():
        best: Any = found.found  # NumPy arrays by now
        kind, involved = best.kind, best.involved
        scan, row, echo = np.nonzero(involved & (kind >= 0)[..., None])
        tx, rx = ring.paths[found.batch.path[scan, echo]].T
        own = np.zeros((*kind.shape, ring.count), np.int64)
        np.add.at(own, (scan, row, tx), 1)
        np.add.at(own, (scan, row, rx), tx != rx)
        theta = np.where(kind == kernels.PLANE, best.parameters[..., 1], 0.0)
        support = involved.sum(axis=-1)
        solid = (found.decided == kernels.PLANE) & (support >= SUPPORT) & ((own > 0).sum(axis=-1) >= 3)
        ends = _along(theta, best.segment)
        parts.append(Scene(kind, best.parameters, solid, ends, support, own, best.sigma, False))
        order.append(found.batch.scans)
        if progress is not None:
            progress(sum(map(len, order)), len(log))
    if not parts:
        return nowhere(ring, len(log))
    back = np.argsort(np.concatenate(order))
    return Scene(*(np.concatenate(column)[back] for column in list(zip(*parts, strict=True))[:-1]), fixed=False)


def nowhere(ring: Ring, scans: int) -> Scene:
    """Nothing around the robot in any scan."""
    nothing = np.zeros((scans, 1, 2))
    return Scene(
        kind=np.full((scans, 1), -1),
        parameters=nothing,
        solid=np.zeros((scans, 1), bool),
        ends=nothing,
        support=np.zeros((scans, 1), np.int64),
        own=np.zeros((scans, 1, ring.count), np.int64),
        sigma=np.full(scans, np.nan),
        fixed=False,
    )


def scene_of_map(ring: Ring, log: Log) -> Scene:
    """The walls of a map as each scan with a pose should see them, the nearest ten."""
    segments = np.asarray(build_map(ring, log, window=WINDOW).segments, np.float64)
    if not len(segments):
        return nowhere(ring, len(log))
    known = np.all(np.isfinite(log.pose), axis=1)
    pose = np.where(known[:, None], log.pose, 0.0)
    c, s = np.cos(pose[:, 2])[:, None, None], np.sin(pose[:, 2])[:, None, None]
    offset = segments[None] - pose[:, None, None, :2]
    local = np.stack([c * offset[..., 0] + s * offset[..., 1], c * offset[..., 1] - s * offset[..., 0]], axis=-1)
    along = local[:, :, 1] - local[:, :, 0]
    theta = np.arctan2(-along[..., 0], along[..., 1])
    rho = (local[:, :, 0] * np.stack([np.cos(theta), np.sin(theta)], axis=-1)).sum(axis=-1)
    theta, rho = np.where(rho < 0, theta + np.pi, theta), np.abs(rho)
    ends = _along(theta, local)
    # Nearest by the nearest point that a wall has.
    distance = np.hypot(rho, np.maximum(np.maximum(ends[..., 0], -ends[..., 1]), 0))
    order = np.argsort(distance, axis=1, kind="stable")[:, :10]
    near = np.take_along_axis(distance, order, axis=1) < ring.max_range + 0.5
    there = near & known[:, None]
    pick = lambda x: np.take_along_axis(x, order.reshape(order.shape + (1,) * (x.ndim - 2)), axis=1)  # noqa: E731
    many = np.full(order.shape, 10**6)
    return Scene(
        kind=np.where(there, kernels.PLANE, -1),
        parameters=np.stack([pick(rho), pick(theta)], axis=-1),
        solid=there,
        ends=pick(ends),
        support=many,
        own=np.zeros((*order.shape, ring.count), np.int64),
        sigma=np.full(len(log), np.nan),
        fixed=True,
    )


def _along(theta: np.ndarray, segment: np.ndarray) -> np.ndarray:
    """Where along their lines segments begin and end, metres from the foot of the origin."""
    tangent = np.stack([-np.sin(theta), np.cos(theta)], axis=-1)
    return np.sort((segment * tangent[..., None, :]).sum(axis=-1), axis=-1)


def noise_of(scene: Scene) -> float:
    """Median noise of the scans with walls, metres; 10 mm where it is not known, as with a map."""
    known = scene.sigma[scene.solid.any(axis=1)]
    return float(np.median(known)) if np.isfinite(known).any() else 0.01


def outlook_of(ring: Ring, scene: Scene, block: slice) -> tuple[Any, Float[np.ndarray, "block reflectors paths"]]:
    """The ``Outlook`` of a ring in a block of scans, as NumPy, and the ranges that its paths should report, metres."""
    size = block.stop - block.start
    pad = ((0, BLOCK - size), (0, 0))
    kind = np.pad(scene.kind[block], pad, constant_values=-1)
    parameters = np.pad(scene.parameters[block], (*pad, (0, 0)))
    seen = predict_all_echoes(ring.echo_paths, kind.astype(np.int32), parameters.astype(np.float32))
    seen = jax.tree.map(lambda leaf: np.asarray(leaf)[:size], seen)
    scale = REFERENCE_SPEED_OF_SOUND / float(ring.speed_of_sound)
    return seen, seen.range * scale + np.asarray(ring.echo_paths.range_offset, np.float64)

"""Reference reflectors around the robot in every scan, and what the sensors should hear of them."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.detection.ml_detector import ml_detections
from jaxsonar.detection.settings import hough_settings
from jaxsonar.diagnostics.settings import SETTINGS
from jaxsonar.geometry.se2 import rotate, tangent_of, unit
from jaxsonar.hardware.messages import REFERENCE_SPEED_OF_SOUND
from jaxsonar.kernels.detection_cones import predict_all_echoes
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


class ReferenceScene(NamedTuple):
    """Reflectors around the robot in every scan, robot frame."""

    kind: Int[np.ndarray, "scans reflectors"]
    """PLANE, CORNER or EDGE; -1 for no reflector."""
    parameters: Float[np.ndarray, "scans reflectors 2"]
    """(rho, theta) of planes, (x, y) of corners and edges; metres, radians."""
    is_wall: Bool[np.ndarray, "scans reflectors"]
    """Reference walls, which sensors are compared with. The other reflectors only explain echoes."""
    extent: Float[np.ndarray, "scans reflectors 2"]
    """Start and end of walls along their tangent, metres from the foot of the origin."""
    echoes: Int[np.ndarray, "scans reflectors"]
    """Number of echoes that support each reflector."""
    echoes_of_sensor: Int[np.ndarray, "scans reflectors sensors"]
    """Number of those echoes that each sensor sent or received."""
    sigma: Float[np.ndarray, " scans"]
    """Standard deviation of the ranges, metres; NaN where it is unknown."""
    number: Int[np.ndarray, "scans reflectors"]
    """Number of each reflector; scans of one piece of the trajectory share them. -1 for no reflector."""
    shift: Float[np.ndarray, "scans reflectors"]
    """Minus the derivative of a wall's rho by its theta, both in the frame in which it was estimated, metres: where the
    robot is along the wall in that frame."""
    by_poses: bool
    """Whether the poses of the log gather the echoes of several scans."""

    def at(self, rows: Int[np.ndarray, " rows"]) -> "ReferenceScene":
        """The given scans."""
        return ReferenceScene(*(column[rows] for column in self[:-1]), by_poses=self.by_poses)

    def noise(self, *, default: float) -> float:
        """Median standard deviation of the ranges in scans with walls, metres; ``default`` where it is unknown."""
        known = self.sigma[self.is_wall.any(axis=1)]
        return float(np.median(known)) if np.isfinite(known).any() else default


def evenly_spaced(count: int, most: int) -> Int[np.ndarray, " rows"]:
    """At most ``most`` of the rows 0 to count - 1, evenly spaced."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def select_scans(log: Log, rows: Int[np.ndarray, " rows"]) -> Log:
    """The given scans of a log, with the motion between all of its scans."""
    if len(rows) == len(log):
        return log
    return replace(Log.from_scans([log[int(row)] for row in rows]), odometry=log.motion)


def renumber(log: Log, place: Int[np.ndarray, " sensors"]) -> Log:
    """The log with other sensor numbers: sensor k becomes ``place[k]``."""
    return replace(log, tx=place[log.tx], rx=place[log.rx], asked=place[log.asked])


def scene_from_scans(
    ring: Ring, log: Log, sigma: float | None, progress: Callable[[int, int], None] | None
) -> ReferenceScene:
    """The reflectors that explain each scan alone (maximum likelihood detector)."""
    flat, _ = FlatEchoes.from_log(ring, log)
    scenes, order = [], []
    for batch in ml_detections(ring, flat, hough_settings(ring, None), sigma) if len(flat.scan) else ():
        found: Any = batch.found  # of NumPy arrays
        kind, involved = found.kind, found.involved
        scan, row, echo = np.nonzero(involved & (kind >= 0)[..., None])
        tx, rx = ring.paths[batch.batch.path[scan, echo]].T
        of_sensor = np.zeros((*kind.shape, ring.count), np.int64)
        np.add.at(of_sensor, (scan, row, tx), 1)
        np.add.at(of_sensor, (scan, row, rx), tx != rx)
        theta = np.where(kind == kernels.PLANE, found.parameters[..., 1], 0.0)
        echoes = involved.sum(axis=-1)
        least = SETTINGS.reference.min_echoes
        is_wall = (batch.decided == kernels.PLANE) & (echoes >= least) & ((of_sensor > 0).sum(axis=-1) >= least)
        extent = _extent_along(theta, found.segment)
        scenes.append(
            ReferenceScene(
                kind,
                found.parameters,
                is_wall,
                extent,
                echoes,
                of_sensor,
                found.sigma,
                number=np.zeros_like(kind),
                shift=np.zeros(kind.shape),
                by_poses=False,
            )
        )
        order.append(batch.batch.scans)
        if progress is not None:
            progress(sum(map(len, order)), len(log))
    if not scenes:
        return empty_scene(ring, len(log))
    back = np.argsort(np.concatenate(order))
    columns = list(zip(*scenes, strict=True))[:-1]
    scene = ReferenceScene(*(np.concatenate(column)[back] for column in columns), by_poses=False)
    return scene._replace(number=np.arange(scene.kind.size).reshape(scene.kind.shape))


def empty_scene(ring: Ring, scans: int) -> ReferenceScene:
    """No reflector in any scan."""
    return ReferenceScene(
        kind=np.full((scans, 1), -1),
        parameters=np.zeros((scans, 1, 2)),
        is_wall=np.zeros((scans, 1), bool),
        extent=np.zeros((scans, 1, 2)),
        echoes=np.zeros((scans, 1), np.int64),
        echoes_of_sensor=np.zeros((scans, 1, ring.count), np.int64),
        sigma=np.full(scans, np.nan),
        number=np.full((scans, 1), -1),
        shift=np.zeros((scans, 1)),
        by_poses=False,
    )


def move_scene(scene: ReferenceScene, robot_from_other: Float[np.ndarray, "scans 3"]) -> ReferenceScene:
    """The reflectors in another frame in each scan; the extent of the walls is not kept.

    Args:
        scene: reflectors, robot frame.
        robot_from_other: pose of the other frame, robot frame: x, y (m), theta (rad).
    """
    turn = robot_from_other[:, None, 2]
    plane = scene.kind == kernels.PLANE
    first, second = np.moveaxis(scene.parameters.astype(np.float64), -1, 0)
    rho = first - (robot_from_other[:, None, :2] * unit(second)).sum(axis=-1)
    theta = np.where(rho < 0, second + np.pi, second) - turn
    point = rotate(scene.parameters - robot_from_other[:, None, :2], -turn)
    parameters = np.where(plane[..., None], np.stack([np.abs(rho), theta], axis=-1), point)
    return scene._replace(parameters=parameters, extent=np.full_like(scene.extent, np.nan))


def predict_reports(
    ring: Ring, scene: ReferenceScene, block: slice, path_pose: Float[np.ndarray, "scans paths 3"] | None = None
) -> tuple[Any, Float[np.ndarray, "block reflectors paths"]]:
    """Predicted echoes of all paths from all reflectors in a block of scans.

    Args:
        ring: the sensors.
        scene: the reflectors of all scans.
        block: rows of the scans.
        path_pose: scan_from_robot of all scans when each path was measured; None for a robot at rest.

    Returns:
        A ``PredictionTable`` of NumPy arrays, and the ranges that the paths would report, metres.
    """
    size = block.stop - block.start
    padding = ((0, SETTINGS.reference.block_scans - size), (0, 0))
    kind = np.pad(scene.kind[block], padding, constant_values=-1)
    parameters = np.pad(scene.parameters[block], (*padding, (0, 0)))
    pose = None if path_pose is None else np.pad(path_pose[block], (*padding, (0, 0))).astype(np.float32)
    padded = predict_all_echoes(ring.echo_paths, kind.astype(np.int32), parameters.astype(np.float32), pose)
    predicted: Any = jax.tree.map(lambda leaf: np.asarray(leaf)[:size], padded)
    scale = REFERENCE_SPEED_OF_SOUND / float(ring.speed_of_sound)
    return predicted, predicted.range * scale + np.asarray(ring.echo_paths.range_offset, np.float64)


def _extent_along(theta: np.ndarray, segment: np.ndarray) -> np.ndarray:
    """Start and end of segments along the tangents of their lines, metres from the foot of the origin."""
    return np.sort((segment * tangent_of(theta)[..., None, :]).sum(axis=-1), axis=-1)

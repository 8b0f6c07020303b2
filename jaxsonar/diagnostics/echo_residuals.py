"""Residuals of echoes against reference walls: what every path should hear of them, and its nearest echo."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.diagnostics.reference_scene import ReferenceScene, predict_reports
from jaxsonar.diagnostics.settings import SETTINGS
from jaxsonar.geometry.se2 import tangent_of, transform_points, unit
from jaxsonar.hardware.messages import REFERENCE_SPEED_OF_SOUND
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.sliding_windows import is_fresh_reading
from jaxsonar.sensors.ring import Ring


class ResidualTable(NamedTuple):
    """Predicted and reported ranges.

    The columns ``rows`` have an entry for every wall and path that may hear it; the columns ``echoes`` for every echo
    in scans with walls.
    """

    wall: Int[np.ndarray, " rows"]
    """Number of the wall, counted over all scans."""
    scan: Int[np.ndarray, " rows"]
    """Scan."""
    tx: Int[np.ndarray, " rows"]
    """Transmitter."""
    rx: Int[np.ndarray, " rows"]
    """Receiver."""
    residual: Float[np.ndarray, " rows"]
    """Reported minus predicted range of the path's nearest echo, metres; inf without an echo. Only a path that was
    measured has a row."""
    is_nearest: Bool[np.ndarray, " rows"]
    """Whether no other reflector predicts a range closer to that echo."""
    d_range_d_wall: Float[np.ndarray, "rows 2"]
    """Derivatives of the predicted range with respect to the wall's rho and theta."""
    visibility: Float[np.ndarray, " rows"]
    """Weight by both detection cones: 1 inside, 0 outside."""
    off_axis: Float[np.ndarray, " rows"]
    """Angle of the sound off the axis of the transmitter, radians."""
    beyond_end: Float[np.ndarray, " rows"]
    """Distance of the point of reflection from the wall's ends, metres; 0 between them."""
    unobstructed: Bool[np.ndarray, " rows"]
    """Whether no known wall is in the way, and the reading is a new one as far as the log shows."""
    along: Float[np.ndarray, " rows"]
    """Point of reflection along the wall, from a fixed point of it, metres."""
    independent_echoes: Int[np.ndarray, " rows"]
    """Echoes that support the wall without those of the sensor itself (for a cross path: of the path, both ways). If
    the poses gather the walls: around the point of reflection, because there may be gaps in a wall."""
    is_between: Bool[np.ndarray, " rows"]
    """Whether such echoes are on both sides of the point of reflection; True if single scans show the walls."""
    echo_tx: Int[np.ndarray, " echoes"]
    """Transmitter of each echo."""
    echo_rx: Int[np.ndarray, " echoes"]
    """Receiver of each echo."""
    echo_residual: Float[np.ndarray, " echoes"]
    """Distance to the nearest reflector that the path can hear, metres; inf without one."""


def predict_and_match(ring: Ring, scene: ReferenceScene, log: Log) -> ResidualTable:
    """Predict what each measured path should hear of each wall, and match it with the nearest echo.

    Args:
        ring: the sensors.
        scene: the reflectors of each scan.
        log: the scans; readings with a time of their own are predicted from the robot's pose at that time.
    """
    flat, _ = FlatEchoes.from_log(ring, log)
    # Only a log that marks neither silence nor ages needs a guess which readings are new.
    unmarked = len(log.asked) > 0 and not log.age.any()
    fresh = is_fresh_reading(flat) if scene.by_poses and unmarked else np.ones(len(flat.scan), bool)
    size = SETTINGS.reference.block_scans
    blocks = [slice(first, min(first + size, len(log))) for first in range(0, max(1, len(log)), size)]
    tables = [
        _match_block(ring, scene, block, flat, *_dense_ranges(flat, block, fresh, len(ring.paths))) for block in blocks
    ]
    table = ResidualTable(*(np.concatenate(column) for column in zip(*tables, strict=True)))
    if not scene.by_poses:
        return table
    sides = _echoes_around(table)
    return table._replace(independent_echoes=sides.sum(axis=1), is_between=(sides > 0).all(axis=1))


def _echoes_around(table: ResidualTable) -> Int[np.ndarray, "rows 2"]:
    """Echoes of other sensors that the wall reflected on each side of the point of reflection of each row."""
    settings = SETTINGS.reference
    heard = np.abs(table.residual) < settings.support_gate
    heard &= table.is_nearest & (table.visibility > 0) & (table.beyond_end <= settings.end_margin)
    place = table.wall * settings.apart + np.clip(table.along, -settings.apart / 3, settings.apart / 3)

    def around(of: Bool[np.ndarray, " rows"], at: Float[np.ndarray, " places"]) -> Int[np.ndarray, "places 2"]:
        echoes = np.sort(place[of])
        bounds = [np.searchsorted(echoes, at + side * settings.end_margin) for side in (-1, 0, 1)]
        return np.diff(bounds, axis=0).T

    support = around(heard, place)
    low, high = np.minimum(table.tx, table.rx), np.maximum(table.tx, table.rx)
    for one, other in np.unique(np.stack([low, high], axis=-1), axis=0):
        of_path = (low == one) & (high == other)
        own = heard & ((low == one) | (high == one) if one == other else of_path)
        support[of_path] -= around(own, place[of_path])
    return support


def _match_block(
    ring: Ring,
    scene: ReferenceScene,
    block: slice,
    flat: FlatEchoes,
    reported: Float[np.ndarray, "block paths slots"],
    is_new: Bool[np.ndarray, "block paths"],
) -> ResidualTable:
    """The table of one block of scans, from reported ranges and whether they are new readings."""
    tx, rx = ring.paths.T
    predicted, expected = predict_reports(ring, scene, block, flat.path_pose)
    is_wall = scene.is_wall[block]
    # Each echo belongs to the nearest reflector. Each wall gets the nearest echo of each path.
    difference = reported[:, None] - expected[..., None]
    difference = np.where(predicted.exists[..., None] & np.isfinite(difference), difference, np.inf)
    distance = np.where((predicted.visibility > 0)[..., None], np.abs(difference), np.inf)
    nearest = np.abs(difference).argmin(axis=-1)[..., None]
    residual = np.take_along_axis(difference, nearest, axis=-1)[..., 0]
    nearest_reflector = np.broadcast_to(distance.argmin(axis=1)[:, None], difference.shape)
    owner = np.take_along_axis(nearest_reflector, nearest, axis=-1)[..., 0]
    # Where the sound is reflected, and whether something is in the way.
    start, end = np.moveaxis(scene.extent[block], -1, 0)
    beyond_end = np.maximum(start[..., None] - predicted.footpoint, predicted.footpoint - end[..., None])
    unobstructed = ~_is_behind_wall(scene, block, predicted.footpoint) & is_new[:, None]
    if scene.by_poses:
        midpoint = np.broadcast_to(ring.exact_paths.midpoint, (len(is_wall), len(tx), 2))
        if flat.path_pose is not None:
            midpoint = transform_points(flat.path_pose[block], midpoint)
        unobstructed &= ~_is_occluded(midpoint, scene, block, predicted.footpoint)
    # Walls that a path may hear; direct paths also if the wall is outside of the cone, to measure the cone.
    kept = is_wall[..., None] & predicted.exists & (predicted.range < ring.max_range - SETTINGS.reference.range_margin)
    kept &= (predicted.visibility > 0) | (tx == rx)
    if flat.measured is not None:
        kept &= flat.measured[block][:, None]
    row = s, r, p = np.nonzero(kept)
    of_tx, of_rx = (scene.echoes_of_sensor[block][s, r, sensor[p]] for sensor in (tx, rx))
    own = np.minimum(of_tx, of_rx)  # at least the echoes of the path, both ways
    if not scene.by_poses:
        own = np.where(tx[p] == rx[p], own, 2)
    scale = REFERENCE_SPEED_OF_SOUND / float(ring.speed_of_sound)
    by_wall = predicted.d_range_d_landmark[row].astype(np.float64)
    by_wall[:, 1] -= by_wall[:, 0] * scene.shift[block][s, r]
    scan, path, slot = np.nonzero(np.isfinite(reported) & np.any(is_wall, axis=1)[:, None, None])
    return ResidualTable(
        wall=scene.number[block][s, r],
        scan=s + block.start,
        tx=tx[p],
        rx=rx[p],
        residual=residual[row],
        is_nearest=np.equal(owner[row], r),
        d_range_d_wall=(by_wall * scale).astype(np.float32),
        visibility=predicted.visibility[row],
        off_axis=predicted.departure_angle[row],
        beyond_end=np.maximum(beyond_end, 0)[row],
        unobstructed=unobstructed[row],
        along=predicted.footpoint[row] + scene.shift[block][s, r],
        independent_echoes=scene.echoes[block][s, r] - own,
        is_between=np.ones(len(s), bool),
        echo_tx=tx[path],
        echo_rx=rx[path],
        echo_residual=distance.min(axis=1)[scan, path, slot],
    )


def _dense_ranges(
    flat: FlatEchoes, block: slice, fresh: Bool[np.ndarray, " echoes"], paths: int
) -> tuple[Float[np.ndarray, "block paths slots"], Bool[np.ndarray, "block paths"]]:
    """Reported ranges in ascending order, NaN for none, and whether all readings of a path are new."""
    begin, end = int(flat.start[block.start]), int(flat.start[block.stop])
    scan, path = flat.scan[begin:end] - block.start, flat.path[begin:end]
    order = np.lexsort((flat.reported[begin:end], path, scan))
    key = (scan * paths + path)[order]
    rank = np.arange(len(key)) - np.searchsorted(key, key)
    reported = np.full((block.stop - block.start, paths, max(1, int(rank.max(initial=0)) + 1)), np.nan)
    reported[scan[order], path[order], rank] = flat.reported[begin:end][order]
    is_new = np.ones(reported.shape[:2], bool)
    stale = ~fresh[begin:end]
    is_new[scan[stale], path[stale]] = False
    return reported, is_new


def _is_behind_wall(
    scene: ReferenceScene, block: slice, footpoint: Float[np.ndarray, "block reflectors paths"]
) -> Bool[np.ndarray, "block reflectors paths"]:
    """Points of reflection beyond the observed ends of their wall that lie behind the line of another wall."""
    settings = SETTINGS.reference
    rho, theta = np.moveaxis(scene.parameters[block].astype(np.float64), -1, 0)
    is_wall, (start, end) = scene.is_wall[block], np.moveaxis(scene.extent[block], -1, 0)
    angle = theta[:, :, None] - theta[:, None, :]
    # n_j . (rho_i n_i + s t_i) = rho_i cos(theta_i - theta_j) - s sin(theta_i - theta_j)
    depth = rho[..., None, None] * np.cos(angle)[..., None] - footpoint[:, :, None, :] * np.sin(angle)[..., None]
    behind = (depth > rho[:, None, :, None] + settings.range_margin) & is_wall[:, None, :, None]
    behind &= (np.abs(angle) > settings.min_wall_angle)[..., None]
    beyond_end = (footpoint < start[..., None]) | (footpoint > end[..., None])
    return behind.any(axis=2) & beyond_end


def _is_occluded(
    midpoint: Float[np.ndarray, "block paths 2"],
    scene: ReferenceScene,
    block: slice,
    footpoint: Float[np.ndarray, "block reflectors paths"],
) -> Bool[np.ndarray, "block reflectors paths"]:
    """Points of reflection that another wall occludes from the virtual sensor of the path, which is in ``midpoint``."""
    rho, theta = np.moveaxis(scene.parameters[block].astype(np.float64), -1, 0)
    n, t = unit(theta), tangent_of(theta)
    point = (rho[..., None] * n)[:, :, None] + footpoint[..., None] * t[:, :, None]  # (scans, walls, paths, 2)
    ray = point - midpoint[:, None]
    # Where the ray to the point of wall w crosses the line of wall j, as a fraction of the ray and along the wall.
    toward = np.einsum("swpx,sjx->swjp", ray, n)
    height = rho[:, None, :, None] - np.einsum("spx,sjx->sjp", midpoint, n)[:, None]
    fraction = height / np.where(toward == 0, 1, toward)
    along = np.einsum("spx,sjx->sjp", midpoint, t)[:, None] + fraction * np.einsum("swpx,sjx->swjp", ray, t)
    start, end = np.moveaxis(scene.extent[block], -1, 0)[..., None, :, None]
    crosses = (
        (fraction > 0) & (fraction < 0.97) & (along > start) & (along < end) & scene.is_wall[block][:, None, :, None]
    )
    return crosses.any(axis=2)


def explained_fraction(table: ResidualTable, gate: float, sensors: int) -> Float[np.ndarray, " sensors"]:
    """Fraction of the echoes of each sensor, sent or received, within ``gate`` (metres) of a reflector."""
    cross = table.echo_tx != table.echo_rx
    explained = np.abs(table.echo_residual) < gate

    def count(which: Bool[np.ndarray, " echoes"]) -> np.ndarray:
        return np.bincount(np.append(table.echo_tx[which], table.echo_rx[which & cross]), minlength=sensors)

    total = count(np.ones(len(explained), bool))
    return np.where(total > 0, count(explained) / np.maximum(total, 1), np.nan)

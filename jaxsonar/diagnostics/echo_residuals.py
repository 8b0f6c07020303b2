"""What each path should hear of the walls of every scan, and the echo nearest to it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.diagnostics.reference_scene import BLOCK, Scene, outlook_of
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.sliding_windows import is_fresh_reading
from jaxsonar.sensors.ring import REFERENCE_SPEED_OF_SOUND, Ring

MARGIN = 0.25
"""Metres that a wall is taken to go on beyond its outermost feet, where nothing cuts it."""


class Look(NamedTuple):
    """Columns, one row for every path and wall that it may hear; then of every echo in scans with walls."""

    wall: Int[np.ndarray, " rows"]
    """Number of the wall, counted over all scans."""
    tx: Int[np.ndarray, " rows"]
    """Sensor that sends."""
    rx: Int[np.ndarray, " rows"]
    """Sensor that hears."""
    residual: Float[np.ndarray, " rows"]
    """Reported - expected, metres, of the nearest echo; inf: none."""
    mine: Bool[np.ndarray, " rows"]
    """No other reflector is nearer to that echo."""
    slope: Float[np.ndarray, "rows 2"]
    """Derivatives of the expected range by the wall's rho and theta."""
    share: Float[np.ndarray, " rows"]
    """How far it lies within both cones."""
    angle: Float[np.ndarray, " rows"]
    """Off the axis of the transmitter, radians."""
    beyond: Float[np.ndarray, " rows"]
    """Metres from the wall's ends to the point of reflection; 0 between them."""
    open: Bool[np.ndarray, " rows"]
    """Nothing stands before it, as far as is known, and the reading is new."""
    others: Int[np.ndarray, " rows"]
    """Echoes that the wall rests on without the sensor (of cross echoes: the path, there and back) itself."""
    echo_tx: Int[np.ndarray, " echoes"]
    """Sensor that sent the echo."""
    echo_rx: Int[np.ndarray, " echoes"]
    """Sensor that heard it."""
    echo_residual: Float[np.ndarray, " echoes"]
    """Metres to the nearest reflector that its path can hear; inf: none."""


def looked(ring: Ring, scene: Scene, log: Log) -> Look:
    """What each path should hear of each wall, and the echo nearest to it."""
    flat, _ = FlatEchoes.from_log(ring, log)
    fresh = is_fresh_reading(flat) if scene.fixed else np.ones(len(flat.scan), bool)
    number = np.cumsum(scene.solid).reshape(scene.solid.shape) - 1
    blocks = [slice(first, min(first + BLOCK, len(log))) for first in range(0, max(1, len(log)), BLOCK)]
    parts = [_looked_at(ring, scene, block, *_dense(flat, block, fresh, len(ring.paths)), number) for block in blocks]
    return Look(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _looked_at(
    ring: Ring,
    scene: Scene,
    block: slice,
    reported: Float[np.ndarray, "block paths slots"],
    new: Bool[np.ndarray, "block paths"],
    number: Int[np.ndarray, "scans reflectors"],
) -> Look:
    """The same of a block of scans; ranges as reported, and whether they are new readings."""
    tx, rx = ring.paths.T
    seen, wanted = outlook_of(ring, scene, block)
    solid = scene.solid[block]
    # Each echo belongs to the reflector nearest to it; each wall gets the nearest echo of each path.
    away = reported[:, None] - wanted[..., None]
    away = np.where(seen.exists[..., None] & np.isfinite(away), away, np.inf)
    heard = np.where((seen.visibility > 0)[..., None], np.abs(away), np.inf)
    nearest = np.abs(away).argmin(axis=-1)[..., None]
    residual = np.take_along_axis(away, nearest, axis=-1)[..., 0]
    best = np.broadcast_to(heard.argmin(axis=1)[:, None], away.shape)
    owner = np.take_along_axis(best, nearest, axis=-1)[..., 0]
    low, high = np.moveaxis(scene.ends[block], -1, 0)
    beyond = np.maximum(low[..., None] - seen.footpoint, seen.footpoint - high[..., None])
    clear = ~_behind(scene, block, seen.footpoint) & new[:, None]
    if scene.fixed:
        clear &= ~_hidden(np.asarray(ring.echo_paths.midpoint, np.float64), scene, block, seen.footpoint)
    kept = solid[..., None] & seen.exists & (seen.range < ring.max_range - 0.02)
    kept &= (seen.visibility > 0) | (tx == rx)
    row = s, r, p = np.nonzero(kept)
    alone = np.where(tx[p] == rx[p], scene.own[block][s, r, tx[p]], 2)
    scale = REFERENCE_SPEED_OF_SOUND / float(ring.speed_of_sound)
    scan, path, slot = np.nonzero(np.isfinite(reported) & np.any(solid, axis=1)[:, None, None])
    return Look(
        wall=number[block][s, r],
        tx=tx[p],
        rx=rx[p],
        residual=residual[row],
        mine=np.equal(owner[row], r),
        slope=seen.d_range_d_reflector[row] * scale * (not scene.fixed),
        share=seen.visibility[row],
        angle=seen.departure_angle[row],
        beyond=np.maximum(beyond, 0)[row],
        open=clear[row],
        others=scene.support[block][s, r] - alone,
        echo_tx=tx[path],
        echo_rx=rx[path],
        echo_residual=heard.min(axis=1)[scan, path, slot],
    )


def _dense(flat: FlatEchoes, block: slice, fresh: np.ndarray, paths: int) -> tuple[np.ndarray, np.ndarray]:
    """Ranges (scans, paths, slots), NaN = none; and where all of them are new readings (scans, paths)."""
    begin, end = int(flat.start[block.start]), int(flat.start[block.stop])
    scan, path = flat.scan[begin:end] - block.start, flat.path[begin:end]
    order = np.lexsort((flat.reported[begin:end], path, scan))
    key = (scan * paths + path)[order]
    rank = np.arange(len(key)) - np.searchsorted(key, key)
    reported = np.full((block.stop - block.start, paths, max(1, int(rank.max(initial=0)) + 1)), np.nan)
    reported[scan[order], path[order], rank] = flat.reported[begin:end][order]
    new = np.ones(reported.shape[:2], bool)
    stale = ~fresh[begin:end]
    new[scan[stale], path[stale]] = False
    return reported, new


def _behind(scene: Scene, block: slice, foot: np.ndarray) -> np.ndarray:
    """Points of reflection beyond a wall's seen ends that lie behind another wall: (scans, reflectors, paths)."""
    rho, theta = np.moveaxis(scene.parameters[block].astype(np.float64), -1, 0)
    solid, (low, high) = scene.solid[block], np.moveaxis(scene.ends[block], -1, 0)
    turn = theta[:, :, None] - theta[:, None, :]
    # n_j . (rho_i n_i + foot t_i) = rho_i cos + foot sin(theta_j - theta_i)
    depth = rho[..., None, None] * np.cos(turn)[..., None] - foot[:, :, None, :] * np.sin(turn)[..., None]
    over = (depth > rho[:, None, :, None] + 0.02) & solid[:, None, :, None] & (np.abs(turn) > 0.1)[..., None]
    outside = (foot < low[..., None]) | (foot > high[..., None])
    return over.any(axis=2) & outside


def _hidden(midpoint: np.ndarray, scene: Scene, block: slice, foot: np.ndarray) -> np.ndarray:
    """Points of reflection that another wall hides from the virtual sensor: (scans, reflectors, paths)."""
    rho, theta = np.moveaxis(scene.parameters[block].astype(np.float64), -1, 0)
    n, t = (np.stack(pair, axis=-1) for pair in ((np.cos(theta), np.sin(theta)), (-np.sin(theta), np.cos(theta))))
    point = (rho[..., None] * n)[:, :, None] + foot[..., None] * t[:, :, None]  # (scans, walls, paths, 2)
    ray = point - midpoint
    towards = np.einsum("swpx,sjx->swjp", ray, n)
    share = (rho[:, None, :, None] - np.einsum("px,sjx->sjp", midpoint, n)[:, None]) / np.where(
        towards == 0, 1, towards
    )
    where = np.einsum("px,sjx->sjp", midpoint, t)[:, None] + share * np.einsum("swpx,sjx->swjp", ray, t)
    low, high = np.moveaxis(scene.ends[block], -1, 0)[..., None, :, None]
    crossed = (share > 0) & (share < 0.97) & (where > low) & (where < high) & scene.solid[block][:, None, :, None]
    return crossed.any(axis=2)


def explained_share(look: Look, gate: float, count: int) -> np.ndarray:
    """Share of the echoes of each sensor, sent or heard, that a reflector explains."""
    once = look.echo_tx != look.echo_rx
    fits = np.abs(look.echo_residual) < gate

    def each(which: Bool[np.ndarray, " echoes"]) -> np.ndarray:
        return np.bincount(np.append(look.echo_tx[which], look.echo_rx[which & once]), minlength=count)

    total = each(np.ones(len(fits), bool))
    return np.where(total > 0, each(fits) / np.maximum(total, 1), np.nan)

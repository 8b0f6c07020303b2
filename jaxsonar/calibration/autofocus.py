"""The first stage of calibration: a badly wrong ring is focused until the echoes of walls meet in the accumulator.

What comes out is near enough for least squares, which needs to know which echoes belong together. Sharpening alone
collapses along the mean range offset and the speed of sound: the mean is held, the speed has a prior.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsonar import kernels
from jaxsonar.hardware.errors import SonarError
from jaxsonar.kernels.array_geometry import SensorArray
from jaxsonar.kernels.autofocus import ring_focus_measure
from jaxsonar.kernels.hough_accumulator import HoughSettings
from jaxsonar.kernels.shape_buckets import bucket_size
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring_parameters import PRIOR

OFFSET_SD = 0.015
"""Metres; prior of a sensor's relative range offset around the given one."""
MOST_OFFSET, MOST_SPEED = 0.050, 0.04
"""Metres, and share of the speed: no result is farther from the given ring."""
WORLD = 8.0
"""Metres; scans taken farther from the middle of a log's poses are left out, so that the accumulator stays small."""
_CELL = 0.01  # m, of rho
_WIDTHS = (1.5, 1.0)  # cells, from coarse to fine; wider ones led the office's drive, which hardly turns, astray
_STEPS = 20  # of each width
_STRIDES = (0.1, 0.03)  # of each width, in standard deviations of the prior
_BEYOND = 1.05  # echoes near the maximum range stay when offsets and speed move


def autofocus_ring(ring: Ring, log: Log, *, poses: bool, speed: bool, scans: int = 40) -> Ring:
    """The ring with the relative range offsets, and the speed of sound, that make its echoes meet most sharply.

    The mean range offset stays as given. Without poses each scan is looked at alone, and offsets that look like a move
    of the whole ring are hardly seen: they stay nearly as given. The given ring comes back, the same object, unless
    the sharpness at the finest scale rose, by more nats than parameters were fitted.

    Args:
        ring: as far as it is known.
        log: what it heard.
        poses: trust the poses of the log; scans without one are left out.
        speed: also find the speed of sound; it takes poses.
        scans: use this many at most, evenly chosen.

    Raises:
        SonarError: speed without poses, no scan to use, fewer than one scan asked for, or a sensor the ring lacks.
    """
    if speed and not poses:
        raise SonarError("focus: speed=True with poses=False came; allowed is speed only with poses, which give scale")
    if scans < 1:
        raise SonarError(f"focus: scans = {scans} came; allowed is 1 or more")
    echoes, reach = _chosen(ring, log, poses, scans)
    # Curves of a far wall run steeply through the world, up to metres a radian; in the robot frame never so.
    fine = HoughSettings(theta_cells=720 if poses else 120, point_pitch=float(np.radians(0.5 if poses else 1.0)))
    columns = bucket_size(int(np.ceil((reach + _BEYOND * ring.max_range) / _CELL)), least=64)
    settings = dataclasses.replace(fine, rho_cell=_CELL, rho_cells=min(columns, 1_000_000 // fine.theta_cells))
    points = kernels.points_of_widest_arc(np.asarray(ring.beam), settings)
    whole = ring.sensors
    sensors = dataclasses.replace(whole, max_range=whole.max_range * _BEYOND)
    moved, gain = _momentum_ascent(sensors, echoes, settings=settings, points=points, speed=speed)
    if not float(gain) > ring.count - 1 + speed:  # False for NaN
        return ring
    move = np.asarray(moved, dtype=np.float64)
    offset = OFFSET_SD * (move[:-1] - move[:-1].mean())
    factor = np.exp(PRIOR.speed_sd * move[-1]) if speed else 1.0
    return dataclasses.replace(
        ring, range_offset=ring.range_offset + offset, speed_of_sound=ring.speed_of_sound * factor
    )


def _chosen(ring: Ring, log: Log, poses: bool, most: int) -> tuple[kernels.PackedEchoes, float]:
    """Packed echoes, all in one row if there are poses, and how far from the origin the sensors are, metres."""
    flat, _ = FlatEchoes.from_log(ring, log)
    usable = np.diff(flat.start) > 0
    if poses:
        usable &= np.isfinite(log.pose).all(axis=1)
        middle = np.median(log.pose[usable, :2], axis=0) if usable.any() else np.zeros(2)
        with np.errstate(invalid="ignore"):
            usable &= np.hypot(*(log.pose[:, :2] - middle).T) <= WORLD
    index = np.flatnonzero(usable)
    if not len(index):
        needed = "an echo of this ring's paths" + (" and a pose" if poses else "")
        raise SonarError(f"log: {len(log)} scans came, none with {needed}; allowed is a log with at least one")
    if len(index) > most:
        index = index[np.round(np.linspace(0, len(index) - 1, most)).astype(int)]
    rank = np.full(len(log), -1)
    rank[index] = np.arange(len(index))
    row = rank[flat.scan]
    echo = np.flatnonzero(row >= 0)
    row, column = row[echo], echo - flat.start[flat.scan[echo]]
    size = float(np.hypot(*np.asarray(ring.position).T).max())
    if poses:
        at = log.pose[flat.scan[echo]]
        centre = at[:, :2].mean(axis=0)
        at = np.column_stack([at[:, :2] - centre, at[:, 2]])
        row, column = np.zeros_like(row), np.arange(len(echo))
        shape = (1, bucket_size(len(echo), least=512))
        size += float(np.hypot(*at[:, :2].T).max())
        pose = np.zeros((*shape, 3), np.float32)
        pose[row, column] = at
    else:
        pose, shape = None, (bucket_size(len(index), least=8), bucket_size(int(column.max()) + 1, least=64))
    path, reported = np.zeros(shape, np.int32), np.full(shape, np.nan, np.float32)
    path[row, column] = flat.path[echo]
    reported[row, column] = flat.reported[echo]
    return kernels.PackedEchoes(jnp.asarray(path), jnp.asarray(reported), None if pose is None else jnp.asarray(pose)), size


@partial(jax.jit, static_argnames=("settings", "points", "speed"))
def _momentum_ascent(
    sensors: SensorArray, echoes: kernels.PackedEchoes, *, settings: HoughSettings, points: int, speed: bool
) -> tuple[Float[Array, " parameters"], Float[Array, ""]]:
    """Momentum steps of falling length on sharpness and prior, coarse to fine, in standard deviations of the prior.

    Steps of a bounded length, because votes are piecewise bilinear: their slopes jump from cell to cell.

    Returns:
        The offsets' and the speed's move, and by how much the sharpness at the finest scale rose, nats.
    """
    count = sensors.range_offset.shape[0]

    def allowed(move: Float[Array, " parameters"]) -> Float[Array, " parameters"]:
        offset = move[:count] - move[:count].mean()
        offset = offset * jnp.minimum(1, MOST_OFFSET / OFFSET_SD / jnp.maximum(jnp.abs(offset).max(), 1e-6))
        most = jnp.log1p(jnp.asarray([-MOST_SPEED, MOST_SPEED], move.dtype)) / PRIOR.speed_sd * float(speed)
        return jnp.append(offset, jnp.clip(move[count], most[0], most[1]))

    def sharp(move: Float[Array, " parameters"], width: Float[Array, ""]) -> Float[Array, ""]:
        offset = sensors.range_offset + OFFSET_SD * move[:count]
        scale = sensors.range_scale * jnp.exp(PRIOR.speed_sd * move[count])
        changed = dataclasses.replace(sensors, range_offset=offset, range_scale=scale)
        return ring_focus_measure(changed, echoes, width, settings=settings, points=points)

    def slope(move: Float[Array, " parameters"], width: Float[Array, ""]) -> Float[Array, " parameters"]:
        raw = jax.grad(sharp)(move, width) - move  # the prior's is the move itself, in its standard deviations
        return jnp.append(raw[:count] - raw[:count].mean(), raw[count] * float(speed))

    def one_width(move, stage):
        width, stride = stage

        def step(state, k):
            move, mean, square = state
            up = slope(move, width)
            mean = 0.8 * mean + 0.2 * up
            square = 0.95 * square + 0.05 * jnp.mean(up * up)  # one for all: directions stay as they are
            length = stride * (1 - k / _STEPS) / jnp.sqrt(square / (1 - 0.95 ** (k + 1)) + 1e-12)
            return (allowed(move + length * mean / (1 - 0.8 ** (k + 1))), mean, square), None

        start = (move, jnp.zeros_like(move), jnp.zeros((), move.dtype))
        return jax.lax.scan(step, start, jnp.arange(_STEPS, dtype=move.dtype))[0][0], None

    given = jnp.zeros(count + 1, sensors.range_offset.dtype)
    stages = (jnp.asarray(_WIDTHS, given.dtype), jnp.asarray(_STRIDES, given.dtype))
    move, _ = jax.lax.scan(one_width, given, stages)
    finest = stages[0][-1]
    return move, sharp(move, finest) - sharp(given, finest)

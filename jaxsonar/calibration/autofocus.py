"""Autofocus: a ring with large errors is adjusted until the echoes of each wall meet in the Hough accumulator.

The result is accurate enough for least squares, which must know which echoes belong together. The focus measure alone
is degenerate in the mean range offset and the speed of sound: the mean is held, the speed has a prior.
"""

import dataclasses
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsonar import kernels
from jaxsonar.geometry.se2 import compose
from jaxsonar.hardware.errors import SonarError
from jaxsonar.kernels.focus_measure import ring_focus_measure
from jaxsonar.kernels.hough_accumulator import HoughSettings
from jaxsonar.kernels.sensor_array import SensorArray
from jaxsonar.kernels.shape_buckets import bucket_size
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring_parameters import PRIOR


@dataclass(frozen=True)
class AutofocusSettings:
    """Constants of the autofocus. Chosen by hand unless stated otherwise."""

    offset_sd: float = 0.015
    """Prior standard deviation of the range offset of a sensor relative to the mean, metres."""
    max_offset: float = 0.050
    """Largest change of a range offset, metres."""
    max_speed_change: float = 0.04
    """Largest relative change of the speed of sound."""
    max_distance: float = 8.0
    """Scans farther from the median position of a log are left out, metres, so that the accumulator stays small."""
    rho_cell: float = 0.01
    """Size of a cell along rho, metres."""
    max_cells: int = 1_000_000
    """Largest number of cells of the accumulator."""
    theta_cells: tuple[int, int] = (720, 120)
    """Rows of the accumulator with and without poses. In the world frame the curve of a distant wall is steep, up to
    metres per radian; in the robot frame it is not."""
    point_pitch_deg: tuple[float, float] = (0.5, 1.0)
    """Angle between points of an arc with and without poses, degrees."""
    widths: tuple[float, ...] = (1.5, 1.0)
    """Standard deviations of the low pass along rho from coarse to fine, cells. Larger ones made the calibration from
    the office trajectory, which hardly turns, converge to a wrong ring."""
    steps: int = 20
    """Steps of the ascent for each width."""
    strides: tuple[float, ...] = (0.1, 0.03)
    """Length of the first step for each width, prior standard deviations."""
    momentum: float = 0.8
    """Decay of the mean gradient per step."""
    square_decay: float = 0.95
    """Decay of the mean squared gradient per step."""
    range_margin: float = 1.05
    """Factor on the maximum range, so that echoes near it stay when offsets and speed of sound change."""


SETTINGS = AutofocusSettings()


def autofocus_ring(
    ring: Ring, log: Log, *, poses: bool, speed: bool, scans: int = 40, settings: AutofocusSettings = SETTINGS
) -> Ring:
    """The ring whose relative range offsets, and speed of sound, maximize the focus measure of its echoes.

    The mean range offset does not change. Without poses, each scan has an accumulator of its own; offsets that are
    equivalent to a displacement of the whole ring are then hardly observable and change little. The given ring, the
    same object, is returned unless the focus measure at the finest scale increased by more nats than there are
    parameters.

    Args:
        ring: the nominal ring.
        log: its scans.
        poses: whether the poses of the log are used; scans without a pose are left out then.
        speed: whether the speed of sound is estimated as well; requires poses.
        scans: largest number of scans, evenly selected.
        settings: constants of the algorithm.

    Raises:
        SonarError: speed without poses, no usable scan, ``scans`` below 1, or a sensor that the ring does not have.
    """
    if speed and not poses:
        raise SonarError(
            "autofocus: speed=True with poses=False came; allowed is speed only with poses, which determine the scale"
        )
    if scans < 1:
        raise SonarError(f"autofocus: scans = {scans} came; allowed is 1 or more")
    # 1. Pack the echoes of the selected scans.
    echoes, radius = _pack_scans(ring, log, poses, scans, settings)
    # 2. Choose the accumulator.
    variant = 0 if poses else 1
    rows, pitch = settings.theta_cells[variant], float(np.radians(settings.point_pitch_deg[variant]))
    columns = bucket_size(int(np.ceil((radius + settings.range_margin * ring.max_range) / settings.rho_cell)), least=64)
    accumulator = HoughSettings(
        theta_cells=rows,
        point_pitch=pitch,
        rho_cell=settings.rho_cell,
        rho_cells=min(columns, settings.max_cells // rows),
    )
    points = kernels.points_of_widest_arc(np.asarray(ring.beam), accumulator)
    # 3. Climb, and keep the result if the focus improved significantly.
    nominal = ring.sensors
    sensors = dataclasses.replace(nominal, max_range=nominal.max_range * settings.range_margin)
    change, gain = _momentum_ascent(
        sensors, echoes, accumulator=accumulator, points=points, speed=speed, settings=settings
    )
    if not float(gain) > ring.count - 1 + speed:  # False for NaN
        return ring
    change = np.asarray(change, dtype=np.float64)
    offset = settings.offset_sd * (change[:-1] - change[:-1].mean())
    factor = np.exp(PRIOR.speed_sd * change[-1]) if speed else 1.0
    return dataclasses.replace(
        ring, range_offset=ring.range_offset + offset, speed_of_sound=ring.speed_of_sound * factor
    )


def _pack_scans(
    ring: Ring, log: Log, poses: bool, max_scans: int, settings: AutofocusSettings
) -> tuple[kernels.PackedEchoes, float]:
    """Packed echoes, in one row if there are poses, and the largest distance of a sensor from the origin, metres."""
    # 1. Select scans.
    flat, _ = FlatEchoes.from_log(ring, log)
    usable = np.diff(flat.start) > 0
    if poses:
        usable &= np.isfinite(log.pose).all(axis=1)
        median = np.median(log.pose[usable, :2], axis=0) if usable.any() else np.zeros(2)
        with np.errstate(invalid="ignore"):
            usable &= np.hypot(*(log.pose[:, :2] - median).T) <= settings.max_distance
    index = np.flatnonzero(usable)
    if not len(index):
        needed = "an echo of this ring's paths" + (" and a pose" if poses else "")
        raise SonarError(f"log: {len(log)} scans came, none with {needed}; allowed is a log with at least one")
    if len(index) > max_scans:
        index = index[np.round(np.linspace(0, len(index) - 1, max_scans)).astype(int)]
    # 2. Row and column of each of their echoes.
    rank = np.full(len(log), -1)
    rank[index] = np.arange(len(index))
    row = rank[flat.scan]
    echo = np.flatnonzero(row >= 0)
    row, column = row[echo], echo - flat.start[flat.scan[echo]]
    radius = float(np.hypot(*np.asarray(ring.position).T).max())
    motion = None if flat.path_pose is None else flat.path_pose[flat.scan[echo], flat.path[echo]]
    # 3. Padded arrays.
    if poses:
        echo_pose = log.pose[flat.scan[echo]] if motion is None else compose(log.pose[flat.scan[echo]], motion)
        centroid = echo_pose[:, :2].mean(axis=0)
        echo_pose = np.column_stack([echo_pose[:, :2] - centroid, echo_pose[:, 2]])
        row, column = np.zeros_like(row), np.arange(len(echo))
        shape = (1, bucket_size(len(echo), least=512))
    else:
        echo_pose, shape = motion, (bucket_size(len(index), least=8), bucket_size(int(column.max()) + 1, least=64))
    pose = None
    if echo_pose is not None:
        radius += float(np.hypot(*echo_pose[:, :2].T).max())
        pose = np.zeros((*shape, 3), np.float32)
        pose[row, column] = echo_pose
    path, reported = np.zeros(shape, np.int32), np.full(shape, np.nan, np.float32)
    path[row, column] = flat.path[echo]
    reported[row, column] = flat.reported[echo]
    pose = None if pose is None else jnp.asarray(pose)
    return kernels.PackedEchoes(jnp.asarray(path), jnp.asarray(reported), pose), radius


@partial(jax.jit, static_argnames=("accumulator", "points", "speed", "settings"))
def _momentum_ascent(
    sensors: SensorArray,
    echoes: kernels.PackedEchoes,
    *,
    accumulator: HoughSettings,
    points: int,
    speed: bool,
    settings: AutofocusSettings,
) -> tuple[Float[Array, " parameters"], Float[Array, ""]]:
    """Gradient ascent with momentum and decreasing step length on focus measure and prior, from coarse to fine.

    The step length is bounded, because votes are piecewise bilinear and the gradient jumps from cell to cell.

    Returns:
        The change of the offsets and of the log speed of sound in prior standard deviations, and the increase of the
        focus measure at the finest scale, nats.
    """
    count = sensors.range_offset.shape[0]

    def project(change: Float[Array, " parameters"]) -> Float[Array, " parameters"]:
        """The closest change within the limits and without mean offset."""
        offset = change[:count] - change[:count].mean()
        limit = settings.max_offset / settings.offset_sd
        offset = offset * jnp.minimum(1, limit / jnp.maximum(jnp.abs(offset).max(), 1e-6))
        bounds = jnp.asarray([-settings.max_speed_change, settings.max_speed_change], change.dtype)
        low, high = jnp.log1p(bounds) / PRIOR.speed_sd * float(speed)
        return jnp.append(offset, jnp.clip(change[count], low, high))

    def focus(change: Float[Array, " parameters"], width: Float[Array, ""]) -> Float[Array, ""]:
        offset = sensors.range_offset + settings.offset_sd * change[:count]
        scale = sensors.range_scale * jnp.exp(PRIOR.speed_sd * change[count])
        changed = dataclasses.replace(sensors, range_offset=offset, range_scale=scale)
        return ring_focus_measure(changed, echoes, width, settings=accumulator, points=points)

    def gradient(change: Float[Array, " parameters"], width: Float[Array, ""]) -> Float[Array, " parameters"]:
        """Gradient of focus measure and log-prior, without mean offset."""
        full = jax.grad(focus)(change, width) - change
        return jnp.append(full[:count] - full[:count].mean(), full[count] * float(speed))

    def one_width(change, stage):
        width, stride = stage

        def step(state, k):
            change, mean, square = state
            slope = gradient(change, width)
            mean = settings.momentum * mean + (1 - settings.momentum) * slope
            # One mean square for all parameters, so that the direction of the gradient is kept.
            square = settings.square_decay * square + (1 - settings.square_decay) * jnp.mean(slope * slope)
            unbiased = square / (1 - settings.square_decay ** (k + 1))
            length = stride * (1 - k / settings.steps) / jnp.sqrt(unbiased + 1e-12)
            change = project(change + length * mean / (1 - settings.momentum ** (k + 1)))
            return (change, mean, square), None

        start = (change, jnp.zeros_like(change), jnp.zeros((), change.dtype))
        return jax.lax.scan(step, start, jnp.arange(settings.steps, dtype=change.dtype))[0][0], None

    given = jnp.zeros(count + 1, sensors.range_offset.dtype)
    stages = (jnp.asarray(settings.widths, given.dtype), jnp.asarray(settings.strides, given.dtype))
    change, _ = jax.lax.scan(one_width, given, stages)
    finest = stages[0][-1]
    return change, focus(change, finest) - focus(given, finest)

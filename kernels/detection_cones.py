"""Detection cones: which of the predicted echoes the sensors receive, and how fast that ends at the edge of a cone."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .measurement_model import PredictedEcho, reflector_echo
from .planar_geometry import dot, signed_angle
from .sensor_array import EchoPaths, transform_path


@dataclass(frozen=True)
class VisibilitySettings:
    """When a path can receive an echo of a reflector."""

    cone_border: float = 0.08
    """Half width of the soft border of a detection cone, relative to the chord of half the cone; chosen by hand."""
    association_cone_factor: float = 1.2
    """Cones are taken this much wider when echoes are associated with landmarks, because the headings of sensors are
    not exact; chosen by hand."""
    association_wall_margin: float = 0.3
    """Metres that a wall of a map may extend beyond its endpoints, which are the outermost observed footpoints; chosen
    by hand."""

    beam_edge_db: float = 6.0
    """One-way loss at the border of a cone, dB; Gaussian in the off-axis angle. Data sheets define the beam angle by
    6 dB."""
    absorption_db_per_m: float = 1.3
    """Loss in air per metre of path at 40 kHz, dB/m (ISO 9613-1, 20 deg C, 50 % relative humidity)."""
    edge_level_db: float = -20.0
    """Level of an edge or a thin pole at 1 m relative to a wall, dB: that of a smooth pole of 1 cm radius. Edges of
    walls return less (Keller)."""
    level_sd: float = 1.5
    """Spread of the threshold of detection, dB: 6 dB beams differ from real ones; chosen by hand."""


SETTINGS = VisibilitySettings()
DEAF = float("inf")
"""Threshold of sensors that hear nothing outside of their cones, dB."""


def echo_level(echo: PredictedEcho, path: EchoPaths) -> Float[Array, ""]:
    """Level of the echo of a large smooth wall, dB relative to a wall on the axis at 1 m.

    Spreading, absorption and both beams. Corners return as much sound as walls; edges, poles and columns less.
    """
    out, back = echo.departure - path.axes[0], echo.arrival - path.axes[1]
    off_axis = dot(out, out) / path.cone[0] + dot(back, back) / path.cone[1]
    spreading = 20 * jnp.log10(jnp.maximum(echo.range, 1e-2))
    absorption = 2 * SETTINGS.absorption_db_per_m * (echo.range - 1)
    return -(spreading + absorption + SETTINGS.beam_edge_db * off_axis)


def audibility(echo: PredictedEcho, path: EchoPaths, threshold: Float[Array, ""]) -> Float[Array, ""]:
    """Weight of an echo by its level: that of ``visibility`` inside both cones, outside them 1 above the threshold.

    Args:
        echo: the echo.
        path: its path.
        threshold: level of the faintest echoes that are heard outside the cones, dB (``echo_level``); inf: none.
    """
    outside = jax.nn.sigmoid((echo_level(echo, path) - threshold) / SETTINGS.level_sd)
    return jnp.maximum(visibility(echo, path), jnp.where(echo.exists, outside, 0))


def visibility(echo: PredictedEcho, path: EchoPaths) -> Float[Array, ""]:
    """Weight of an echo by both detection cones: 1 inside, 0 outside or if it does not exist, smooth at the border."""
    border = SETTINGS.cone_border
    weight = jnp.clip(((1 + border) ** 2 - off_axis_ratio(echo, path)) / (4 * border), 0, 1)
    return jnp.where(echo.exists, weight * weight * (3 - 2 * weight), 0)


def off_axis_ratio(echo: PredictedEcho, path: EchoPaths) -> Float[Array, ""]:
    """Off-axis angle relative to the cone, the larger one of tx and rx: 0 on the axis, 1 at the border, increasing."""
    out, back = echo.departure - path.axes[0], echo.arrival - path.axes[1]
    return jnp.maximum(dot(out, out) / path.cone[0], dot(back, back) / path.cone[1])


class PredictionTable(eqx.Module):
    """Predicted echoes of every path and reflector of a batch of scans: leading axes (scans, reflectors, paths)."""

    range: Float[Array, "*table"]
    """Half the path length, metres."""
    d_range_d_landmark: Float[Array, "*table 2"]
    """Derivatives of the range with respect to the reflector's two parameters."""
    departure_angle: Float[Array, "*table"]
    """Direction in which the sound leaves, from the axis of the transmitter, radians, counter-clockwise."""
    footpoint: Float[Array, "*table"]
    """As ``PredictedEcho``."""
    visibility: Float[Array, "*table"]
    """Weight by both detection cones: 1 inside, 0 outside or where there is no such reflector."""
    exists: Bool[Array, "*table"]
    """Whether the path is possible, cones aside."""


@jax.jit
def predict_all_echoes(
    paths: EchoPaths,
    kind: Int[Array, "scans reflectors"],
    reflectors: Float[Array, "scans reflectors 2"],
    path_pose: Float[Array, "scans paths 3"] | None = None,
) -> PredictionTable:
    """Predict the echo of every path from every reflector of a batch of scans.

    Args:
        paths: of the ring.
        kind: PLANE, CORNER or EDGE; -1 where there is no reflector.
        reflectors: (rho, theta) of planes, (x, y) of corners and edges; robot frame of the scan, metres, radians.
        path_pose: scan_from_robot when each path was measured: x, y (m), theta (rad); None for a robot at rest.
    """

    def one(kind: Int[Array, ""], reflector: Float[Array, "2"], path: EchoPaths) -> PredictionTable:
        echo = reflector_echo(kind, reflector, path)
        angle = signed_angle(path.axes[0], echo.departure)
        return PredictionTable(
            echo.range, echo.d_range_d_landmark, angle, echo.footpoint, visibility(echo, path), echo.exists
        )

    each_path = jax.vmap(one, in_axes=(None, None, 0))
    each_reflector = jax.vmap(each_path, in_axes=(0, 0, None))
    if path_pose is None:
        return jax.vmap(each_reflector, in_axes=(0, 0, None))(kind, reflectors, paths)
    moved = jax.vmap(jax.vmap(transform_path), in_axes=(None, 0))(paths, path_pose)
    return jax.vmap(each_reflector)(kind, reflectors, moved)

"""Wall segments in the world frame, with the information about their lines, and the fusion of segments of one wall."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.detection.local_model import Line, LocalModel
from jaxsonar.geometry.se2 import tangent_of, transform_points, unit, wrap_angle
from jaxsonar.mapping.observations import Observations, unique_pairs
from jaxsonar.mapping.settings import SETTINGS


@dataclass(frozen=True, eq=False)
class WallSegments(Observations):
    """Straight wall segments, world frame, one per row.

    The line of a segment is parametrized at ``center``, the point where the errors of its offset (perpendicular to the
    line) and of its direction are uncorrelated.
    """

    center: Float[np.ndarray, "segments 2"]
    """Point on the line, metres."""
    theta: Float[np.ndarray, " segments"]
    """Direction of the normal, pointing away from the robot that observed it, radians, in [-pi, pi)."""
    extent: Float[np.ndarray, "segments 2"]
    """Start and end of the segment along its tangent, measured from ``center``, metres."""
    info_offset: Float[np.ndarray, " segments"]
    """Inverse variance of the offset, 1 / m^2."""
    info_theta: Float[np.ndarray, " segments"]
    """Inverse variance of the direction, 1 / rad^2."""
    viewing_distance: Float[np.ndarray, " segments"]
    """Mean distance from which the line was observed, metres."""

    @property
    def normal(self) -> Float[np.ndarray, "segments 2"]:
        """Unit normals."""
        return unit(self.theta)

    @property
    def tangent(self) -> Float[np.ndarray, "segments 2"]:
        """Unit tangents, the normals rotated by 90 degrees counter-clockwise."""
        return tangent_of(self.theta)

    @property
    def endpoints(self) -> Float[np.ndarray, "segments 2 2"]:
        """Start and end points, world frame, metres."""
        return self.center[:, None] + self.extent[..., None] * self.tangent[:, None]

    @property
    def length(self) -> Float[np.ndarray, " segments"]:
        """Length, metres."""
        return self.extent[:, 1] - self.extent[:, 0]

    def grid_cells(self) -> Int[np.ndarray, "segments 3"]:
        """Cell of each segment in position (5 cm) and direction (6 degrees)."""
        cell, angle = SETTINGS.segments.merge_cell, SETTINGS.segments.merge_angle
        return np.column_stack([np.floor(self.center / cell), np.floor(self.theta / angle)]).astype(np.int64)

    def fuse(self, group: Int[np.ndarray, " segments"]) -> "WallSegments":
        """One segment per group: the line that fits its members best, between their outermost projected ends.

        A line through the common center with normal n has the cost

            sum of info_offset (d . n)^2 + info_theta (t . n)^2   =   n' M n,

        where d is the center of a member relative to the common center and t its tangent. The minimum is the
        eigenvector of M with the smaller eigenvalue: segments far apart along a wall determine its direction better
        than any of them alone. Rotating the line by b raises the cost by (difference of the eigenvalues) sin(b)^2,
        which is the information that the result stores. Therefore information adds up, to rounding; the ends differ by
        up to 3 mm, because they are projected each time. A group with a single member is not changed.
        """
        groups = int(group.max(initial=-1)) + 1
        members = np.bincount(group, minlength=groups)
        if len(self) == groups:  # every group has one member
            return self.take(np.argsort(group, kind="stable"))

        def total(values: np.ndarray) -> np.ndarray:
            return np.bincount(group, values, groups)

        # The common center, relative to any member, which avoids cancellation far from the world's origin.
        first = np.zeros(groups, dtype=np.int64)
        first[group] = np.arange(len(group))
        origin = self.center[first]
        d, t, w, v = self.center - origin[group], self.tangent, self.info_offset, self.info_theta
        info = total(w)
        middle = np.stack([total(w * d[:, 0]), total(w * d[:, 1])], axis=-1) / info[:, None]
        d = d - middle[group]
        # The matrix M, its eigenvalues and the direction of the line.
        xx = total(w * d[:, 0] ** 2 + v * t[:, 0] ** 2)
        yy = total(w * d[:, 1] ** 2 + v * t[:, 1] ** 2)
        xy = total(w * d[:, 0] * d[:, 1] + v * t[:, 0] * t[:, 1])
        info_theta = np.hypot(xx - yy, 2 * xy)
        smaller_eigenvalue = 2 * np.maximum(xx * yy - xy * xy, 0) / (xx + yy + info_theta)
        theta = np.arctan2(2 * xy, xx - yy) / 2 + np.pi / 2
        normal = unit(theta)
        # The member with the best known direction determines which side the normal points to.
        order = np.lexsort((self.count, v, group))
        leader = order[np.searchsorted(group[order], np.arange(groups), side="right") - 1]
        facing = (self.normal[leader] * normal).sum(-1)
        theta = wrap_angle(theta + np.where(facing < 0, np.pi, 0.0))

        center = origin + middle
        start, end = outermost_projections(self.endpoints, group, center, tangent_of(theta))
        last_seen = np.full(groups, -np.inf)
        np.maximum.at(last_seen, group, self.last_seen)
        count = total(self.count)
        fused = WallSegments(
            center=center,
            theta=theta,
            extent=np.stack([start, end], axis=-1),
            info_offset=info,
            info_theta=info_theta,
            chi_squared=total(self.chi_squared) + smaller_eigenvalue,
            count=np.rint(count).astype(np.int64),
            echoes=np.rint(total(self.echoes)).astype(np.int64),
            viewing_distance=total(self.viewing_distance * self.count) / count,
            last_seen=last_seen,
            scans=unique_pairs(group[self.scans[0]], self.scans[1]),
        )
        alone = members == 1
        return replace_rows(fused, alone, self.take(first[alone]))


def aggregate_segments(models: Sequence[LocalModel], poses: Float[np.ndarray, "models 3"]) -> WallSegments:
    """The lines of local models as segments in the world frame (paper, section 5, figure 6).

    Args:
        models: local models, robot frame.
        poses: world_from_robot of each: x, y (m), theta (rad). Models with a NaN pose are left out.
    """
    has_pose = np.all(np.isfinite(poses), axis=1)
    lines = [(k, line) for k, model in enumerate(models) if has_pose[k] for line in model.lines]
    model = np.array([k for k, _ in lines], dtype=np.int64)
    theta = np.array([line.theta for _, line in lines]) + poses[model, 2]
    in_robot = np.array([line.segment for _, line in lines], dtype=np.float64).reshape(-1, 2, 2)
    in_world = [transform_points(poses[k], ends) for k, ends in zip(model, in_robot, strict=True)]
    endpoints = np.array(in_world).reshape(-1, 2, 2)
    center, info_offset, info_theta = _uncorrelated_center(lines, endpoints, theta)
    extent = ((endpoints - center[:, None]) * tangent_of(theta)[:, None]).sum(-1)
    seen = np.array([(row, scan) for row, (_, line) in enumerate(lines) for scan in line.scans], dtype=np.int64)
    return WallSegments(
        center=center,
        theta=wrap_angle(theta),
        extent=np.sort(extent, axis=1),
        info_offset=info_offset,
        info_theta=info_theta,
        chi_squared=np.zeros(len(lines)),
        count=np.ones(len(lines), dtype=np.int64),
        echoes=np.array([line.echoes for _, line in lines], dtype=np.int64),
        viewing_distance=np.array([line.rho for _, line in lines], dtype=np.float64),
        last_seen=observation_times(models)[model],
        scans=unique_pairs(*seen.reshape(-1, 2).T),
    )


def observation_times(models: Sequence[LocalModel]) -> Float[np.ndarray, " models"]:
    """Time stamp of each local model, seconds; its scan number where it has none."""
    return np.array([m.scan if np.isnan(m.stamp) else m.stamp for m in models], dtype=np.float64)


def _uncorrelated_center(
    lines: Sequence[tuple[int, Line]], endpoints: Float[np.ndarray, "lines 2 2"], theta: Float[np.ndarray, " lines"]
) -> tuple[Float[np.ndarray, "lines 2"], Float[np.ndarray, " lines"], Float[np.ndarray, " lines"]]:
    """The point of each line where the errors of offset and direction are uncorrelated, and their inverse variances.

    The offset at position s along the line, measured from the footpoint of the robot, has the error
    d_rho - s d_theta. It is uncorrelated with d_theta at s = cov(rho, theta) / var(theta). A line without covariance
    gets the default one at the middle of its footpoints.
    """
    center = endpoints.mean(axis=1)
    info_offset = np.full(len(lines), SETTINGS.segments.offset_sd**-2)
    info_theta = np.full(len(lines), SETTINGS.segments.theta_sd**-2)
    has_cov = np.array([k for k, (_, line) in enumerate(lines) if line.cov is not None], dtype=np.int64)
    if len(has_cov):
        chosen = [lines[k][1] for k in has_cov]
        cov = np.array([line.cov for line in chosen])
        heading = theta[has_cov] - [line.theta for line in chosen]  # of the robot
        middle = np.array([line.segment.mean(axis=0) for line in chosen], dtype=np.float64)
        own = np.array([line.theta for line in chosen])
        middle_along = middle[:, 1] * np.cos(own) - middle[:, 0] * np.sin(own)
        shift = cov[:, 0, 1] / cov[:, 1, 1] - middle_along
        center[has_cov] += shift[:, None] * tangent_of(own + heading)
        info_offset[has_cov] = 1 / (cov[:, 0, 0] - cov[:, 0, 1] ** 2 / cov[:, 1, 1])
        info_theta[has_cov] = 1 / cov[:, 1, 1]
    return center, info_offset, info_theta


def outermost_projections(
    endpoints: Float[np.ndarray, "segments 2 2"],
    group: Int[np.ndarray, " segments"],
    origin: Float[np.ndarray, "groups 2"],
    tangent: Float[np.ndarray, "groups 2"],
) -> tuple[Float[np.ndarray, " groups"], Float[np.ndarray, " groups"]]:
    """First and last projection of the endpoints of each group onto its line, metres from the line's origin.

    This is how the paper bounds a merged wall (section 5).
    """
    along = ((endpoints - origin[group][:, None]) * tangent[group][:, None]).sum(-1)
    first, last = np.full(len(origin), np.inf), np.full(len(origin), -np.inf)
    np.minimum.at(first, group, along.min(axis=1))
    np.maximum.at(last, group, along.max(axis=1))
    return first, last


def replace_rows(segments: WallSegments, rows: Bool[np.ndarray, " segments"], by: WallSegments) -> WallSegments:
    """The segments with some rows replaced, except for their scan numbers."""
    columns: dict[str, Any] = {}
    for field in fields(WallSegments):
        if field.name != "scans":
            values = getattr(segments, field.name).copy()
            values[rows] = getattr(by, field.name)
            columns[field.name] = values
    return replace(segments, **columns)

"""Pieces of walls in the world frame, with what is known of each, and the law by which pieces of one wall add up."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.detection.extract import Line, LocalModel
from jaxsonar.geometry.se2 import to_world, wrap_angle
from jaxsonar.mapping.observations import Sightings, unique_pairs
from jaxsonar.mapping.observations import join as join

SIGMA_OFFSET, SIGMA_THETA = 0.01, float(np.radians(3.0))
"""Standard deviations of a line of the Hough step, metres and radians: what cells and cut-off arcs leave."""


@dataclass(frozen=True, eq=False)
class Pieces(Sightings):
    """Straight pieces of walls, world frame, one row each.

    A piece knows its line best at ``centre``: there the errors of its offset (across the line) and of its direction are
    independent, and ``info_offset`` and ``info_theta`` are their inverse variances.
    """

    centre: Float[np.ndarray, "pieces 2"]
    """Point on the line, metres."""
    theta: Float[np.ndarray, " pieces"]
    """Direction of the normal, away from the robot that saw it, radians, in [-pi, pi)."""
    ends: Float[np.ndarray, "pieces 2"]
    """Where the piece begins and ends, along its tangent from ``centre``, metres."""
    info_offset: Float[np.ndarray, " pieces"]
    """1 / m^2."""
    info_theta: Float[np.ndarray, " pieces"]
    """1 / rad^2."""
    distance: Float[np.ndarray, " pieces"]
    """From how far it was seen, the mean of the lines, metres."""

    @property
    def normal(self) -> Float[np.ndarray, "pieces 2"]:
        """Unit normals."""
        return np.stack([np.cos(self.theta), np.sin(self.theta)], axis=-1)

    @property
    def tangent(self) -> Float[np.ndarray, "pieces 2"]:
        """Unit tangents, the normals turned a quarter counter-clockwise."""
        return np.stack([-np.sin(self.theta), np.cos(self.theta)], axis=-1)

    @property
    def segments(self) -> Float[np.ndarray, "pieces 2 2"]:
        """Endpoints, world frame, metres."""
        return self.centre[:, None] + self.ends[..., None] * self.tangent[:, None]

    @property
    def length(self) -> Float[np.ndarray, " pieces"]:
        """Metres."""
        return self.ends[:, 1] - self.ends[:, 0]


def aggregate(models: Sequence[LocalModel], poses: Float[np.ndarray, "models 3"]) -> Pieces:
    """The segments of local models in the world frame (paper, section 5, figure 6); models without a pose are left out.

    Args:
        models: local models, robot frame.
        poses: world_from_robot of each, x, y (m), theta (rad), NaN where there is none.
    """
    known = np.all(np.isfinite(poses), axis=1)
    lines = [(k, line) for k, model in enumerate(models) if known[k] for line in model.lines]
    model = np.array([k for k, _ in lines], dtype=np.int64)
    theta = np.array([line.theta for _, line in lines]) + poses[model, 2]
    segments = np.array([line.segment for _, line in lines], dtype=np.float64).reshape(-1, 2, 2)
    ends = np.array([to_world(poses[k], segment) for k, segment in zip(model, segments, strict=True)]).reshape(-1, 2, 2)
    centre, info_offset, info_theta = _known_best(lines, ends, theta)
    tangent = np.stack([-np.sin(theta), np.cos(theta)], axis=-1)
    echoes = np.array([line.echoes for _, line in lines], dtype=np.int64)
    along = np.sort(((ends - centre[:, None]) * tangent[:, None]).sum(-1), axis=1)
    seen = np.array([(row, scan) for row, (_, line) in enumerate(lines) for scan in line.scans], dtype=np.int64)
    when = np.array([m.scan if np.isnan(m.stamp) else m.stamp for m in models], dtype=np.float64)
    return Pieces(
        centre=centre,
        theta=wrap_angle(theta),
        ends=along,
        info_offset=info_offset,
        info_theta=info_theta,
        misfit=np.zeros(len(lines)),
        count=np.ones(len(lines), dtype=np.int64),
        echoes=echoes,
        distance=np.array([line.rho for _, line in lines], dtype=np.float64),
        latest=when[model],
        scans=unique_pairs(*seen.reshape(-1, 2).T),
    )


def _known_best(
    lines: Sequence[tuple[int, Line]], ends: Float[np.ndarray, "lines 2 2"], theta: Float[np.ndarray, " lines"]
) -> tuple[Float[np.ndarray, "lines 2"], Float[np.ndarray, " lines"], Float[np.ndarray, " lines"]]:
    """The point of each line where the errors of offset and direction are independent, and their inverse variances.

    A line without covariance has it in the middle of its feet. With one, the offset at s along the line (from the foot
    of the origin) errs by d_rho - s d_theta, and that is independent of d_theta at s = cov(rho, theta) / var(theta).
    """
    centre = ends.mean(axis=1)
    info_offset, info_theta = np.full(len(lines), SIGMA_OFFSET**-2), np.full(len(lines), SIGMA_THETA**-2)
    known = np.array([k for k, (_, line) in enumerate(lines) if line.cov is not None], dtype=np.int64)
    if len(known):
        chosen = [lines[k][1] for k in known]
        cov = np.array([line.cov for line in chosen])
        turn = theta[known] - [line.theta for line in chosen]  # the robot's heading
        middle = np.array([line.segment.mean(axis=0) for line in chosen], dtype=np.float64)
        own = np.array([line.theta for line in chosen])
        along = middle[:, 1] * np.cos(own) - middle[:, 0] * np.sin(own)  # of the middle of the feet
        slide = cov[:, 0, 1] / cov[:, 1, 1] - along
        tangent = np.stack([-np.sin(own + turn), np.cos(own + turn)], axis=-1)
        centre[known] += slide[:, None] * tangent
        info_offset[known] = 1 / (cov[:, 0, 0] - cov[:, 0, 1] ** 2 / cov[:, 1, 1])
        info_theta[known] = 1 / cov[:, 1, 1]
    return centre, info_offset, info_theta


def add_up(pieces: Pieces, group: Int[np.ndarray, " pieces"]) -> Pieces:
    """One piece from all those of a group, for groups 0, 1, 2, ...: the line that fits all of them best.

    With d a piece's centre from the common one and t its tangent, a line with the normal n costs

        sum of info_offset (d . n)^2 + info_theta (t . n)^2   =   n' M n,

    least for the eigenvector of M with the smaller eigenvalue: pieces far apart along the wall tell its direction
    better than any of them alone. A line turned by b from there costs (difference of the eigenvalues) sin(b)^2 more,
    which is what a piece keeps; so the sum of sums is the sum of all, in any order, to rounding (of the ends to 3 mm,
    because they are projected each time). A group of one piece stays what it is.
    """
    groups = int(group.max(initial=-1)) + 1
    members = np.bincount(group, minlength=groups)
    if len(pieces) == groups:  # nothing to add, only an order to keep
        return pieces.take(np.argsort(group, kind="stable"))

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(group, values, groups)

    first = np.zeros(groups, dtype=np.int64)
    first[group] = np.arange(len(group))  # any member will do, to measure from nearby
    origin = pieces.centre[first]
    d, t, w, v = pieces.centre - origin[group], pieces.tangent, pieces.info_offset, pieces.info_theta
    info = total(w)
    middle = np.stack([total(w * d[:, 0]), total(w * d[:, 1])], axis=-1) / info[:, None]
    d = d - middle[group]
    xx = total(w * d[:, 0] ** 2 + v * t[:, 0] ** 2)
    yy = total(w * d[:, 1] ** 2 + v * t[:, 1] ** 2)
    xy = total(w * d[:, 0] * d[:, 1] + v * t[:, 0] * t[:, 1])
    info_theta = np.hypot(xx - yy, 2 * xy)
    least = 2 * np.maximum(xx * yy - xy * xy, 0) / (xx + yy + info_theta)
    theta = np.arctan2(2 * xy, xx - yy) / 2 + np.pi / 2
    normal = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    order = np.lexsort((pieces.count, v, group))  # which way it faces is said by the member that knows best
    leader = order[np.searchsorted(group[order], np.arange(groups), side="right") - 1]
    facing = (pieces.normal[leader] * normal).sum(-1)
    theta = wrap_angle(theta + np.where(facing < 0, np.pi, 0.0))

    centre = origin + middle
    tangent = np.stack([-np.sin(theta), np.cos(theta)], axis=-1)
    low, high = outermost(pieces.segments, group, centre, tangent)
    latest = np.full(groups, -np.inf)
    np.maximum.at(latest, group, pieces.latest)
    count = total(pieces.count)
    summed = Pieces(
        centre=centre,
        theta=theta,
        ends=np.stack([low, high], axis=-1),
        info_offset=info,
        info_theta=info_theta,
        misfit=total(pieces.misfit) + least,
        count=np.rint(count).astype(np.int64),
        echoes=np.rint(total(pieces.echoes)).astype(np.int64),
        distance=total(pieces.distance * pieces.count) / count,
        latest=latest,
        scans=unique_pairs(group[pieces.scans[0]], pieces.scans[1]),
    )
    alone = members == 1
    return overwrite(summed, alone, pieces.take(first[alone]))


def outermost(
    segments: Float[np.ndarray, "pieces 2 2"],
    group: Int[np.ndarray, " pieces"],
    foot: Float[np.ndarray, "groups 2"],
    tangent: Float[np.ndarray, "groups 2"],
) -> tuple[Float[np.ndarray, " groups"], Float[np.ndarray, " groups"]]:
    """First and last of the endpoints of each group, projected onto its line, metres from the foot (section 5)."""
    ends = ((segments - foot[group][:, None]) * tangent[group][:, None]).sum(-1)
    low, high = np.full(len(foot), np.inf), np.full(len(foot), -np.inf)
    np.minimum.at(low, group, ends.min(axis=1))
    np.maximum.at(high, group, ends.max(axis=1))
    return low, high


def overwrite(pieces: Pieces, rows: Bool[np.ndarray, " pieces"], by: Pieces) -> Pieces:
    """Some rows replaced, to the last bit, by what they were."""
    columns: dict[str, Any] = {}
    for field in fields(Pieces):
        if field.name != "scans":
            values = getattr(pieces, field.name).copy()
            values[rows] = getattr(by, field.name)
            columns[field.name] = values
    return replace(pieces, **columns)

"""Pieces of walls in the world frame, with what is known of each, and the law by which pieces of one wall add up."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from .local import LocalModel
from .poses import to_world, wrap_angle

SIGMA_OFFSET, SIGMA_THETA = 0.01, float(np.radians(3.0))
"""Standard deviations of a line of the Hough step, metres and radians: what cells and cut-off arcs leave."""


@dataclass(frozen=True, eq=False)
class Pieces:
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
    misfit: Float[np.ndarray, " pieces"]
    """Sum of the squared, normalised deviations of the added pieces from their common line."""
    count: Int[np.ndarray, " pieces"]
    """How many lines of local models the piece is the sum of."""
    echoes: Int[np.ndarray, " pieces"]
    """How many echoes they rest on."""
    distance: Float[np.ndarray, " pieces"]
    """From how far it was seen, the mean of the lines, metres."""
    latest: Float[np.ndarray, " pieces"]
    """When it was last seen: seconds, or the scan number where there is no stamp."""
    scans: tuple[Int[np.ndarray, " seen"], Int[np.ndarray, " seen"]]
    """Row and scan number of every scan that a piece was seen in, ascending, each once."""

    def __len__(self) -> int:
        return len(self.theta)

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

    def take(self, rows: Int[np.ndarray, " some"] | Bool[np.ndarray, " pieces"]) -> "Pieces":
        """Some of the pieces, in the order asked for."""
        rows = np.arange(len(self))[rows]
        place = np.full(len(self), -1)
        place[rows] = np.arange(len(rows))
        row, number = place[self.scans[0]], self.scans[1]
        pairs = _unique(row[row >= 0], number[row >= 0])
        columns: dict[str, Any] = {f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name != "scans"}
        return Pieces(**columns, scans=pairs)

    def scan_lists(self) -> tuple[tuple[int, ...], ...]:
        """Numbers of the scans that each piece was seen in, ascending."""
        row, number = self.scans
        parts = np.split(number, np.searchsorted(row, np.arange(1, len(self))))
        return tuple(tuple(part.tolist()) for part in parts[: len(self)])


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
    centre = ends.mean(axis=1)
    tangent = np.stack([-np.sin(theta), np.cos(theta)], axis=-1)
    echoes = np.array([line.echoes for _, line in lines], dtype=np.int64)
    along = np.sort(((ends - centre[:, None]) * tangent[:, None]).sum(-1), axis=1)
    seen = np.array([(row, scan) for row, (_, line) in enumerate(lines) for scan in line.scans], dtype=np.int64)
    when = np.array([m.scan if np.isnan(m.stamp) else m.stamp for m in models], dtype=np.float64)
    return Pieces(
        centre=centre,
        theta=wrap_angle(theta),
        ends=along,
        info_offset=np.full(len(lines), SIGMA_OFFSET**-2),
        info_theta=np.full(len(lines), SIGMA_THETA**-2),
        misfit=np.zeros(len(lines)),
        count=np.ones(len(lines), dtype=np.int64),
        echoes=echoes,
        distance=np.array([line.rho for _, line in lines], dtype=np.float64),
        latest=when[model],
        scans=_unique(*seen.reshape(-1, 2).T),
    )


def join(parts: Sequence[Pieces]) -> Pieces:
    """The pieces of several collections as one."""
    columns: dict[str, Any] = {
        f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Pieces) if f.name != "scans"
    }
    offset = np.cumsum([0, *(len(part) for part in parts[:-1])])
    rows = np.concatenate([part.scans[0] + first for part, first in zip(parts, offset, strict=True)])
    return Pieces(**columns, scans=(rows, np.concatenate([part.scans[1] for part in parts])))


def add_up(pieces: Pieces, group: Int[np.ndarray, " pieces"]) -> Pieces:
    """One piece from all those of a group, for groups 0, 1, 2, ...: the line that fits all of them best.

    Least squares on the offsets and directions of the pieces: those far apart along the wall tell its direction better
    than any of them alone (the parallel-axis theorem). The sum of sums is the sum of all, in any order, to rounding.
    A group of one piece stays what it is.
    """
    groups = int(group.max(initial=-1)) + 1
    members = np.bincount(group, minlength=groups)
    if len(pieces) == groups:  # nothing to add, only an order to keep
        return pieces.take(np.argsort(group, kind="stable"))

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(group, values, groups)

    # Deviations are small and measured from the member that knows its direction best.
    order = np.lexsort((pieces.centre[:, 1], pieces.centre[:, 0], -pieces.info_theta, group))
    leader = order[np.searchsorted(group[order], np.arange(groups))]
    theta = pieces.theta[leader]
    normal, tangent = pieces.normal[leader], pieces.tangent[leader]
    offset = pieces.centre - pieces.centre[leader][group]
    along, across = (offset * tangent[group]).sum(-1), (offset * normal[group]).sum(-1)
    turn = wrap_angle(pieces.theta - theta[group])
    turn = np.where(np.abs(turn) > np.pi / 2, wrap_angle(turn + np.pi), turn)  # seen from the other side
    info = total(pieces.info_offset)
    middle, level = total(pieces.info_offset * along) / info, total(pieces.info_offset * across) / info
    along, across = along - middle[group], across - level[group]
    info_theta = total(pieces.info_theta + pieces.info_offset * along**2)
    # A line turned by b has fallen by b times the way along its tangent.
    bend = total(pieces.info_theta * turn - pieces.info_offset * along * across) / info_theta
    deviation = pieces.info_offset * (across + bend[group] * along) ** 2
    deviation += pieces.info_theta * (turn - bend[group]) ** 2

    centre = pieces.centre[leader] + middle[:, None] * tangent + level[:, None] * normal
    theta = wrap_angle(theta + bend)
    tangent = np.stack([-np.sin(theta), np.cos(theta)], axis=-1)
    ends = ((pieces.segments - centre[group][:, None]) * tangent[group][:, None]).sum(-1)
    first, last = np.full(groups, np.inf), np.full(groups, -np.inf)
    np.minimum.at(first, group, ends.min(axis=1))
    np.maximum.at(last, group, ends.max(axis=1))
    latest = np.full(groups, -np.inf)
    np.maximum.at(latest, group, pieces.latest)
    count = total(pieces.count)
    summed = Pieces(
        centre=centre,
        theta=theta,
        ends=np.stack([first, last], axis=-1),
        info_offset=info,
        info_theta=info_theta,
        misfit=total(pieces.misfit + deviation),
        count=np.rint(count).astype(np.int64),
        echoes=np.rint(total(pieces.echoes)).astype(np.int64),
        distance=total(pieces.distance * pieces.count) / count,
        latest=latest,
        scans=_unique(group[pieces.scans[0]], pieces.scans[1]),
    )
    alone = members == 1
    return overwrite(summed, alone, pieces.take(leader[alone]))


def overwrite(pieces: Pieces, rows: Bool[np.ndarray, " pieces"], by: Pieces) -> Pieces:
    """Some rows replaced, to the last bit, by what they were."""
    columns: dict[str, Any] = {}
    for field in fields(Pieces):
        if field.name != "scans":
            values = getattr(pieces, field.name).copy()
            values[rows] = getattr(by, field.name)
            columns[field.name] = values
    return replace(pieces, **columns)


def _unique(row: np.ndarray, number: np.ndarray) -> tuple[Int[np.ndarray, " seen"], Int[np.ndarray, " seen"]]:
    """Pairs of row and scan number, ascending, each once."""
    order = np.lexsort((number, row))
    row, number = row[order], number[order]
    new = np.ones(len(row), dtype=bool)
    new[1:] = (np.diff(row) > 0) | (np.diff(number) != 0)
    return row[new], number[new]

"""Junctions of walls: vertices and the wedges of free space around them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.geometry.segments import crossings, point_to_segments

TOUCH = 1e-3
"""Ends of walls that are closer than this are one vertex; an end this close to another wall touches it. Metres; chosen
by hand."""
ANGLE_TOLERANCE = np.radians(1.0)
"""Largest deviation of a right-angled wedge from 90 deg, and smallest excess over 180 deg of an edge. Radians; chosen
by hand."""
SAME_DIRECTION = 1e-4
"""Walls that leave a vertex in directions closer than this overlap. Radians; chosen by hand."""


@dataclass(frozen=True, eq=False)
class Junctions:
    """Vertices of a room and the wedges of free space between neighboring walls around each of them."""

    vertices: Float[np.ndarray, "vertices 2"]
    """Ends and crossings of walls, world frame, metres."""
    wedge_vertex: Int[np.ndarray, " wedges"]
    """Vertex of each wedge."""
    wedge_start: Float[np.ndarray, " wedges"]
    """Direction of the wall that bounds the wedge clockwise, world frame, radians."""
    wedge_width: Float[np.ndarray, " wedges"]
    """Opening angle, counter-clockwise from there to the next wall, radians, in (0, 2 pi]; 2 pi at a free end."""
    wedge_reach: Float[np.ndarray, "wedges 2"]
    """Length of the (clockwise, counter-clockwise) bounding wall from the vertex, metres."""
    right_angled: Bool[np.ndarray, "walls walls"]
    """Pairs of walls that form a right-angled corner."""

    @property
    def edges(self) -> Int[np.ndarray, " edges"]:
        """Wedges wider than 180 deg, whose vertex diffracts: free ends and outer corners."""
        return np.flatnonzero(self.wedge_width > np.pi + ANGLE_TOLERANCE)

    @property
    def corners(self) -> Int[np.ndarray, " corners"]:
        """Wedges of 90 deg, whose two walls reflect sound back to its source."""
        return np.flatnonzero(np.abs(self.wedge_width - np.pi / 2) <= ANGLE_TOLERANCE)


def find_junctions(walls: Float[np.ndarray, "walls 2 2"]) -> Junctions:
    """Junctions at ends of walls, at ends that touch another wall (T), and at crossings (X).

    Args:
        walls: (walls, 2, 2) endpoints, world frame, metres; ends closer than ``TOUCH`` are equal.
    """
    vertices = list(dict.fromkeys(map(tuple, walls.reshape(-1, 2).tolist())))
    share_a, share_b = crossings(walls, walls)
    inner = np.triu((share_a > 0) & (share_a < 1) & (share_b > 0) & (share_b < 1))
    for a, b in zip(*np.nonzero(inner), strict=True):
        point = walls[a, 0] + share_a[a, b] * (walls[a, 1] - walls[a, 0])
        if (np.linalg.norm(np.array(vertices) - point, axis=-1) > TOUCH).all():
            vertices.append(tuple(point.tolist()))
    positions = np.array(vertices).reshape(-1, 2)
    touching = point_to_segments(positions, walls) <= TOUCH
    rows: list[tuple[int, float, float, float, float]] = []
    right_angled = np.zeros((len(walls), len(walls)), dtype=bool)
    for vertex, point in enumerate(positions):
        rays = _leaving_rays(point, walls, np.flatnonzero(touching[vertex]))
        for k, (angle, reach, members) in enumerate(rays):
            next_angle, next_reach, next_members = rays[(k + 1) % len(rays)]
            width = (next_angle - angle) % (2 * np.pi) if len(rays) > 1 else 2 * np.pi
            rows.append((vertex, angle, width, reach, next_reach))
            if abs(width - np.pi / 2) <= ANGLE_TOLERANCE:
                right_angled[np.ix_(members, next_members)] = True
    table = np.array(rows).reshape(-1, 5)
    return Junctions(
        positions, table[:, 0].astype(int), table[:, 1], table[:, 2], table[:, 3:], right_angled | right_angled.T
    )


def _leaving_rays(
    point: Float[np.ndarray, "2"], walls: Float[np.ndarray, "walls 2 2"], touching: Int[np.ndarray, " touching"]
) -> list[tuple[float, float, list[int]]]:
    """Directions in which walls leave a vertex, counter-clockwise: (angle, length, indices of the walls)."""
    rays = []
    for wall in touching.tolist():
        for start, end in ((0, 1), (1, 0)):
            reach = float(np.linalg.norm(walls[wall, end] - point))
            if reach > TOUCH:
                dx, dy = walls[wall, end] - walls[wall, start]
                rays.append((float(np.arctan2(dy, dx)), reach, wall))
    merged: list[tuple[float, float, list[int]]] = []
    for angle, reach, wall in sorted(rays):
        if merged and angle - merged[-1][0] < SAME_DIRECTION:
            merged[-1] = (merged[-1][0], max(reach, merged[-1][1]), [*merged[-1][2], wall])
        else:
            merged.append((angle, reach, [wall]))
    if len(merged) > 1 and merged[0][0] + 2 * np.pi - merged[-1][0] < SAME_DIRECTION:
        angle, reach, members = merged.pop()  # the same direction on both sides of pi
        merged[0] = (merged[0][0], max(reach, merged[0][1]), merged[0][2] + members)
    return merged

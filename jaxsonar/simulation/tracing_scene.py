"""Walls and sensors prepared for tracing, with the tests of occlusion and of the detection cones."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.floor_plans.room import Room
from jaxsonar.geometry.segments import crossings, point_to_segments
from jaxsonar.simulation.acoustics import Acoustics, amplitudes
from jaxsonar.simulation.beam_bounds import largest_loss, least_wall_losses
from jaxsonar.simulation.traced_echoes import TracedEchoes

TOLERANCE = 1e-9
"""Rounding error that is allowed when a point lies on a wall or at its end, metres; double precision of coordinates
of some metres leaves 1e-15."""
LOUDNESS_MARGIN = 1e-6
"""Relative rounding error of amplitudes that is allowed before the final test of the threshold."""


class WallFrames(NamedTuple):
    """Walls as coordinate frames: origin at the start, first axis along the wall, second axis to its left."""

    start: Float[np.ndarray, "walls 2"]
    tangent: Float[np.ndarray, "walls 2"]
    length: Float[np.ndarray, " walls"]

    @classmethod
    def of(cls, walls: Float[np.ndarray, "walls 2 2"]) -> "WallFrames":
        """The frames of walls that are given by their endpoints."""
        along = walls[:, 1] - walls[:, 0]
        length = np.linalg.norm(along, axis=-1)
        return cls(walls[:, 0], along / length[:, None], length)

    def coordinates(
        self, wall: Int[np.ndarray, " rows"], points: Float[np.ndarray, "rows n 2"]
    ) -> tuple[Float[np.ndarray, "rows n"], Float[np.ndarray, "rows n"]]:
        """Coordinates (along, across) of points in the frame of one wall per row."""
        x = points[..., 0] - self.start[wall, 0, None]
        y = points[..., 1] - self.start[wall, 1, None]
        cos, sin = self.tangent[wall, 0, None], self.tangent[wall, 1, None]
        return cos * x + sin * y, cos * y - sin * x

    def normal(self, wall: Int[np.ndarray, " rows"]) -> Float[np.ndarray, "rows 2"]:
        """Unit normals, to the left of each wall."""
        return np.stack([-self.tangent[wall, 1], self.tangent[wall, 0]], axis=-1)

    def point_at(
        self, wall: Int[np.ndarray, " rows"], along: Float[np.ndarray, " rows"]
    ) -> Float[np.ndarray, "rows 2"]:
        """Points at these distances (metres) along each wall."""
        return self.start[wall] + along[:, None] * self.tangent[wall]

    def block(self, p: Float[np.ndarray, "legs 2"], q: Float[np.ndarray, "legs 2"]) -> Bool[np.ndarray, " legs"]:
        """Legs from p to q that a wall intersects; a leg that ends on a wall is not blocked by it.

        The test compares distances from the wall's line, so that no list of exceptions for endpoints is needed.
        """
        blocked = np.zeros(len(p), dtype=bool)
        normal = self.normal(np.arange(len(self.start)))
        level = (normal * self.start).sum(-1)
        for rows in row_slices(len(p), len(self.start)):
            side_p, side_q = p[rows] @ normal.T - level, q[rows] @ normal.T - level
            leg, wall = np.nonzero((side_p * side_q < 0) & (np.minimum(np.abs(side_p), np.abs(side_q)) > TOLERANCE))
            share = side_p[leg, wall] / (side_p[leg, wall] - side_q[leg, wall])
            intersection = p[rows][leg] + share[:, None] * (q[rows][leg] - p[rows][leg])
            position = ((intersection - self.start[wall]) * self.tangent[wall]).sum(-1)
            on_wall = (position >= -TOLERANCE) & (position <= self.length[wall] + TOLERANCE)
            blocked[rows][leg[on_wall]] = True
        return blocked


@dataclass(frozen=True, eq=False)
class TracingScene:
    """Inputs that all tracers share. Coordinates are relative to the room, since large ones would cost precision."""

    origin: Float[np.ndarray, "2"]
    """Origin of the coordinates, world frame, metres."""
    walls: WallFrames
    """Walls within range of any group."""
    index: Int[np.ndarray, " walls"]
    """Their indices in the room."""
    circles: Float[np.ndarray, "groups circles 3"]
    """Center x, y and radius of round columns, and then of moving circles, in each group."""
    separation: Float[np.ndarray, "walls walls"]
    """Distance between two walls, metres."""
    distance: Float[np.ndarray, "groups walls"]
    """Distance from the hub of a group to a wall, metres."""
    sensors: Float[np.ndarray, "groups sensors 2"]
    """Positions."""
    hub: Float[np.ndarray, "groups 2"]
    """Mean position of the sensors of each group."""
    radius: Float[np.ndarray, " groups"]
    """Largest distance of a sensor from the hub, metres."""
    pairs: Int[np.ndarray, "pairs 2"]
    """Sensor indices tx, rx."""
    baseline2: Float[np.ndarray, "groups pairs"]
    """Squared distance of tx and rx."""
    max_range: float
    """Largest half path length, metres."""
    axis: Float[np.ndarray, "groups sensors 2"] | None
    """Unit vectors of the sensor axes; None for omnidirectional sensors."""
    half_beam: Float[np.ndarray, " sensors"]
    """Half the nominal width of each cone, radians."""
    cos_limit: Float[np.ndarray, " sensors"]
    """Cosine of the largest off-axis angle: the border of the cone (hard beams) or 90 deg (soft beams)."""
    wall_loss: Float[np.ndarray, "groups walls sensors"] | None
    """Smallest one-way loss of each beam towards each wall, dB; None for omnidirectional sensors."""
    acoustics: Acoustics | None
    """Soft beams: echoes must reach the threshold of this model; None for hard beams."""

    @classmethod
    def of(
        cls,
        room: Room,
        sensors: Float[np.ndarray, "groups sensors 2"],
        pairs: Int[np.ndarray, "pairs 2"],
        max_range: float,
        axis: Float[np.ndarray, "groups sensors 2"] | None,
        half_beam: Float[np.ndarray, " sensors"] | None,
        acoustics: Acoustics | None = None,
        moving: Float[np.ndarray, "groups moving 3"] | None = None,
    ) -> "TracingScene":
        """Prepare a room and groups of sensors in the world frame; arguments as ``echo_tracing.trace_echoes``."""
        corners = np.concatenate([room.walls.reshape(-1, 2), room.poles, room.circles[:, :2]])
        origin = corners.mean(0) if len(corners) else np.zeros(2)
        sensors = sensors - origin
        hub = sensors.mean(1)
        radius = np.linalg.norm(sensors - hub[:, None], axis=-1).max(1)
        walls = room.walls - origin
        distance = point_to_segments(hub, walls)
        # Every point of a sound path lies within half its length of the midpoint of its sensors.
        index = np.flatnonzero((distance <= max_range + radius[:, None]).any(0))
        walls = walls[index]
        ends = point_to_segments(walls.reshape(-1, 2), walls).reshape(len(walls), 2, len(walls)).min(1)
        share_a, share_b = crossings(walls, walls)
        crossed = (share_a >= 0) & (share_a <= 1) & (share_b >= 0) & (share_b <= 1)
        half_beam = np.full(sensors.shape[1], np.pi) if half_beam is None else half_beam
        circles = np.broadcast_to(room.circles, (len(sensors), *room.circles.shape))
        circles = circles if moving is None else np.concatenate([circles, moving], axis=1)
        return cls(
            origin=origin,
            walls=WallFrames.of(walls),
            index=index,
            circles=circles - np.append(origin, 0.0),
            separation=np.where(crossed, 0.0, np.minimum(ends, ends.T)),
            distance=distance[:, index],
            sensors=sensors,
            hub=hub,
            radius=radius,
            pairs=pairs,
            baseline2=((sensors[:, pairs[:, 0]] - sensors[:, pairs[:, 1]]) ** 2).sum(-1),
            max_range=max_range,
            axis=axis,
            half_beam=half_beam,
            cos_limit=np.cos(half_beam) if acoustics is None else np.zeros(len(half_beam)),
            wall_loss=None if axis is None else least_wall_losses(sensors, axis, walls, half_beam, acoustics),
            acoustics=acoustics,
        )

    def candidates(
        self, group: Int[np.ndarray, " rows"], first: Int[np.ndarray, " rows"], last: Int[np.ndarray, " rows"]
    ) -> tuple[Int[np.ndarray, " found"], Int[np.ndarray, " found"]]:
        """(row, pair) that can give an echo over a first and a last wall (equal for one reflection), by the beams.

        Args:
            group: index of the group of sensors.
            first: wall that tx must reach.
            last: wall from which rx must hear.
        """
        if self.wall_loss is None:
            row, pair = np.divmod(np.arange(len(group) * len(self.pairs)), len(self.pairs))
            return row, pair
        legs = self.distance[group, first] + self.separation[first, last] + self.distance[group, last]
        limit = largest_loss(legs / 2 - self.radius[group], self.acoustics)
        i, j = self.pairs.T
        loss = self.wall_loss[group, first][:, i] + self.wall_loss[group, last][:, j]
        row, pair = np.nonzero(loss <= limit[:, None])
        return row, pair

    def audible(self, found: TracedEchoes) -> TracedEchoes:
        """Echoes within the beams with no wall or circle across any leg; the cheapest test comes first."""
        if self.axis is not None:
            kept = np.arange(len(found))
            for side, point in ((0, found.first), (1, found.last)):
                group, sensor = found.group[kept], self.pairs[found.pair[kept], side]
                leg = point[kept] - self.sensors[group, sensor]
                kept = kept[in_cone(leg, self.axis[group, sensor], self.cos_limit[sensor])]
            found = found[kept]
        found = found[self.loud(found)]
        for side, point in ((0, "first"), (1, "last")):
            start = self.sensors[found.group, self.pairs[found.pair, side]]
            found = found[~self.block(found.group, start, getattr(found, point))]
        return found[~self.block(found.group, found.first, found.last)]

    def loud(self, found: TracedEchoes) -> Bool[np.ndarray, " found"]:
        """Whether each echo reaches the threshold with soft beams; all do with hard beams and without axes."""
        if self.axis is None or self.acoustics is None:
            return np.ones(len(found), dtype=bool)
        amplitude = amplitudes(
            found, self.pairs, self.sensors, self.axis, self.half_beam, self.acoustics, self.circle_radius
        )
        # The caller decides about echoes at the threshold, in the coordinates of the world.
        return amplitude >= self.acoustics.threshold * (1 - LOUDNESS_MARGIN)

    @property
    def circle_radius(self) -> Float[np.ndarray, " circles"]:
        """Radii of the circles, metres; the same in every group."""
        return self.circles[0, :, 2] if len(self.circles) else np.zeros(self.circles.shape[1])

    def block(
        self, group: Int[np.ndarray, " legs"], p: Float[np.ndarray, "legs 2"], q: Float[np.ndarray, "legs 2"]
    ) -> Bool[np.ndarray, " legs"]:
        """Legs from p to q that a wall or a circle intersects; a leg that ends on one is not blocked by it.

        Args:
            group: index of the group of sensors; circles may be at another place in each group.
            p: starts of the legs, metres from the origin of the scene.
            q: their ends.
        """
        blocked = self.walls.block(p, q)
        for rows in row_slices(len(p), self.circles.shape[1]):
            leg, circles = (q - p)[rows, None], self.circles[group[rows]]
            to = circles[..., :2] - p[rows, None]
            share = np.clip((leg * to).sum(-1) / np.maximum((leg**2).sum(-1), TOLERANCE**2), 0, 1)
            distance = np.linalg.norm(share[..., None] * leg - to, axis=-1)
            blocked[rows] |= (distance < circles[..., 2] - TOLERANCE).any(axis=1)
        return blocked

    def points_in_range(
        self, points: Float[np.ndarray, "points 2"]
    ) -> tuple[Int[np.ndarray, " near"], Int[np.ndarray, " near"]]:
        """(group, point) pairs within the maximum range of the group's sensors."""
        distance = np.linalg.norm(self.hub[:, None] - points, axis=-1)
        group, point = np.nonzero(distance <= self.max_range + self.radius[:, None])
        return group, point


def in_cone(
    leg: Float[np.ndarray, "*batch 2"], axis: Float[np.ndarray, "*batch 2"], cos_limit: Float[np.ndarray, "..."]
) -> Bool[np.ndarray, "*batch"]:
    """Whether the direction of a leg lies within the cone around the axis."""
    return (leg * axis).sum(-1) >= (cos_limit - 1e-12) * np.linalg.norm(leg, axis=-1)


def row_slices(rows: int, width: int, cells: int = 1 << 18) -> Iterator[slice]:
    """Slices of rows of this width, small enough for temporary arrays to stay in the cache."""
    step = max(1, cells // max(1, width))
    return (slice(k, min(k + step, rows)) for k in range(0, rows, step))

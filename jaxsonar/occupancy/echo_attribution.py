"""Which echoes a map explains: by one reflector, by two walls, and by the sound of another transmitter (crosstalk)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.detection.arc_tables import simultaneous_transmitters
from jaxsonar.geometry.se2 import transform_points, wrap_angle
from jaxsonar.geometry.segments import cross, lengths
from jaxsonar.kernels.detection_cones import SETTINGS as CONES
from jaxsonar.occupancy.echo_arcs import EchoArcs
from jaxsonar.occupancy.known_reflectors import KnownReflectors
from jaxsonar.occupancy.settings import SETTINGS
from jaxsonar.sensors.ring import Ring

_WALLS = SETTINGS.reflectors


class ReceivedEchoes(NamedTuple):
    """Echoes with the sensors that sent and received them."""

    position: Float[np.ndarray, "echoes 2 2"]
    """Of transmitter and receiver, world frame, metres."""
    heading: Float[np.ndarray, "echoes 2"]
    """Of both, radians."""
    half_width: Float[np.ndarray, "echoes 2"]
    """Of their cones, radians."""
    distance: Float[np.ndarray, " echoes"]
    """Half path length, metres."""

    @classmethod
    def of(cls, ring: Ring, arcs: EchoArcs, sensors: Int[np.ndarray, "echoes 2"]) -> "ReceivedEchoes":
        """The echoes of arcs, sent and received by these sensors."""
        return cls(
            transform_points(arcs.pose[:, None], np.asarray(ring.position)[sensors]),
            np.asarray(ring.heading)[sensors] + arcs.pose[:, None, 2],
            np.minimum(np.asarray(ring.beam) / 2, np.pi / 2)[sensors],
            arcs.distance,
        )

    def take(self, rows: Int[np.ndarray, " some"]) -> "ReceivedEchoes":
        """Some of the echoes."""
        return ReceivedEchoes(*(column[rows] for column in self))

    def off_axis(
        self, rows: Int[np.ndarray, " some"], rays: Float[np.ndarray, "some 2 2"]
    ) -> Float[np.ndarray, "some 2"]:
        """Angles of rays from both sensors of some echoes off their axes, radians."""
        return np.abs(wrap_angle(np.arctan2(rays[..., 1], rays[..., 0]) - self.heading[rows]))

    def is_audible(
        self,
        rows: Int[np.ndarray, " some"],
        off_axis: Float[np.ndarray, "some 2"],
        strength: Float[np.ndarray, " some"] | float,
    ) -> Bool[np.ndarray, " some"]:
        """Whether some echoes are loud enough, also outside of the cones.

        The level is that of ``kernels.detection_cones.echo_level`` with angles off the axes for chords.

        Args:
            rows: the echoes.
            off_axis: angles off both axes, radians.
            strength: level of the reflectors relative to a wall, dB.
        """
        distance = self.distance[rows]
        beams = CONES.beam_edge_db * ((off_axis / self.half_width[rows]) ** 2).sum(-1)
        air = 20 * np.log10(np.maximum(distance, 1e-2)) + 2 * CONES.absorption_db_per_m * (distance - 1)
        return (strength - air - beams > _WALLS.hearing_threshold) & (off_axis < np.pi / 2).all(axis=-1)


def explained_by_map(known: KnownReflectors, ring: Ring, arcs: EchoArcs) -> Bool[np.ndarray, " arcs"]:
    """Which echoes known reflectors explain.

    Args:
        known: the map around the echoes.
        ring: the sensors.
        arcs: the echoes.
    """
    sensors = ring.paths[arcs.path]
    echoes = ReceivedEchoes.of(ring, arcs, sensors)
    explained = explained_by_reflectors(known, echoes)
    rows = np.flatnonzero(~explained)
    explained[rows] = explained_by_two_walls(known.walls, echoes.take(rows))
    # Other sensors that fired at the same time.
    together = simultaneous_transmitters(ring)
    for other in () if together is None else together[arcs.path].T:
        rows = np.flatnonzero(~explained & (other >= 0))
        ends = np.stack([other[rows], sensors[rows, 1]], axis=-1)
        echoes = ReceivedEchoes.of(ring, arcs.take(rows), ends)
        explained[rows] = explained_by_reflectors(known, echoes, own=False)
        left = np.flatnonzero(~explained[rows])
        explained[rows[left]] = explained_by_two_walls(known.walls, echoes.take(left))
    return explained


def explained_by_reflectors(
    known: KnownReflectors, echoes: ReceivedEchoes, *, own: bool = True
) -> Bool[np.ndarray, " echoes"]:
    """Which echoes have the range of a known wall, wall end, corner, point or circle.

    The reflector is within both cones, or its echo is loud enough.

    Args:
        known: the map around the echoes.
        echoes: the echoes.
        own: whether all reflectors within both cones are heard; not so for crosstalk.
    """
    walls, points, radii, position = known.walls, known.reflecting_points(), known.reflecting_radii(), echoes.position
    length = lengths(walls)
    tangent = (walls[:, 1] - walls[:, 0]) / np.maximum(length, 1e-9)[:, None]
    offset = position[:, :, None] - walls[:, 0]
    height, along = cross(tangent, offset), (offset * tangent).sum(-1)
    # The image source: heights add up.
    total = np.maximum(np.abs(height).sum(axis=1), 1e-9)
    foot = along[:, 0] + np.abs(height[:, 0]) / total * (along[:, 1] - along[:, 0])
    expected = np.hypot(total, along[:, 1] - along[:, 0]) / 2
    on_wall = (np.abs(foot - length / 2) <= length / 2 + _WALLS.beyond_end) & (height[:, 0] * height[:, 1] > 0)
    wall_gap = np.where(on_wall, np.abs(expected - echoes.distance[:, None]), np.inf)
    # A corner reflects to the middle of the sensors, an edge to both.
    as_edge = np.linalg.norm(points - position[:, :, None], axis=-1).mean(axis=1) - radii
    as_corner = np.linalg.norm(points - position.mean(axis=1)[:, None], axis=-1) - radii
    measured = echoes.distance[:, None]
    point_gap = np.minimum(np.abs(as_edge - measured), np.abs(as_corner - measured))
    gap = np.concatenate([wall_gap, point_gap], axis=1)
    row, target = np.nonzero(gap <= (_WALLS.explained if own else _WALLS.explained_outside))
    on_points = target >= len(walls)
    place = np.empty((len(row), 2))
    place[on_points] = points[target[on_points] - len(walls)]
    at = target[~on_points]
    place[~on_points] = walls[at, 0] + foot[row[~on_points], at, None] * tangent[at]
    off_axis = echoes.off_axis(row, place[:, None] - position[row])
    strength = np.concatenate([np.zeros(len(walls)), known.reflecting_levels()])[target]
    seen = echoes.is_audible(row, off_axis, strength) & (gap[row, target] <= _WALLS.explained_outside)
    if own:
        seen |= (off_axis <= echoes.half_width[row] + _WALLS.beyond_cone).all(axis=1)
    return np.bincount(row[seen], minlength=len(gap)) > 0


def explained_by_two_walls(
    walls: Float[np.ndarray, "walls 2 2"], echoes: ReceivedEchoes
) -> Bool[np.ndarray, " echoes"]:
    """Which echoes have the range of a reflection at one known wall and then at another, and are loud enough.

    Args:
        walls: those around the echoes, world frame, metres.
        echoes: the echoes.
    """
    explained = np.zeros(len(echoes.distance), bool)
    length = lengths(walls)
    tangent = (walls[:, 1] - walls[:, 0]) / np.maximum(length, 1e-9)[:, None]
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
    rho = (walls[:, 0] * normal).sum(-1)
    tx, rx = echoes.position[:, 0], echoes.position[:, 1]

    def height(point, wall):
        return (point * normal[wall]).sum(-1) - rho[wall]

    def crossing(start, end, wall):
        """Where rays cross walls, and whether they do."""
        before, after = height(start, wall), height(end, wall)
        share = before / np.where(before == after, 1.0, before - after)
        point = start + share[:, None] * (end - start)
        along = ((point - walls[wall, 0]) * tangent[wall]).sum(-1)
        on_wall = np.abs(along - length[wall] / 2) <= length[wall] / 2 + _WALLS.beyond_end
        return point, (before * after < 0) & on_wall

    for second in range(len(walls)):
        # The image of the image: the sound seems to go straight to the receiver behind both walls.
        image = rx - 2 * height(rx, second)[:, None] * normal[second]
        depth = image @ normal.T - rho
        double = image[:, None] - 2 * depth[..., None] * normal
        gap = np.abs(np.linalg.norm(double - tx[:, None], axis=-1) / 2 - echoes.distance[:, None])
        gap[:, second] = np.inf
        row, first = np.nonzero(gap <= _WALLS.explained_outside)
        out, leaves = crossing(tx[row], double[row, first], first)
        back, arrives = crossing(out, image[row], np.full(len(row), second))
        rays = np.stack([out - tx[row], back - rx[row]], axis=1)
        audible = echoes.is_audible(row, echoes.off_axis(row, rays), 0.0)
        explained[row[leaves & arrives & audible]] = True
    return explained

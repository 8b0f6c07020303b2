"""What one scan sees, as arrays, and the map that placing builds of it: walls and points with their noise."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.detection.extract import LocalModel
from jaxsonar.floor_plans.room import point_to_walls
from jaxsonar.geometry.se2 import inverse, to_world, unit, wrap_angle

LINE_FLOOR, POINT_FLOOR = (0.02, np.radians(1.0)), 0.03
"""Added to the noise of lines (across and in direction) and of points: the ring may not be calibrated yet."""
ENOUGH = 6
"""Echoes that a line needs to be trusted fully."""
NOT_PARALLEL, SAME_PLACE = 0.3, 0.15
"""Sine of the angle between two lines that cross; metres within which distances agree."""


class Seen(NamedTuple):
    """What is seen from one frame: lines and points, with the noise that they are trusted to have."""

    theta: Float[np.ndarray, " lines"]
    """Direction of the normal, away from the robot."""
    segment: Float[np.ndarray, "lines 2 2"]
    """Both ends."""
    sigma: Float[np.ndarray, "lines 2"]
    """Across the middle of the segment, metres, and of theta, radians."""
    trust: Float[np.ndarray, " lines"]
    """0 to 1."""
    point: Float[np.ndarray, "points 2"]
    kind: Bool[np.ndarray, " points"]
    """True: a corner."""
    spread: Float[np.ndarray, " points"]
    """Standard deviation of each coordinate, metres."""
    heard: Float[np.ndarray, "reflectors 2"]
    """rho and theta of everything, undecided ones included."""

    @property
    def middle(self) -> Float[np.ndarray, "lines 2"]:
        """Of the segments."""
        return self.segment.mean(axis=1)

    @property
    def radius(self) -> float:
        """How far from the frame's origin anything is."""
        ends = np.concatenate([self.segment.reshape(-1, 2), self.point])
        return float(np.linalg.norm(ends, axis=1).max(initial=0.0))


def seen_of(model: LocalModel, *, blur: float = 1.0) -> Seen:
    """A local model as arrays, its covariances widened for a ring that is not calibrated: less with a smaller blur."""
    theta = np.array([line.theta for line in model.lines], dtype=np.float64)
    segment = np.array([line.segment for line in model.lines], dtype=np.float64).reshape(-1, 2, 2)
    cov = np.array([np.zeros((2, 2)) if line.cov is None else line.cov for line in model.lines], dtype=np.float64)
    cov = cov.reshape(-1, 2, 2)
    along = (segment.mean(axis=1) * tangent_of(theta)).sum(-1)
    across = cov[:, 0, 0] - 2 * along * cov[:, 0, 1] + along**2 * cov[:, 1, 1]
    sigma = np.sqrt(np.stack([np.maximum(across, 0.0), cov[:, 1, 1]], axis=-1) + np.square(blur * np.array(LINE_FLOOR)))
    points = [one for one in model.points if not _where_two_meet(np.array([one.x, one.y]), model)]
    noise = np.array([np.trace(one.cov) / 2 for one in points], dtype=np.float64)
    reflectors = [(line.rho, line.theta) for line in model.lines]
    reflectors += [(other.rho, other.theta) for other in model.undecided]
    reflectors += [(float(np.hypot(one.x, one.y)), float(np.arctan2(one.y, one.x))) for one in model.points]
    return Seen(
        theta=theta,
        segment=segment,
        sigma=sigma,
        trust=np.clip(np.array([line.echoes for line in model.lines], dtype=np.float64) / ENOUGH, 0.3, 1.0),
        point=np.array([(one.x, one.y) for one in points], dtype=np.float64).reshape(-1, 2),
        kind=np.array([one.kind == "corner" for one in points], dtype=bool),
        spread=np.sqrt(noise + (blur * POINT_FLOOR) ** 2),
        heard=np.array(reflectors, dtype=np.float64).reshape(-1, 2),
    )


def _where_two_meet(point: Float[np.ndarray, "2"], model: LocalModel) -> bool:
    """Whether two of the scan's own lines say already that there is a corner."""
    theta = np.array([line.theta for line in model.lines], dtype=np.float64)
    rho = np.array([line.rho for line in model.lines], dtype=np.float64)
    on = theta[np.abs(unit(theta) @ point - rho) < SAME_PLACE]
    return bool((np.abs(np.sin(on[:, None] - on)) > NOT_PARALLEL).any())


class Places:
    """Walls and points found so far, world frame. A wall has one side: its normal leads away from the robot."""

    def __init__(self) -> None:
        self.reference = np.zeros((0, 2))  # a point near the wall
        self.theta = np.zeros(0)  # direction of the normal
        self.offset = np.zeros(0)  # the wall's distance from the reference, along the normal
        self.cov = np.zeros((0, 2, 2))  # of offset and theta
        self.extent = np.zeros((0, 2))  # along the tangent from the reference
        self.sightings = np.zeros(0)
        self.point = np.zeros((0, 2))
        self.kind = np.zeros(0, dtype=bool)  # as in Seen
        self.spread = np.zeros(0)

    @property
    def normal(self) -> Float[np.ndarray, "walls 2"]:
        """Away from the robot."""
        return unit(self.theta)

    @property
    def tangent(self) -> Float[np.ndarray, "walls 2"]:
        """A quarter turn on from the normal."""
        return tangent_of(self.theta)

    @property
    def level(self) -> Float[np.ndarray, " walls"]:
        """Of every place p on a wall, normal . p, metres."""
        return (self.reference * self.normal).sum(-1) + self.offset

    @property
    def segment(self) -> Float[np.ndarray, "walls 2 2"]:
        """What was seen of the walls."""
        foot = self.reference + self.offset[:, None] * self.normal
        return foot[:, None] + self.extent[..., None] * self.tangent[:, None]

    def near(self, centre: Float[np.ndarray, "2"], radius: float) -> "Places":
        """Those that reach into a circle."""
        walls = (point_to_walls(centre[None], self.segment)[0] if len(self.theta) else np.zeros(0)) < radius
        points = np.linalg.norm(self.point - centre, axis=1) < radius
        part = Places()
        for name in ("reference", "theta", "offset", "cov", "extent", "sightings"):
            setattr(part, name, getattr(self, name)[walls])
        for name in ("point", "kind", "spread"):
            setattr(part, name, getattr(self, name)[points])
        return part

    def as_seen(self, pose: Float[np.ndarray, "3"]) -> Seen:
        """The whole map as if seen at a pose."""
        back = inverse(pose)
        return Seen(
            theta=self.theta + back[2],
            segment=to_world(back, self.segment),
            sigma=np.sqrt(self.cov[:, [0, 1], [0, 1]] + np.square(LINE_FLOOR)),
            trust=np.minimum(self.sightings / 2, 1.0),
            point=to_world(back, self.point),
            kind=self.kind,
            spread=self.spread + POINT_FLOOR,
            heard=np.zeros((0, 2)),
        )

    def add(
        self,
        seen: Seen,
        pose: Float[np.ndarray, "3"],
        wall: Int[np.ndarray, " lines"],
        point: Int[np.ndarray, " points"],
    ) -> None:
        """What a placed scan saw: known walls and points become better, the others are new.

        Args:
            seen: what it saw.
            pose: world_from_robot.
            wall: number of each line's wall, -1 where it is new.
            point: the same of points.
        """
        theta, segment = wrap_angle(seen.theta + pose[2]), to_world(pose, seen.segment)
        for line, known in enumerate(wall):
            if known < 0:
                self._new_wall(theta[line], segment[line], seen.sigma[line])
            else:
                self._better_wall(known, theta[line], segment[line], seen.sigma[line])
        at = to_world(pose, seen.point)
        for index, known in enumerate(point):
            if known < 0:
                self.point = np.concatenate([self.point, at[index][None]])
                self.kind = np.append(self.kind, seen.kind[index])
                self.spread = np.append(self.spread, seen.spread[index])
            else:
                a, b = self.spread[known] ** -2, seen.spread[index] ** -2
                self.point[known] = (a * self.point[known] + b * at[index]) / (a + b)
                self.spread[known] = (a + b) ** -0.5

    def _new_wall(self, theta: float, segment: Float[np.ndarray, "2 2"], sigma: Float[np.ndarray, "2"]) -> None:
        middle = segment.mean(axis=0)
        along = np.sort((segment - middle) @ tangent_of(theta))
        self.reference = np.concatenate([self.reference, middle[None]])
        self.theta, self.offset = np.append(self.theta, theta), np.append(self.offset, 0.0)
        self.cov = np.concatenate([self.cov, np.diag(sigma**2)[None]])
        self.extent = np.concatenate([self.extent, along[None]])
        self.sightings = np.append(self.sightings, 1.0)

    def _better_wall(
        self, wall: int | np.integer, theta: float, segment: Float[np.ndarray, "2 2"], sigma: Float[np.ndarray, "2"]
    ) -> None:
        """A Kalman step: the distance at the segment's middle and the direction are what was measured."""
        from_reference = segment - self.reference[wall]
        middle = from_reference.mean(axis=0)
        along = float(middle @ tangent_of(self.theta[wall]))
        across = middle @ unit(self.theta[wall]) - self.offset[wall]
        surprise = np.array([across, wrap_angle(float(theta - self.theta[wall]))])
        design = np.array([[1.0, along], [0.0, 1.0]])
        gain = self.cov[wall] @ design.T @ np.linalg.inv(design @ self.cov[wall] @ design.T + np.diag(sigma**2))
        change = gain @ surprise
        self.offset[wall] += change[0]
        self.theta[wall] = wrap_angle(float(self.theta[wall] + change[1]))
        self.cov[wall] = (np.eye(2) - gain @ design) @ self.cov[wall]
        reached = from_reference @ tangent_of(self.theta[wall])
        self.extent[wall] = min(self.extent[wall, 0], reached.min()), max(self.extent[wall, 1], reached.max())
        self.sightings[wall] += 1


def tangent_of(theta: Float[np.ndarray, "*batch"] | float) -> Float[np.ndarray, "*batch 2"]:
    """A quarter turn on from the normals."""
    return np.stack([-np.sin(theta), np.cos(theta)], axis=-1)


def quarter(vector: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    """Turned by 90 deg counter-clockwise."""
    return np.stack([-vector[..., 1], vector[..., 0]], axis=-1)


def turned(vector: Float[np.ndarray, "*#batch 2"], heading: Float[np.ndarray, "*#batch"]) -> Float[np.ndarray, "... 2"]:
    """Vectors of the robot's frame by the robot's headings into the world's."""
    return np.cos(heading)[..., None] * vector + np.sin(heading)[..., None] * quarter(vector)

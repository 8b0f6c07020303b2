"""NumPy operations on ``kernels.Landmarks``, the container of planes, corners, edges and circles in any frame.

A landmark has a kind, two parameters, an anchor near it, and, for planes, an extent, for circles a radius: see
``kernels.Landmarks``.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.geometry.se2 import inverse, perpendicular, relative_jacobians, rotate, tangent_of, unit, wrap_angle
from jaxsonar.kernels.landmarks import Landmarks
from jaxsonar.kernels.measurement_model import CIRCLE, PLANE
from jaxsonar.kernels.shape_buckets import pad_rows

UNUSED = -1
"""Kind of the rows that padding adds."""


def concatenate_landmarks(parts: Sequence[Landmarks]) -> Landmarks:
    """Landmarks of one frame in one container; an empty one without parts."""
    radii = [np.zeros(len(part.kind)) if part.radius is None else np.asarray(part.radius) for part in parts]
    no_circles = all(part.radius is None for part in parts)
    return Landmarks(
        kind=np.concatenate([np.zeros(0, np.int32), *(part.kind for part in parts)]).astype(np.int32),
        parameters=np.concatenate([np.zeros((0, 2)), *(part.parameters for part in parts)]),
        anchor=np.concatenate([np.zeros((0, 2)), *(part.anchor for part in parts)]),
        extent=np.concatenate([np.zeros((0, 2)), *(part.extent for part in parts)]),
        radius=None if no_circles else np.concatenate(radii),
    )


def pad_landmarks(landmarks: Landmarks, rows: int) -> Landmarks:
    """The landmarks with this many rows; new rows are unused."""
    kind, *rest = _arrays(landmarks)
    parameters, anchor, extent = (pad_rows(leaf, rows) for leaf in rest)
    radius = None if landmarks.radius is None else pad_rows(np.asarray(landmarks.radius), rows)
    return Landmarks(pad_rows(kind, rows, fill=UNUSED), parameters, anchor, extent, radius)


def landmarks_from_segments(
    rho: Float[np.ndarray, " walls"], theta: Float[np.ndarray, " walls"], segments: Float[np.ndarray, "walls 2 2"]
) -> Landmarks:
    """Planes anchored at the middles of observed segments.

    Args:
        rho: distances from the origin, metres.
        theta: directions of the normals, radians.
        segments: observed parts; they need not lie exactly on the planes.
    """
    middle = segments.mean(axis=1)
    half = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=-1) / 2
    distance = rho - (unit(theta) * middle).sum(-1)
    return Landmarks(
        kind=np.full(len(rho), PLANE, np.int32),
        parameters=np.stack([distance, theta], axis=-1),
        anchor=middle,
        extent=np.stack([-half, half], axis=-1),
    )


def landmarks_from_points(
    kind: Int[np.ndarray, " points"],
    positions: Float[np.ndarray, "points 2"],
    radius: Float[np.ndarray, " points"] | None = None,
) -> Landmarks:
    """Corners, edges and circles anchored where they are.

    Args:
        kind: CORNER, EDGE or CIRCLE.
        positions: metres; of circles the center.
        radius: of circles, metres; not used for other kinds. None: there is no circle.
    """
    zeros, is_circle = np.zeros_like(positions), kind == CIRCLE
    radii = None if radius is None or not is_circle.any() else np.where(is_circle, radius, 0.0)
    return Landmarks(kind=kind.astype(np.int32), parameters=zeros, anchor=positions, extent=zeros, radius=radii)


def landmark_positions(landmarks: Landmarks) -> Float[np.ndarray, "landmarks 2"]:
    """Position of each point, center of each circle; of each plane the footpoint of its anchor."""
    kind, parameters, anchor, _ = _arrays(landmarks)
    foot = parameters[:, :1] * unit(parameters[:, 1])
    return anchor + np.where((kind == PLANE)[:, None], foot, parameters)


def wall_segments(landmarks: Landmarks) -> Float[np.ndarray, "landmarks 2 2"]:
    """Both end points of each plane, metres; all landmarks must be planes."""
    _, parameters, _, extent = _arrays(landmarks)
    tangent = tangent_of(parameters[:, 1])
    return landmark_positions(landmarks)[:, None] + extent[..., None] * tangent[:, None]


def transform_landmarks(new_from_old: Float[np.ndarray, "3"], landmarks: Landmarks) -> Landmarks:
    """The landmarks in another frame; their anchors move along."""
    kind, parameters, anchor, extent = _arrays(landmarks)
    heading = new_from_old[2]
    line, point = parameters + np.array([0.0, heading]), rotate(parameters, heading)
    return Landmarks(
        kind=kind,
        parameters=np.where((kind == PLANE)[:, None], line, point),
        anchor=rotate(anchor, heading) + new_from_old[:2],
        extent=extent,
        radius=landmarks.radius,
    )


class TransformedParameters(NamedTuple):
    """Parameters of landmarks in another frame, relative to given anchors there, and their derivatives."""

    parameters: Float[np.ndarray, "*landmarks 2"]
    """As ``Landmarks.parameters``; theta in [-pi, pi)."""
    by_transform: Float[np.ndarray, "*landmarks 2 3"]
    """Derivatives with respect to new_from_old."""
    by_parameters: Float[np.ndarray, "*landmarks 2 2"]
    """Derivatives with respect to the parameters in the old frame."""


def transform_parameters(
    new_from_old: Float[np.ndarray, "3"], landmarks: Landmarks, anchor: Float[np.ndarray, "*#landmarks 2"]
) -> TransformedParameters:
    """Parameters of landmarks in another frame relative to other anchors, to first order in all errors.

    Args:
        new_from_old: the transformation.
        landmarks: in the old frame.
        anchor: in the new frame, one for each landmark.
    """
    kind, parameters, own_anchor, _ = _arrays(landmarks)
    heading = np.asarray(new_from_old[2])
    arm = rotate(own_anchor, heading)
    offset = arm + new_from_old[:2] - anchor
    plane = (kind == PLANE)[..., None]
    # Planes: the distance of the new anchor along the normal.
    theta = parameters[..., 1] + heading
    normal = unit(theta)
    along = (tangent_of(theta) * offset).sum(-1)
    line = np.stack([parameters[..., 0] + (normal * offset).sum(-1), wrap_angle(theta)], axis=-1)
    # Points: the offset from the new anchor.
    point_arm = arm + rotate(parameters, heading)
    point = point_arm + new_from_old[:2] - anchor
    by_transform = np.zeros((*theta.shape, 2, 3))
    by_transform[..., 0, :2] = np.where(plane, normal, [1.0, 0.0])
    by_transform[..., 1, :2] = np.where(plane, 0.0, [0.0, 1.0])
    by_angle = np.stack([along + (normal * perpendicular(arm)).sum(-1), np.ones(theta.shape)], axis=-1)
    by_transform[..., 2] = np.where(plane, by_angle, perpendicular(point_arm))
    c, s = np.cos(heading), np.sin(heading)
    by_line = np.zeros((*theta.shape, 2, 2))
    by_line[..., 0, 0] = by_line[..., 1, 1] = 1.0
    by_line[..., 0, 1] = along
    by_parameters = np.where(plane[..., None], by_line, np.array([[c, -s], [s, c]]))
    return TransformedParameters(np.where(plane, line, point), by_transform, by_parameters)


def landmarks_in_robot_frame(
    pose: Float[np.ndarray, "3"], landmarks: Landmarks
) -> tuple[Float[np.ndarray, "landmarks 2"], Float[np.ndarray, "landmarks 2 5"]]:
    """Parameters of landmarks relative to the robot, and their Jacobians.

    Args:
        pose: frame_from_robot.
        landmarks: in that frame.

    Returns:
        (rho, theta) of planes with rho of either sign, (x, y) of points and circles, robot frame; derivatives with
        respect to the pose (3) and to the landmark's own parameters (2).
    """
    robot_from_frame = inverse(pose)
    seen = transform_parameters(robot_from_frame, landmarks, np.zeros(2))
    by_pose = seen.by_transform @ relative_jacobians(pose, robot_from_frame)[0]
    return seen.parameters, np.concatenate([by_pose, seen.by_parameters], axis=-1)


def _arrays(landmarks: Landmarks) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Kind, parameters, anchor and extent as NumPy arrays."""
    kind, parameters = np.asarray(landmarks.kind), np.asarray(landmarks.parameters)
    return kind, parameters, np.asarray(landmarks.anchor), np.asarray(landmarks.extent)

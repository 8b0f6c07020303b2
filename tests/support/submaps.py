"""Submaps from floor plans without simulated echoes: landmarks with errors drawn from their covariance."""

from itertools import pairwise

import numpy as np

from jaxsonar import kernels
from jaxsonar.geometry.landmarks import transform_landmarks
from jaxsonar.geometry.se2 import inverse, relative
from jaxsonar.loop_closure.submap import Submap

REACH = 1.7  # m


def rectangle(width, height):
    """Corners of a rectangle, counter-clockwise: free space is on the left."""
    return np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])


def corridor_with_rooms(length, doors, *, width=1.8):
    """Outline of a corridor from (0, 0) along x, with niches and rooms on its left side.

    A niche is (x, half width, depth), a room (x, half width of its door, x0, x1, height).
    """
    outline = [(0.0, 0.0), (length, 0.0), (length, width)]
    for door in sorted(doors, reverse=True):
        x, half = door[:2]
        if len(door) == 3:
            depth = width + door[2]
            outline += [(x + half, width), (x + half, depth), (x - half, depth), (x - half, width)]
        else:
            x0, x1, high = door[2:]
            sill = width + 0.15
            outline += [(x + half, width), (x + half, sill), (x1, sill), (x1, sill + high)]
            outline += [(x0, sill + high), (x0, sill), (x - half, sill), (x - half, width)]
    return np.array([*outline, (0.0, width)])


def drive(*stops, pitch=0.15):
    """Poses along a polyline, heading in the direction of travel."""
    stops, poses = np.array(stops, dtype=float), []
    for start, end in pairwise(stops):
        step = end - start
        count = max(int(np.linalg.norm(step) / pitch), 1)
        position = start + np.arange(count)[:, None] / count * step
        poses.append(np.concatenate([position, np.full((count, 1), np.arctan2(step[1], step[0]))], axis=1))
    return np.concatenate(poses)


def ring_corridor(width, height, doors=(), *, across=1.8):
    """Outlines of a corridor around a block: the outer polygon, and the block, clockwise, with niches
    (side, x, half width, depth)."""
    block = [np.array([[0.0, 0.0], [0.0, height], [width, height], [width, 0.0]])]
    corners, outline = block[0], []
    for side in range(4):
        start, end = corners[side], corners[(side + 1) % 4]
        tangent = (end - start) / np.linalg.norm(end - start)
        inward = np.array([tangent[1], -tangent[0]])
        outline.append(start)
        for at, half, depth in sorted(door[1:] for door in doors if door[0] == side):
            for x, y in ((at - half, 0.0), (at - half, depth), (at + half, depth), (at + half, 0.0)):
                outline.append(start + x * tangent + y * inward)
    return [rectangle(width + 2 * across, height + 2 * across) - across, np.array(outline)]


def _sides(outlines):
    """Start and end of every wall, and the corner before its start."""
    outlines = outlines if isinstance(outlines, list) else [outlines]
    rolled = [np.concatenate([np.roll(one, turn, axis=0) for one in outlines]) for turn in (0, -1, 1)]
    return rolled[0], rolled[1], rolled[2]


def _blocked(outline, start, end):
    """Whether lines from start to end, (lines, 2) each, pass through a wall of the polygon."""
    a, b, _ = _sides(outline)
    line, wall = (end - start)[:, None], (b - a)[None]
    cross = line[..., 0] * wall[..., 1] - line[..., 1] * wall[..., 0]
    cross = np.where(np.abs(cross) < 1e-12, np.nan, cross)
    offset = a[None] - start[:, None]
    t = (offset[..., 0] * wall[..., 1] - offset[..., 1] * wall[..., 0]) / cross
    u = (offset[..., 0] * line[..., 1] - offset[..., 1] * line[..., 0]) / cross
    return ((t > 1e-6) & (t < 1 - 1e-4) & (u > -1e-9) & (u < 1 + 1e-9)).any(axis=1)


def covariance(rng, count, slip):
    """Joint covariance of exit pose (3) and parameters: independent and common errors."""
    sigma = np.concatenate([slip * np.array([0.02, 0.02, 0.01]), np.tile([0.008, 0.006], count)])
    common = rng.normal(size=(3 + 2 * count, 3)) * sigma[:, None] / 2
    return np.diag(sigma**2) + common @ common.T


def submap(outline, world_from_robot, world_from_next, rng, *, row=0, slip=1.0, missed=0.0, spurious=0.0):
    """A submap of a polygon along a trajectory, in the frame of its first pose.

    ``slip`` scales the errors of the exit pose, ``missed`` is the probability that a landmark is not observed, and
    ``spurious`` the mean number of false landmarks.
    """
    position = world_from_robot[:, :2]
    found = [
        *_observed_walls(outline, position, rng, missed),
        *_observed_points(outline, position, rng, missed),
        *_false_landmarks(position, rng, spurious),
    ]
    kind, parameters, anchor, extent, scans = zip(*found, strict=True) if found else ((),) * 5
    landmarks = kernels.Landmarks(
        np.array(kind, np.int32),
        np.array(parameters, dtype=float).reshape(-1, 2),
        np.array(anchor, dtype=float).reshape(-1, 2),
        np.array(extent, dtype=float).reshape(-1, 2),
    )
    landmarks = transform_landmarks(inverse(world_from_robot[0]), landmarks)
    poses = relative(np.broadcast_to(world_from_robot[0], world_from_robot.shape), world_from_robot)
    cov = covariance(rng, len(kind), slip)
    error = np.linalg.cholesky(cov) @ rng.normal(size=len(cov))
    return Submap(
        landmarks=landmarks.with_parameters(landmarks.parameters + error[3:].reshape(-1, 2)),
        scan_counts=np.array(scans),
        exit_pose=relative(world_from_robot[0], world_from_next) + error[:3],
        covariance=cov,
        rows=np.arange(row, row + len(poses)),
        poses=poses,
        pose_covariances=np.tile(1e-4 * np.eye(3), (len(poses), 1, 1)),
    )


def _observed_walls(outline, position, rng, missed):
    """Walls with their foot points in sight of at least three positions: kind, parameters, anchor, extent, scans."""
    for start, end in zip(*_sides(outline)[:2], strict=True):
        length = np.linalg.norm(end - start)
        tangent = (end - start) / length
        normal = np.array([tangent[1], -tangent[0]])  # away from the free space on the left
        along, distance = (position - start) @ tangent, -(position - start) @ normal
        seen = (along > 0.02) & (along < length - 0.02) & (distance > 0.05) & (distance < REACH)
        foot = start + along[:, None] * tangent
        seen[seen] = ~_blocked(outline, position[seen], foot[seen])
        if seen.sum() < 3 or rng.random() < missed:
            continue
        middle = start + np.mean([along[seen].min(), along[seen].max()]) * tangent
        anchor = middle + rng.uniform(-0.3, 0.3, 2)
        extent = np.sort((foot[seen] - anchor) @ np.array([-normal[1], normal[0]]))[[0, -1]]
        parameters = [normal @ (middle - anchor), np.arctan2(normal[1], normal[0])]
        yield kernels.PLANE, parameters, anchor, extent, int(seen.sum())


def _observed_points(outline, position, rng, missed):
    """Corners and edges in sight of at least three positions: kind, parameters, anchor, extent, scans."""
    start, end, before = _sides(outline)
    for previous, corner, following in zip(before, start, end, strict=True):
        first, second = corner - previous, following - corner
        turns_left = first[0] * second[1] - first[1] * second[0] > 0
        near = np.flatnonzero(np.linalg.norm(position - corner, axis=1) < REACH)
        targets = np.broadcast_to(corner, (len(near), 2))
        near = near[~_blocked(outline, position[near], targets)] if len(near) else near
        if len(near) < 3 or rng.random() < missed:
            continue
        anchor = corner + rng.uniform(-0.05, 0.05, 2)
        yield kernels.CORNER if turns_left else kernels.EDGE, corner - anchor, anchor, [0.0, 0.0], len(near)


def _false_landmarks(position, rng, spurious):
    """Landmarks at random positions near the trajectory: kind, parameters, anchor, extent, scans."""
    for _ in range(rng.poisson(spurious)):
        center, theta = position[rng.integers(len(position))], rng.uniform(-np.pi, np.pi)
        distance, half = rng.uniform(0.5, REACH), rng.uniform(0.05, 0.4)
        kind = int(rng.choice([kernels.PLANE, kernels.CORNER, kernels.EDGE]))
        anchor = center + distance * np.array([np.cos(theta), np.sin(theta)])
        wall = kind == kernels.PLANE
        yield kind, [0.0, theta] if wall else [0.0, 0.0], anchor, [-half, half] if wall else [0.0, 0.0], 3


def submaps(outline, trajectory, rng, *, scans=22, **errors):
    """A trajectory divided into submaps, and their true poses, one more than submaps."""
    starts = np.arange(0, len(trajectory) - 1, scans)
    if len(trajectory) - starts[-1] < scans // 2:
        starts = starts[:-1]
    bounds = np.append(starts, len(trajectory) - 1)
    made = [
        submap(outline, trajectory[i : j + 1], trajectory[j], rng, row=int(i), **errors) for i, j in pairwise(bounds)
    ]
    return made, trajectory[bounds]

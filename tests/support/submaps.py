"""Submaps made of floor plans directly: what a robot would have found, with errors drawn from their covariance."""

from itertools import pairwise

import numpy as np

from jaxsonar import kernels
from jaxsonar.geometry.landmarks import transform_landmarks
from jaxsonar.geometry.se2 import inverse, relative
from jaxsonar.loop_closure.submap import Submap

REACH = 1.7  # m


def room(width, height):
    """A rectangle, counter-clockwise: free space is on the left."""
    return np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])


def building(length, doors, *, width=1.8):
    """A corridor from (0, 0) along x; on its left niches (x, half width, depth), rooms (x, half width, x0, x1, h)."""
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


def along(*stops, pitch=0.15):
    """Poses along a polyline, heading forward."""
    stops, poses = np.array(stops, dtype=float), []
    for start, end in pairwise(stops):
        way = end - start
        count = max(int(np.linalg.norm(way) / pitch), 1)
        at = start + np.arange(count)[:, None] / count * way
        poses.append(np.concatenate([at, np.full((count, 1), np.arctan2(way[1], way[0]))], axis=1))
    return np.concatenate(poses)


def ring(width, height, doors=(), *, across=1.8):
    """A corridor around a block: the polygon outside, and the block clockwise, with niches (side, x, half, depth)."""
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
    return [room(width + 2 * across, height + 2 * across) - across, np.array(outline)]


def _sides(outlines):
    """Start and end of every wall, and the corner before its start."""
    outlines = outlines if isinstance(outlines, list) else [outlines]
    rolled = [np.concatenate([np.roll(one, turn, axis=0) for one in outlines]) for turn in (0, -1, 1)]
    return rolled[0], rolled[1], rolled[2]


def _blocked(outline, start, end):
    """Which ways from start to end (ways, 2) go through a wall of the polygon."""
    a, b, _ = _sides(outline)
    way, wall = (end - start)[:, None], (b - a)[None]
    cross = way[..., 0] * wall[..., 1] - way[..., 1] * wall[..., 0]
    cross = np.where(np.abs(cross) < 1e-12, np.nan, cross)
    offset = a[None] - start[:, None]
    t = (offset[..., 0] * wall[..., 1] - offset[..., 1] * wall[..., 0]) / cross
    u = (offset[..., 0] * way[..., 1] - offset[..., 1] * way[..., 0]) / cross
    return ((t > 1e-6) & (t < 1 - 1e-4) & (u > -1e-9) & (u < 1 + 1e-9)).any(axis=1)


def covariance(rng, count, slip):
    """Of exit (3) and parameters: errors of their own and some that all have in common."""
    sigma = np.concatenate([slip * np.array([0.02, 0.02, 0.01]), np.tile([0.008, 0.006], count)])
    common = rng.normal(size=(3 + 2 * count, 3)) * sigma[:, None] / 2
    return np.diag(sigma**2) + common @ common.T


def submap(outline, world_from_robot, world_from_next, rng, *, row=0, slip=1.0, missed=0.0, spurious=0.0):
    """What is found of a polygon on a stretch of path; frame: the first pose."""
    base, at = world_from_robot[0], world_from_robot[:, :2]
    a, b, c = _sides(outline)
    kind, parameters, anchor, ends, scans = [], [], [], [], []
    for start, end in zip(a, b, strict=True):
        length = np.linalg.norm(end - start)
        tangent = (end - start) / length
        normal = np.array([tangent[1], -tangent[0]])  # away from the free space on the left
        way, distance = (at - start) @ tangent, -(at - start) @ normal
        good = (way > 0.02) & (way < length - 0.02) & (distance > 0.05) & (distance < REACH)
        foot = start + way[:, None] * tangent
        good[good] = ~_blocked(outline, at[good], foot[good])
        if good.sum() < 3 or rng.random() < missed:
            continue
        middle = start + np.mean([way[good].min(), way[good].max()]) * tangent
        anchored = middle + rng.uniform(-0.3, 0.3, 2)
        level, theta = normal @ (middle - anchored), np.arctan2(normal[1], normal[0])
        # The tangent of a normal is a quarter turn on from it.
        reach = np.sort((foot[good] - anchored) @ np.array([-normal[1], normal[0]]))[[0, -1]]
        kind.append(kernels.PLANE)
        parameters.append([level, theta])
        anchor.append(anchored)
        ends.append(reach)
        scans.append(int(good.sum()))
    for before, corner, after in zip(c, a, b, strict=True):
        way, further = corner - before, after - corner
        left = way[0] * further[1] - way[1] * further[0] > 0
        near = np.flatnonzero(np.linalg.norm(at - corner, axis=1) < REACH)
        near = near[~_blocked(outline, at[near], np.broadcast_to(corner, (len(near), 2)))] if len(near) else near
        if len(near) < 3 or rng.random() < missed:
            continue
        anchored = corner + rng.uniform(-0.05, 0.05, 2)
        kind.append(kernels.CORNER if left else kernels.EDGE)
        parameters.append(corner - anchored)
        anchor.append(anchored)
        ends.append([0.0, 0.0])
        scans.append(len(near))
    for _ in range(rng.poisson(spurious)):
        place, theta = at[rng.integers(len(at))], rng.uniform(-np.pi, np.pi)
        distance, half = rng.uniform(0.5, REACH), rng.uniform(0.05, 0.4)
        kind.append(int(rng.choice([kernels.PLANE, kernels.CORNER, kernels.EDGE])))
        anchor.append(place + distance * np.array([np.cos(theta), np.sin(theta)]))
        scans.append(3)
        wall = kind[-1] == kernels.PLANE
        parameters.append([0.0, theta] if wall else [0.0, 0.0])
        ends.append([-half, half] if wall else [0.0, 0.0])
    # Into the frame of the first pose.
    landmarks = kernels.Landmarks(
        np.array(kind, np.int32),
        np.array(parameters).reshape(-1, 2),
        np.array(anchor).reshape(-1, 2),
        np.array(ends, dtype=float).reshape(-1, 2),
    )
    landmarks = transform_landmarks(inverse(base), landmarks)
    poses, exit_pose = (
        relative(np.broadcast_to(base, world_from_robot.shape), world_from_robot),
        relative(base, world_from_next),
    )
    cov = covariance(rng, len(kind), slip)
    rows = np.arange(row, row + len(poses))
    pose_cov = np.tile(1e-4 * np.eye(3), (len(poses), 1, 1))
    error = np.linalg.cholesky(cov) @ rng.normal(size=len(cov))
    moved = exit_pose + error[:3]
    landmarks = landmarks.with_parameters(landmarks.parameters + error[3:].reshape(-1, 2))
    return Submap(landmarks, np.array(scans), moved, cov, rows, poses, pose_cov)


def submaps(outline, path, rng, *, scans=22, **errors):
    """A path in pieces, each a submap; with the true poses of their bases, one more than submaps."""
    starts = np.arange(0, len(path) - 1, scans)
    if len(path) - starts[-1] < scans // 2:
        starts = starts[:-1]
    bounds = np.append(starts, len(path) - 1)
    made = [submap(outline, path[i : j + 1], path[j], rng, row=int(i), **errors) for i, j in pairwise(bounds)]
    return made, path[bounds]

"""A map as the scene that echoes are compared with: every wall, corner and edge, and what may be heard of them."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.detection.extract import local_models
from jaxsonar.detection.local_map import LocalModel
from jaxsonar.geometry.landmarks import (
    concatenate_landmarks,
    landmarks_from_points,
    landmarks_from_segments,
    pad_landmarks,
)
from jaxsonar.geometry.se2 import unit
from jaxsonar.kernels.shape_buckets import next_power_of_two, pad_rows
from jaxsonar.mapping.build_map import assemble_map, build_map
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.mapping.map_evidence import gather_evidence
from jaxsonar.mapping.observations import merge_cells
from jaxsonar.mapping.point_landmarks import cluster_points
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring

_MEETS = 0.3  # m; walls that end this near to where their lines cross make a corner
_SQUARE = float(np.radians(15.0))  # off a right angle; from there on a corner does not reflect back
_OF_CORNER = 0.08  # m; a corner of the map this near to where two walls meet is theirs
_TWICE = 2  # scans that see a point
_ROOM = 16


def map_with_tentative_points(
    ring: Ring, log: Log, *, window: float | None, models: Sequence[LocalModel] | None = None
) -> GlobalMap:
    """The map of a log, with every corner and edge that two scans saw, however little they agree where.

    A map keeps only points that stand still; before ring and poses are adjusted they do not.

    Args:
        ring: the sensors.
        log: scans with poses.
        window: metres of path for a local model, where single scans are sparse.
        models: the local models of the log, where they are known already; without a window they need no poses.
    """
    if window is not None:
        return build_map(ring, log, window=window)
    evidence = gather_evidence(ring, log, local_models(ring, log) if models is None else models)
    world = assemble_map(evidence)
    found, _ = cluster_points(merge_cells(evidence.points))
    apart = np.linalg.norm(found.position[:, None] - world.points[None], axis=-1).min(axis=1, initial=np.inf)
    more = found.take((found.scan_counts() >= _TWICE) & (apart > _OF_CORNER))
    return replace(
        world,
        points=np.concatenate([world.points, more.position]),
        point_kinds=(*world.point_kinds, *more.kinds),
        point_cov=np.concatenate([world.point_cov, more.inflated_cov]),
        point_echoes=np.concatenate([world.point_echoes, more.echoes]),
        point_scans=(*world.point_scans, *more.scan_lists()),
    )


class LandmarkMap(NamedTuple):
    """Reflectors of one or more worlds, and the reflections that may be heard of them; NumPy arrays, padded."""

    landmarks: kernels.Landmarks
    world: Int[np.ndarray, " reflectors"]
    """Which map each reflector is from; -1 for padding."""
    candidates: kernels.CandidateReflections
    visible: Bool[np.ndarray, "scans reflectors"] | None = None
    """Which scans may hear each reflector; None: all."""

    def candidates_in_range(
        self, poses: Float[np.ndarray, "scans 3"], world: Int[np.ndarray, " scans"], reach: float
    ) -> Int[np.ndarray, "scans near"]:
        """Rows of the candidates that scans may hear, -1 for none: those of their world of which a part is in reach.

        Args:
            poses: of the scans, where they are now.
            world: of each scan.
            reach: how far off an echo may come from, metres.
        """
        scene, reflection = self.landmarks, self.candidates.reflection
        wall = np.asarray(scene.kind) == kernels.PLANE
        parameters, anchor, ends = (np.asarray(leaf) for leaf in (scene.parameters, scene.anchor, scene.extent))
        offset = poses[:, None, :2] - anchor
        theta = np.where(wall, parameters[:, 1], 0.0)
        along = (offset * unit(theta + np.pi / 2)).sum(axis=-1)
        beyond = np.maximum(np.maximum(ends[:, 0] - along, along - ends[:, 1]), 0.0)
        across = (offset * unit(theta)).sum(axis=-1) - parameters[:, 0]
        distance = np.where(wall, np.hypot(across, beyond), np.linalg.norm(offset - parameters, axis=-1))
        either = np.minimum(distance[:, np.asarray(reflection.first)], distance[:, np.asarray(reflection.second)])
        heard = (either < reach) & (np.asarray(self.candidates.world) == world[:, None]) & (world >= 0)[:, None]
        heard &= np.asarray(reflection.kind) >= 0
        if self.visible is not None:
            heard &= self.visible[:, np.asarray(reflection.first)]
        room = min(next_power_of_two(int(heard.sum(axis=1).max(initial=1)), least=_ROOM), heard.shape[1])
        order = np.argsort(~heard, axis=1, kind="stable")[:, :room]
        return np.where(np.take_along_axis(heard, order, axis=1), order, -1).astype(np.int32)


def landmark_map_of(maps: Sequence[GlobalMap], *, tie_corners: bool) -> LandmarkMap:
    """The reflectors of maps.

    Args:
        worlds: one map for every world that scans were taken in.
        tied: corners are where two walls meet, so that wall to wall reflections say how far off the walls are; a corner
            is a place of its own otherwise.
    """
    parts: list[kernels.Landmarks] = []
    world: list[Int[np.ndarray, " landmarks"]] = [np.zeros(0, int)]
    meetings: list[tuple[int, int, int]] = []  # first wall, second wall, world
    for number, map_ in enumerate(maps):
        pairs, is_intersection = _wall_intersections(map_)
        first = sum(len(part.kind) for part in parts)
        kept = np.append(np.ones(len(map_), bool), ~is_intersection | (not tie_corners))
        parts.append(map_landmarks(map_).take(np.flatnonzero(kept)))
        world.append(np.full(len(parts[-1].kind), number))
        if tie_corners:
            meetings += [(first + a, first + b, number) for a, b in pairs]
    return _padded(concatenate_landmarks(parts), np.concatenate(world), meetings)


def map_landmarks(map_: GlobalMap) -> kernels.Landmarks:
    """The walls, then the points of a map as landmarks, each anchored at its middle."""
    kinds = [kernels.CORNER if kind == "corner" else kernels.EDGE for kind in map_.point_kinds]
    points = landmarks_from_points(np.array(kinds, np.int32), map_.points)
    return concatenate_landmarks([landmarks_from_segments(map_.rho, map_.theta, map_.segments), points])


def _wall_intersections(map_: GlobalMap) -> tuple[list[tuple[int, int]], Bool[np.ndarray, " points"]]:
    """Pairs of walls that end where they meet at about a right angle, and which corners of the map are these."""
    count = len(map_)
    a, b = np.triu_indices(count, k=1)
    turn = np.abs(np.sin(map_.theta[a] - map_.theta[b]))
    square = turn > np.cos(_SQUARE)
    a, b = a[square], b[square]
    normal = unit(map_.theta)
    both = np.stack([normal[a], normal[b]], axis=1)
    cross = np.linalg.solve(both, np.stack([map_.rho[a], map_.rho[b]], axis=-1)[..., None])[..., 0]
    near = np.ones(len(a), dtype=bool)
    for wall in (a, b):
        near &= np.linalg.norm(map_.segments[wall] - cross[:, None], axis=-1).min(axis=1) < _MEETS
    cross = cross[near]
    apart = np.linalg.norm(map_.points[:, None] - cross[None], axis=-1).min(axis=1, initial=np.inf)
    corner = np.array([name == "corner" for name in map_.point_kinds], dtype=bool)
    return list(zip(a[near].tolist(), b[near].tolist(), strict=True)), corner & (apart < _OF_CORNER)


def _padded(
    scene: kernels.Landmarks, world: Int[np.ndarray, " reflectors"], meetings: Sequence[tuple[int, int, int]]
) -> LandmarkMap:
    """With room for a power of two of reflectors, and of candidates, so that few shapes are compiled."""
    count = len(world)
    room = next_power_of_two(count, least=_ROOM)
    scene = pad_landmarks(scene, room)
    first, second, of_world = np.array(meetings, dtype=np.int32).reshape(-1, 3).T
    pairs = len(first)
    size = next_power_of_two(count + 2 * pairs, least=_ROOM)
    rest = size - count - 2 * pairs
    alone = np.arange(count, dtype=np.int32)
    candidates = kernels.CandidateReflections(
        reflection=kernels.Reflection(
            kind=np.concatenate(
                [scene.kind[:count], np.full(2 * pairs, kernels.SECOND_ORDER, np.int32), np.full(rest, -1, np.int32)]
            ),
            first=np.concatenate([alone, first, second, np.zeros(rest, np.int32)]),
            second=np.concatenate([alone, second, first, np.zeros(rest, np.int32)]),
        ),
        world=np.concatenate([world, of_world, of_world, np.full(rest, -1)]).astype(np.int32),
        group=np.concatenate(
            [alone, count + np.tile(np.arange(pairs), 2), np.full(rest, -1)], dtype=np.int32, casting="unsafe"
        ),
    )
    return LandmarkMap(scene, pad_rows(world.astype(np.int32), room, fill=-1), candidates)

"""Landmarks of a map, and the reflections at them that echoes can be associated with."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.detection.extract import local_models
from jaxsonar.detection.local_model import LocalModel
from jaxsonar.geometry.landmarks import (
    concatenate_landmarks,
    landmarks_from_points,
    landmarks_from_segments,
    pad_landmarks,
)
from jaxsonar.geometry.se2 import unit
from jaxsonar.geometry.segments import perpendicular_intersections
from jaxsonar.kernels.shape_buckets import next_power_of_two, pad_rows
from jaxsonar.mapping.build_map import assemble_map, build_map
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.mapping.map_evidence import gather_evidence
from jaxsonar.mapping.observations import merge_cells
from jaxsonar.mapping.point_landmarks import cluster_points
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class LandmarkMapSettings:
    """Constants of the landmark map. All of them were chosen by hand."""

    max_corner_gap: float = 0.3
    """Walls that end within this distance of the intersection of their lines form a corner, metres."""
    max_skew: float = float(np.radians(15.0))
    """Largest deviation from a right angle at which a corner reflects back to the robot, radians."""
    corner_radius: float = 0.08
    """A corner of the map within this distance of an intersection of walls is the same corner, metres."""
    min_point_scans: int = 2
    """Scans in which a tentative point must have been detected."""
    min_rows: int = 16
    """Landmarks, reflections and candidates are padded to a power of two, at least this."""


SETTINGS = LandmarkMapSettings()
LANDMARK_KINDS = {"corner": kernels.CORNER, "edge": kernels.EDGE, "circle": kernels.CIRCLE}
"""Kinds of points of a map that are landmarks. Undecided reflectors are not: their range model is unknown."""


def map_with_tentative_points(
    ring: Ring,
    log: Log,
    *,
    window: float | None = None,
    models: Sequence[LocalModel] | None = None,
    settings: LandmarkMapSettings = SETTINGS,
) -> GlobalMap:
    """The map of a log, with all corners and edges that two scans detected.

    ``build_map`` keeps only points whose detections agree in position. Before ring and poses are adjusted, those of
    most points do not.

    Args:
        ring: the sensors.
        log: scans with poses.
        window: length of trajectory gathered for one local model, metres; None: single scans.
        models: the local models of the log if they are known; they need no poses. Not with a window.
        settings: constants of the map.
    """
    if window is not None:
        # An adjustment needs lines that local models determine, rather than long ones.
        return build_map(ring, log, window=window, grow=False, reflectors=False)
    evidence = gather_evidence(ring, log, local_models(ring, log) if models is None else models)
    map_ = assemble_map(evidence)
    found, _ = cluster_points(merge_cells(evidence.points))
    distance = np.linalg.norm(found.position[:, None] - map_.points[None], axis=-1).min(axis=1, initial=np.inf)
    more = found.take((found.scan_counts() >= settings.min_point_scans) & (distance > settings.corner_radius))
    return map_.with_points(
        np.concatenate([map_.points, more.position]),
        point_kinds=(*map_.point_kinds, *more.kinds),
        point_cov=np.concatenate([map_.point_cov, more.inflated_cov]),
        point_echoes=np.concatenate([map_.point_echoes, more.echoes]),
        point_scans=(*map_.point_scans, *more.scan_lists()),
        point_radius=np.append(map_.point_radius, np.full(len(more.kinds), np.nan)),
    )


class LandmarkMap(NamedTuple):
    """Landmarks of one or more worlds, and the reflections at them; NumPy arrays, padded."""

    landmarks: kernels.Landmarks
    map_index: Int[np.ndarray, " landmarks"]
    """Index of the map that each landmark belongs to; -1 for padding."""
    candidates: kernels.CandidateReflections
    """Reflections that echoes may be associated with."""
    visible: Bool[np.ndarray, "scans landmarks"] | None = None
    """Visibility mask: which scans can observe each landmark; None: all scans of their map."""

    def candidates_in_range(
        self, poses: Float[np.ndarray, "scans 3"], map_index: Int[np.ndarray, " scans"], max_range: float
    ) -> Int[np.ndarray, "scans near"]:
        """Rows of the candidates that each scan can observe; -1 for unused entries.

        Args:
            poses: world_from_robot of the scans.
            map_index: index of the map of each scan.
            max_range: largest distance of the closest part of a landmark, metres.
        """
        landmarks, reflection = self.landmarks, self.candidates.reflection
        is_wall = np.asarray(landmarks.kind) == kernels.PLANE
        parameters, anchor, extent = (
            np.asarray(leaf) for leaf in (landmarks.parameters, landmarks.anchor, landmarks.extent)
        )
        offset = poses[:, None, :2] - anchor
        theta = np.where(is_wall, parameters[:, 1], 0.0)
        along = (offset * unit(theta + np.pi / 2)).sum(axis=-1)
        beyond_end = np.maximum(np.maximum(extent[:, 0] - along, along - extent[:, 1]), 0.0)
        across = (offset * unit(theta)).sum(axis=-1) - parameters[:, 0]
        distance = np.where(is_wall, np.hypot(across, beyond_end), np.linalg.norm(offset - parameters, axis=-1))
        if landmarks.radius is not None:
            distance -= np.asarray(landmarks.radius)
        first, second = np.asarray(reflection.first), np.asarray(reflection.second)
        in_range = np.minimum(distance[:, first], distance[:, second]) < max_range
        in_range &= (np.asarray(self.candidates.map_index) == map_index[:, None]) & (map_index >= 0)[:, None]
        in_range &= np.asarray(reflection.kind) >= 0
        if self.visible is not None:
            in_range &= self.visible[:, first]
        count = int(in_range.sum(axis=1).max(initial=1))
        width = min(next_power_of_two(count, least=SETTINGS.min_rows), in_range.shape[1])
        order = np.argsort(~in_range, axis=1, kind="stable")[:, :width]
        return np.where(np.take_along_axis(in_range, order, axis=1), order, -1).astype(np.int32)


def landmark_map_of(maps: Sequence[GlobalMap], *, tie_corners: bool) -> LandmarkMap:
    """The landmarks of maps, and the reflections at them.

    Args:
        maps: the maps; ``map_index`` is the position in this sequence.
        tie_corners: whether a corner is the intersection of its walls, with echoes of second order. These depend on the
            distance of the walls differently than echoes of first order. Otherwise a corner is a landmark of its own.
    """
    parts: list[kernels.Landmarks] = []
    map_index: list[Int[np.ndarray, " landmarks"]] = [np.zeros(0, int)]
    wall_pairs: list[tuple[int, int, int]] = []  # first wall, second wall, map
    for number, whole in enumerate(maps):
        map_ = whole.with_kinds(*LANDMARK_KINDS)
        pairs, is_intersection = _wall_intersections(map_)
        first = sum(len(part.kind) for part in parts)
        kept = np.append(np.ones(len(map_), bool), ~is_intersection | (not tie_corners))
        parts.append(map_landmarks(map_).take(np.flatnonzero(kept)))
        map_index.append(np.full(len(parts[-1].kind), number))
        if tie_corners:
            wall_pairs += [(first + a, first + b, number) for a, b in pairs]
    return _padded(concatenate_landmarks(parts), np.concatenate(map_index), wall_pairs)


def map_landmarks(map_: GlobalMap) -> kernels.Landmarks:
    """The walls, then the corners, edges and circles of a map as landmarks, each anchored at its middle."""
    map_ = map_.with_kinds(*LANDMARK_KINDS)
    kinds = [LANDMARK_KINDS[kind] for kind in map_.point_kinds]
    points = landmarks_from_points(np.array(kinds, np.int32), map_.points, map_.point_radius)
    return concatenate_landmarks([landmarks_from_segments(map_.rho, map_.theta, map_.segments), points])


def _wall_intersections(
    map_: GlobalMap, settings: LandmarkMapSettings = SETTINGS
) -> tuple[list[tuple[int, int]], Bool[np.ndarray, " points"]]:
    """Pairs of walls that form a corner of about a right angle, and which points of the map are such corners."""
    crossing = perpendicular_intersections(map_.theta, map_.segments, max_skew=settings.max_skew)
    meet = (crossing.gap < settings.max_corner_gap).all(axis=1)
    distance = np.linalg.norm(map_.points[:, None] - crossing.point[meet], axis=-1).min(axis=1, initial=np.inf)
    is_corner = np.array([kind == "corner" for kind in map_.point_kinds], dtype=bool)
    pairs = list(zip(crossing.first[meet].tolist(), crossing.second[meet].tolist(), strict=True))
    return pairs, is_corner & (distance < settings.corner_radius)


def _padded(
    landmarks: kernels.Landmarks,
    map_index: Int[np.ndarray, " landmarks"],
    wall_pairs: Sequence[tuple[int, int, int]],
    settings: LandmarkMapSettings = SETTINGS,
) -> LandmarkMap:
    """The map with landmarks and candidates padded to powers of two, so that few shapes are compiled."""
    count = len(map_index)
    landmarks = pad_landmarks(landmarks, next_power_of_two(count, least=settings.min_rows))
    first, second, map_of_pair = np.array(wall_pairs, dtype=np.int32).reshape(-1, 3).T
    pairs = len(first)
    size = next_power_of_two(count + 2 * pairs, least=settings.min_rows)
    own = np.arange(count, dtype=np.int32)
    # Second-order reflections at a pair of walls occur in both orders; the two are one group.
    kind = np.concatenate([landmarks.kind[:count], np.full(2 * pairs, kernels.SECOND_ORDER, np.int32)])
    group = np.concatenate([own, count + np.tile(np.arange(pairs), 2)]).astype(np.int32)
    candidates = kernels.CandidateReflections(
        reflection=kernels.Reflection(
            kind=pad_rows(kind, size, fill=-1),
            first=pad_rows(np.concatenate([own, first, second]), size),
            second=pad_rows(np.concatenate([own, second, first]), size),
        ),
        map_index=pad_rows(np.concatenate([map_index, map_of_pair, map_of_pair]).astype(np.int32), size, fill=-1),
        group=pad_rows(group, size, fill=-1),
    )
    map_index = pad_rows(map_index.astype(np.int32), len(landmarks.kind), fill=-1)
    return LandmarkMap(landmarks, map_index, candidates)

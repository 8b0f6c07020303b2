"""Global maps from logs: local models, evidence, and the assembly of walls and points (paper, section 5)."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from jaxsonar import kernels
from jaxsonar.detection.extract import local_models
from jaxsonar.detection.local_model import KIND_NAMES, LocalModel
from jaxsonar.detection.settings import DEFAULT_SIGMA, hough_settings, widened
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.hardware.errors import SonarError
from jaxsonar.mapping.artifact_removal import (
    find_openings,
    is_pole_line,
    remove_corner_lines,
    remove_driven_through,
    remove_seen_through,
)
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.mapping.hough_merging import merge_by_hough
from jaxsonar.mapping.map_evidence import MapEvidence, gather_evidence_of_each
from jaxsonar.mapping.observations import concatenate, merge_cells
from jaxsonar.mapping.point_landmarks import PointLandmarks, cluster_points, is_static
from jaxsonar.mapping.segment_fusion import estimate_systematic_error, fuse_segments, robust_refit
from jaxsonar.mapping.settings import SETTINGS
from jaxsonar.mapping.wall_endpoints import blocks_gap, detached_points, end_walls, snap_endpoints, spurious_walls
from jaxsonar.mapping.wall_growth import grow_walls
from jaxsonar.mapping.wall_segments import WallSegments
from jaxsonar.reflectors.find_reflectors import Reflector, find_reflectors
from jaxsonar.reflectors.kind_fit import PLANE
from jaxsonar.reflectors.range_measurements import RangeMeasurements
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.single_firings import group_firings
from jaxsonar.scans.sliding_windows import window_lengths
from jaxsonar.sensors.ring import Ring

MERGING_METHODS = ("fused", "paper")
"""How segments become walls: by iterative fusion, or by the paper's clustering of midpoints and Hough transform."""


def build_map(
    ring: Ring,
    log: Log,
    *,
    method: str = "ml",
    settings: kernels.HoughSettings | None = None,
    sigma: float | None = None,
    window: float | None = None,
    merging: str = "fused",
    grow: bool = True,
    reflectors: bool = True,
    on_left_out: Callable[[int], None] | None = None,
    on_observed: Callable[[Sequence[LocalModel], MapEvidence], None] | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> GlobalMap:
    """The walls, corners, edges and circles of the world, from a log of scans with poses (paper, section 5).

    Firings that stand in scans of their own are grouped (``group_firings``). The map names the first scan of a group.
    With windows, walls are found in windows of several lengths, and grow over single echoes (``grow_walls``).

    Args:
        ring: the sensors.
        log: scans; those without a pose are left out.
        method: detection method, as for ``local_models``.
        settings: settings of the Hough transform, as for ``local_models``.
        sigma: standard deviation of the ranges, as for ``local_models``.
        window: length of trajectory gathered into one local model, metres, as for ``local_models``.
        merging: "fused", or "paper" for the paper's method.
        grow: with windows and merging "fused": whether to use several lengths and growth. False: the walls of windows
            of one length, as ``Mapper`` finds them scan by scan.
        reflectors: whether to seek circles and other reflectors beside the walls (``add_reflectors``); not with
            method "hough" for single scans, nor with merging "paper".
        on_left_out: called with the number of echoes on pairs of sensors that this ring does not listen to.
        on_observed: called with the local models and their evidence; with windows, those of the given length.
        progress: called with the stage and (scans done, scans); 0 scans if the stage does not count them.

    Raises:
        SonarError: as for ``local_models``; an unknown merging method; or no scan with a pose.
    """
    check_merging(merging)
    check_poses(log)
    log = group_firings(log)
    settings = hough_settings(ring, settings, window=window)
    is_grown = grow and merging == "fused" and window is not None
    lengths = window_lengths(window) if is_grown and window is not None else (window,)
    settings = widened(ring, settings, window=max(length or 0.0 for length in lengths))
    report = progress or (lambda stage, done, total: None)
    # Detect lines, corners and edges in every scan or window.
    models: list[list[LocalModel]] = []
    row_of_scan = {number: row for row, number in enumerate(log.scan.tolist())}
    for length in lengths:
        found = local_models(
            ring,
            log,
            method=method,
            settings=settings,
            sigma=sigma,
            window=length,
            on_left_out=on_left_out if length == window else None,
        )
        models.append([])
        for model in found:
            models[-1].append(model)
            report("local models", row_of_scan[model.scan] + 1, len(log))
    # Transform them to the world frame, and find the free space from missing echoes.
    report("map", 0, 0)
    evidence = gather_evidence_of_each(ring, log, models)
    if on_observed is not None:
        on_observed(models[0], evidence[0])
    # Merge the observations of each wall and point.
    if is_grown:
        world = assemble_grown_map(ring, log, evidence, sigma=sigma)
    else:
        world = assemble_map(evidence[0], merging=merging, min_scans=required_scans(window))
    if not reflectors or not seeks_reflectors(method, window, merging):
        return world
    return add_reflectors(world, evidence[0].scans.measurements(), sigma=sigma)


def seeks_reflectors(method: str, window: float | None, merging: str) -> bool:
    """Whether maps of a method contain reflectors beside walls; arguments as for ``build_map``."""
    return merging == "fused" and (method == "ml" or window is not None)


def add_reflectors(
    world: GlobalMap, measurements: RangeMeasurements | None, *, sigma: float | None = None
) -> GlobalMap:
    """A map with the reflectors that answer from several places and that its walls do not explain.

    They are short walls, corners, edges, circles, or of undecided kind. Short walls and points that such a reflector
    explains better are replaced by it.

    Args:
        world: walls, corners, edges and circles.
        measurements: echoes and silences of all scans with poses; None: no scan.
        sigma: standard deviation of the ranges, metres, if the walls do not show it.
    """
    if measurements is None:
        return world
    assumed = DEFAULT_SIGMA if sigma is None else sigma
    found = find_reflectors(measurements, np.array(world.segments), np.array(world.points), sigma=assumed)
    world = world.take_walls(~found.replaced_walls).take_points(~found.replaced_points)
    missing = [one for one in found.reflectors if not one.is_wall]
    world = _with_planes(world, [one for one in missing if one.kind == PLANE])
    new = [one for one in missing if one.kind != PLANE]
    if not new:
        return end_walls(world)
    cov = np.array([one.cov for one in new])
    circle_cov = np.where(np.isfinite([one.radius for one in new])[:, None, None], cov, np.nan)
    kinds = (*world.point_kinds, *("undecided" if one.kind < 0 else KIND_NAMES[one.kind] for one in new))
    points = np.concatenate([world.points, [one.position for one in new]])
    echoes = np.append(world.point_echoes, [len(one.echoes) for one in new])
    order = np.lexsort((points[:, 1], points[:, 0], -echoes))
    scans = (*world.point_scans, *(one.scans for one in new))
    world = world.with_points(
        points[order],
        point_kinds=tuple(kinds[k] for k in order),
        point_cov=np.concatenate([world.point_cov, cov[:, :2, :2]])[order],
        point_echoes=echoes[order],
        point_scans=tuple(scans[k] for k in order),
        point_radius=np.append(world.point_radius, [one.radius for one in new])[order],
        point_circle_cov=np.concatenate([world.point_circle_cov, circle_cov])[order],
        point_probabilities=np.concatenate([world.point_probabilities, [one.probability for one in new]])[order],
    )
    return end_walls(world)


def _with_planes(world: GlobalMap, planes: Sequence[Reflector]) -> GlobalMap:
    """The map with further walls. Their standard deviations are those of the noise of the ranges."""
    if not planes:
        return world
    line = np.array([one.line for one in planes])
    side = np.where(line[:, 0] < 0, np.pi, 0.0)
    sd = np.sqrt(np.diagonal([one.line_cov for one in planes], axis1=-2, axis2=-1))
    echoes = np.append(world.echoes, [len(one.echoes) for one in planes])
    order = np.argsort(-echoes, kind="stable")
    scans = (*world.scans, *(one.scans for one in planes))
    return replace(
        world,
        segments=np.concatenate([world.segments, [one.segment for one in planes]])[order],
        rho=np.append(world.rho, np.abs(line[:, 0]))[order],
        theta=np.append(world.theta, wrap_angle(line[:, 1] + side))[order],
        sigma_rho=np.append(world.sigma_rho, sd[:, 0])[order],
        sigma_theta=np.append(world.sigma_theta, sd[:, 1])[order],
        echoes=echoes[order],
        scans=tuple(scans[k] for k in order),
        end_kinds=(),
        end_cov=None,
    )


def assemble_grown_map(
    ring: Ring, log: Log, evidence: Sequence[MapEvidence], *, sigma: float | None = None
) -> GlobalMap:
    """The walls that windows of several lengths show, grown over the single measurements of their log.

    Args:
        ring: the sensors.
        log: the scans with poses, in the order of the trajectory.
        evidence: the evidence of each window length.
        sigma: standard deviation of the ranges, metres; ``SupportSettings.sigma`` if omitted.
    """
    merged = [_merged(one, 1) for one in evidence]
    seeds = concatenate([walls for walls, _ in merged])
    walls = grow_walls(seeds, RangeMeasurements.from_log(ring, log), evidence[0].driven, sigma=sigma)
    return _as_global_map(walls, merged[0][1])


def assemble_map(
    evidence: MapEvidence, *, merging: str = "fused", min_scans: int = SETTINGS.evidence.min_scans
) -> GlobalMap:
    """The map that the evidence supports.

    Args:
        evidence: of all scans.
        merging: "fused" or "paper".
        min_scans: number of scans that must have observed a wall or a point (fewer if there are not enough scans).
    """
    check_merging(merging)
    if merging == "paper":
        walls = merge_by_hough(evidence.segments, linkage_distance=evidence.linkage_distance)
        return _as_global_map(walls, evidence.points.take(np.arange(0)))
    return _as_global_map(*_merged(evidence, min_scans))


def _merged(evidence: MapEvidence, min_scans: int) -> tuple[WallSegments, PointLandmarks]:
    """Walls and points from the observations of all scans."""
    min_scans = min(min_scans, max(1, evidence.models - 1))
    segments, free_space = merge_cells(evidence.segments), evidence.free_space
    segments = remove_driven_through(segments, evidence.driven)

    # 1. Estimate the systematic error of the poses, and cluster corners and edges.
    systematic_error = estimate_systematic_error(segments, gap=evidence.gap)
    fuse = partial(fuse_segments, gap=evidence.gap, systematic_error=systematic_error)
    points = _confirmed_points(merge_cells(evidence.points), min_scans, systematic_error)
    # 2. Fuse segments into walls, remove what later scans saw through, and fuse again.
    walls, wall_of = fuse(segments)
    remaining = remove_seen_through(segments, wall_of, free_space)
    if remaining is not segments:
        segments = remaining
        walls, _ = fuse(segments)
    # 3. Remove the lines of corners and fuse again; keep confirmed walls that are not lines of poles or points.
    segments = remove_corner_lines(segments, walls)
    walls, wall_of = fuse(segments)
    artifact = is_pole_line(walls) | spurious_walls(walls, points)
    confirmed = np.flatnonzero(~artifact & (walls.count >= min_scans))
    # 4. Bridge occluded parts of walls, but not openings, and do not continue a wall beyond an edge.
    is_opening = partial(find_openings, segments=segments, free_space=free_space)
    walls, bridged_of = fuse_segments(
        walls.take(confirmed),
        gap=SETTINGS.evidence.bridged_gap,
        systematic_error=systematic_error,
        is_opening=lambda gaps, theta: is_opening(gaps, theta) | blocks_gap(gaps, points),
        near_wall=SETTINGS.fusion.near_wall,
    )
    # 5. Refit the walls with outlying segments down-weighted.
    final_of = np.full(len(segments), -1)
    final_of[confirmed] = bridged_of
    used = final_of[wall_of] >= 0
    walls = robust_refit(segments.take(used), final_of[wall_of[used]], walls, systematic_error=systematic_error)
    # 6. Move the ends of the walls to corners and edges, and drop points that lie on the face of a wall.
    walls = snap_endpoints(walls, points, is_opening)
    return walls, points.take(~detached_points(walls, points))


def required_scans(window: float | None) -> int:
    """Number of scans that must have observed a wall; with windows a single local model is enough."""
    return 1 if window else SETTINGS.evidence.min_scans


def check_merging(merging: str) -> None:
    """Raise a SonarError for an unknown merging method."""
    if merging not in MERGING_METHODS:
        raise SonarError(f"merging {merging!r}; allowed is {' or '.join(MERGING_METHODS)}")


def check_poses(log: Log) -> None:
    """Raise a SonarError for a log with scans of which none has a pose, or with a pose too far from the origin."""
    if len(log) and not np.isfinite(log.pose).any():
        raise SonarError(f"none of the {len(log)} scans has a pose; allowed is a log with x, y, theta for a map")
    limit = SETTINGS.evidence.max_coordinate
    far = np.abs(log.pose[:, :2]).max(axis=1, initial=0) > limit  # False for NaN
    if far.any():
        k = int(far.argmax())
        x, y, _ = log.pose[k]
        raise SonarError(f"scan {log.scan[k]}: pose x {x:g}, y {y:g} m; allowed are {limit:g} m at most")


def _confirmed_points(observations: PointLandmarks, min_scans: int, systematic_error: float) -> PointLandmarks:
    """Corners and edges that enough scans observed, and that do not move."""
    points, point_of = cluster_points(observations)
    static = is_static(points, observations, point_of, systematic_error=systematic_error)
    return points.take((points.scan_counts() >= min_scans) & static)


def _as_global_map(walls: WallSegments, points: PointLandmarks) -> GlobalMap:
    """Walls and points with standard deviations that include the observed scatter, sorted by number of echoes.

    A single observation has no scatter; the covariance that its local model states is a lower bound, and left out.
    """
    walls = walls.take(np.lexsort((walls.center[:, 1], walls.center[:, 0], -walls.echoes)))
    points = points.take(np.lexsort((points.position[:, 1], points.position[:, 0], -points.echoes)))
    rho = (walls.normal * walls.center).sum(-1)
    moment_arm = (walls.tangent * walls.center).sum(-1)
    # The variance factor comes from the scatter of the segments about their wall; the expected one counts once more.
    variance_factor = np.where(walls.count > 1, (walls.chi_squared + 2) / (2 * walls.count), np.nan)
    sigma_theta = np.sqrt(variance_factor / walls.info_theta)
    sigma_rho = np.sqrt(variance_factor / walls.info_offset + (moment_arm * sigma_theta) ** 2)
    theta = np.where(rho < 0, walls.theta + np.pi, walls.theta)
    return GlobalMap(
        segments=walls.endpoints,
        rho=np.abs(rho),
        theta=wrap_angle(theta),
        sigma_rho=sigma_rho,
        sigma_theta=sigma_theta,
        echoes=walls.echoes,
        scans=walls.scan_lists(),
        points=points.position,
        point_kinds=points.kinds,
        point_cov=np.where((points.count > 1)[:, None, None], points.inflated_cov, np.nan),
        point_echoes=points.echoes,
        point_scans=points.scan_lists(),
    )

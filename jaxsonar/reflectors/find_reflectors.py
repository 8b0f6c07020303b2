"""Search for reflectors in the echoes that the long walls of a map and their corners leave over."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.geometry.robust_statistics import MAD_TO_SIGMA
from jaxsonar.geometry.se2 import perpendicular, tangent_of, unit
from jaxsonar.geometry.segments import crossings, lengths, point_to_segments
from jaxsonar.reflectors.center_votes import center_seeds
from jaxsonar.reflectors.explained_echoes import (
    explained_by_points,
    explained_by_two_walls,
    hidden_by_walls,
    meeting_points,
    near_points,
    range_scatter,
    wall_residuals,
)
from jaxsonar.reflectors.kind_fit import CIRCLE, EDGE, PLANE, KindFits, add_silences, fit_kinds, near_echoes
from jaxsonar.reflectors.range_measurements import RangeMeasurements, independent_weights
from jaxsonar.reflectors.settings import SETTINGS


@dataclass(frozen=True, eq=False)
class Reflector:
    """A reflector that answered from several places, world frame."""

    kind: int
    """Number of its kind in ``detection.local_model.KIND_NAMES``; -1 if the kind is undecided."""
    position: Float[np.ndarray, "2"]
    """Center of a circle, position of a corner or an edge; of an undecided reflector or a plane its nearest point,
    metres."""
    radius: float
    """Radius of a circle, metres; NaN otherwise."""
    cov: Float[np.ndarray, "3 3"]
    """Covariance of (x, y, radius), square metres; NaN for the radius unless the kind is a circle."""
    probability: Float[np.ndarray, "4"]
    """Probability of plane, corner, edge and circle."""
    echoes: Int[np.ndarray, " echoes"]
    """Rows of the measurements that it caused."""
    scans: tuple[int, ...]
    """Numbers of their scans, ascending."""
    segment: Float[np.ndarray, "2 2"]
    """As a plane: its outermost points of reflection, metres."""
    line: Float[np.ndarray, "2"]
    """As a plane: (rho, theta) of its line in the world frame, metres and radians; rho may be negative."""
    line_cov: Float[np.ndarray, "2 2"]
    """Covariance of the line from the noise of the ranges."""
    evidence: float
    """Log-likelihood ratio to clutter, nats."""
    residual: Float[np.ndarray, " inliers"]
    """Measured minus predicted ranges of its echoes, metres."""
    is_visible: bool
    """Whether no wall hides it, and enough of the measurements that point at it hear it."""
    is_wall: bool = False
    """Whether a wall of the map describes it."""


@dataclass(frozen=True, eq=False)
class FoundReflectors:
    """The reflectors beside the walls of a map, and what they replace."""

    reflectors: tuple[Reflector, ...]
    """Those with most evidence first found first."""
    replaced_walls: Bool[np.ndarray, " walls"]
    """Short walls whose echoes a reflector of another kind explains, and mirror images behind other walls."""
    replaced_points: Bool[np.ndarray, " points"]
    """Points at the position of a reflector."""
    sigma: float
    """Standard deviation of ranges about the reflectors, metres."""


def find_reflectors(
    measurements: RangeMeasurements,
    walls: Float[np.ndarray, "walls 2 2"],
    points: Float[np.ndarray, "points 2"],
    *,
    sigma: float,
) -> FoundReflectors:
    """Corners, edges, circles and undecided reflectors that a map of walls and points lacks.

    Args:
        measurements: echoes and silences of all scans with poses.
        walls: both ends of the walls of the map, metres.
        points: corners and edges of the map, metres.
        sigma: standard deviation of ranges if the walls do not show it, metres.
    """
    settings = SETTINGS.explanation
    heard = np.flatnonzero(np.isfinite(measurements.distance))
    if not len(heard):
        return FoundReflectors((), np.zeros(len(walls), dtype=bool), np.zeros(len(points), dtype=bool), sigma)
    echoes = measurements.take(heard)
    residual = wall_residuals(echoes, walls)
    ghosts = _ghost_walls(echoes, walls, residual, sigma)
    walls, residual = walls[~ghosts], residual[:, ~ghosts]
    long = lengths(walls) >= settings.released_length
    for chosen in (residual[:, long], residual):
        scatter = range_scatter(chosen)
        if not np.isnan(scatter):
            sigma = scatter
            break
    fixed = walls[long]
    crossing = meeting_points(fixed)
    at_walls = near_points(points, np.concatenate([fixed.reshape(-1, 2), crossing]), settings.vertex_distance)
    vertices = np.concatenate([crossing, points[at_walls]])
    found: list[Reflector] = []
    for _ in range(settings.sigma_iterations):
        wide = sigma + settings.model_error / settings.gate
        explained = (np.abs(residual[:, long]) < settings.gate * wide).any(axis=1)
        left = np.flatnonzero(~explained)
        left = left[~explained_by_points(echoes.take(left), vertices, wide)]
        left = left[~explained_by_two_walls(echoes.take(left), fixed, wide)]
        on_walls = np.abs(residual[np.ix_(left, ~long)].T) < SETTINGS.fit.start_gate
        seeds = _wall_seeds(walls[~long], echoes.origin[left], on_walls)
        found = _search(measurements, heard[left], fixed, sigma, walls.reshape(-1, 2), seeds, on_walls)
        # Without long walls only the reflectors show the scatter of the ranges.
        squared = np.concatenate([one.residual for one in found] or [np.zeros(0)]) ** 2
        if long.any() or len(squared) < settings.min_scatter_echoes:
            break
        before, sigma = sigma, max(MAD_TO_SIGMA * float(np.sqrt(np.median(squared))), settings.min_sigma)
        if max(before / sigma, sigma / before) < settings.same_sigma:
            break
    found, replaced = _with_walls(walls, residual, heard, long, found, sigma + settings.model_error / settings.gate)
    points_found = [one for one in found if not one.is_wall and one.kind != PLANE]
    position = np.array([one.position for one in points_found]).reshape(-1, 2)
    reach = settings.vertex_distance + np.nan_to_num([one.radius for one in points_found])
    replaced_points = (np.linalg.norm(points[:, None] - position, axis=-1) < reach).any(axis=1)
    planes = [one.segment for one in found if not one.is_wall and one.kind == PLANE]
    replaced_points |= _on_faces(points, np.array(planes).reshape(-1, 2, 2))
    replaced_points[at_walls] = False
    removed = ghosts.copy()
    removed[~ghosts] = replaced
    return FoundReflectors(tuple(found), removed, replaced_points, sigma)


def _ghost_walls(
    echoes: RangeMeasurements,
    walls: Float[np.ndarray, "walls 2 2"],
    residual: Float[np.ndarray, "rows walls"],
    sigma: float,
) -> Bool[np.ndarray, " walls"]:
    """Walls behind other walls whose echoes two other walls in turn explain.

    Args:
        echoes: all echoes.
        walls: both ends, metres.
        residual: as from ``wall_residuals``.
        sigma: standard deviation of ranges if the walls do not show it, metres.
    """
    settings = SETTINGS.explanation
    scatter = range_scatter(residual)
    wide = max(sigma if np.isnan(scatter) else scatter, settings.min_sigma) + settings.model_error / settings.gate
    fits = np.abs(residual) < settings.gate * wide
    ghosts = np.zeros(len(walls), dtype=bool)
    for wall in np.argsort(fits.sum(axis=0), kind="stable").tolist():
        rows, others = np.flatnonzero(fits[:, wall]), ~ghosts
        others[wall] = False
        if not len(rows) or not others.any():
            continue
        own = echoes.take(rows)
        tangent = (walls[wall, 1] - walls[wall, 0]) / max(float(lengths(walls[wall : wall + 1])[0]), 1e-9)
        foot = walls[wall, 0] + ((own.origin - walls[wall, 0]) @ tangent)[:, None] * tangent
        if hidden_by_walls(own.origin, foot, walls[others]).mean() > settings.ghost_share:
            ghosts[wall] = explained_by_two_walls(own, walls[others], wide).mean() > settings.ghost_share
    return ghosts


def _search(
    measurements: RangeMeasurements,
    free: Int[np.ndarray, " free"],
    walls: Float[np.ndarray, "walls 2 2"],
    sigma: float,
    ends: Float[np.ndarray, "ends 2"],
    wall_seeds: tuple[Float[np.ndarray, "short 2"], Float[np.ndarray, " short"]],
    on_walls: Bool[np.ndarray, "short free"],
) -> list[Reflector]:
    """The reflectors of the echoes that nothing explains: first at short walls, then at the seeds with most votes.

    Args:
        measurements: echoes and silences.
        free: rows of the echoes that nothing explains.
        walls: both ends of the walls that hide what is behind them, metres.
        sigma: standard deviation of ranges, metres.
        ends: ends of all walls, metres.
        wall_seeds: centers and radii of circles that touch the short walls, metres.
        on_walls: echoes near each of these.
    """
    weight = independent_weights(measurements.section)
    found: list[Reflector] = []
    centers, radii = center_seeds(measurements.take(free))
    near, close = near_echoes(measurements, free, centers, radii)
    near_walls, close_walls = near_echoes(measurements, free, *wall_seeds)
    near = np.concatenate([near_walls & on_walls, near])
    close = np.concatenate([close_walls & on_walls, close])
    centers, radii = np.concatenate([wall_seeds[0], centers]), np.append(wall_seeds[1], radii)
    is_free, left = np.ones(len(free), dtype=bool), np.ones(len(centers), dtype=bool)
    while True:
        left &= (close & is_free).sum(axis=1) >= SETTINGS.decision.min_echoes
        # Short walls come first: a circle that touches several of them must not take their echoes.
        count = len(wall_seeds[1])
        chosen = _with_own_echoes(
            close & is_free, left & (np.arange(len(left)) < count) if left[:count].any() else left
        )
        if not len(chosen):
            return found
        left[chosen] = False
        wave = fit_kinds(measurements, free, weight, centers[chosen], radii[chosen], near[chosen] & is_free, sigma)
        wave = _refitted(measurements, free, is_free, weight, wave, sigma)
        for fits in sorted(wave, key=lambda fits: -np.inf if fits is None else -float(fits.evidence.max())):
            one = None if fits is None else _decided(measurements, weight, fits, sigma, walls, ends)
            if one is not None and is_free[np.searchsorted(free, one.echoes)].mean() > SETTINGS.decision.min_free_share:
                # What is hidden by a wall, or heard at one place only, is an artifact; its echoes are used up, too.
                is_free[np.searchsorted(free, one.echoes)] = False
                if one.is_visible:
                    found.append(one)


def _refitted(
    measurements: RangeMeasurements,
    free: Int[np.ndarray, " free"],
    is_free: Bool[np.ndarray, " free"],
    weight: Float[np.ndarray, " rows"],
    fits: list[KindFits | None],
    sigma: float,
) -> list[KindFits | None]:
    """The fits, repeated where more echoes are near a fitted corner, edge or circle than were near its seed."""
    point = [k for k, one in enumerate(fits) if one is not None and np.argmax(one.evidence) != PLANE]
    if not point:
        return fits
    best = [(one, int(np.argmax(one.evidence))) for k in point if (one := fits[k]) is not None]
    centers = np.array([one.center[kind] for one, kind in best])
    radii = np.array([one.parameters[kind, 2] for one, kind in best])
    near, close = near_echoes(measurements, free, centers, radii, close=SETTINGS.fit.gate * sigma)
    used = np.array([np.count_nonzero(one.inlier[kind]) for one, kind in best])
    more = (close & is_free).sum(axis=1) > SETTINGS.fit.more_echoes * used
    again = fit_kinds(measurements, free, weight, centers[more], radii[more], near[more] & is_free, sigma)
    better = dict(zip(np.array(point)[more].tolist(), again, strict=True))
    return [better.get(k, one) for k, one in enumerate(fits)]


def _wall_seeds(
    walls: Float[np.ndarray, "walls 2 2"],
    origin: Float[np.ndarray, "free 2"],
    on_walls: Bool[np.ndarray, "walls free"],
) -> tuple[Float[np.ndarray, "walls 2"], Float[np.ndarray, " walls"]]:
    """Centers and radii of large circles that touch walls from behind.

    Args:
        walls: both ends, metres.
        origin: midpoints of the sensors of the echoes, metres.
        on_walls: echoes near each wall; most of them are in front of it.
    """
    radius = SETTINGS.fit.plane_radius
    normal = perpendicular(walls[:, 1] - walls[:, 0]) / np.maximum(lengths(walls), 1e-9)[:, None]
    middle = walls.mean(axis=1)
    ahead = np.sign(((middle[:, None] - origin) * normal[:, None]).sum(-1))
    side = np.where((ahead * on_walls).sum(axis=1) < 0, -1.0, 1.0)
    return middle + radius * side[:, None] * normal, np.full(len(walls), radius)


def _with_own_echoes(close: Bool[np.ndarray, "seeds free"], left: Bool[np.ndarray, " seeds"]) -> Int[np.ndarray, " _"]:
    """Seeds that share few echoes with each other, those with most votes first."""
    chosen, used = [], np.zeros(close.shape[1], dtype=bool)
    for seed in np.flatnonzero(left).tolist():
        own = close[seed]
        if np.count_nonzero(own & used) <= SETTINGS.voting.shared * np.count_nonzero(own):
            chosen.append(seed)
        used |= own
    return np.array(chosen, dtype=np.int64)


def _decided(
    measurements: RangeMeasurements,
    weight: Float[np.ndarray, " rows"],
    fits: KindFits,
    sigma: float,
    walls: Float[np.ndarray, "walls 2 2"],
    ends: Float[np.ndarray, "ends 2"],
) -> Reflector | None:
    """The reflector of the most likely kind, undecided if it is not much more likely; None without enough evidence."""
    settings = SETTINGS.decision
    evidence, count, gone = add_silences(measurements, weight, fits, sigma, walls)
    odds = evidence + np.log(settings.prior)
    if len(near_points(fits.nearest[[EDGE]], ends, settings.end_distance)):
        odds[CIRCLE] -= np.log(settings.end_odds)
    probability = np.exp(odds - odds.max())
    probability /= probability.sum()
    best = int(np.argmax(probability))
    origin = measurements.origin[fits.rows[fits.inlier[best]]]
    places = np.unique(np.floor(origin / settings.place), axis=0)
    if len(origin) < settings.min_echoes or evidence[best] < settings.min_evidence or len(places) < settings.min_places:
        return None
    nearest = fits.nearest[best]
    hidden = hidden_by_walls(origin, np.broadcast_to(nearest, origin.shape), walls)
    rho, theta, radius = fits.parameters[best]
    kind = best if probability[best] >= settings.min_probability else -1
    slope = np.zeros((3, 3))
    slope[:2, 0], slope[:2, 1], slope[2, 2] = unit(theta), rho * tangent_of(theta), 1.0
    if kind == CIRCLE:
        slope[:2, 1], slope[:2, 2] = (rho + radius) * tangent_of(theta), unit(theta)
    cov = slope @ fits.cov[best] @ slope.T
    cov = (cov + cov.T) / 2
    if kind != CIRCLE:
        cov[2], cov[:, 2] = np.nan, np.nan
    ends = fits.plane_extent(measurements.origin[fits.rows])
    plane_rho, plane_theta = fits.parameters[PLANE, :2]
    to_world = np.array([[1.0, fits.origin @ tangent_of(plane_theta)], [0.0, 1.0]])
    claimed = fits.rows[fits.inlier[probability > settings.min_claim].any(axis=0)]
    return Reflector(
        kind=kind,
        position=fits.center[best] if kind == CIRCLE else nearest,
        radius=float(radius) if kind == CIRCLE else float("nan"),
        cov=cov,
        probability=probability,
        echoes=claimed,
        scans=tuple(np.unique(measurements.scan[claimed]).tolist()),
        segment=fits.nearest[PLANE] + ends[:, None] * tangent_of(plane_theta),
        line=np.array([plane_rho + fits.origin @ unit(plane_theta), plane_theta]),
        line_cov=to_world @ fits.cov[PLANE, :2, :2] @ to_world.T,
        evidence=float(evidence[best]),
        residual=fits.residual[best, fits.inlier[best]],
        is_visible=bool(
            count[best, 0] >= settings.min_heard_share * count[best].sum()
            and hidden.mean() <= 0.5
            and gone[best] < settings.most_missed
        ),
    )


def _continues_a_wall(segment: Float[np.ndarray, "2 2"], walls: Float[np.ndarray, "walls 2 2"]) -> bool:
    """Whether a segment lies on the line of a wall, beside it or beyond a gap that may be part of it."""
    settings = SETTINGS.explanation
    length = np.maximum(lengths(walls), 1e-9)[:, None]
    tangent = (walls[:, 1] - walls[:, 0]) / length
    offset = segment - walls[:, :1]
    along = (offset * tangent[:, None]).sum(-1)
    across = (offset * perpendicular(tangent)[:, None]).sum(-1)
    gap = np.maximum(along.min(axis=1) - length[:, 0], -along.max(axis=1))
    return bool(((np.abs(across) < settings.same_line).all(axis=1) & (gap < settings.bridged_gap)).any())


def _on_faces(
    points: Float[np.ndarray, "points 2"], walls: Float[np.ndarray, "walls 2 2"]
) -> Bool[np.ndarray, " points"]:
    """Points on the faces of walls, away from their ends. A corner or an edge cannot be there."""
    distance = SETTINGS.explanation.vertex_distance
    on_face = point_to_segments(points, walls).min(axis=1, initial=np.inf) < distance
    on_face[near_points(points, walls.reshape(-1, 2), 2 * distance)] = False
    return on_face


def _with_walls(
    walls: Float[np.ndarray, "walls 2 2"],
    residual: Float[np.ndarray, "rows walls"],
    heard: Int[np.ndarray, " rows"],
    long: Bool[np.ndarray, " walls"],
    found: list[Reflector],
    sigma: float,
) -> tuple[list[Reflector], Bool[np.ndarray, " walls"]]:
    """The reflectors, those marked that walls of the map describe, and the short walls that others replace.

    Args:
        walls: both ends, metres.
        residual: as from ``wall_residuals``, one row per echo.
        heard: rows of the measurements that are echoes.
        long: walls that cannot be replaced.
        found: the reflectors.
        sigma: standard deviation of ranges about a wall, metres.
    """
    settings = SETTINGS.explanation
    fits = np.abs(residual) < settings.gate * sigma
    fits &= ~fits[:, long].any(axis=1, keepdims=True) & ~long
    by_other, marked, described = np.zeros(len(heard), dtype=bool), [], walls
    for one in found:
        rows = np.searchsorted(heard, one.echoes)
        share = fits[rows].mean(axis=0).max(initial=0.0)
        on_wall = point_to_segments(one.position[None], walls).min(initial=np.inf) < settings.on_wall
        known = share > settings.replaced_share or (one.kind < 0 and on_wall)
        is_plane = one.kind == PLANE
        known |= is_plane and _continues_a_wall(one.segment, described)
        is_wall = known and one.probability[PLANE] >= settings.min_wall_probability
        by_other[rows] = not is_wall and not is_plane
        is_short = lengths(one.segment[None])[0] < settings.min_new_wall_length
        way, wall = crossings(one.segment[None], described)
        crosses = ((way > 0) & (way < 1) & (wall > 0) & (wall < 1)).any()
        is_doubtful = is_plane and bool(
            one.probability[PLANE] < settings.min_new_wall_probability or is_short or crosses
        )
        if is_plane and not is_wall and not is_doubtful:
            described = np.concatenate([described, one.segment[None]])
        marked.append(replace(one, is_wall=bool(is_wall), kind=-1 if is_doubtful else one.kind))
    count = np.maximum(fits.sum(axis=0), 1)
    return marked, ~long & ((fits & by_other[:, None]).sum(axis=0) > settings.replaced_share * count)

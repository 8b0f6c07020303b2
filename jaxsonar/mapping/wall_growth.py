"""Growth of walls over the single measurements that fit their lines, for rings with few sensors.

Local models of windows show that a wall exists, and where its line is. Single echoes then tell how far it extends: one
more echo on the line of a known wall extends it, but no echo creates a wall. Measurements are assigned to the wall with
the most evidence first. A wall that is left with too little evidence is dropped: a second line on the same wall, a
slanted line across a step, or a line behind a wall.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.geometry.se2 import tangent_of, unit, wrap_angle
from jaxsonar.geometry.segments import crossings, point_to_segments
from jaxsonar.mapping.artifact_removal import angle_between_lines
from jaxsonar.mapping.driven_space import DrivenSpace
from jaxsonar.mapping.observations import unique_pairs
from jaxsonar.mapping.settings import SETTINGS
from jaxsonar.mapping.wall_segments import WallSegments
from jaxsonar.mapping.wall_support import EchoModel, MeasurementIndex, line_evidence
from jaxsonar.reflectors.range_measurements import RangeMeasurements, independent_weights


@dataclass(frozen=True, eq=False)
class WallLine:
    """A wall while it grows: its line, its extent, and the echoes that support it."""

    seed: int
    """Row of the wall that it grew from."""
    center: Float[np.ndarray, "2"]
    """Point on the line where the errors of its offset and of its direction are uncorrelated, metres."""
    theta: float
    """Direction of the normal, away from the robot, radians."""
    extent: Float[np.ndarray, "2"]
    """Start and end along the tangent, measured from the center, metres."""
    echoes: Int[np.ndarray, " echoes"]
    """Rows of the measurements that it caused."""
    score: float = 0.0
    """Log-likelihood ratio of the wall to none, nats."""
    variance: tuple[float, float] = (np.inf, np.inf)
    """Variances of the offset (square metres) and of the direction (square radians)."""

    @property
    def endpoints(self) -> Float[np.ndarray, "2 2"]:
        """Start and end point, metres."""
        return self.center + self.extent[:, None] * tangent_of(self.theta)


def grow_walls(
    walls: WallSegments, measurements: RangeMeasurements, driven: DrivenSpace, *, sigma: float | None = None
) -> WallSegments:
    """Walls with the extents that single measurements support, and with lines that are fitted to all their echoes.

    Collinear walls become one wall if the gap between them is closed. Walls without enough evidence are dropped.

    Args:
        walls: walls of local models, also several ones of the same wall.
        measurements: echoes and silences of the same log.
        driven: where the robot was.
        sigma: standard deviation of the ranges, metres; ``SupportSettings.sigma`` if omitted.
    """
    index, none = MeasurementIndex(measurements), np.zeros(0, dtype=np.int64)
    lines = [WallLine(k, walls.center[k], float(walls.theta[k]), walls.extent[k], none) for k in range(len(walls))]
    model = EchoModel(SETTINGS.support.sigma if sigma is None else sigma)
    model = replace(model, detection=_detection_probability(lines, index, model))
    for _ in range(SETTINGS.growth.iterations):
        # Strongest first: each echo supports one wall, and a wall hides what is behind it.
        unassigned, grown = np.ones(len(measurements), dtype=bool), []
        alone = [_supported_parts(line, walls, index, driven, unassigned, [], model) for line in lines]
        strength = np.array([sum(part.score for part in parts) for parts in alone])
        for k in np.argsort(-strength, kind="stable"):
            for part in _supported_parts(lines[k], walls, index, driven, unassigned, grown, model):
                unassigned[part.echoes] = False
                grown.append(_fitted(part, measurements, model.sigma))
        lines = grown
    return _as_segments(lines, walls, measurements)


def _supported_parts(
    line: WallLine,
    walls: WallSegments,
    index: MeasurementIndex,
    driven: DrivenSpace,
    unassigned: Bool[np.ndarray, " measurements"],
    stronger: list[WallLine],
    model: EchoModel,
) -> list[WallLine]:
    """The parts of a line that are walls and that contain a part of the known wall.

    Args:
        line: a known wall.
        walls: the walls that lines grow from.
        index: all measurements.
        driven: where the robot was.
        unassigned: measurements that support no stronger wall.
        stronger: walls with more evidence, which hide what is behind them.
        model: properties of the echoes.
    """
    settings = SETTINGS.growth
    rows = index.near(line.endpoints, settings.reach)
    measurements = index.measurements.take(rows)
    evidence = line_evidence(measurements, line.center, line.theta, model)
    tangent = tangent_of(line.theta)
    low, high = line.extent[0] - settings.reach, line.extent[1] + settings.reach
    used = (evidence.log_ratio != 0) & (evidence.foot > low) & (evidence.foot < high)
    used &= unassigned[rows] | ~evidence.fits
    used[used] = ~_is_hidden(measurements.origin[used], line.center + evidence.foot[used, None] * tangent, stronger)
    # Log-likelihood ratio of every cell along the line.
    cells = int(np.ceil((high - low) / settings.cell))
    position = low + (np.arange(cells) + 0.5) * settings.cell
    cell = np.minimum(((evidence.foot[used] - low) / settings.cell).astype(np.int64), cells - 1)
    ratio = np.minimum(evidence.log_ratio[used], settings.max_gain) * independent_weights(measurements.section[used])
    score = np.convolve(np.bincount(cell, ratio, cells), settings.footprint, mode="same")
    is_known = (position >= line.extent[0]) & (position <= line.extent[1])
    score -= np.where(is_known, 0.0, settings.cost * settings.cell)
    crossed_at = driven.latest(line.center + position[:, None] * tangent)
    was_crossed = crossed_at > walls.last_seen[line.seed] - SETTINGS.artifacts.door_time
    score -= np.where(was_crossed, settings.driven_cost, 0.0)
    # The most likely parts. Short ones need echoes of high evidence, and hardly any against them.
    largest = min(model.largest_log_ratio(measurements.max_range), settings.max_gain)
    least_mean = settings.short_share * largest
    fitting, parts = np.flatnonzero(used & evidence.fits), []
    for first, last in _best_intervals(score, settings.switch):
        start, stop = low + first * settings.cell, low + (last + 1) * settings.cell
        own = fitting[(evidence.foot[fitting] >= start) & (evidence.foot[fitting] < stop)]
        total = float(score[first : last + 1].sum())
        if not is_known[first : last + 1].any() or total < settings.min_score or len(own) < settings.min_echoes:
            continue
        extent = np.array([evidence.foot[own].min(), evidence.foot[own].max()])
        is_weak = total < least_mean * len(np.unique(measurements.section[own]))
        if extent[1] - extent[0] >= (settings.short if is_weak else settings.min_length):
            parts.append(replace(line, extent=extent, echoes=rows[own], score=total))
    echoes = [index.measurements.take(part.echoes) for part in parts]
    is_artifact = [_is_corner_line(*one, stronger, model.sigma) for one in zip(parts, echoes, strict=True)]
    return [part for part, dropped in zip(parts, is_artifact, strict=True) if not dropped]


def _detection_probability(lines: list[WallLine], index: MeasurementIndex, model: EchoModel) -> float:
    """Probability of an echo from a wall that a sensor faces, from the measurements of known walls.

    The nominal value counts as ``detection_weight`` measurements. The known walls contain some that are none, which
    lowers the result; therefore it has limits.
    """
    settings = SETTINGS.support
    fitting, all_ = settings.detection * settings.detection_weight, settings.detection_weight
    for line in lines:
        measurements = index.measurements.take(index.near(line.endpoints, 0.0))
        found = line_evidence(measurements, line.center, line.theta, model)
        inside = found.near_axis & (found.foot >= line.extent[0]) & (found.foot <= line.extent[1])
        fits, missed = np.count_nonzero(inside & found.fits), np.count_nonzero(inside & found.missed)
        if fits > missed:
            fitting, all_ = fitting + fits, all_ + fits + missed
    return min(max(fitting / all_, settings.min_detection), settings.max_detection)


def _best_intervals(score: Float[np.ndarray, " cells"], switch: float) -> list[tuple[int, int]]:
    """First and last cell of the intervals with the largest sum of scores, minus ``switch`` for each of their ends.

    This is the most likely sequence of two states (Viterbi algorithm).
    """
    off, on = 0.0, -np.inf
    begins, ends = np.zeros(len(score), dtype=bool), np.zeros(len(score), dtype=bool)
    for k, gain in enumerate(score.tolist()):
        begins[k], ends[k] = off - switch > on, on - switch > off
        off, on = max(off, on - switch), max(on, off - switch) + gain
    is_on, state = np.zeros(len(score), dtype=bool), on - switch > off
    for k in range(len(score) - 1, -1, -1):
        is_on[k] = state
        state = not begins[k] if state else bool(ends[k])
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_on, [False]]).astype(np.int8)))
    return [(int(first), int(stop) - 1) for first, stop in edges.reshape(-1, 2)]


def _is_hidden(
    origin: Float[np.ndarray, "rows 2"], foot: Float[np.ndarray, "rows 2"], walls: list[WallLine]
) -> Bool[np.ndarray, " rows"]:
    """Which lines of sight a wall blocks clearly before their end."""
    hidden, length = np.zeros(len(origin), dtype=bool), np.linalg.norm(foot - origin, axis=1)
    for one in walls:
        sight, wall = (part[:, 0] for part in crossings(np.stack([origin, foot], axis=1), one.endpoints[None]))
        before = (1 - sight) * length
        hidden |= (sight > 0) & (before > SETTINGS.growth.hidden_depth) & (wall >= 0) & (wall <= 1)
    return hidden


def _is_corner_line(line: WallLine, echoes: RangeMeasurements, walls: list[WallLine], sigma: float) -> bool:
    """Whether a short line consists of echoes of a corner where two walls meet, or of an edge where one ends.

    Such a line touches the arcs of the echoes, and has the direction of neither wall.
    """
    settings, artifacts = SETTINGS.growth, SETTINGS.artifacts
    if not walls or line.extent[1] - line.extent[0] > settings.short:
        return False
    theta = np.array([wall.theta for wall in walls])
    ends = np.array([wall.endpoints for wall in walls])
    differs = angle_between_lines(theta, np.array([line.theta])) > artifacts.same_direction
    # Both ends of each wall, and the points where two walls would meet.
    share, _ = crossings(ends, ends)
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)
    beyond = np.maximum(np.abs(share - 0.5) - 0.5, 0) * length[:, None]
    meets = (np.maximum(beyond, beyond.T) <= artifacts.max_extension) & differs[:, None] & differs
    meets &= angle_between_lines(theta[:, None], theta) > 2 * artifacts.same_direction
    first, second = np.nonzero(np.triu(meets))
    crossing = ends[first, 0] + share[first, second, None] * (ends[first, 1] - ends[first, 0])
    points = np.concatenate([ends[differs].reshape(-1, 2), crossing])
    if not len(points):
        return False
    near = point_to_segments(points, line.endpoints[None])[:, 0] < artifacts.max_extension / 2
    points = points[near]
    offset = echoes.origin[:, None] - points
    edge = sum(np.linalg.norm(offset + sign * echoes.half_baseline[:, None], axis=-1) for sign in (-1, 1)) / 2
    corner = np.linalg.norm(offset, axis=-1)
    residual = np.minimum(*(np.abs(model - echoes.distance[:, None]) for model in (edge, corner)))
    explained = (residual <= SETTINGS.support.gate * sigma).mean(axis=0)
    return bool((explained >= settings.corner_share).any())


def _fitted(line: WallLine, measurements: RangeMeasurements, sigma: float) -> WallLine:
    """The wall with its line fitted to its echoes by least squares with weights of a Cauchy distribution."""
    settings = SETTINGS.growth
    echoes = measurements.take(line.echoes)
    center, theta = line.center + line.extent.mean() * tangent_of(line.theta), line.theta
    prior = np.diag([0.0, (sigma / settings.direction_prior) ** 2])
    weight, residual, information = np.ones(len(echoes)), np.zeros(len(echoes)), np.eye(2)
    for _ in range(settings.refit_iterations):
        predicted, jacobian = echoes.predicted(center, theta)
        residual = echoes.distance - predicted
        weight = 1 / (1 + (residual / sigma) ** 2)
        information = jacobian.T @ (weight[:, None] * jacobian) + prior
        offset, turn = np.linalg.solve(information, jacobian.T @ (weight * residual))
        # Move to the point where the errors of offset and direction are uncorrelated.
        shift = -float(information[0, 1] / information[0, 0])
        center = center + offset * unit(theta) + shift * tangent_of(theta + turn)
        theta = float(wrap_angle(theta + turn))
    # Measurements of one section are not independent, so their number does not reduce the variance.
    variance = (weight * residual**2).sum() / max(weight.sum() - 2, 1.0) + settings.variance_floor**2
    variance *= 1 / independent_weights(echoes.section).mean()
    foot = (echoes.origin - center) @ tangent_of(theta)
    information_theta = information[1, 1] - information[0, 1] ** 2 / information[0, 0]
    return replace(
        line,
        center=center,
        theta=theta,
        extent=np.array([foot.min(), foot.max()]),
        variance=(float(variance / information[0, 0]), float(variance / information_theta)),
    )


def _as_segments(lines: list[WallLine], walls: WallSegments, measurements: RangeMeasurements) -> WallSegments:
    """The grown walls as a table. The variances are those of the fits, with all scatter in them."""
    table = walls.take(np.array([line.seed for line in lines], dtype=np.int64))
    if not lines:
        return table
    count = np.array([len(line.echoes) for line in lines])
    row, echo = np.repeat(np.arange(len(lines)), count), np.concatenate([line.echoes for line in lines])
    last_seen = np.full(len(lines), -np.inf)
    np.maximum.at(last_seen, row, measurements.time[echo])
    variance = np.array([line.variance for line in lines])
    return replace(
        table,
        center=np.array([line.center for line in lines]),
        theta=np.array([line.theta for line in lines]),
        extent=np.array([line.extent for line in lines]),
        info_offset=1 / variance[:, 0],
        info_theta=1 / variance[:, 1],
        chi_squared=2.0 * (count - 1),
        count=count,
        echoes=count,
        viewing_distance=np.bincount(row, measurements.distance[echo]) / count,
        last_seen=last_seen,
        scans=unique_pairs(row, measurements.scan[echo]),
    )

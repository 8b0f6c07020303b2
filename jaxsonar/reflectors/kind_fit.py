"""Joint fits of reflectors as plane, corner, edge and circle to their echoes of all scans, and the evidence of each.

Every kind has the coordinates (rho, theta) of its point nearest to an origin in front of it, and a circle its radius
beside them. A plane is fitted as a circle of a very large radius, an edge as one of radius 0, and a corner as an edge
that transmitter and receiver see from their midpoint. So one range model and one prior of the position serve all kinds.
"""

from dataclasses import dataclass
from math import log, pi

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import betaln

from jaxsonar.geometry.se2 import tangent_of, unit, wrap_angle
from jaxsonar.reflectors.circle_ranges import circle_ranges
from jaxsonar.reflectors.explained_echoes import hidden_by_walls
from jaxsonar.reflectors.range_measurements import RangeMeasurements
from jaxsonar.reflectors.settings import SETTINGS

PLANE, CORNER, EDGE, CIRCLE = range(4)
"""Kinds of reflectors by their columns, in the order of ``detection.local_model.KIND_NAMES``."""
_STARTS = np.array([PLANE, CORNER, EDGE] + [CIRCLE] * len(SETTINGS.fit.radii))
"""Kind of each start of a fit."""
_RADII = np.array([SETTINGS.fit.plane_radius, 0.0, 0.0, *SETTINGS.fit.radii])
"""Radius at each start, metres."""


@dataclass(frozen=True, eq=False)
class KindFits:
    """One reflector fitted as each kind."""

    origin: Float[np.ndarray, "2"]
    """Origin of the parameters, world frame, metres."""
    parameters: Float[np.ndarray, "4 3"]
    """Of each kind: (rho, theta) of its point nearest to the origin, and its radius (0 unless a circle)."""
    cov: Float[np.ndarray, "4 3 3"]
    """Covariance of the parameters; meaningless for the radius unless the kind is a circle."""
    evidence: Float[np.ndarray, "4"]
    """Log-likelihood ratio to clutter, nats: marginal likelihood of the echoes."""
    rows: Int[np.ndarray, " rows"]
    """Rows of the measurements that took part."""
    residual: Float[np.ndarray, "4 rows"]
    """Measured minus predicted ranges, metres."""
    inlier: Bool[np.ndarray, "4 rows"]
    """Echoes that each kind explains."""

    @property
    def nearest(self) -> Float[np.ndarray, "4 2"]:
        """Point of each kind nearest to the origin, world frame, metres."""
        return self.origin + self.parameters[:, :1] * unit(self.parameters[:, 1])

    @property
    def center(self) -> Float[np.ndarray, "4 2"]:
        """As ``nearest``, but the center of the circle."""
        return self.nearest + self.parameters[:, 2:] * unit(self.parameters[:, 1])

    def plane_extent(self, origins: Float[np.ndarray, "rows 2"]) -> Float[np.ndarray, "2"]:
        """First and last foot of the plane's echoes along its tangent, from ``nearest``, metres.

        Args:
            origins: midpoints of the sensors of all echoes that took part.
        """
        foot = (origins[self.inlier[PLANE]] - self.origin) @ tangent_of(self.parameters[PLANE, 1])
        return np.array([foot.min(initial=np.inf), foot.max(initial=-np.inf)]) if len(foot) else np.zeros(2)


def fit_kinds(
    measurements: RangeMeasurements,
    free: Int[np.ndarray, " free"],
    weight: Float[np.ndarray, " rows"],
    centers: Float[np.ndarray, "seeds 2"],
    radii: Float[np.ndarray, " seeds"],
    near: Bool[np.ndarray, "seeds free"],
    sigma: float,
) -> list[KindFits | None]:
    """Fits of all kinds at several seeds; None where the echoes near a seed are rather clutter.

    Args:
        measurements: echoes and silences.
        free: rows of the echoes that no other reflector has caused.
        weight: share of each measurement that is independent of the others.
        centers: centers of circles at which the fits start, metres.
        radii: their radii, metres.
        near: the free echoes near each of them (``near_echoes``).
        sigma: standard deviation of ranges, metres.
    """
    settings = SETTINGS.fit
    if not len(centers):
        return []
    # The echoes of each seed, padded to a common length.
    count = near.sum(axis=1)
    order = np.argsort(~near, axis=1, kind="stable")[:, : int(count.max(initial=1))]
    rows, valid = free[order], np.take_along_axis(near, order, axis=1)
    w = np.where(valid, weight[rows], 0.0)[:, None]
    distance, midpoint, half = (
        x[rows] for x in (measurements.distance, measurements.origin, measurements.half_baseline)
    )
    mean = (midpoint * valid[..., None]).sum(axis=1, keepdims=True) / count[:, None, None]
    away = np.where(valid, ((midpoint - mean) ** 2).sum(-1), np.inf)
    origin = np.take_along_axis(midpoint, away.argmin(axis=1)[:, None, None], axis=1)
    midpoint = midpoint - origin
    toward = centers - origin[:, 0]
    p = np.empty((len(centers), len(_STARTS), 3))
    p[..., 0] = np.maximum(np.hypot(*toward.T) - radii, settings.min_rho)[:, None]
    p[..., 1] = np.arctan2(toward[:, 1], toward[:, 0])[:, None]
    p[..., 2] = _RADII
    clutter, share = 1 / measurements.max_range, settings.inlier_share
    fixed = np.zeros((len(_STARTS), 3))
    fixed[_STARTS != CIRCLE, 2] = 1.0
    # Gauss-Newton with the weights of a mixture with clutter; the noise falls to sigma, so that coarse starts suffice.
    for iteration in range(settings.iterations):
        noise = max(sigma, settings.first_sigma * settings.noise_decay**iteration)
        predicted, jacobian = _predicted(p, midpoint, half)
        residual = distance[:, None] - predicted
        core = share / (np.sqrt(2 * pi) * noise) * np.exp(-0.5 * (residual / noise) ** 2)
        inlier = w * core / (core + (1 - share) * clutter)
        weighted = inlier[..., None] * jacobian
        information = weighted.swapaxes(-1, -2) @ jacobian
        gradient = (weighted.swapaxes(-1, -2) @ residual[..., None])[..., 0]
        diagonal = np.diagonal(information, axis1=-2, axis2=-1)
        damping = settings.damping * diagonal + np.array(settings.floor) + 1e9 * fixed
        step = np.linalg.solve(information + damping[..., None] * np.eye(3), gradient[..., None])[..., 0]
        step[..., 0] = np.clip(step[..., 0], -settings.max_step, settings.max_step)
        turn = settings.max_step / p[..., 0]
        step[..., 1] = np.clip(step[..., 1], -turn, turn)
        p[..., :2] += step[..., :2]
        p[..., 0] = np.maximum(p[..., 0], settings.min_rho)
        circle = p[:, CIRCLE:, 2]
        grown = circle + np.clip(step[:, CIRCLE:, 2], -0.5 * circle, circle)
        p[:, CIRCLE:, 2] = np.clip(grown, settings.min_radius, settings.max_radius)
        if noise == sigma and np.abs(step[..., :2]).max() < settings.converged * sigma:
            break
    # Marginal likelihood of each start (Laplace approximation).
    predicted, jacobian = _predicted(p, midpoint, half)
    residual = distance[:, None] - predicted
    core = share / (np.sqrt(2 * pi) * sigma) * np.exp(-0.5 * (residual / sigma) ** 2)
    log_ratio = (w * np.log(core / clutter + 1 - share)).sum(axis=-1)
    weighted = (w * core / (core + (1 - share) * clutter))[..., None] * jacobian
    prior = np.array([measurements.max_range**-2, 0.1, settings.max_radius**-2])
    information = weighted.swapaxes(-1, -2) @ jacobian / sigma**2 + np.eye(3) * prior
    information += 1e12 * fixed[..., None] * np.eye(3)
    cov = np.linalg.inv(information)
    volume = 0.5 * np.linalg.slogdet(2 * pi * cov[..., :2, :2])[1]
    evidence = log_ratio - log(measurements.max_range * 2 * pi) + np.minimum(volume, 0.0)
    # The radius has a scale-invariant prior; one that the echoes hardly determine counts as the whole prior.
    given = (
        cov[..., CIRCLE:, 2, 2]
        - (cov[..., CIRCLE:, 2, None, :2] @ np.linalg.inv(cov[..., CIRCLE:, :2, :2]) @ cov[..., CIRCLE:, :2, 2, None])[
            ..., 0, 0
        ]
    )
    prior_density = 1 / (p[:, CIRCLE:, 2] * log(settings.max_radius / settings.min_radius))
    evidence[:, CIRCLE:] += np.minimum(0.5 * np.log(2 * pi * np.maximum(given, 1e-18)) + np.log(prior_density), 0.0)
    best = np.tile(np.arange(4), (len(centers), 1))
    best[:, CIRCLE] += evidence[:, CIRCLE:].argmax(axis=1)
    fits: list[KindFits | None] = []
    for k, chosen in enumerate(best):
        if evidence[k, chosen].max() < SETTINGS.decision.min_evidence:
            fits.append(None)
            continue
        of_seed = slice(0, int(count[k]))
        parameters, own = p[k, chosen], residual[k, chosen, of_seed]
        parameters[:CIRCLE, 2] = 0.0
        inside = np.abs(own) < settings.gate * sigma
        fits.append(
            KindFits(origin[k, 0], parameters, cov[k, chosen], evidence[k, chosen], rows[k, of_seed], own, inside)
        )
    return fits


def near_echoes(
    measurements: RangeMeasurements,
    free: Int[np.ndarray, " free"],
    centers: Float[np.ndarray, "seeds 2"],
    radii: Float[np.ndarray, " seeds"],
    *,
    close: float = SETTINGS.fit.close,
) -> tuple[Bool[np.ndarray, "seeds free"], Bool[np.ndarray, "seeds free"]]:
    """Echoes that take part in the fit at a seed, and those that are so close that they probably belong to it.

    Args:
        measurements: echoes and silences.
        free: rows of the echoes.
        centers: centers of circles, metres.
        radii: their radii, metres.
        close: largest deviation of those that probably belong to it, metres.
    """
    settings = SETTINGS.fit
    away = centers[:, None] - measurements.origin[free]
    distance = np.hypot(away[..., 0], away[..., 1]) - radii[:, None]
    deviation = np.abs(measurements.distance[free] - distance)
    near = (deviation < settings.start_gate) & (distance > settings.min_distance)
    seed, echo = np.nonzero(near)
    away = away[seed, echo]
    angle = np.abs(wrap_angle(np.arctan2(away[:, 1], away[:, 0]) - measurements.axis[free[echo]]))
    near[seed, echo] = angle < measurements.half_width[free[echo]] + settings.view_margin
    return near, near & (deviation < close)


def _predicted(
    p: Float[np.ndarray, "seeds starts 3"],
    midpoint: Float[np.ndarray, "seeds rows 2"],
    half_baseline: Float[np.ndarray, "seeds rows 2"],
) -> tuple[Float[np.ndarray, "seeds starts rows"], Float[np.ndarray, "seeds starts rows 3"]]:
    """Ranges of all echoes for each start, and their derivatives by (rho, theta, radius)."""
    kind = _STARTS[: p.shape[1]]
    normal, tangent = unit(p[..., 1]), tangent_of(p[..., 1])
    radius = np.where(kind == PLANE, SETTINGS.fit.plane_radius, p[..., 2])
    reach = p[..., 0] + radius
    baseline = np.where(kind == CORNER, 0.0, 1.0)[:, None, None] * half_baseline[:, None]
    center = (reach[..., None] * normal)[..., None, :]
    distance, slope, by_radius = circle_ranges(center, radius[..., None], midpoint[:, None], baseline)
    jacobian = np.empty((*distance.shape, 3))
    jacobian[..., 0] = (slope @ normal[..., None])[..., 0]
    jacobian[..., 1] = reach[..., None] * (slope @ tangent[..., None])[..., 0]
    jacobian[..., 2] = jacobian[..., 0] + by_radius
    return distance, jacobian


def add_silences(
    measurements: RangeMeasurements,
    weight: Float[np.ndarray, " rows"],
    fits: KindFits,
    sigma: float,
    walls: Float[np.ndarray, "walls 2 2"],
) -> tuple[Float[np.ndarray, "4"], Int[np.ndarray, "4 2"], Int[np.ndarray, "4"]]:
    """Evidence of each kind with that of the measurements that should hear it, how many do and do not, and gone.

    The probability of an echo is unknown; it is integrated out (beta-binomial distribution). Only measurements from the
    first to the last echo count. The third result is the number of later scans that should have heard it.

    Args:
        measurements: echoes and silences.
        weight: share of each measurement that is independent of the others.
        fits: the fits.
        sigma: standard deviation of ranges, metres.
        walls: both ends of the walls that hide what is behind them, metres.
    """
    decision = SETTINGS.decision
    best = int(np.argmax(fits.evidence))
    away = fits.nearest[best] - measurements.origin
    reach = measurements.max_range
    near = measurements.is_first & (np.abs(away) < reach).all(axis=1)
    near = np.flatnonzero(near)
    angle = np.abs(wrap_angle(np.arctan2(away[near, 1], away[near, 0]) - measurements.axis[near]))
    near = near[angle < measurements.half_width[near] + SETTINGS.fit.view_margin]
    near = near[~hidden_by_walls(measurements.origin[near], measurements.origin[near] + away[near], walls)]
    origin = measurements.origin[near] - fits.origin
    predicted, _ = _predicted(fits.parameters[None], origin[None], measurements.half_baseline[near][None])
    predicted = predicted[0]
    count, value, gone = np.zeros((4, 2), dtype=np.int64), fits.evidence.copy(), np.zeros(4, dtype=np.int64)
    begin, end = fits.plane_extent(measurements.origin[fits.rows])
    tangent = tangent_of(fits.parameters[PLANE, 1])
    for kind in range(4):
        toward = fits.center[kind] - measurements.origin[near]
        if kind == PLANE:
            toward = np.broadcast_to(unit(fits.parameters[PLANE, 1]), toward.shape)
        angle = np.abs(wrap_angle(np.arctan2(toward[:, 1], toward[:, 0]) - measurements.axis[near]))
        asked = angle < decision.certain_view * measurements.half_width[near]
        heard_from = measurements.distance[fits.rows[fits.inlier[kind]]]
        if len(heard_from):  # what is farther may be too weak
            asked &= predicted[kind] <= np.quantile(heard_from, decision.certain_quantile)
        asked &= predicted[kind] < decision.certain_range * reach
        asked &= measurements.distance[near] > predicted[kind] - SETTINGS.fit.gate * sigma
        if kind == PLANE:
            foot = origin @ tangent
            asked &= (foot >= begin) & (foot <= end)
        is_heard = np.zeros(int(measurements.measurement.max(initial=0)) + 1, dtype=bool)
        is_heard[measurements.measurement[fits.rows[fits.inlier[kind]]]] = True
        time = measurements.time[fits.rows[fits.inlier[kind]]]
        first, last = time.min(initial=np.inf), time.max(initial=-np.inf)
        rows = near[asked]
        gone[kind] = len(np.unique(measurements.scan[rows[measurements.time[rows] > last]]))
        rows = rows[(measurements.time[rows] >= first) & (measurements.time[rows] <= last)]
        hears, w = is_heard[measurements.measurement[rows]], weight[rows]
        count[kind] = np.count_nonzero(hears), np.count_nonzero(~hears)
        h, m = float(w[hears].sum()), float(w[~hears].sum())
        a, b = decision.heard_prior
        value[kind] += betaln(h + a, m + b) - betaln(a, b)
    return value, count, gone

"""Update of many pose hypotheses by the echoes of one scan in a known map: one compiled program for all hypotheses.

Each hypothesis is a normal distribution of the pose. The echoes are assigned softly to the landmarks around it, the
pose is fitted to them, and every landmark gets its evidence. The echoes of one landmark share its error in the map.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.kernels.detection_cones import visibility
from jaxsonar.kernels.landmarks import AnyArray, landmark_echo, landmark_in_robot_frame
from jaxsonar.kernels.planar_geometry import normal, tangent, wrap_angle
from jaxsonar.kernels.sensor_array import widen_cones
from jaxsonar.localization.settings import UPDATE_SETTINGS as SETTINGS

Scalar = Float[AnyArray, ""] | np.float64
"""A number, of double precision as all of this module."""


class MapArrays(NamedTuple):
    """Landmarks of a known map, padded; rows of kind -1 are unused."""

    landmarks: kernels.Landmarks
    covariance: Float[AnyArray, "landmarks 2 2"]
    """Of the parameters of each landmark."""
    opening: Float[AnyArray, "landmarks 2 2"]
    """Directions in which the two walls of a corner extend from it; 0 for walls, and for corners and edges of a map."""


class ScanArrays(NamedTuple):
    """One scan, padded."""

    paths: kernels.EchoPaths
    """(echoes,) robot frame of the scan's pose."""
    ranges: Float[AnyArray, " echoes"]
    """Corrected ranges, metres."""
    is_echo: Bool[AnyArray, " echoes"]
    """False for padding."""
    direct: kernels.EchoPaths
    """(sensors,) direct paths."""
    first: Float[AnyArray, "sensors"]
    """Range of the first echo of each direct path, metres; infinite if it heard nothing."""
    measured: Bool[AnyArray, " sensors"]
    """Whether the scan measured the direct path."""
    sigma: Scalar
    """Standard deviation of the ranges, metres."""
    max_range: Scalar
    """Of the ring, metres."""
    full_echoes: Scalar
    """Number of echoes of a wall or corner that is surely observed."""
    map_views: Scalar
    """Number of scans that share the error of a wall in the map."""


class ScanUpdate(NamedTuple):
    """Hypotheses after a scan, with the evidence of every landmark near them."""

    poses: Float[AnyArray, "hypotheses 3"]
    covariances: Float[AnyArray, "hypotheses 3 3"]
    landmark: Int[AnyArray, "hypotheses near"]
    """Rows of the landmarks near each hypothesis."""
    evidence: Float[AnyArray, "hypotheses near"]
    """Log-likelihood ratio of each landmark's echoes against unknown reflectors, nats; negative if it was missed."""
    explained: Float[AnyArray, " hypotheses"]
    """Number of echoes that the map explains."""
    log_odometry: Float[AnyArray, " hypotheses"]
    """Log-probability of the fitted pose given the predicted one, relative to the latter, and of the volume of poses
    that the scan leaves (Laplace's approximation): the other part of the scan's marginal likelihood, nats."""


@jax.jit
def update_hypotheses(
    poses: Float[AnyArray, "hypotheses 3"],
    covariances: Float[AnyArray, "hypotheses 3 3"],
    known: MapArrays,
    scan: ScanArrays,
    iterations: Int[AnyArray, ""] | np.int64,
) -> ScanUpdate:
    """Fit each hypothesis to the echoes of a scan.

    Args:
        poses: world_from_robot before the scan, metres and radians.
        covariances: of these poses.
        known: the map.
        scan: the echoes.
        iterations: number of Gauss-Newton steps before the last one.
    """
    return jax.vmap(_update_one, in_axes=(0, 0, None, None, None))(poses, covariances, known, scan, iterations)


def _update_one(
    pose: Float[AnyArray, "3"],
    covariance: Float[AnyArray, "3 3"],
    known: MapArrays,
    scan: ScanArrays,
    iterations: Int[AnyArray, ""] | np.int64,
) -> ScanUpdate:
    """Update ONE hypothesis: robust Gauss-Newton steps with annealed weights, then the evidence at the fitted pose."""
    rows, landmarks, landmark_covariance, is_near = _near_landmarks(pose, covariance, known, scan.max_range)
    prior_information = jnp.linalg.inv(covariance)

    def match_at(state, annealing):
        return _match(state, landmarks, landmark_covariance, is_near, covariance, scan, annealing)

    def information_of(match, annealing):
        """Information matrix and right-hand side of a Gauss-Newton step on the prior and the weighted echoes."""
        count = len(rows)
        echoes = jax.ops.segment_sum(match.responsibility, match.landmark, count)
        is_trusted = jnp.clip(SETTINGS.trust_slope * (echoes / scan.full_echoes - SETTINGS.trust_echoes), 0.0, 1.0)
        is_trusted = jnp.maximum(is_trusted, annealing)  # before the pose is fitted, all echoes are weak
        weight = match.responsibility * is_trusted[match.landmark] / scan.sigma**2
        by_pose = weight[:, None] * match.by_pose
        outer = jax.ops.segment_sum(
            match.by_landmark[:, :, None] * (weight[:, None] * match.by_landmark)[:, None, :], match.landmark, count
        )
        mixed = jax.ops.segment_sum(by_pose[:, :, None] * match.by_landmark[:, None, :], match.landmark, count)
        right = jax.ops.segment_sum((weight * match.residual)[:, None] * match.by_landmark, match.landmark, count)
        # The parameters of each landmark are eliminated (Schur complement); their prior holds for several scans.
        inner = jnp.linalg.inv(jnp.linalg.inv(landmark_covariance * scan.map_views) + outer)
        gain = mixed @ inner
        information = by_pose.T @ match.by_pose - jnp.einsum("kij,klj->il", gain, mixed)
        vector = by_pose.T @ match.residual - jnp.einsum("kij,kj->i", gain, right)
        return information + prior_information, vector

    def step(annealing, state):
        information, vector = information_of(match_at(state, annealing), annealing)
        return state + jnp.linalg.solve(information, vector - prior_information @ _difference(state, pose)), information

    def fit_from(annealing):
        """The update by a fit whose weights begin with this fraction of the variance of the predicted pose."""
        state = jax.lax.fori_loop(
            0,
            iterations,
            lambda number, state: step(annealing * SETTINGS.annealing_factor ** number.astype(pose.dtype), state)[0],
            pose,
        )
        state, information = step(0.0, state)
        # A fit that contradicts the prediction is a wrong match of echoes to walls: the prediction is kept.
        change = _difference(state, pose)
        squared = change @ prior_information @ change
        is_fit = squared < SETTINGS.max_innovation
        state = jnp.where(is_fit, state, pose)
        information = jnp.where(is_fit, information, prior_information)
        evidence, explained = _evidence(state, match_at(state, 0.0), landmarks, landmark_covariance, is_near, scan)
        volume = (jnp.linalg.slogdet(prior_information)[1] - jnp.linalg.slogdet(information)[1]) / 2
        log_odometry = volume - jnp.where(is_fit, squared, 0.0) / 2
        covariance = jnp.linalg.inv(information)
        return ScanUpdate(_wrapped(state), covariance, rows, evidence, explained, log_odometry)

    # One fit finds poses far from the prediction, one starts with the matches at the prediction.
    fits = jax.vmap(fit_from)(jnp.array([1.0, 0.0], dtype=pose.dtype))
    best = (fits.evidence.sum(axis=1) + fits.log_odometry).argmax()
    return jax.tree.map(lambda column: column[best], fits)


class _Match(NamedTuple):
    """The most likely landmark of each echo at a pose."""

    landmark: Int[Array, " echoes"]
    """Row among the landmarks near the hypothesis."""
    responsibility: Float[Array, " echoes"]
    """Probability that the echo comes from that landmark."""
    log_ratio: Float[Array, " echoes"]
    """Log-likelihood ratio of the mixture of that landmark and unknown reflectors against the latter, nats."""
    residual: Float[Array, " echoes"]
    by_pose: Float[Array, "echoes 3"]
    by_landmark: Float[Array, "echoes 2"]


def _match(
    pose: Float[AnyArray, "3"],
    landmarks: kernels.Landmarks,
    covariance: Float[Array, "near 2 2"],
    is_near: Bool[Array, " near"],
    pose_covariance: Float[AnyArray, "3 3"],
    scan: ScanArrays,
    annealing: Float[Array, ""] | float,
) -> _Match:
    """Match every echo to the landmark of the nearest expected range, in standard deviations.

    ``annealing`` is the fraction of the variance of the predicted pose that is added to that of the residuals.
    """
    expected = kernels.expected_ranges(pose, landmarks, scan.paths, SETTINGS.hearing_threshold)
    expected = jnp.where(is_near[:, None], expected, jnp.inf)
    distance = jnp.abs(expected - scan.ranges[None])
    best = (distance / jnp.sqrt(covariance[:, :1, 0] + scan.sigma**2)).argmin(axis=0)
    found = jnp.isfinite(expected[best, jnp.arange(len(best))]) & scan.is_echo
    mine = jax.tree.map(lambda leaf: jnp.asarray(leaf)[best], landmarks)

    def range_of(unknowns, landmark, path):
        moved = landmark.with_parameters(unknowns[3:])
        return landmark_echo(landmark_in_robot_frame(unknowns[:3], moved), moved, path).range

    unknowns = jnp.concatenate([jnp.broadcast_to(pose, (len(best), 3)), mine.parameters], axis=1)
    value, jacobian = jax.vmap(jax.value_and_grad(range_of))(unknowns, mine, scan.paths)
    jacobian = jnp.where(found[:, None], jacobian, 0.0)
    residual = jnp.where(found, scan.ranges - value, 0.0)
    by_pose, by_landmark = jacobian[:, :3], jacobian[:, 3:]
    prior = annealing * jnp.einsum("ei,ij,ej->e", by_pose, pose_covariance, by_pose) + scan.sigma**2
    variance = prior + jnp.einsum("ei,eij,ej->e", by_landmark, covariance[best], by_landmark)
    odds = SETTINGS.known_share / (1 - SETTINGS.known_share) * scan.max_range / jnp.sqrt(2 * jnp.pi)
    ratio = jnp.where(found, odds / jnp.sqrt(variance) * jnp.exp(-(residual**2) / (2 * variance)), 0.0)
    # Other landmarks of about the same range: the echo may be theirs.
    others = covariance[:, :1, 0] + prior[None]
    rivals = jnp.where(jnp.arange(len(expected))[:, None] == best[None], 0.0, odds / jnp.sqrt(others))
    rivals = (rivals * jnp.exp(-jnp.minimum(distance**2 / (2 * others), 700.0))).sum(axis=0)
    return _Match(best, ratio / (1 + ratio + rivals), jnp.log1p(ratio), residual, by_pose, by_landmark)


def _evidence(
    pose: Float[AnyArray, "3"],
    match: _Match,
    landmarks: kernels.Landmarks,
    covariance: Float[Array, "near 2 2"],
    is_near: Bool[Array, " near"],
    scan: ScanArrays,
) -> tuple[Float[Array, " near"], Float[Array, ""]]:
    """Evidence of every landmark, and the number of explained echoes."""
    count = len(landmarks.kind)
    is_explained = match.log_ratio > np.log(2.0)
    echoes = jax.ops.segment_sum(is_explained.astype(pose.dtype), match.landmark, count)
    gain = jax.ops.segment_sum(jnp.where(is_explained, match.log_ratio, 0.0), match.landmark, count)
    # The echoes of one reflector count as a few independent ones, for they share its two parameters. Few echoes may
    # match by chance.
    counted = SETTINGS.independent_echoes * jnp.minimum(echoes / scan.full_echoes, 1.0)
    gain = gain * counted / jnp.maximum(echoes, 1.0)
    # Missed: direct paths that face a wall, and receive neither its echo nor a nearer one.
    expected = kernels.expected_ranges(pose, landmarks, scan.direct)
    is_due = _is_well_visible(pose, landmarks, scan.direct) & scan.measured[None]
    is_due &= (is_near & (jnp.asarray(landmarks.kind) == kernels.PLANE))[:, None]
    is_due &= expected < SETTINGS.reliable_range_fraction * scan.max_range
    tolerance = 3 * jnp.sqrt(covariance[:, :1, 0] + scan.sigma**2) + SETTINGS.missed_margin
    is_due &= scan.first[None] > expected - tolerance
    missed = (is_due & (scan.first[None] > expected + tolerance)).sum(axis=1).astype(pose.dtype)
    is_missed = (missed >= SETTINGS.min_missed_paths) & (
        missed > SETTINGS.missed_share * is_due.sum(axis=1).astype(pose.dtype)
    )
    evidence = jnp.where(is_missed, -SETTINGS.missed_nats, gain)
    return evidence, is_explained.sum().astype(pose.dtype)


def _is_well_visible(
    pose: Float[AnyArray, "3"], landmarks: kernels.Landmarks, paths: kernels.EchoPaths
) -> Bool[Array, "near paths"]:
    """Whether a path surely receives a wall's echo: well inside the cones, and within the ends of the wall."""
    narrow = widen_cones(paths, SETTINGS.inner_cone)

    def visible(landmark, path):
        echo = landmark_echo(landmark_in_robot_frame(jnp.asarray(pose), landmark), landmark, path)
        along = echo.footpoint + jnp.dot(tangent(jnp.asarray(landmark.parameters[1])), pose[:2] - landmark.anchor)
        inside = (along > landmark.extent[0] + SETTINGS.end_margin) & (along < landmark.extent[1] - SETTINGS.end_margin)
        return (visibility(echo, path) > 0.5) & inside

    return jax.vmap(jax.vmap(visible, in_axes=(None, 0)), in_axes=(0, None))(landmarks, narrow)


def _near_landmarks(
    pose: Float[AnyArray, "3"], covariance: Float[AnyArray, "3 3"], known: MapArrays, max_range: Scalar
) -> tuple[Int[Array, " near"], kernels.Landmarks, Float[Array, "near 2 2"], Bool[Array, " near"]]:
    """The nearest landmarks; walls face the robot, and those behind other walls are left out.

    Returns:
        Rows in the map, landmarks, covariances, and which of them may be heard.
    """
    rows, landmarks, distance, foot = _nearest(pose, known)
    kind = jnp.asarray(landmarks.kind)
    is_wall = kind == kernels.PLANE
    uncertainty = 3 * jnp.sqrt(jnp.trace(covariance[:2, :2]))
    is_near = (kind >= 0) & (distance < max_range + uncertainty)
    is_near &= ~_is_hidden(pose, landmarks, foot, is_wall & is_near)
    # The other side of a wall: normal and distance are reversed.
    theta = jnp.asarray(landmarks.parameters[:, 1])
    side = ((jnp.asarray(landmarks.anchor) - pose[None, :2]) * normal(theta)).sum(-1) + landmarks.parameters[:, 0]
    is_reversed = is_wall & (side < 0)
    other = jnp.stack([-landmarks.parameters[:, 0], theta + jnp.pi], axis=-1)
    parameters = jnp.where(is_reversed[:, None], other, landmarks.parameters)
    extent = jnp.asarray(landmarks.extent)
    extent = jnp.where(is_reversed[:, None], -extent[:, ::-1], extent)
    # A corner of two walls is concave within the angle of its walls, and an edge outside of it.
    opening = jnp.asarray(known.opening)[rows]
    offset = pose[None, :2] - (landmarks.anchor + landmarks.parameters)
    is_outside = (jnp.einsum("kij,kj->ki", opening, offset) < 0).any(axis=1)
    kind = jnp.where((kind == kernels.CORNER) & is_outside, kernels.EDGE, kind)
    landmarks = kernels.Landmarks(kind, parameters, landmarks.anchor, extent, landmarks.radius)
    return rows, landmarks, jnp.asarray(known.covariance)[rows], is_near


def _nearest(
    pose: Float[AnyArray, "3"], known: MapArrays
) -> tuple[Int[Array, " near"], kernels.Landmarks, Float[Array, " near"], Float[Array, "near 2"]]:
    """Rows of the nearest landmarks, these landmarks, their distances (metres) and nearest points."""
    every = known.landmarks
    kind = jnp.asarray(every.kind)
    theta = jnp.asarray(every.parameters[:, 1])
    t, n = tangent(theta), normal(theta)
    offset = pose[None, :2] - every.anchor
    along = jnp.clip((offset * t).sum(-1), every.extent[:, 0], every.extent[:, 1])
    on_wall = every.anchor + every.parameters[:, :1] * n + along[:, None] * t
    foot = jnp.where((kind == kernels.PLANE)[:, None], on_wall, every.anchor + every.parameters)
    distance = jnp.linalg.norm(foot - pose[None, :2], axis=-1)
    if every.radius is not None:
        distance -= jnp.asarray(every.radius)
    distance = jnp.where(kind >= 0, distance, jnp.inf)
    size = min(SETTINGS.max_landmarks, len(distance))
    _, rows = jax.lax.top_k(-distance, size)
    near = jax.tree.map(lambda leaf: jnp.asarray(leaf)[rows], every)
    return rows, near, distance[rows], foot[rows]


def _is_hidden(
    pose: Float[AnyArray, "3"],
    landmarks: kernels.Landmarks,
    foot: Float[Array, "near 2"],
    is_wall: Bool[Array, " near"],
) -> Bool[Array, " near"]:
    """Whether a wall stands between the robot and the nearest point of a landmark."""
    theta = jnp.asarray(landmarks.parameters[:, 1])
    n, t = normal(theta), tangent(theta)
    here = ((landmarks.anchor - pose[None, :2]) * n).sum(-1) + landmarks.parameters[:, 0]
    # Fraction of the way to each point (rows) at which the line meets each wall (columns).
    way = foot - pose[None, :2]
    toward = way @ n.T
    fraction = here[None] / jnp.where(jnp.abs(toward) < 1e-9, 1e-9, toward)
    length = jnp.linalg.norm(foot - pose[None, :2], axis=-1)[:, None]
    meets = pose[None, None, :2] + fraction[..., None] * way[:, None]
    along = ((meets - landmarks.anchor[None]) * t[None]).sum(-1)
    margin = SETTINGS.sight_margin
    inside = (along > landmarks.extent[None, :, 0] + margin) & (along < landmarks.extent[None, :, 1] - margin)
    between = (fraction > 0) & (fraction * length < length - margin)
    return (inside & between & is_wall[None]).any(axis=1)


def _difference(pose: Float[AnyArray, "3"], other: Float[AnyArray, "3"]) -> Float[Array, "3"]:
    return _wrapped(pose - other)


def _wrapped(pose: Float[AnyArray, "3"]) -> Float[Array, "3"]:
    return jnp.stack([pose[0], pose[1], wrap_angle(jnp.asarray(pose[2]))])

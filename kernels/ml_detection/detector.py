"""Maximum-likelihood detection: the reflectors that explain the echoes of a scan best, each echo at most once.

The ranges of the right echoes determine a line to a fraction of their noise; the problem is which echoes these are and
what kind of reflector they come from. Every candidate line of the Hough transform is fitted as a plane, as a corner and
as an edge. Then, in a few passes over the whole scan, the reflectors with the most evidence are selected one after the
other, each with the echoes that are left. Each pass gives the next one a better estimate of the scene: where two walls
reflect one sound, where corners can be, which directions the walls have, the detection probability, the noise.

Evidence is counted in nats (natural logarithms of likelihood ratios). It is the sum of

- the log-likelihood ratio of each echo between this reflector, with Gaussian noise, and clutter;
- the log likelihood of missed detections: paths that should have received the reflector and did not;
- the log prior of such a reflector, and the volume of its posterior (Laplace approximation).
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .. import hough_accumulator as hough
from ..hough_accumulator import HoughSettings
from ..hough_voting import PackedEchoes, RingArcs, map_scans, tangent_lines
from ..measurement_model import CIRCLE, CORNER, EDGE, PLANE, plane_echo, point_echo
from ..planar_geometry import fold_line, segment_endpoints, wrap_angle
from ..robust_fit import (
    crosstalk_of_echoes,
    edge_from_midpoint,
    fit_reflector,
    paths_and_ranges,
    plane_from_both_sides,
    start_of_point,
)
from ..sensor_array import EchoPaths, transform_path
from .circles import fit_circles, nearest_point
from .joint_refinement import refine_jointly
from .likelihood import (
    clutter_log_density,
    hears_outside_cones,
    plane_log_prior,
    plane_missed_log_likelihood,
    point_log_prior,
    point_missed_log_likelihood,
    refine,
)
from .scene_estimate import update_scene
from .settings import DetectionSettings
from .state import Hypotheses, ScanData, SceneEstimate, Selection, count, determinant

_IS_EDGE = (0.0, 1.0)  # corner, edge

REFLECTOR_KINDS = PLANE, CORNER, EDGE, CIRCLE
"""Kinds of detected reflectors, in the order of ``Detections.probability``."""


class Detections(eqx.Module):
    """The reflectors of scans, those with the most evidence first; kind -1 where there are fewer."""

    kind: Int[Array, "*scans reflectors"]
    """PLANE, CORNER, EDGE or CIRCLE, the most likely one; -1 for unused rows."""
    parameters: Float[Array, "*scans reflectors 2"]
    """(rho, theta) of a plane, (x, y) of a corner, an edge or the nearest point of a circle; robot frame, metres,
    radians."""
    covariance: Float[Array, "*scans reflectors 2 2"]
    """Covariance of the parameters by the noise of the ranges."""
    circle: Float[Array, "*scans reflectors 3"]
    """Center x, y and radius of the reflector as a circle, metres."""
    circle_covariance: Float[Array, "*scans reflectors 3 3"]
    """Covariance of the circle by the noise of the ranges and the prior of the curvature."""
    probability: Float[Array, "*scans reflectors 4"]
    """Posterior probabilities of plane, corner, edge and circle, given that it is one of them."""
    evidence: Float[Array, "*scans reflectors"]
    """Nats above clutter."""
    involved: Bool[Array, "*scans reflectors echoes"]
    """Echoes that each reflector explains; no echo twice."""
    segment: Float[Array, "*scans reflectors 2 2"]
    """Planes: endpoints, the outermost footpoints of the involved sensors (paper, section 5), metres."""
    sigma: Float[Array, "*scans"]
    """Standard deviation of the ranges, given or estimated, metres."""


@partial(jax.jit, static_argnames=("hough_settings", "settings"))
def detect_ml(
    ring: RingArcs,
    echoes: PackedEchoes,
    sigma: Float[Array, ""],
    *,
    hough_settings: HoughSettings,
    settings: DetectionSettings,
) -> Detections:
    """Find the reflectors that explain a batch of scans, in one compiled step.

    Args:
        ring: arcs of the ring's paths.
        echoes: (scans, echoes) packed echoes.
        sigma: standard deviation of the ranges, metres; NaN: it is estimated for each scan.
        hough_settings: settings of the Hough transform that gives the candidates.
        settings: prior and weights.
    """

    def one_scan(packed: PackedEchoes) -> Detections:
        # Padding costs nothing where scans are processed one after the other.
        return jax.lax.cond(
            jnp.isfinite(packed.range).any(),
            lambda packed: detect_in_scan(ring, packed, sigma, hough_settings, settings),
            lambda packed: _no_detections(packed, sigma, settings),
            packed,
        )

    return map_scans(one_scan, echoes)


def detect_in_scan(
    ring: RingArcs,
    packed: PackedEchoes,
    sigma: Float[Array, ""],
    hough_settings: HoughSettings,
    settings: DetectionSettings,
) -> Detections:
    """Find the reflectors that explain ONE scan; arguments as ``detect_ml``."""
    # Candidates: maxima of the accumulator (paper, section 4).
    votes = hough.accumulate(tangent_lines(ring, packed, hough_settings).cell, hough_settings)
    full_wall_paths = ring.full_wall_paths * (1 if packed.scans_per_row is None else packed.scans_per_row)
    level = settings.peak_threshold * hough.votes_of_paths(full_wall_paths, hough_settings)
    smooth = hough.lowpass(votes, hough_settings)
    rho, theta = hough.peaks(smooth, level, size=settings.candidates, settings=hough_settings)

    # Robust fit of each candidate as plane, corner and edge. Sigma is not known well yet.
    echo_paths, ranges = paths_and_ranges(ring, packed)
    known = jnp.isfinite(sigma)
    initial_sigma = jnp.where(known, jnp.maximum(sigma, settings.min_sigma), settings.initial_sigma)
    parameters, usable = fit_hypotheses(echo_paths, ranges, rho, theta, initial_sigma, settings)

    # Passes over the whole scan: evaluate all hypotheses, select the best ones, update the estimate of the scene.
    paths = ring.paths if packed.path_pose is None else jax.vmap(transform_path)(ring.paths, packed.path_pose)
    paths, own_paths = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), (paths, echo_paths))
    scan = ScanData(
        paths=paths,
        echo_paths=own_paths,
        path_index=packed.path,
        ranges=ranges,
        valid=ranges > 0,
        max_range=ring.max_range,
        full_wall_paths=full_wall_paths,
        measured=packed.measured,
        crosstalk=crosstalk_of_echoes(ring, packed),
    )

    def one_pass(state: tuple[SceneEstimate, Float[Array, "3 k 2"]], _: None):
        scene, parameters = state
        hypotheses = evaluate_hypotheses(scan, parameters, scene, settings)
        selection = select_reflectors(scan, hypotheses, usable, scene, settings)
        selected = hypotheses.take(selection.hypothesis)
        scene = update_scene(scan, selected, selection, scene, sigma, settings)
        return (scene, hypotheses.parameters.reshape(parameters.shape)), (selected, selection, scene.sigma)

    start = SceneEstimate.initial(initial_sigma, settings), parameters
    (scene, _), passes = jax.lax.scan(one_pass, start, None, length=settings.passes)
    selected, selection, final_sigma = jax.tree.map(lambda leaf: leaf[-1], passes)

    # Refine all of them together: they compete for the echoes.
    clutter = clutter_log_density(scan, scene, settings)
    exists = selection.evidence > -jnp.inf
    joint = refine_jointly(scan, selection.kind, selected.parameters, exists, clutter, scene, settings)
    selected = selected._replace(parameters=jnp.where(exists[:, None], joint.parameters, selected.parameters))

    # Fit the selected reflectors as circles, and let the four kinds compete.
    circles = fit_circles(scan, selected, selection, clutter, scene, settings)
    kind, probability = compare_with_circles(selection, circles.evidence, settings)

    # Planes in canonical form, and their endpoints; of circles the nearest points.
    is_plane, is_circle = selection.kind == PLANE, kind == CIRCLE
    line = jnp.stack(fold_line(selected.parameters[:, 0], selected.parameters[:, 1]), axis=-1)
    folded = is_plane & (selected.parameters[:, 0] < 0)
    parameters = jnp.where(is_plane[:, None], line, selected.parameters)
    parameters = jnp.where(is_circle[:, None], jax.vmap(nearest_point)(circles.circle), parameters)
    covariance = joint.covariance
    signs = np.array([[[1.0, -1.0], [-1.0, 1.0]]], np.float32)  # rho changes its sign, theta does not
    covariance = jnp.where(folded[:, None, None], covariance * signs, covariance)
    each_segment = jax.vmap(lambda x, involved: segment_endpoints(x[0], x[1], echo_paths.midpoint, involved))
    return Detections(
        kind=jnp.where(selection.evidence > -jnp.inf, kind, -1),
        circle=circles.circle,
        circle_covariance=circles.covariance,
        parameters=parameters,
        covariance=covariance,
        probability=probability,
        evidence=selection.evidence,
        involved=selection.involved,
        segment=each_segment(parameters, selection.involved),
        sigma=final_sigma,
    )


def _no_detections(packed: PackedEchoes, sigma: Float[Array, ""], settings: DetectionSettings) -> Detections:
    size, dtype = settings.reflectors, packed.range.dtype
    return Detections(
        kind=jnp.full(size, -1),
        circle=jnp.zeros((size, 3), dtype),
        circle_covariance=jnp.zeros((size, 3, 3), dtype),
        parameters=jnp.zeros((size, 2), dtype),
        covariance=jnp.zeros((size, 2, 2), dtype),
        probability=jnp.zeros((size, 4), dtype),
        evidence=jnp.full(size, -jnp.inf, dtype),
        involved=jnp.zeros((size, len(packed.path)), bool),
        segment=jnp.zeros((size, 2, 2), dtype),
        sigma=jnp.where(jnp.isfinite(sigma), sigma, jnp.asarray(settings.initial_sigma, dtype)),
    )


def fit_hypotheses(
    paths: EchoPaths,
    ranges: Float[Array, " echoes"],
    rho: Float[Array, " candidates"],
    theta: Float[Array, " candidates"],
    sigma: Float[Array, ""],
    settings: DetectionSettings,
) -> tuple[Float[Array, "3 k 2"], Bool[Array, " k"]]:
    """Fit the best candidates robustly as planes, corners and edges.

    Args:
        paths: (echoes,) path of every echo.
        ranges: corrected ranges, metres; 0 where there is no echo.
        rho: distances of the candidate lines, metres; NaN where there is none.
        theta: directions of their normals, radians.
        sigma: standard deviation of the ranges, metres.
        settings: tolerances.

    Returns:
        Parameters by kind, and which of the k rows are distinct candidates.
    """
    # Fit all candidates as planes.
    tolerance = settings.fit_tolerance * sigma
    initial_scale = jnp.maximum(settings.fit_initial_scale, tolerance)
    candidate = jnp.isfinite(rho)
    starts = jnp.stack([jnp.where(candidate, rho, 1), jnp.where(candidate, theta, 0)], axis=-1)
    fit_plane = partial(fit_reflector, plane_from_both_sides, tolerance=tolerance, initial_scale=initial_scale)
    lines, scores = jax.vmap(fit_plane, in_axes=(0, None, None))(starts, paths, ranges)
    # Of candidates that converge to the same line keep the best one.
    total = jnp.where(candidate, scores.sum(axis=1), -1)
    same = jnp.abs(lines[:, None, 0] - lines[None, :, 0]) < settings.duplicate_rho
    same &= jnp.abs(wrap_angle(lines[:, None, 1] - lines[None, :, 1])) < settings.duplicate_theta
    rank = jnp.arange(len(total))
    better = (total[None, :] > total[:, None]) | ((total[None, :] == total[:, None]) & (rank[None, :] < rank[:, None]))
    total = jnp.where((same & better).any(axis=1), -1, total)
    total, best = jax.lax.top_k(total, settings.hypotheses)

    # Fit the best ones as points. A corner is an edge with all paths reduced to their virtual sensors.
    def fit_point(is_edge: Float[Array, ""], line: Float[Array, "2"], score: Float[Array, " echoes"]):
        legs = eqx.tree_at(lambda p: p.half_baseline, paths, is_edge * paths.half_baseline)
        start = start_of_point(line, paths.midpoint, score)
        return fit_reflector(edge_from_midpoint, start, legs, ranges, tolerance=tolerance, initial_scale=tolerance)[0]

    each_point = jax.vmap(jax.vmap(fit_point, in_axes=(None, 0, 0)), in_axes=(0, None, None))
    points = each_point(jnp.asarray(_IS_EDGE, rho.dtype), lines[best], scores[best])
    return jnp.concatenate([lines[best][None], points]), total > 0


def evaluate_hypotheses(
    scan: ScanData, start: Float[Array, "3 k 2"], scene: SceneEstimate, settings: DetectionSettings
) -> Hypotheses:
    """Refine every candidate as every kind and compute its evidence.

    Returns:
        (3 k,) hypotheses: planes, then corners, then edges.
    """
    clutter = clutter_log_density(scan, scene, settings)

    def with_base(one: Hypotheses, missed: Float[Array, ""], prior: Float[Array, ""]) -> Hypotheses:
        volume = jnp.log(2 * jnp.pi) - 0.5 * jnp.log(determinant(one.information) + 1)
        return one._replace(base=missed + settings.prior_weight * prior + volume)

    def plane(x: Float[Array, "2"]) -> Hypotheses:
        one = refine(scan, plane_echo, x, scene, clutter, settings)
        outside = hears_outside_cones(scene)
        weight = jnp.where(outside, 1, settings.missed_weight_plane)
        missed = weight * plane_missed_log_likelihood(scan, one, scene, settings)
        one = with_base(one, missed, plane_log_prior(scan, one, scene, settings))
        # Points have fewer echoes than a full wall.
        fraction = count(one.log_ratio > 0) / scan.full_wall_paths
        bonus = jnp.where(outside, 0, settings.full_wall_bonus)
        return one._replace(base=one.base + bonus * (fraction - settings.typical_fraction))

    def point(is_edge: Float[Array, ""], x: Float[Array, "2"]) -> Hypotheses:
        model = partial(point_echo, is_edge)
        one = refine(scan, model, x, scene, clutter, settings)
        missed = point_missed_log_likelihood(scan, model, is_edge, one, scene, settings, settings.edge_strength)
        prior = point_log_prior(scan, is_edge, one, scene, settings)
        return with_base(one, settings.missed_weight_point * missed, prior)

    planes = jax.vmap(plane)(start[PLANE])
    is_edge = jnp.repeat(jnp.asarray(_IS_EDGE, start.dtype), start.shape[1])
    points = jax.vmap(point)(is_edge, start[1:].reshape(-1, 2))
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), planes, points)


def select_reflectors(
    scan: ScanData,
    hypotheses: Hypotheses,
    usable: Bool[Array, " k"],
    scene: SceneEstimate,
    settings: DetectionSettings,
) -> Selection:
    """Select hypotheses greedily by their evidence, each with the echoes that are left when its turn comes."""
    positive = hypotheses.log_ratio > 0
    counted, exact = positive.astype(hypotheses.base.dtype), jax.lax.Precision.HIGHEST
    gains = jnp.concatenate([jnp.where(positive, hypotheses.log_ratio, 0), counted])
    usable_rows = jnp.tile(usable, 3) & jnp.isfinite(hypotheses.base)

    def select(left: Bool[Array, " echoes"], _: None):
        gain, echoes = jnp.dot(gains, left.astype(gains.dtype), precision=exact).reshape(2, -1)
        # Two echoes at least: one determines nothing.
        score = jnp.where(usable_rows & (echoes > 1.5), gain + hypotheses.base, -jnp.inf)
        best = score.argmax()
        involved = left & positive[best] & (score[best] > settings.min_evidence)
        return left & ~involved, (best, score, involved)

    _, (best, score, involved) = jax.lax.scan(select, scan.valid, None, length=settings.reflectors)
    evidence = jnp.take_along_axis(score, best[:, None], axis=1)[:, 0]
    # The kinds compete by their best hypotheses that explain at least half of the same echoes.
    shared = jnp.dot(involved.astype(counted.dtype), counted.T, precision=exact)
    half = 2 * shared >= involved.sum(axis=1, dtype=shared.dtype)[:, None]
    by_kind = jnp.where(half, score, -jnp.inf).reshape(len(best), 3, -1).max(axis=2)
    outside = hears_outside_cones(scene)
    handicap = jnp.where(outside, settings.plane_handicap_outside, settings.plane_handicap).astype(by_kind.dtype)
    log_odds = settings.tempering * by_kind.at[:, PLANE].add(-handicap)
    log_odds = jnp.where(jnp.isfinite(log_odds).any(axis=1, keepdims=True), log_odds, 0)
    return Selection(
        hypothesis=best,
        kind=best // len(usable),
        evidence=jnp.where(evidence > settings.min_evidence, evidence, -jnp.inf),
        involved=involved,
        log_odds=log_odds,
    )


def compare_with_circles(
    selection: Selection, evidence: Float[Array, " reflectors"], settings: DetectionSettings
) -> tuple[Int[Array, " reflectors"], Float[Array, "reflectors 4"]]:
    """The most likely kind of each reflector, and the probabilities of plane, corner, edge and circle.

    Args:
        selection: the selected reflectors, with the log odds of planes, corners and edges.
        evidence: of each of them as a circle, nats.
        settings: tempering of the evidence.
    """
    log_odds = jnp.concatenate([selection.log_odds, settings.tempering * evidence[:, None]], axis=1)
    probability = jax.nn.softmax(log_odds, axis=1)
    return jnp.where(probability.argmax(axis=1) == len(REFLECTOR_KINDS) - 1, CIRCLE, selection.kind), probability

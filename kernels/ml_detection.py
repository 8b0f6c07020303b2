"""What stands around the robot, given all echoes of a scan: the reflectors that explain them best, each echo once.

The ranges of the right echoes determine a line to a fraction of their noise; the work is to tell which echoes these are
and what they come from. Every candidate line of the Hough step is fitted as a plane, as a corner and as an edge. Then,
in a few passes over the whole scan, the reflectors with the most evidence are taken one after the other, each with the
echoes that are still free, and what was taken tells the next pass what to expect: where two walls reflect one sound,
where corners can be, which directions the walls of this place have, how many echoes get lost, how large the noise is.

Evidence is counted in nats (natural logarithms of probabilities):

- echoes: how much likelier each one is from this reflector, with Gaussian noise, than from clutter;
- silence: paths that should have heard the reflector and did not; a wall may end, an edge may be faint;
- expectation: how likely such a reflector is before any echo, in the volume that its covariance leaves (Laplace).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from . import hough_accumulator as hough
from . import isorange_arcs as arcs
from . import line_centroids as clusters
from . import measurement_model as reflectors
from .array_geometry import EchoPaths
from .geometry import fold_line, normal, tangent, wrap_angle
from .hough_accumulator import HoughSettings
from .hough_voting import Echoes, RingArcs, lines_of_scan, over_scans
from .measurement_model import Sighting
from .robust_fit import edge, fit, heard, plane

PLANE, CORNER, EDGE = 0, 1, 2
"""Kinds of reflectors, in the order of ``Explanation.probability``."""
_DIFFRACTS = (0.0, 1.0)  # corner, edge
_PASSES = 4
_STEPS = 2  # of the fit in each pass
_SECOND_ORDER_WALLS = 7  # of a scan's reflectors, those with the most evidence, between which sound is followed


@dataclass(frozen=True)
class Expectations:
    """What is expected of rooms and rings before any echo, and how the evidence is weighed.

    The counts and weights were chosen on rooms drawn at random (``jaxsonar.random_room``); they matter where the ranges
    leave it open what a reflector is, and hardly where they do not.
    """

    candidates: int = 20
    """Maxima of the accumulator that are fitted."""
    hypotheses: int = 12
    """Of them, those that are weighed as planes, corners and edges."""
    reflectors: int = 10
    """Reflectors that a scan can have."""
    peak: float = 0.1
    """Occupancy of a candidate, as a fraction of the points that a fully seen wall puts into its cell."""
    sigma: float = 0.006
    """Noise of the ranges to begin with where it is to be estimated, metres."""
    sigma_weight: float = 6.0
    """Number of echoes that the guess of the pass before counts for."""
    least_sigma: float = 1e-4
    """Metres; single precision and what sensors can do."""
    clutter: float = 0.5
    """Echoes a metre and path that nothing explains."""
    heard: float = 0.8
    """Share of the echoes inside the cones that arrive; a guess that the scan's own share adds to."""
    heard_weight: float = 8.0
    """Number of paths that this guess counts for."""
    blanking: float = 0.035
    """Metres behind an echo in which a path does not hear the next one."""
    planes: float = 3.0
    """Walls that a scan sees."""
    corners: float = 1.0
    """Right-angled corners that a scan sees."""
    edges: float = 0.3
    """Edges and poles that a scan sees."""
    corner_alone: float = 0.1
    """Share of the corners of which neither wall is seen."""
    corner_of_one: float = 0.15
    """Share of the corners of which one wall is seen; for each wall."""
    corner_of_two: float = 0.5
    """Share of the corners of which both walls are seen; for each pair."""
    edge_alone: float = 0.3
    """Share of the edges and poles that do not stand on the line of a wall."""
    square: float = 0.4
    """Share of the walls that are parallel or square to another one; a guess that the scan's own share adds to."""
    square_weight: float = 2.0
    """Number of walls that this guess counts for."""
    crossing: float = 2.0
    """Nats against a wall whose foot lies on the line of another wall, where a corner would be."""
    wall: float = 2.0
    """Length of walls, metres: one ends within a gap g between two feet with probability g / wall."""
    hidden: float = 6.0
    """Nats that silence costs at most: something may stand before a reflector."""
    faint: float = 1.0
    """Nats that silence off the axes costs at most at an edge, which may be faint."""
    full: float = 10.0
    """Nats for a wall that all its paths hear, against one that none hears: points answer to fewer of them."""
    usual: float = 0.55
    """Share of a full wall's echoes from which on there are more of them than expected of a point."""
    silence_plane: float = 0.7
    """Weight of the silence of a wall."""
    silence_point: float = 1.15
    """Weight of the silence of a corner or edge."""
    prior: float = 1.4
    """Weight of the expectations."""
    least: float = 6.0
    """Nats above clutter that a reflector needs."""
    temper: float = 0.44
    """From nats to the logarithm of odds: echoes of one reflector err together."""
    doubt: float = 2.5
    """Nats by which a wall must be likelier than a point for even odds: there are many points to choose from."""


class Explanation(eqx.Module):
    """The reflectors of scans, those with the most evidence first; kind -1 where there are fewer."""

    kind: Int[Array, "*scans reflectors"]
    """PLANE, CORNER or EDGE, the likeliest; -1 none."""
    parameters: Float[Array, "*scans reflectors 2"]
    """(rho, theta) of a plane, (x, y) of a corner or an edge; robot frame, metres, radians."""
    covariance: Float[Array, "*scans reflectors 2 2"]
    """Of the parameters, from the ranges' noise."""
    probability: Float[Array, "*scans reflectors 3"]
    """Of plane, corner and edge, given that it is one of them."""
    evidence: Float[Array, "*scans reflectors"]
    """Nats above clutter."""
    involved: Bool[Array, "*scans reflectors echoes"]
    """Echoes that each explains; no echo twice."""
    segment: Float[Array, "*scans reflectors 2 2"]
    """Planes: endpoints, the outermost feet of the sensors involved (paper, section 5), metres."""
    sigma: Float[Array, "*scans"]
    """Noise of the ranges, given or estimated, metres."""


class _Scan(NamedTuple):
    """ONE scan, ready to be explained."""

    paths: EchoPaths
    """All paths of the ring, their axis last: loops over them run along the memory."""
    echo: EchoPaths
    """The path of each echo, their axis last."""
    path: Array
    """(echoes,) its row."""
    reach: Array
    """(echoes,) corrected ranges, metres."""
    valid: Array
    """(echoes,) which of them are echoes."""
    max_range: Array
    full_wall: Array


class _Scene(NamedTuple):
    """What the passes so far say about the place."""

    wall: Array
    """(reflectors, 2) rho, theta."""
    covariance: Array
    """(reflectors, 2, 2) of them."""
    known: Array
    """(reflectors,) which of the rows are walls."""
    share: Array
    """Share of the expected echoes that arrive."""
    square: Array
    """Share of the walls that are parallel or square to another one."""
    sigma: Array
    """Noise of the ranges, metres."""


class _Support(NamedTuple):
    """What speaks for hypotheses."""

    parameters: Array
    """(2,)"""
    information: Array
    """(2, 2) inverse covariance."""
    gain: Array
    """(echoes,) nats that each echo brings; negative: another reflector's, or clutter."""
    foot: Array
    """(echoes,) where along a plane each echo is reflected."""
    residual: Array
    """(echoes,) metres."""
    base: Array
    """Nats of silence and expectation."""


Model = Callable[[Float[Array, "2"], EchoPaths], Sighting]


@partial(jax.jit, static_argnames=("settings", "expected"))
def explain(
    ring: RingArcs,
    echoes: Echoes,
    sigma: Float[Array, ""],
    *,
    settings: HoughSettings,
    expected: Expectations,
) -> Explanation:
    """Find the reflectors that explain a batch of scans, in one compiled step.

    Args:
        ring: arcs of the ring's paths.
        echoes: (scans, echoes) packed echoes.
        sigma: standard deviation of the ranges, metres; NaN: estimated for each scan.
        settings: of the Hough step.
        expected: what is expected of rooms and rings.
    """

    def one_scan(packed: Echoes) -> Explanation:
        # Candidates: maxima of the paper's accumulator.
        voting = lines_of_scan(ring, packed, settings)
        smooth = hough.lowpass(hough.accumulate(voting.cell, settings), settings)
        level = expected.peak * hough.votes_of(ring.full_wall, settings)
        rho, theta = hough.peaks(smooth, level, size=expected.candidates, settings=settings)
        # Each fitted as plane, corner and edge, robustly; the noise is not known yet to more than an order.
        echo = jax.tree.map(lambda leaf: leaf[packed.path], ring.paths)
        reach = jax.vmap(lambda r, o: arcs.corrected_range(r, range_offset=o, range_scale=ring.range_scale))(
            packed.range, echo.range_offset
        )
        valid = (reach > 0) & (reach < ring.max_range)
        paths, own = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), (ring.paths, echo))
        scan = _Scan(paths, own, packed.path, reach, valid, ring.max_range, ring.full_wall)
        known = jnp.isfinite(sigma)
        first = jnp.where(known, jnp.maximum(sigma, expected.least_sigma), expected.sigma)
        start, here = _fitted(ring, packed, rho, theta, first, expected)
        # Passes over the whole scan, each with what the one before has found.
        size = expected.reflectors
        walls, unknown, none = jnp.zeros((size, 2)), jnp.zeros((size, 2, 2)), jnp.zeros(size, bool)
        share, square = (jnp.asarray(guess, reach.dtype) for guess in (expected.heard, expected.square))
        scene = _Scene(walls, unknown, none, share, square, first)

        def look(state: tuple[_Scene, Float[Array, "3 k 2"]], _: None):
            scene, start = state
            supports = _weighed(scan, start, scene, expected)
            chosen = _chosen(scan, supports, here, expected)
            found = _taken(supports, chosen.hypothesis)
            scene = _learned(scan, found, chosen, scene, sigma, expected)
            return (scene, supports.parameters.reshape(start.shape)), (found, chosen, scene.sigma)

        _, passes = jax.lax.scan(look, (scene, start), None, length=_PASSES)
        found, chosen, noise = jax.tree.map(lambda leaf: leaf[-1], passes)
        _, kind, evidence, involved, probability = chosen
        is_plane = kind == PLANE
        rho, theta = fold_line(found.parameters[:, 0], found.parameters[:, 1])
        flipped = is_plane & (found.parameters[:, 0] < 0)
        covariance = jax.vmap(_inverse)(found.information)
        found = found._replace(
            parameters=jnp.where(is_plane[:, None], jnp.stack([rho, theta], axis=-1), found.parameters)
        )
        covariance = jnp.where(
            flipped[:, None, None], covariance * np.array([[[1.0, -1.0], [-1.0, 1.0]]], np.float32), covariance
        )
        segment = jax.vmap(lambda x, own: clusters.extent(x[0], x[1], echo.midpoint, own))(found.parameters, involved)
        return Explanation(
            kind=jnp.where(evidence > -jnp.inf, kind, -1),
            parameters=found.parameters,
            covariance=covariance,
            probability=probability,
            evidence=evidence,
            involved=involved,
            segment=segment,
            sigma=noise,
        )

    def nothing(packed: Echoes) -> Explanation:
        size, real = expected.reflectors, packed.range.dtype
        return Explanation(
            kind=jnp.full(size, -1),
            parameters=jnp.zeros((size, 2), real),
            covariance=jnp.zeros((size, 2, 2), real),
            probability=jnp.zeros((size, 3), real),
            evidence=jnp.full(size, -jnp.inf, real),
            involved=jnp.zeros((size, len(packed.path)), bool),
            segment=jnp.zeros((size, 2, 2), real),
            sigma=jnp.where(jnp.isfinite(sigma), sigma, jnp.asarray(expected.sigma, real)),
        )

    def one_or_none(packed: Echoes) -> Explanation:  # padding costs nothing where scans come one after the other
        return jax.lax.cond(jnp.isfinite(packed.range).any(), one_scan, nothing, packed)

    return over_scans(one_or_none, echoes)


def _fitted(
    ring: RingArcs,
    packed: Echoes,
    rho: Float[Array, " candidates"],
    theta: Float[Array, " candidates"],
    sigma: Float[Array, ""],
    expected: Expectations,
) -> tuple[Float[Array, "3 k 2"], Bool[Array, " k"]]:
    """The best candidates as planes, corners and edges, each fitted robustly to the echoes around it.

    Returns:
        Parameters, and which of the rows are candidates.
    """
    echo = heard(ring, packed)
    tolerance = 2.5 * sigma
    widest = jnp.maximum(0.04, tolerance)  # m: a cell of the accumulator
    here = jnp.isfinite(rho)
    starts = jnp.stack([jnp.where(here, rho, 1), jnp.where(here, theta, 0)], axis=-1)
    lines, scores = jax.vmap(lambda x: fit(plane, x, echo, tolerance=tolerance, widest=widest))(starts)
    # Candidates that came to the same line are one.
    total = jnp.where(here, scores.sum(axis=1), -1)
    near = jnp.abs(lines[:, None, 0] - lines[None, :, 0]) < 0.005
    near &= jnp.abs(wrap_angle(lines[:, None, 1] - lines[None, :, 1])) < 0.01
    rank = jnp.arange(len(total))
    better = (total[None, :] > total[:, None]) | ((total[None, :] == total[:, None]) & (rank[None, :] < rank[:, None]))
    total = jnp.where((near & better).any(axis=1), -1, total)
    total, best = jax.lax.top_k(total, expected.hypotheses)

    def point(diffracts: Float[Array, ""], line: Float[Array, "2"], score: Float[Array, " echoes"]):
        # It begins in the middle of what the plane explains. A corner sends and hears as if from the virtual sensor.
        middle, half = (echo.tx + echo.rx) / 2, (echo.rx - echo.tx) / 2 * diffracts
        foot = middle @ tangent(line[1])
        place = line[0] * normal(line[1]) + (score * foot).sum() / jnp.maximum(score.sum(), 1e-6) * tangent(line[1])
        legs = eqx.tree_at(lambda e: (e.tx, e.rx), echo, (middle - half, middle + half))
        return fit(edge, place, legs, tolerance=tolerance, widest=tolerance)[0]

    points = jax.vmap(jax.vmap(point, in_axes=(None, 0, 0)), in_axes=(0, None, None))
    both = points(jnp.asarray(_DIFFRACTS, rho.dtype), lines[best], scores[best])
    return jnp.concatenate([lines[best][None], both]), total > 0


def _weighed(scan: _Scan, start: Float[Array, "3 k 2"], scene: _Scene, expected: Expectations) -> _Support:
    """The support of every candidate as every kind, (3 k, ...), planes first."""
    clutter = jnp.log(expected.clutter + _second_order(scan, scene))

    def support(model: Model, x: Float[Array, "2"]) -> _Support:
        return _refined(scan, model, x, scene, clutter)

    def with_base(found: _Support, silence: Float[Array, ""], prior: Float[Array, ""]) -> _Support:
        volume = jnp.log(2 * jnp.pi) - 0.5 * jnp.log(_determinant(found.information) + 1)
        return found._replace(base=silence + expected.prior * prior + volume)

    def plane(x: Float[Array, "2"]) -> _Support:
        found = support(reflectors.plane, x)
        silence = expected.silence_plane * _silence_of_plane(scan, found, scene, expected)
        found = with_base(found, silence, _plane_prior(scan, found, scene, expected))
        share = _count(found.gain > 0) / scan.full_wall
        return found._replace(base=found.base + expected.full * (share - expected.usual))

    def point(diffracts: Float[Array, ""], x: Float[Array, "2"]) -> _Support:
        model = partial(_point, diffracts)
        found = support(model, x)
        silence = expected.silence_point * _silence_of_point(scan, model, diffracts, found, scene, expected)
        return with_base(found, silence, _point_prior(scan, diffracts, found, scene, expected))

    planes = jax.vmap(plane)(start[PLANE])
    points = jax.vmap(point)(jnp.repeat(jnp.asarray(_DIFFRACTS, start.dtype), start.shape[1]), start[1:].reshape(-1, 2))
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), planes, points)


def _point(diffracts: Float[Array, ""], place: Float[Array, "2"], path: EchoPaths) -> Sighting:
    """A corner (0), which sends and hears as if from the virtual sensor, or an edge (1), each leg for itself."""
    return reflectors.edge(place, eqx.tree_at(lambda p: p.half_baseline, path, diffracts * path.half_baseline))


def _refined(
    scan: _Scan, model: Model, x: Float[Array, "2"], scene: _Scene, clutter: Float[Array, " echoes"]
) -> _Support:
    """Maximum likelihood over the ranges: each echo weighs as much as it is likely to come from this reflector."""

    def look(x: Float[Array, "2"], echo: EchoPaths):
        sighting = model(x, echo)
        return sighting, reflectors.heard_share(sighting, echo)

    def step(x: Float[Array, "2"], _: None):
        sighting, share = jax.vmap(look, in_axes=(None, -1), out_axes=-1)(x, scan.echo)
        share, residual, (a, b) = scene.share * share, scan.reach - sighting.range, sighting.slope
        odds = jnp.log(share / (1 - share) + 1e-9) + _gauss(residual, scene.sigma) - clutter
        gain = jnp.where(scan.valid, odds, -jnp.inf)
        weight = jax.nn.sigmoid(gain) / scene.sigma**2
        aa, ab, bb = (weight * a * a).sum(), (weight * a * b).sum(), (weight * b * b).sum()
        information = jnp.stack([jnp.stack([aa, ab]), jnp.stack([ab, bb])])
        pull = jnp.stack([(weight * residual * a).sum(), (weight * residual * b).sum()])
        x = x + jnp.clip(_inverse(information) @ pull, -0.05, 0.05)
        return x, (information, gain, sighting.foot, residual)

    x, looks = jax.lax.scan(step, x, None, length=_STEPS)
    information, gain, foot, residual = jax.tree.map(lambda leaf: leaf[-1], looks)  # the last step is tiny
    return _Support(x, information, gain, foot, residual, jnp.zeros(()))


class _Silence(NamedTuple):
    """What all paths should have heard of a reflector, and the echoes that excuse some of them."""

    foot: Array
    """(paths,) as ``Sighting``."""
    share: Array
    """(paths,) how far it lies within the cones and the maximum range."""
    off_axis: Array
    """(paths,)"""
    cost: Array
    """(paths,) nats that each path costs if it heard nothing."""
    echo_foot: Array
    """(echoes,)"""
    echo_off_axis: Array
    """(echoes,)"""
    excuse: Array
    """(echoes,) nats by which each echo excuses its path: it is heard, or its blanking hides the reflector."""

    def total(self, paths: Bool[Array, " paths"], echoes: Bool[Array, " echoes"]) -> Float[Array, ""]:
        """Nats, at most 0, that some of the paths cost."""
        return jnp.minimum(jnp.where(paths, self.cost, 0).sum() - jnp.where(echoes, self.excuse, 0).sum(), 0)


def _silence(scan: _Scan, model: Model, support: _Support, scene: _Scene, expected: Expectations) -> _Silence:
    """What the paths should have heard of a reflector."""

    def look(path: EchoPaths):
        sighting = model(support.parameters, path)
        near = sighting.range < scan.max_range - 1e-3 - 2 * scene.sigma
        share = jnp.where(near, reflectors.heard_share(sighting, path), 0)
        cost = jnp.log(1 - scene.share * share)
        return sighting.range, sighting.foot, share, reflectors.off_axis(sighting, path), cost

    looks = jax.vmap(look, in_axes=-1, out_axes=-1)
    _, foot, share, off_axis, cost = looks(scan.paths)
    reach, echo_foot, _, echo_off_axis, excuse = looks(scan.echo)
    behind = scan.reach - reach
    excused = scan.valid & (behind < 4 * scene.sigma) & (behind > -expected.blanking - 4 * scene.sigma)
    return _Silence(foot, share, off_axis, cost, echo_foot, echo_off_axis, jnp.where(excused, excuse, 0))


def _silence_of_point(
    scan: _Scan,
    model: Model,
    diffracts: Float[Array, ""],
    support: _Support,
    scene: _Scene,
    expected: Expectations,
) -> Float[Array, ""]:
    """Nats, at most 0, that the paths cost which should have heard a corner or an edge and did not."""
    silence = _silence(scan, model, support, scene, expected)
    # A faint edge is heard near the axes only.
    border = jnp.where(support.gain > 0, silence.echo_off_axis, 0).max() + 1e-3
    border = jnp.where(diffracts > 0, border, jnp.inf)
    inside = silence.total(silence.off_axis < border, silence.echo_off_axis < border)
    outside = silence.total(silence.off_axis >= border, silence.echo_off_axis >= border)
    return jnp.maximum(inside, -expected.hidden) + jnp.maximum(outside, -expected.faint)


def _silence_of_plane(scan: _Scan, support: _Support, scene: _Scene, expected: Expectations) -> Float[Array, ""]:
    """Nats, at most 0, that silent paths cost a wall; it may end beyond its outermost feet, before the next of them."""
    silence = _silence(scan, reflectors.plane, support, scene, expected)
    foot, echo_foot, mine = silence.foot, silence.echo_foot, support.gain > 0
    low, high = jnp.where(mine, support.foot, jnp.inf).min(), jnp.where(mine, support.foot, -jnp.inf).max()
    inside = silence.total((foot >= low) & (foot <= high), (echo_foot >= low) & (echo_foot <= high))
    nats = jnp.maximum(inside, -expected.hidden)
    for gap, echo_gap in ((low - foot, low - echo_foot), (foot - high, echo_foot - high)):
        next_silent = jnp.where((silence.share > 0.4) & (gap > 1e-3), gap, jnp.inf).min()
        ends = jnp.log(jnp.clip(next_silent, 0.02, expected.wall) / expected.wall)
        nats += jnp.where(jnp.isfinite(next_silent), jnp.maximum(silence.total(gap > 0, echo_gap > 0), ends), 0)
    return nats


def _plane_prior(scan: _Scan, support: _Support, scene: _Scene, expected: Expectations) -> Float[Array, ""]:
    """Nats before any echo: anywhere, rather square to other walls, not across their corners."""
    rho, theta = support.parameters
    density = jnp.log(expected.planes / (2 * jnp.pi * scan.max_range))
    turn = wrap_angle(scene.wall[:, 1] - theta)
    short = scene.wall[:, 0] - normal(scene.wall[:, 1]) @ (rho * normal(theta))
    crossing = (scene.known & (jnp.abs(short) < 0.06) & _oblique(turn)).any()
    square = _squareness(support.parameters, _inverse(support.information)[1, 1], scene)
    direction = jnp.log(1 - scene.square + scene.square * square)
    density += direction - jnp.where(crossing, expected.crossing, 0)
    return density


def _squareness(line: Float[Array, "2"], variance: Float[Array, ""], scene: _Scene) -> Float[Array, ""]:
    """How much likelier this direction is than any other if walls are parallel or square; 1 without another wall."""
    turn = wrap_angle(scene.wall[:, 1] - line[1])
    itself = (jnp.abs(scene.wall[:, 0] - line[0]) < 0.08) & (jnp.abs(turn) < 0.15)
    skew = jnp.abs(jnp.mod(turn + jnp.pi / 4, jnp.pi / 2) - jnp.pi / 4)  # to the next quarter turn
    spread = jnp.sqrt(variance + scene.covariance[:, 1, 1] + np.radians(0.5) ** 2)
    others = scene.known & ~itself
    square = jnp.where(others, jnp.exp(_gauss(skew, spread)) * jnp.pi / 2, 0).max()
    return jnp.where(others.any(), square, 1)


def _point_prior(
    scan: _Scan, diffracts: Float[Array, ""], support: _Support, scene: _Scene, expected: Expectations
) -> Float[Array, ""]:
    """Nats before any echo: corners are where walls meet, edges where they end; both also where no wall is seen."""
    place = support.parameters
    n, along = normal(scene.wall[:, 1]), tangent(scene.wall[:, 1]) @ place
    own = jnp.einsum("wi,ij,wj->w", n, _inverse(support.information), n)
    c = scene.covariance
    lever = c[:, 0, 0] - 2 * along * c[:, 0, 1] + along**2 * c[:, 1, 1]  # the line's uncertainty, here
    off = scene.wall[:, 0] - n @ place
    bearing = jnp.arctan2(place[1], jnp.where((place == 0).all(), 1, place[0]))
    beside = scene.known & _oblique(wrap_angle(scene.wall[:, 1] - bearing))  # not the point itself taken for a wall
    on_wall = jnp.where(beside, jnp.exp(_gauss(off, jnp.sqrt(own + lever + scene.sigma**2))), 0)
    anywhere = 1 / (jnp.pi * scan.max_range**2)
    along_one = on_wall.sum() / (2 * scan.max_range)
    beside_walls = along_one / jnp.maximum(_count(scene.known), 1)
    edges = expected.edges * (expected.edge_alone * anywhere + (1 - expected.edge_alone) * beside_walls)
    angle = jnp.abs(wrap_angle(scene.wall[:, None, 1] - scene.wall[None, :, 1])) - jnp.pi / 2
    right = angle**2 < 9 * (c[:, None, 1, 1] + c[None, :, 1, 1] + np.radians(0.5) ** 2)
    at_two = jnp.triu(jnp.where(right, on_wall[:, None] * on_wall[None, :], 0), 1).sum()
    corners = expected.corner_alone * anywhere + expected.corner_of_one * along_one + expected.corner_of_two * at_two
    return jnp.log(jnp.where(diffracts > 0, edges, expected.corners * corners))


def _second_order(scan: _Scan, scene: _Scene) -> Float[Array, " echoes"]:
    """How dense echoes from wall to wall are expected at each echo's range, 1/m."""
    size = min(len(scene.known), _SECOND_ORDER_WALLS)
    first, second = np.nonzero(~np.eye(size, dtype=bool))

    def pair(first: Float[Array, "2"], second: Float[Array, "2"], known: Bool[Array, ""]) -> Float[Array, " echoes"]:
        def one(path: EchoPaths, reach: Float[Array, ""]) -> Float[Array, ""]:
            sighting = reflectors.second_order(first, second, path)
            spread = 2 * scene.sigma + 0.002
            return reflectors.heard_share(sighting, path) * jnp.exp(_gauss(reach - sighting.range, spread))

        return jnp.where(known, scene.share * jax.vmap(one, in_axes=-1)(scan.echo, scan.reach), 0)

    known = scene.known[first] & scene.known[second]
    densities = jax.vmap(pair)(scene.wall[first], scene.wall[second], known)
    return jnp.where(scan.valid, densities.max(axis=0), 0)


class _Chosen(NamedTuple):
    """Reflectors in the order of their evidence."""

    hypothesis: Array
    """(reflectors,) its row."""
    kind: Array
    """(reflectors,) PLANE, CORNER or EDGE."""
    evidence: Array
    """(reflectors,) nats; -inf where no reflector has enough."""
    involved: Array
    """(reflectors, echoes) those that were left when its turn came."""
    probability: Array
    """(reflectors, 3) of the kinds, for these echoes."""


def _chosen(scan: _Scan, supports: _Support, here: Bool[Array, " k"], expected: Expectations) -> _Chosen:
    """Reflectors in the order of their evidence, each with the echoes that are left when its turn comes."""
    positive = supports.gain > 0
    counted, exact = positive.astype(supports.base.dtype), jax.lax.Precision.HIGHEST
    worth = jnp.concatenate([jnp.where(positive, supports.gain, 0), counted])
    open_ = jnp.tile(here, 3) & jnp.isfinite(supports.base)

    def take(free: Bool[Array, " echoes"], _: None):
        gain, several = jnp.dot(worth, free.astype(worth.dtype), precision=exact).reshape(2, -1)
        score = jnp.where(open_ & (several > 1.5), gain + supports.base, -jnp.inf)  # fewer than two determine nothing
        best = score.argmax()
        own = free & positive[best] & (score[best] > expected.least)
        return free & ~own, (best, score, own)

    _, (best, score, own) = jax.lax.scan(take, scan.valid, None, length=expected.reflectors)
    evidence = jnp.take_along_axis(score, best[:, None], axis=1)[:, 0]
    # Its rivals are hypotheses of any kind that explain at least half of its echoes.
    shared = jnp.dot(own.astype(counted.dtype), counted.T, precision=exact)
    rivals = jnp.where(2 * shared >= own.sum(axis=1, dtype=shared.dtype)[:, None], score, -jnp.inf)
    of_kind = rivals.reshape(len(best), 3, -1).max(axis=2)
    odds = expected.temper * (of_kind - jnp.asarray([expected.doubt, 0, 0], of_kind.dtype)[None])
    odds = jnp.where(jnp.isfinite(odds).any(axis=1, keepdims=True), odds, 0)
    return _Chosen(
        hypothesis=best,
        kind=best // len(here),
        evidence=jnp.where(evidence > expected.least, evidence, -jnp.inf),
        involved=own,
        probability=jax.nn.softmax(odds, axis=1),
    )


def _taken(supports: _Support, index: Int[Array, " reflectors"]) -> _Support:
    return jax.tree.map(lambda leaf: leaf[index], supports)


def _learned(
    scan: _Scan, found: _Support, chosen: _Chosen, scene: _Scene, sigma: Float[Array, ""], expected: Expectations
) -> _Scene:
    """What the reflectors of a pass tell the next one."""
    _, kind, evidence, involved, _ = chosen
    wall = (kind == PLANE) & (evidence > -jnp.inf)
    covariance = jax.vmap(_inverse)(found.information)
    # The share of the paths well inside all cones and between the outermost feet that heard their wall.
    low = jnp.where(involved, found.foot, jnp.inf).min(axis=1) + 1e-3
    high = jnp.where(involved, found.foot, -jnp.inf).max(axis=1) - 1e-3

    def certain(line: Float[Array, "2"], low: Float[Array, ""], high: Float[Array, ""], path: EchoPaths):
        sighting = reflectors.plane(line, path)
        near = sighting.range < scan.max_range - 1e-3 - 2 * scene.sigma
        between = (sighting.foot > low) & (sighting.foot < high)
        return near & between & (reflectors.heard_share(sighting, path) > 0.95)

    each_path = jax.vmap(jax.vmap(certain, in_axes=(None, None, None, -1)), in_axes=(0, 0, 0, None))
    sure = each_path(found.parameters, low, high, scan.paths) & wall[:, None]
    asked, answered = _count(sure), _count(sure[:, scan.path] & involved)
    weight = expected.heard_weight
    share = jnp.clip((weight * expected.heard + answered) / (weight + asked), 0.3, 0.97)
    # Noise: what is left between ranges and walls; two of each wall's residuals are spent on the wall itself.
    many = wall & (involved.sum(axis=1) >= 4)
    left = jnp.where(involved & many[:, None], found.residual**2, 0).sum()
    free = _count(involved & many[:, None]) - 2 * _count(many)
    guess = expected.sigma_weight * scene.sigma**2
    estimate = jnp.sqrt((guess + left) / (expected.sigma_weight + free))
    # The share of the walls that are parallel or square to another one.
    known = scene._replace(wall=found.parameters, covariance=covariance, known=wall)
    square = jax.vmap(lambda line, c: _squareness(line, c[1, 1], known))(found.parameters, covariance)
    member = scene.square * square / (1 - scene.square + scene.square * square)
    squares = jnp.where(wall, member, 0).sum() + expected.square_weight * expected.square
    return known._replace(
        share=share,
        square=squares / (_count(wall) + expected.square_weight),
        sigma=jnp.where(jnp.isfinite(sigma), scene.sigma, jnp.maximum(estimate, expected.least_sigma)),
    )


def _count(which: Bool[Array, "*any"]) -> Float[Array, ""]:
    return which.sum(dtype=jnp.float32)


def _oblique(turn: Float[Array, "*any"]) -> Bool[Array, "*any"]:
    """Directions that differ by 11 to 126 deg: of a wall, and of a point on its line that is not its foot."""
    return (jnp.abs(turn) > 0.2) & (jnp.abs(turn) < 2.2)


def _gauss(x: Float[Array, "*any"], sigma: Float[Array, "*#any"]) -> Float[Array, "*any"]:
    """Logarithm of the normal density."""
    return -0.5 * (x / sigma) ** 2 - jnp.log(sigma * np.sqrt(2 * np.pi))


def _determinant(m: Float[Array, "2 2"]) -> Float[Array, ""]:
    return jnp.maximum(m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0], 0)


def _inverse(m: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    """Inverse of an information matrix; one that is not determined gets a large variance instead of an infinite one."""
    a, b, d = m[0, 0] * (1 + 1e-5) + 1, m[0, 1], m[1, 1] * (1 + 1e-5) + 1
    return jnp.stack([jnp.stack([d, -b]), jnp.stack([-b, a])]) / (a * d - b * b)

"""What all scans heard, as targets whose kind is open: groups of echoes that one wall, corner or edge explains.

The ranges of ``kernels.reflectors`` in NumPy, for sensors anywhere in the world: placing evaluates them thousands of
times on arrays that are small and differ in shape.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.stats import chi2

from jaxsonar import kernels
from jaxsonar.detection.extract import LocalModel
from jaxsonar.geometry.se2 import unit
from jaxsonar.scans.echo_batches import echoes_of, exact_paths
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring

KINDS = kernels.PLANE, kernels.CORNER, kernels.EDGE
_DECIDED = 0.8  # probability of a line of a local model
_LEAST_ODDS = 0.02  # probability of any kind
_OUT = 3.5  # sigma; an echo farther off is of something else
_ODD = 0.003  # chance of residuals that are larger
_STEPS = 6
_SLOTS = 4  # echoes of one path


class Range(NamedTuple):
    """What paths measure of reflectors, and how that changes."""

    reach: Float[np.ndarray, "..."]
    """Half the path length, metres."""
    own: Float[np.ndarray, "... 2"]
    """Slope by the reflector's two parameters."""
    middle: Float[np.ndarray, "... 2"]
    """Gradient by the midpoint of the sensors."""
    base: Float[np.ndarray, "... 2"]
    """Gradient by half their baseline."""

    @property
    def leaving(self) -> Float[np.ndarray, "... 2"]:
        """Unit vectors along which the sound leaves the transmitters."""
        return self.base - self.middle

    @property
    def arriving(self) -> Float[np.ndarray, "... 2"]:
        """Unit vectors from the receivers to where the sound comes from."""
        return -self.base - self.middle


def plane(
    place: Float[np.ndarray, "*#batch 2"], middle: Float[np.ndarray, "*#batch 2"], base: Float[np.ndarray, "*#batch 2"]
) -> Range:
    """Walls (rho, theta), rho of either sign; midpoints and half baselines of the sensors, metres."""
    rho, cos, sin = place[..., 0], np.cos(place[..., 1]), np.sin(place[..., 1])
    mx, my, bx, by = middle[..., 0], middle[..., 1], base[..., 0], base[..., 1]
    height, across = rho - (mx * cos + my * sin), by * cos - bx * sin
    reach = np.sqrt(height * height + across * across)
    upright, along = height / reach, across / reach
    turn = -(upright * (my * cos - mx * sin) + along * (bx * cos + by * sin))
    return Range(
        reach,
        np.stack([upright, turn], axis=-1),
        np.stack([-cos * upright, -sin * upright], axis=-1),
        np.stack([-sin * along, cos * along], axis=-1),
    )


def corner(
    place: Float[np.ndarray, "*#batch 2"], middle: Float[np.ndarray, "*#batch 2"], base: Float[np.ndarray, "*#batch 2"]
) -> Range:
    """Right-angled corners (x, y)."""
    away = place - middle
    reach = np.sqrt(away[..., 0] ** 2 + away[..., 1] ** 2)
    towards = away / reach[..., None]
    return Range(reach, towards, -towards, np.zeros_like(towards))


def edge(
    place: Float[np.ndarray, "*#batch 2"], middle: Float[np.ndarray, "*#batch 2"], base: Float[np.ndarray, "*#batch 2"]
) -> Range:
    """Edges and thin poles (x, y)."""
    away = place - middle
    out, back = away + base, away - base
    first, second = (np.sqrt(leg[..., 0] ** 2 + leg[..., 1] ** 2) for leg in (out, back))
    out, back = out / first[..., None], back / second[..., None]
    mean = (out + back) / 2
    return Range((first + second) / 2, mean, -mean, (out - back) / 2)


OF_KIND = {kernels.PLANE: plane, kernels.CORNER: corner, kernels.EDGE: edge}


def expected(
    kind: Int[np.ndarray, " rows"],
    place: Float[np.ndarray, "rows *#batch 2"],
    middle: Float[np.ndarray, "#rows *#batch 2"],
    base: Float[np.ndarray, "#rows *#batch 2"],
) -> Range:
    """What is measured of reflectors of all kinds, one a row."""
    if len(kind) and (kind == kind[0]).all():
        return OF_KIND[int(kind[0])](place, middle, base)
    shape = np.broadcast_shapes(place.shape, middle.shape, base.shape)
    out = Range(np.empty(shape[:-1]), np.empty(shape), np.empty(shape), np.empty(shape))
    for one, measured in OF_KIND.items():
        rows = np.flatnonzero(kind == one)
        if len(rows):
            given = (array[rows] if len(array) > 1 else array for array in (place, middle, base))
            for whole, part in zip(out, measured(*given), strict=True):
                whole[rows] = part
    return out


class Heard(NamedTuple):
    """Echoes, flat, in the frames of their robots."""

    scan: Int[np.ndarray, " echoes"]
    target: Int[np.ndarray, " echoes"]
    """Row of ``Targets``; -1 for none."""
    range: Float[np.ndarray, " echoes"]
    """Half path lengths, corrected, metres."""
    path: Int[np.ndarray, " echoes"]
    """Row of the ring's paths."""
    middle: Float[np.ndarray, "echoes 2"]
    """Virtual sensor."""
    base: Float[np.ndarray, "echoes 2"]
    """Half the way from transmitter to receiver."""


class Targets(NamedTuple):
    """What scans heard as one thing, in the frames of their robots."""

    scan: Int[np.ndarray, " targets"]
    plane: Float[np.ndarray, "targets 2"]
    """(rho, theta), if it is a wall."""
    point: Float[np.ndarray, "targets 2"]
    """(x, y), if it is none."""
    odds: Float[np.ndarray, "targets 3"]
    """Logarithm of the probability of each kind, by the local model."""


class Geometry(NamedTuple):
    """Of echo paths, as ``kernels.EchoPaths`` has it."""

    middle: Float[np.ndarray, "paths 2"]
    base: Float[np.ndarray, "paths 2"]
    axes: Float[np.ndarray, "paths 2 2"]
    cone: Float[np.ndarray, "paths 2"]

    def take(self, rows: Int[np.ndarray, " rows"]) -> "Geometry":
        """Some of them."""
        return Geometry(*(column[rows] for column in self))


@dataclass(frozen=True, eq=False)
class Views:
    """All scans, as their local models see them."""

    ring: Ring
    sigma: float
    """Noise of the ranges, metres."""
    echoes: Heard
    """Those of the targets."""
    loose: Heard
    """All others."""
    targets: Targets
    ranges: Float[np.ndarray, "scans paths slots"]
    """All ranges, metres; infinite where there is no echo."""
    paths: Geometry

    @classmethod
    def of(cls, ring: Ring, log: Log, models: Sequence[LocalModel], sigma: float) -> "Views":
        """Scans and their local models; ``sigma``: noise of the ranges, metres."""
        own = exact_paths(ring)
        paths = Geometry(*(np.asarray(leaf) for leaf in (own.midpoint, own.half_baseline, own.axes, own.cone)))
        ranges = np.full((len(models), len(ring.paths), _SLOTS), np.inf)
        echoes: list[tuple[np.ndarray, ...]] = []
        targets: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]] = []
        for row, model in enumerate(models):
            path, reach = echoes_of(ring, log[row])
            order = np.lexsort((reach, path))
            path, reach = path[order], reach[order]
            slot = np.arange(len(path)) - np.searchsorted(path, path)
            kept = slot < _SLOTS
            ranges[row, path[kept], slot[kept]] = reach[kept]
            target = np.full(len(path), -1)
            for place, point, odds, its in _targets_of(model):
                free = np.flatnonzero(np.isin(path, ring.path_index[its[:, 0], its[:, 1]]) & (target < 0))
                mine = free[_of_one(place, point, path[free], reach[free], paths, sigma)]
                if len(mine):
                    target[mine] = len(targets)
                    targets.append((row, place, point, odds))
            echoes.append((np.full(len(path), row), target, reach, path))
        scan, target, reach, path = _columns(echoes)
        flat = Heard(scan, target, reach, path, paths.middle[path], paths.base[path])
        some, rest = (Heard(*(column[rows] for column in flat)) for rows in (target >= 0, target < 0))
        return cls(ring, sigma, some, rest, _as_targets(targets), ranges, paths)

    @cached_property
    def near(self) -> Int[np.ndarray, " some"]:
        """Paths between sensors that look about the same way."""
        width = np.asarray(self.ring.echo_paths.width)
        return np.flatnonzero(width > 0.5 * width.max())


def _columns(
    echoes: Sequence[tuple[np.ndarray, ...]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Scan, target, range and path of all echoes."""
    none = np.zeros(0, dtype=np.int64)
    whole = [np.concatenate(column) for column in zip((none, none, np.zeros(0), none), *echoes, strict=True)]
    return whole[0], whole[1], whole[2], whole[3]


def _as_targets(rows: Sequence[tuple[int, np.ndarray, np.ndarray, np.ndarray]]) -> Targets:
    scan = np.array([row[0] for row in rows], dtype=np.int64)
    plane_, point = (np.array([row[k] for row in rows], dtype=np.float64).reshape(-1, 2) for k in (1, 2))
    return Targets(scan, plane_, point, np.array([row[3] for row in rows], dtype=np.float64).reshape(-1, 3))


def _targets_of(model: LocalModel) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """As a wall, as a point, log odds of the kinds, and paths of all that a local model has."""
    rest = (1 - _DECIDED) / 2
    for line in model.lines:
        place = np.array([line.rho, line.theta])
        yield place, line.rho * unit(line.theta), np.log([_DECIDED, rest, rest]), line.paths
    for one in model.points:
        odds = np.full(3, max((1 - one.probability) / 2, _LEAST_ODDS))
        odds[kernels.CORNER if one.kind == "corner" else kernels.EDGE] = one.probability
        point = np.array([one.x, one.y])
        yield np.array([np.hypot(*point), np.arctan2(one.y, one.x)]), point, np.log(odds), one.paths
    for other in model.undecided:
        odds = np.array([other.probability[name] for name in ("plane", "corner", "edge")])
        place, point = np.array([other.rho, other.theta]), np.array([other.x, other.y])
        yield place, point, np.log(np.maximum(odds, _LEAST_ODDS)), other.paths


def _of_one(
    place: Float[np.ndarray, "2"],
    point: Float[np.ndarray, "2"],
    path: Int[np.ndarray, " echoes"],
    reach: Float[np.ndarray, " echoes"],
    paths: Geometry,
    sigma: float,
) -> Int[np.ndarray, " some"]:
    """Echoes that one reflector explains, one a path; none if no kind of reflector explains them well."""
    if not len(path):
        return np.zeros(0, dtype=np.int64)
    middle, base = paths.middle[path], paths.base[path]
    starts = {kind: place if kind == kernels.PLANE else point for kind in KINDS}
    off = np.min([np.abs(OF_KIND[k](at[None], middle, base).reach - reach) for k, at in starts.items()], axis=0)
    order = np.argsort(off, kind="stable")
    mine = order[np.unique(path[order], return_index=True)[1]]
    mine = mine[off[mine] < 6 * sigma + 0.02]
    if len(mine) < 2:
        return np.zeros(0, dtype=np.int64)
    fits = [_residuals(k, at, reach[mine], middle[mine], base[mine], sigma) for k, at in starts.items()]
    best = min(fits, key=lambda off: float(np.square(np.minimum(off, _OUT)).sum()))
    good = best < _OUT
    odd = chi2.sf(np.square(best[good]).sum(), max(int(good.sum()) - 2, 1)) < _ODD
    return mine[good] if good.sum() >= 2 and not odd else np.zeros(0, dtype=np.int64)


def _residuals(
    kind: int,
    place: Float[np.ndarray, "2"],
    reach: Float[np.ndarray, " echoes"],
    middle: Float[np.ndarray, "echoes 2"],
    base: Float[np.ndarray, "echoes 2"],
    sigma: float,
) -> Float[np.ndarray, " echoes"]:
    """By how many sigma echoes are off the reflector of this kind that fits them best (Geman and McClure)."""
    place, scale = place.copy(), 8 * sigma
    for _ in range(_STEPS):
        measured = OF_KIND[kind](place[None], middle, base)
        left = reach - measured.reach
        weight = 1 / np.square(1 + np.square(left / scale))
        scale = max(scale / 2, 3 * sigma)
        information = measured.own.T @ (weight[:, None] * measured.own) + 1e-4 * np.eye(2)
        place += np.clip(np.linalg.solve(information, measured.own.T @ (weight * left)), -0.1, 0.1)
    return np.abs(reach - OF_KIND[kind](place[None], middle, base).reach) / sigma

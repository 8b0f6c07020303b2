"""Echo groups: the echoes of one scan that one wall, corner or edge explains, for many scans."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import chi2

from jaxsonar import kernels
from jaxsonar.detection.local_model import LocalModel
from jaxsonar.geometry.se2 import unit
from jaxsonar.registration.reflector_fit import fit_reflectors
from jaxsonar.registration.settings import RANGE_SETTINGS as SETTINGS
from jaxsonar.scans.flat_echoes import corrected_echoes
from jaxsonar.scans.measured_paths import measured_paths
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.range_models import KINDS, RANGE_OF_KIND
from jaxsonar.sensors.ring import Ring


class GroupedEchoes(NamedTuple):
    """Echoes as flat arrays, in the frames of their robots."""

    scan: Int[np.ndarray, " echoes"]
    group: Int[np.ndarray, " echoes"]
    """Row of ``EchoGroups``; -1 for unassigned echoes."""
    range: Float[np.ndarray, " echoes"]
    """Half path lengths, corrected, metres."""
    path: Int[np.ndarray, " echoes"]
    """Row of the ring's paths."""
    midpoint: Float[np.ndarray, "echoes 2"]
    """Midpoint between transmitter and receiver, metres."""
    half_baseline: Float[np.ndarray, "echoes 2"]
    """Half the vector from transmitter to receiver, metres."""


class EchoGroups(NamedTuple):
    """Groups of echoes whose kind of reflector is undecided, in the frames of their robots."""

    scan: Int[np.ndarray, " groups"]
    plane: Float[np.ndarray, "groups 2"]
    """(rho, theta) if the reflector is a wall, metres and radians."""
    point: Float[np.ndarray, "groups 2"]
    """(x, y) if it is a corner or an edge, metres."""
    log_prior: Float[np.ndarray, "groups 3"]
    """Log-probability of each kind according to the local model."""


class _EchoGroup(NamedTuple):
    """One row of ``EchoGroups``, with the paths (transmitter, receiver) of its echoes."""

    plane: Float[np.ndarray, "2"]
    point: Float[np.ndarray, "2"]
    log_prior: Float[np.ndarray, "3"]
    paths: Int[np.ndarray, "echoes 2"]


@dataclass(frozen=True, eq=False)
class ScanObservations:
    """The echoes of all scans, and their groups."""

    ring: Ring
    sigma: float
    """Standard deviation of the ranges, metres."""
    grouped: GroupedEchoes
    """Echoes that belong to a group."""
    unassigned: GroupedEchoes
    """All other echoes."""
    groups: EchoGroups
    ranges: Float[np.ndarray, "scans paths slots"]
    """All ranges by path, metres, sorted; infinite where there is no echo."""
    paths: kernels.EchoPaths
    """Of the ring, NumPy arrays."""
    measured: Bool[np.ndarray, "scans paths"]
    """Paths that each scan measured, whether or not they heard anything."""

    @classmethod
    def of(cls, ring: Ring, log: Log, models: Sequence[LocalModel], sigma: float) -> "ScanObservations":
        """Group the echoes of scans according to their local models.

        Args:
            ring: the sensors.
            log: the scans.
            models: the local model of each scan.
            sigma: standard deviation of the ranges, metres.
        """
        paths = jax.tree.map(np.asarray, ring.exact_paths)
        slots = SETTINGS.echoes_per_path
        ranges = np.full((len(models), len(ring.paths), slots), np.inf)
        echoes: list[tuple[np.ndarray, ...]] = []
        groups: list[tuple[int, _EchoGroup]] = []
        for row, model in enumerate(models):
            path, measured = corrected_echoes(ring, log[row])
            order = np.lexsort((measured, path))
            path, measured = path[order], measured[order]
            slot = np.arange(len(path)) - np.searchsorted(path, path)
            kept = slot < slots
            ranges[row, path[kept], slot[kept]] = measured[kept]
            group = np.full(len(path), -1)
            for one in _groups_of(model):
                own = ring.path_index[one.paths[:, 0], one.paths[:, 1]]
                free = np.flatnonzero(np.isin(path, own) & (group < 0))
                mine = free[_inliers(one, path[free], measured[free], paths, sigma)]
                if len(mine):
                    group[mine] = len(groups)
                    groups.append((row, one))
            echoes.append((np.full(len(path), row), group, measured, path))
        scan, group, measured, path = _columns(echoes)
        flat = GroupedEchoes(scan, group, measured, path, paths.midpoint[path], paths.half_baseline[path])
        some, rest = (GroupedEchoes(*(column[rows] for column in flat)) for rows in (group >= 0, group < 0))
        table = EchoGroups(
            scan=np.array([row for row, _ in groups], dtype=np.int64),
            plane=np.array([one.plane for _, one in groups], dtype=np.float64).reshape(-1, 2),
            point=np.array([one.point for _, one in groups], dtype=np.float64).reshape(-1, 2),
            log_prior=np.array([one.log_prior for _, one in groups], dtype=np.float64).reshape(-1, 3),
        )
        return cls(ring, sigma, some, rest, table, ranges, paths, measured_paths(ring, log))

    def paths_at(self, rows: Int[np.ndarray, " rows"]) -> kernels.EchoPaths:
        """Some of the paths."""
        return jax.tree.map(lambda leaf: leaf[rows], self.paths)

    @cached_property
    def wide_paths(self) -> Int[np.ndarray, " some"]:
        """Rows of the paths whose transducers look in about the same direction."""
        width = np.asarray(self.ring.echo_paths.width)
        return np.flatnonzero(width > 0.5 * width.max())


def _columns(
    echoes: Sequence[tuple[np.ndarray, ...]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Scan, group, range and path of all echoes."""
    none = np.zeros(0, dtype=np.int64)
    whole = [np.concatenate(column) for column in zip((none, none, np.zeros(0), none), *echoes, strict=True)]
    return whole[0], whole[1], whole[2], whole[3]


def _groups_of(model: LocalModel) -> Iterator[_EchoGroup]:
    """The reflectors of a local model, as walls and as points."""
    rest = (1 - SETTINGS.decided_probability) / 2
    least = SETTINGS.min_kind_probability
    for line in model.lines:
        log_prior = np.log([SETTINGS.decided_probability, rest, rest])
        yield _EchoGroup(np.array([line.rho, line.theta]), line.rho * unit(line.theta), log_prior, line.paths)
    for one in model.points:
        if one.kind == "circle":
            continue  # no kind of reflector here fits a circle from all sides
        probability = np.full(3, max((1 - one.probability) / 2, least))
        probability[kernels.CORNER if one.kind == "corner" else kernels.EDGE] = one.probability
        point = np.array([one.x, one.y])
        plane = np.array([np.hypot(*point), np.arctan2(one.y, one.x)])
        yield _EchoGroup(plane, point, np.log(probability), one.paths)
    for other in model.undecided:
        probability = np.array([other.probability[name] for name in ("plane", "corner", "edge")])
        plane, point = np.array([other.rho, other.theta]), np.array([other.x, other.y])
        yield _EchoGroup(plane, point, np.log(np.maximum(probability, least)), other.paths)


def _inliers(
    one: _EchoGroup,
    path: Int[np.ndarray, " echoes"],
    measured: Float[np.ndarray, " echoes"],
    paths: kernels.EchoPaths,
    sigma: float,
) -> Int[np.ndarray, " inliers"]:
    """Echoes that one reflector explains, at most one per path; none if no kind of reflector explains them well."""
    nothing = np.zeros(0, dtype=np.int64)
    if not len(path):
        return nothing
    midpoint, base = np.asarray(paths.midpoint)[path], np.asarray(paths.half_baseline)[path]
    start = np.stack([one.plane, one.point, one.point])
    predicted = [RANGE_OF_KIND[kind](start[None, kind], midpoint, base).range for kind in KINDS]
    off = np.abs(np.stack(predicted) - measured).min(axis=0)
    order = np.argsort(off, kind="stable")
    mine = order[np.unique(path[order], return_index=True)[1]]
    mine = mine[off[mine] < 6 * sigma + 0.02]
    if len(mine) < 2:
        return nothing
    fit = fit_reflectors(
        start[None],
        np.zeros(len(mine), dtype=np.int64),
        measured[mine],
        midpoint[mine],
        base[mine],
        sigma=sigma,
        steps=SETTINGS.group_steps,
        scales=SETTINGS.group_scales,
    )
    cost = np.square(np.minimum(np.abs(fit.residual), SETTINGS.group_gate)).sum(axis=1)
    best = np.abs(fit.residual[cost.argmin()])
    good = best < SETTINGS.group_gate
    probability = chi2.sf(np.square(best[good]).sum(), max(int(good.sum()) - 2, 1))
    return mine[good] if good.sum() >= 2 and probability >= SETTINGS.group_significance else nothing

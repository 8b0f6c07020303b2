"""Kinds of echo paths that a ring lists and that a log neither heard nor measured."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from jaxsonar.plausibility.implausibility import Implausibility
from jaxsonar.scans.measured_paths import measured_paths, path_rows
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class UnheardPathSettings:
    """When a kind of paths counts as never heard. Chosen by hand."""

    min_expected: float = 50.0
    """Least expected number of echoes of an unheard kind, from the number of echoes of the other kinds."""


SETTINGS = UnheardPathSettings()


def neighbor_offsets(ring: Ring) -> Int[np.ndarray, " paths"]:
    """Distance between transmitter and receiver of each path, in sensors, on either side; 0: a direct echo."""
    tx, rx = ring.paths.T
    offset = np.abs(rx - tx)
    return np.minimum(offset, ring.count - offset) if ring.closed else offset


def unheard_offsets(ring: Ring, log: Log) -> list[int]:
    """Neighbor offsets (0: direct echoes) whose paths the ring lists, but the log never measured.

    Paths with silent readings were measured. The offsets count only if ``SETTINGS.min_expected`` echoes or more of one
    of them are expected. The expectation is the number of echoes of the other kinds, scaled by the width of the
    directions in which the paths detect a wall.
    """
    path = path_rows(ring, log.tx, log.rx)[np.isfinite(log.range)]
    offset, width = neighbor_offsets(ring), ring.exact_paths.width
    heard = np.bincount(offset[path[path >= 0]], minlength=int(offset.max()) + 1)
    width = np.bincount(offset, weights=width, minlength=len(heard))
    is_heard = heard > 0
    if not is_heard.any() or width[is_heard].sum() == 0:
        return []
    expected = heard.sum() * width / width[is_heard].sum()
    if not (expected[~is_heard] >= SETTINGS.min_expected).any():
        return []
    is_measured = np.bincount(offset, weights=measured_paths(ring, log).any(axis=0), minlength=len(heard)) > 0
    return np.flatnonzero(~is_heard & ~is_measured).tolist()


def unheard_warning(ring: Ring, log: Log) -> Implausibility | None:
    """A warning about kinds of paths that were never heard; None if there is none."""
    offsets = unheard_offsets(ring, log)
    if not offsets:
        return None
    neighbors = [str(k) for k in offsets if k]
    listed = " or ".join(filter(None, [", ".join(neighbors[:-1]), *neighbors[-1:]]))
    kinds = ["no direct echo"] * (0 in offsets) + [f"no echo from neighbor {listed}"] * bool(neighbors)
    paths = int(np.isin(neighbor_offsets(ring), offsets).sum())
    what = f"{' and '.join(kinds)} among {log.echo_count} echoes, but {ring.name!r} lists {paths} such paths"
    cause = "the device probably does not report them, and they count as not measured"
    if 0 in offsets:
        cause, remedy = "the device probably leaves direct echoes out", "record them, or check tx and rx of the log"
    elif offsets == list(range(offsets[0], ring.neighbors + 1)):
        remedy = f"set neighbors = {offsets[0] - 1} in the ring"
    else:
        remedy = "check which neighbors the device listens to"
    return Implausibility("unheard paths", what, cause, remedy)

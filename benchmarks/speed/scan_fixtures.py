"""Scans for the measurements: simulated with hard cones in random rooms, with their echoes or with about 64."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsonar import Log, Ring, Scan, random_pose, random_room, simulate

SLOTS = 2
"""Maximum number of echoes on each path."""
ROOMS = 20
"""Number of random rooms."""
SIGMA = 0.003
"""Range noise, metres."""
DENSE = 1 / 3
"""Share of the scans in ``Batch.dense``: those with the most echoes, about 64 each."""


class Batch(NamedTuple):
    """Two sets of scans of one ring."""

    ring: Ring
    mixed: Float[np.ndarray, "scans paths slots"]
    """All scans, about 45 echoes each; half path lengths, metres, NaN = no echo."""
    dense: Float[np.ndarray, "scans paths slots"]
    """The third with the most echoes, about 64 each, repeated to the same number of scans."""


def scans_of_random_rooms(ring: Ring, count: int, *, seed: int = 0) -> Float[np.ndarray, "scans paths slots"]:
    """Ranges (metres, NaN = no echo) of scans in 20 random rooms, noise 3 mm, in random order."""
    rng = np.random.default_rng(seed)
    parts = []
    for k in range(ROOMS):
        room = random_room(rng)
        poses = np.stack([random_pose(rng, room) for _ in range(-(-count // ROOMS))])
        parts.append(
            simulate(ring, room, poses, sigma=SIGMA, seed=seed + k, beams="hard").dense(len(ring.paths), SLOTS)
        )
    order = rng.permutation(sum(len(part) for part in parts))[:count]
    return np.concatenate(parts)[order].astype(np.float32)


def echoes_of(ranges: Float[np.ndarray, "scans paths slots"]) -> Float[np.ndarray, " scans"]:
    """Number of echoes of each scan."""
    return np.isfinite(ranges).sum(axis=(1, 2)).astype(float)


def batch(count: int, *, seed: int = 0, ring: Ring | None = None) -> Batch:
    """Scans of the paper's ring or of another one."""
    ring = Ring.circular() if ring is None else ring
    mixed = scans_of_random_rooms(ring, count, seed=seed)
    dense_rows = np.argsort(-echoes_of(mixed), kind="stable")[: max(1, round(DENSE * count))]
    return Batch(ring, mixed, mixed[np.resize(np.sort(dense_rows), count)])


def single_scans(ring: Ring, ranges: Float[np.ndarray, "scans paths slots"]) -> list[Scan]:
    """The same scans as ``Scan`` objects, which measured all paths."""
    scan, path, slot = np.nonzero(np.isfinite(ranges))
    tx, rx = ring.paths[path].T
    count = len(ranges)
    range_ = ranges[scan, path, slot].astype(np.float64)
    stamp, pose = 0.1 * np.arange(count), np.full((count, 3), np.nan)
    return list(Log.from_echoes(scan, tx, rx, range_, stamp=stamp, pose=pose, asked=ring.paths))

"""What a scan measured: the paths that fired and were listened to, whether or not they heard anything.

Only a path that was measured can be silent. A path without a measurement is no evidence at all.
"""

import numpy as np
from jaxtyping import Bool, Float, Int, Num

from jaxsonar.scans.readings import is_repeated
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


def measured_paths(ring: Ring, log: Log) -> Bool[np.ndarray, "scans paths"]:
    """Which paths of a ring each scan of a log measured.

    These are the paths with a reading in the scan, and those that every scan measured (``Log.asked``). A path that only
    has a repeated old reading (``is_repeated``) was not measured. The result may be a read-only broadcast array.

    Args:
        ring: the sensors; sensors and pairs that it does not have are ignored.
        log: the scans.
    """
    always, repeated = _asked_paths(ring, log.asked), is_repeated(log)
    if always.all() and not repeated.any():
        return np.broadcast_to(always, (len(log), len(always)))
    path = path_rows(ring, log.tx, log.rx)
    known = path >= 0
    if always[path[known]].all() and not repeated.any():
        return np.broadcast_to(always, (len(log), len(always)))
    measured = np.tile(always, (len(log), 1))
    scan = log.echo_scan
    old = known & repeated
    measured[scan[old], path[old]] = False
    new = known & ~repeated
    measured[scan[new], path[new]] = True
    return measured


def echoes_of_long_wall(ring: Ring, log: Log) -> float:
    """Number of paths that receive a long wall, of those that a scan measures (median).

    In a log that does not list its measurements, paths of the same kind as a heard one (direct, or between sensors with
    the same distance in the ring) count as measured: most of them hear nothing in a large room.
    """
    if not len(log):
        return 0.0
    width, measured = np.asarray(ring.exact_paths.width), measured_paths(ring, log)
    kind = (ring.paths[:, 1] - ring.paths[:, 0]) % ring.count
    of_heard_kind = np.isin(kind, (log.asked[:, 1] - log.asked[:, 0]) % ring.count)
    rows = of_heard_kind[None] if len(log.asked) else measured
    return round(float(np.median([width[paths].sum() for paths in rows]) / (2 * np.pi)), 6)


def full_wall_paths(
    ring: Ring, counts: Float[np.ndarray, "rows paths"], *, directions: int = 360
) -> Float[np.ndarray, " rows"]:
    """Number of measurements that receive a wide wall: the mean over all directions in which any of them receives it.

    For one measurement of every path it equals ``kernels.full_wall_paths``.

    Args:
        ring: the sensors.
        counts: number of measurements of each path, in the scan or window of each row.
        directions: number of directions of the mean.
    """
    geometry, key = ring.exact_paths, ("full_wall_paths", directions)
    if key not in ring.cache:
        angle = (np.arange(directions) + 0.5) * (2 * np.pi / directions)
        received = np.mod(angle - geometry.start[:, None], 2 * np.pi) < geometry.width[:, None]
        ring.cache[key] = received.astype(np.float32)
    covered = ((counts > 0).astype(np.float32) @ ring.cache[key] > 0).mean(axis=1)
    return counts @ geometry.width / (2 * np.pi * np.maximum(covered, 1 / directions))


def equivalent_scans(
    ring: Ring, counts: Num[np.ndarray, "rows paths"] | Bool[np.ndarray, "rows paths"]
) -> Float[np.ndarray, " rows"]:
    """Number of scans of all paths to which the measurements of each row amount.

    It is the ratio of the numbers of measurements that receive a wide wall (``full_wall_paths``). Where anything was
    measured, a wall is received by one measurement at least.

    Args:
        ring: the sensors.
        counts: number of measurements of each path, in the scan or window of each row.
    """
    whole = np.maximum(full_wall_paths(ring, np.ones((1, len(ring.paths)))), 1)
    if counts.dtype == bool and len(counts) > 1:  # few rows are distinct
        packed = np.packbits(counts, axis=1)
        _, first, row = np.unique(packed.view(f"V{packed.shape[1]}"), return_index=True, return_inverse=True)
        counts = counts[first]
    else:
        row = np.arange(len(counts))
    return (np.maximum(full_wall_paths(ring, counts.astype(np.float64)), 1) / whole)[row.ravel()]


def _asked_paths(ring: Ring, asked: Int[np.ndarray, "pairs 2"]) -> Bool[np.ndarray, " paths"]:
    """Mask of the pairs; the latest one is stored in ``Ring.cache``, because all parts of a log have the same pairs."""
    latest = ring.cache.get("asked_paths")
    if latest is None or not np.array_equal(latest[0], asked):
        always = np.zeros(len(ring.paths), bool)
        path = path_rows(ring, *asked.T)
        always[path[path >= 0]] = True
        always.setflags(write=False)
        ring.cache["asked_paths"] = latest = asked, always
    return latest[1]


def path_rows(ring: Ring, tx: Int[np.ndarray, " pairs"], rx: Int[np.ndarray, " pairs"]) -> Int[np.ndarray, " pairs"]:
    """Rows of ``Ring.paths``; -1 for pairs that are no paths of the ring, and for sensors that it does not have."""
    known = (tx < ring.count) & (rx < ring.count)
    path = np.full(len(tx), -1)
    path[known] = ring.path_index[tx[known], rx[known]]
    return path

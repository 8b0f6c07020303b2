"""Echoes that a wall of their own scan explains.

A map contains walls that several scans observed. The echoes of a wall that only one scan observed match no wall of the
map, but often a point next to it, and pull the scan there. So they are never associated with points.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from jaxsonar.detection.local_model import LocalModel
from jaxsonar.estimation.batch_data import BatchData
from jaxsonar.estimation.robust_adjustment import SETTINGS as GNC_SETTINGS
from jaxsonar.geometry.se2 import rotate
from jaxsonar.sensors.range_models import plane_range
from jaxsonar.sensors.ring import Ring
from jaxsonar.smoothing.settings import SETTINGS


def wall_explained_mask(ring: Ring, data: BatchData, models: Sequence[LocalModel]) -> Bool[np.ndarray, "scans echoes"]:
    """Whether each echo has the range of a wall of its own scan, and the wall was detected on its path.

    Args:
        ring: the sensors.
        data: the scans of one log.
        models: local models of all scans of this log.
    """
    mask = np.zeros(data.path.shape, dtype=bool)
    paths = ring.exact_paths
    midpoint, half_baseline = np.asarray(paths.midpoint), np.asarray(paths.half_baseline)
    tx, rx = ring.paths[data.path].T
    ranges = np.asarray(ring.corrected(data.reported, tx.T, rx.T), dtype=np.float64)
    for row, scan in enumerate(data.scan_rows[0].tolist()):
        model, path = models[scan], data.path[row]
        middle, base = midpoint[path], half_baseline[path]
        if data.path_pose is not None:
            motion = data.path_pose[row, path]
            middle, base = motion[:, :2] + rotate(middle, motion[:, 2]), rotate(base, motion[:, 2])
        gate = GNC_SETTINGS.gate_sigmas * (model.sigma if model.sigma > 0 else SETTINGS.default_sigma)
        for line in model.lines:
            expected = plane_range(np.array([line.rho, line.theta]), middle, base).range
            detected = np.isin(path, ring.path_index[line.paths[:, 0], line.paths[:, 1]])
            mask[row] |= detected & (np.abs(ranges[row] - expected) < gate)  # False for NaN: no echo
    return mask

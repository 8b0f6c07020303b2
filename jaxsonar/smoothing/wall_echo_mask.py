"""Which echoes a wall of their own scan explains.

A map has what several scans saw. The echoes of a wall that only one saw find nothing in it but what happens to be near,
often the edge next door, and pull the scan there; so what is of a wall by its own scan is of no point of the map.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from jaxsonar.detection.local_map import LocalModel
from jaxsonar.estimation.batch_data import BatchData
from jaxsonar.estimation.robust_adjustment import GATE
from jaxsonar.sensors.range_models import plane_range
from jaxsonar.sensors.ring import Ring

_SIGMA = 0.003  # m; noise of a scan that does not tell


def of_own_walls(ring: Ring, data: BatchData, models: Sequence[LocalModel]) -> Bool[np.ndarray, "scans echoes"]:
    """Whether each echo is on a path on which its scan hears a wall, as far as that is.

    Args:
        ring: the sensors.
        data: the scans of one log.
        models: local models of all scans of this log.
    """
    out = np.zeros(data.path.shape, dtype=bool)
    paths = ring.exact_paths
    middle, half = np.asarray(paths.midpoint), np.asarray(paths.half_baseline)
    tx, rx = ring.paths[data.path].T
    ranges = np.asarray(ring.corrected(data.reported, tx.T, rx.T), dtype=np.float64)
    for row, scan in enumerate(data.scan_rows[0].tolist()):
        model, own = models[scan], data.path[row]
        gate = GATE * (model.sigma if model.sigma > 0 else _SIGMA)
        for line in model.lines:
            expected = plane_range(np.array([line.rho, line.theta]), middle[own], half[own]).range
            heard = np.isin(own, ring.path_index[line.paths[:, 0], line.paths[:, 1]])
            out[row] |= heard & (np.abs(ranges[row] - expected) < gate)  # False for NaN: no echo
    return out

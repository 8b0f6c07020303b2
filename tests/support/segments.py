"""segments."""

from dataclasses import fields

import numpy as np

from jaxsonar.geometry.se2 import rotation, wrap_angle
from jaxsonar.mapping.wall_segments import SIGMA_OFFSET, SIGMA_THETA, Pieces

COLUMNS = [field.name for field in fields(Pieces) if field.name != "scans"]


def pieces_at(centre, theta, *, length: np.ndarray | float = 0.5, **columns):
    """Pieces as single lines of local models leave them, a scan each; any column may be given."""
    theta = wrap_angle(np.asarray(theta, float).reshape(-1))
    count = len(theta)
    half = np.broadcast_to(np.asarray(length, float), count) / 2
    known = {
        "centre": np.array(centre, float).reshape(-1, 2),
        "theta": theta,
        "ends": np.stack([-half, half], axis=-1),
        "info_offset": np.full(count, SIGMA_OFFSET**-2),
        "info_theta": np.full(count, SIGMA_THETA**-2),
        "misfit": np.zeros(count),
        "count": np.ones(count, np.int64),
        "echoes": np.arange(count) + 3,
        "distance": 1 + np.arange(count) / 8,
        "latest": np.arange(count) / 4,
        "scans": (np.arange(count), np.arange(count)),
    }
    return Pieces(**(known | columns))


def moved(pieces, pose):
    """The same pieces in a world that was turned by pose[2] and then shifted."""
    columns = {name: getattr(pieces, name) for name in COLUMNS}
    columns["centre"] = pieces.centre @ rotation(pose[2]).T + pose[:2]
    return Pieces(**columns | {"theta": wrap_angle(pieces.theta + pose[2])}, scans=pieces.scans)


def same(one, two):
    """To the last bit."""
    return one.scan_lists() == two.scan_lists() and all(
        np.array_equal(getattr(one, name), getattr(two, name)) for name in COLUMNS
    )

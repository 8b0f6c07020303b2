"""Wall segments for tests: construction, rigid motion and exact comparison."""

from dataclasses import fields

import numpy as np

from jaxsonar.geometry.se2 import rotation, wrap_angle
from jaxsonar.mapping.settings import SETTINGS
from jaxsonar.mapping.wall_segments import WallSegments

COLUMNS = [field.name for field in fields(WallSegments) if field.name != "scans"]


def segments_at(center, theta, *, length: np.ndarray | float = 0.5, **columns):
    """Segments as of single lines of local models, one scan each; any column can be given."""
    theta = wrap_angle(np.asarray(theta, float).reshape(-1))
    count = len(theta)
    half = np.broadcast_to(np.asarray(length, float), count) / 2
    known = {
        "center": np.array(center, float).reshape(-1, 2),
        "theta": theta,
        "extent": np.stack([-half, half], axis=-1),
        "info_offset": np.full(count, SETTINGS.segments.offset_sd**-2),
        "info_theta": np.full(count, SETTINGS.segments.theta_sd**-2),
        "chi_squared": np.zeros(count),
        "count": np.ones(count, np.int64),
        "echoes": np.arange(count) + 3,
        "viewing_distance": 1 + np.arange(count) / 8,
        "last_seen": np.arange(count) / 4,
        "scans": (np.arange(count), np.arange(count)),
    }
    return WallSegments(**(known | columns))


def moved(segments, pose):
    """The same segments in a world that was rotated by pose[2] and then translated."""
    columns = {name: getattr(segments, name) for name in COLUMNS}
    columns["center"] = segments.center @ rotation(pose[2]).T + pose[:2]
    return WallSegments(**columns | {"theta": wrap_angle(segments.theta + pose[2])}, scans=segments.scans)


def same(one, two):
    """Whether two tables are exactly equal."""
    return one.scan_lists() == two.scan_lists() and all(
        np.array_equal(getattr(one, name), getattr(two, name)) for name in COLUMNS
    )

"""Which parts of the borders of known circles exist."""

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from jaxsonar.geometry.se2 import unit, wrap_angle
from jaxsonar.occupancy.known_reflectors import KnownReflectors
from jaxsonar.occupancy.settings import SETTINGS
from jaxsonar.occupancy.wall_profile import FacingReadings

_WALLS = SETTINGS.reflectors


def with_confirmed_borders(known: KnownReflectors, readings: FacingReadings, *, resolution: float) -> KnownReflectors:
    """The reflectors to draw: large circles become points on those parts of their borders that readings confirm.

    A map has large circles that are none, such as a wall of which few echoes were heard. The echoes prove only the part
    of the border that they came from. Small circles are drawn completely.

    Args:
        known: the map.
        readings: of all scans.
        resolution: distance of the points, metres.
    """
    large = known.point_radius > _WALLS.whole_circle
    points, sd = [known.points[~large]], [known.point_sd[~large]]
    for row in np.flatnonzero(large):
        center, radius = known.points[row], float(known.point_radius[row])
        count = int(np.ceil(2 * np.pi * radius / resolution))
        direction = unit((np.arange(count) + 0.5) * (2 * np.pi / count))
        shown = _confirmed_sectors(center, radius, readings, count)
        # A point on the border moves with the center and with the radius.
        jacobian = np.column_stack([direction, np.ones(count)])[shown]
        variance = np.einsum("ni,ij,nj->n", jacobian, known.circle_cov[row], jacobian)
        points.append(center + radius * direction[shown])
        sd.append(np.sqrt(np.maximum(variance, 0)))
    drawn, drawn_sd = np.concatenate(points), np.concatenate(sd)
    radius = np.zeros(len(drawn))
    radius[: (~large).sum()] = known.point_radius[~large]
    return known._replace(points=drawn, point_sd=drawn_sd, point_radius=radius, circle_cov=np.zeros((len(drawn), 3, 3)))


def _confirmed_sectors(
    center: Float[np.ndarray, "2"], radius: float, readings: FacingReadings, count: int
) -> Bool[np.ndarray, " sectors"]:
    """Which of equal sectors of ONE circle answered a reading that faced them, and were not looked through.

    Args:
        center: of the circle, world frame, metres.
        radius: of the circle, metres.
        readings: of all scans.
        count: number of sectors, counter-clockwise from x.
    """
    offset = readings.position - center
    expected = np.linalg.norm(offset, axis=-1) - radius
    angle = np.arctan2(offset[:, 1], offset[:, 0])
    off_axis = np.abs(wrap_angle(angle + np.pi - readings.heading))
    in_cone = (off_axis <= readings.certain / SETTINGS.free.certain) & (expected > 0)
    facing = in_cone & (off_axis <= readings.certain)
    later = readings.first_echo - expected
    sector = np.floor(angle % (2 * np.pi) * (count / (2 * np.pi))).astype(int) % count
    confirmed, refuted = (
        np.bincount(sector[some], minlength=count)
        for some in (in_cone & (np.abs(later) <= _WALLS.explained), facing & (later > _WALLS.explained))
    )
    # Beside a reflection there is more of the same circle.
    reach = int(np.ceil(_WALLS.border_beside * count / (2 * np.pi)))
    beside = ndimage.maximum_filter1d(confirmed, 2 * reach + 1, mode="wrap") > 0
    kernel = np.ones(2 * _WALLS.window + 1, np.int64)
    refuted, confirmed = (ndimage.convolve1d(counts, kernel, mode="wrap") for counts in (refuted, confirmed))
    return beside & ~((refuted >= _WALLS.min_looks) & (refuted > 2 * confirmed))

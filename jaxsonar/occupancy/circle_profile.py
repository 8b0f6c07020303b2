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
    """The reflectors to draw: large uncertain circles become points where readings confirm their borders.

    A map has large circles that are none, such as a wall of which few echoes were heard. Echoes prove only the part of
    the border that they came from. Small and certain circles are drawn completely, as wide as the side that is known
    best: radius and distance of the center are correlated.

    Args:
        known: the map.
        readings: of all scans.
        resolution: distance of the points, metres.
    """
    partial = np.zeros(len(known.points), bool)
    border, border_sd, sd = [np.zeros((0, 2))], [np.zeros(0)], known.point_sd.copy()
    for row in np.flatnonzero((known.point_radius > 0) & known.circle_cov.any(axis=(1, 2))):
        center, radius = known.points[row], float(known.point_radius[row])
        count = int(np.ceil(2 * np.pi * radius / resolution))
        direction = unit((np.arange(count) + 0.5) * (2 * np.pi / count))
        # A point on the border moves with the center and with the radius.
        jacobian = np.column_stack([direction, np.ones(count)])
        across = np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", jacobian, known.circle_cov[row], jacobian), 0))
        partial[row] = radius > _WALLS.whole_circle and across.max() > _WALLS.certain_border
        if partial[row]:
            shown = _confirmed_sectors(center, radius, readings, count)
            border.append(center + radius * direction[shown])
            border_sd.append(across[shown])
        else:
            sd[row] = across.min()
    border = np.concatenate(border)
    return known._replace(
        points=np.concatenate([known.points[~partial], border]),
        point_sd=np.concatenate([sd[~partial], *border_sd]),
        point_radius=np.concatenate([known.point_radius[~partial], np.zeros(len(border))]),
        circle_cov=np.concatenate([known.circle_cov[~partial], np.zeros((len(border), 3, 3))]),
    )


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

"""Tracing of all echoes in a room: exact path lengths with the causing reflector, independent of acoustics.

NumPy in double precision, vectorized over groups of sensors (scans), pairs of sensors (paths) and reflectors.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.floor_plans.room import Room
from jaxsonar.simulation.acoustics import Acoustics
from jaxsonar.simulation.circle_echoes import trace_circles
from jaxsonar.simulation.image_sources import trace_corners, trace_planes, trace_second_order
from jaxsonar.simulation.point_scatterers import trace_edges, trace_poles
from jaxsonar.simulation.traced_echoes import TracedEchoes
from jaxsonar.simulation.tracing_scene import TracingScene


def trace_echoes(
    room: Room,
    sensors: Float[np.ndarray, "groups sensors 2"],
    pairs: Int[np.ndarray, "pairs 2"],
    *,
    max_range: float = np.inf,
    axis: Float[np.ndarray, "groups sensors 2"] | None = None,
    half_beam: Float[np.ndarray, " sensors"] | None = None,
    acoustics: Acoustics | None = None,
    moving: Float[np.ndarray, "groups moving 3"] | None = None,
) -> TracedEchoes:
    """All echoes between pairs of sensors, for many poses of one array at once.

    - Plane: image source. The point of incidence lies on the wall, and both sensors are on one side of it.
    - Second order: image of the image, for every ordered pair of walls. Two orders of equal length are one echo.
    - Corner: walls that meet at 90 deg (within 1 deg, then taken as exactly 90) act as a point reflection at their
      vertex c: the length is 2|m - c| with the midpoint m of the sensors. Both sensors lie inside the wedge.
    - Edge and pole: the length is |s_i - c| + |s_j - c|. At an edge both sensors lie inside its wedge.

    - Circle: one reflection at its outside, where the path over it is shortest.

    No leg intersects a wall or a circle; poles do not occlude. With ``axis`` and ``half_beam`` the sound must leave tx
    and reach rx within their cones, in its exact directions (no far-field approximation). With ``acoustics`` the beams
    are soft: the cones do not limit the directions, but the amplitude must reach the threshold, and both directions lie
    in front of the sensors (at most 90 deg off their axes).

    Args:
        room: the reflectors.
        sensors: (groups, sensors, 2) positions, world frame, metres; a group is a scan.
        pairs: (pairs, 2) sensor indices tx, rx, the same for every group.
        max_range: largest half path length, metres.
        axis: (groups, sensors, 2) unit vectors of the sensor axes, world frame; requires half_beam.
        half_beam: (sensors,) half the width of each cone, radians.
        acoustics: amplitudes and threshold for soft beams; requires axis and half_beam.
        moving: (groups, moving, 3) centers x, y and radii of circles that move, metres. A radius is the same in all
            groups. Their indices as reflectors follow those of the circles of the room.
    """
    scene = TracingScene.of(room, sensors, pairs, max_range, axis, half_beam, acoustics, moving)
    junctions = room.junctions
    found = TracedEchoes.concatenate(
        [
            trace_planes(scene),
            trace_corners(scene, junctions),
            trace_edges(scene, junctions),
            trace_poles(scene, room.poles),
            trace_circles(scene),
            trace_second_order(scene, junctions.right_angled),
        ]
    )
    return replace(found, first=found.first + scene.origin, last=found.last + scene.origin)

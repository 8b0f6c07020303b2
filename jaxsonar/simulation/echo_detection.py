"""The echoes that a threshold detector reports on every path: tracing, amplitudes, crosstalk, and blanking."""

import numpy as np
from jaxtyping import Float

from jaxsonar.floor_plans.room import Room
from jaxsonar.simulation.acoustics import Acoustics, amplitudes, unblanked
from jaxsonar.simulation.echo_tracing import trace_echoes
from jaxsonar.simulation.traced_echoes import EchoColumns, EchoKind
from jaxsonar.simulation.transducer_array import TransducerArray

BEAMS = ("soft", "hard")
"""Models of the beams; see ``simulate``."""


def detect_echoes(
    array: TransducerArray,
    room: Room,
    poses: Float[np.ndarray, "scans 3"],
    moving: Float[np.ndarray, "scans walkers 3"],
    *,
    acoustics: Acoustics,
    beams: str,
    max_echoes: int,
    blanking: float,
) -> EchoColumns:
    """Echoes that a threshold detector reports in some scans, with exact ranges.

    Args:
        array: the sensors.
        room: the reflectors.
        poses: world_from_robot of the scans.
        moving: centers x, y and radii of the walkers at each scan, metres.
        acoustics: as for ``simulate``.
        beams: as for ``simulate``.
        max_echoes: as for ``simulate``.
        blanking: as for ``simulate``.
    """
    # Trace the echoes of all pairs of sensors, and drop those below the threshold.
    sensors, axis = array.in_world(poses)
    found = trace_echoes(
        room,
        sensors,
        array.pairs,
        max_range=array.max_range,
        axis=axis,
        half_beam=array.half_beam,
        acoustics=acoustics if beams == "soft" else None,
        moving=moving,
    )
    radius = np.append(room.circles[:, 2], moving[0, :, 2])
    amplitude = amplitudes(found, array.pairs, sensors, axis, array.half_beam, acoustics, radius)
    loud = amplitude >= acoustics.threshold
    found, amplitude = found[loud], amplitude[loud]
    # Both sensors of a pair transmit in turn; each direction has a path of its own.
    echo, direction = np.nonzero(array.reported_on[found.pair] >= 0)
    path = array.reported_on[found.pair[echo], direction]
    tied = [column[echo] for column in (found.second, found.reflector, found.kind, found.length)]
    order = np.lexsort((*tied, path, found.group[echo]))
    echo, direction, path = echo[order], direction[order], path[order]
    # The detector does not distinguish transmitters: all echoes of a path take part in blanking.
    key = found.group[echo] * len(array.paths) + path
    kept = unblanked(key, found.length[echo] / 2, blanking, max_echoes)
    echo, direction, path = echo[kept], direction[kept], path[kept]
    found = found[echo]
    # In the opposite direction the order of the two walls is reversed.
    reversed_walls = (direction == 1) & (found.kind == EchoKind.SECOND_ORDER)
    return EchoColumns(
        scan=found.group,
        path=path,
        range=found.length / 2,
        amplitude=amplitude[echo],
        kind=np.where(array.is_crosstalk[found.pair], int(EchoKind.CROSSTALK), found.kind),
        reflector=np.where(reversed_walls, found.second, found.reflector),
        reflector_kind=found.kind,
        transmitter=array.pairs[found.pair, direction],
        second=found.second,
    )

"""Traced echoes between single transmitters and receivers."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jaxsonar import Room
from jaxsonar.simulation.echo_tracing import trace_echoes
from jaxsonar.simulation.traced_echoes import TracedEchoes


def trace_between(
    room: Room,
    tx: Float[np.ndarray, "pairs 2"],
    rx: Float[np.ndarray, "pairs 2"],
    *,
    max_range: float = np.inf,
) -> TracedEchoes:
    """All echoes from each tx to its rx, for omnidirectional sensors.

    Args:
        room: the reflectors.
        tx: (pairs, 2) transmitters, world frame, metres.
        rx: (pairs, 2) receivers, world frame, metres.
        max_range: largest half path length, metres.

    Returns:
        The echoes; ``pair`` is the row of tx and rx.
    """
    found = trace_echoes(room, np.stack([tx, rx], axis=1), np.array([[0, 1]]), max_range=max_range)
    return replace(found, group=np.zeros_like(found.group), pair=found.group)

"""Echo paths between sensors at any positions, for tests of the measurement model."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxsonar.kernels import EchoPaths


def paths_between(tx, rx, *, heading=None, half_beam=0.5, dtype=None):
    """Echo paths of transmitters and receivers (paths, 2); the fields of the Hough transform are 0.

    Args:
        tx: positions of the transmitters, metres.
        rx: positions of the receivers, metres.
        heading: (paths, 2) headings of tx and rx, radians; 0 if left out.
        half_beam: half opening angle of all detection cones, radians.
        dtype: of the result; the default precision if left out.
    """
    heading = np.zeros((len(tx), 2)) if heading is None else heading
    fields: dict[str, Any] = {
        "midpoint": (tx + rx) / 2,
        "half_baseline": (rx - tx) / 2,
        "start": np.zeros(len(tx)),
        "width": np.zeros(len(tx)),
        "range_offset": np.zeros(len(tx)),
        "axes": np.stack([np.cos(heading), np.sin(heading)], axis=-1),
        "cone": np.full((len(tx), 2), 4 * np.sin(half_beam / 2) ** 2),
    }
    return EchoPaths(**{name: jnp.asarray(value, dtype) for name, value in fields.items()})

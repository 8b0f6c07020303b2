"""Global maps as CAD drawings (DXF). Needs the extra ``cad``."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from jaxsonar.fileio.atomic_files import atomic_write, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.mapping.global_map import GlobalMap

LAYER = "WALLS"
"""The layer that holds the segments."""
_METRES = 6  # $INSUNITS


def save_dxf(world: GlobalMap, path: str | os.PathLike[str]) -> None:
    """Write the segments of a map as a drawing: a LINE each on the layer WALLS, in metres, world frame.

    The same map gives the same bytes: the drawing carries fixed dates and no random identity.

    Args:
        world: the segments.
        path: the file, replaced only once all is written.

    Raises:
        SonarError: the place cannot be written, or the extra is missing.
    """
    ezdxf = load_ezdxf(path)
    with _fixed_dates(ezdxf), atomic_write(path) as file:
        drawing = ezdxf.new("R2010", units=_METRES)
        drawing.layers.add(LAYER)
        space = drawing.modelspace()
        for start, end in world.segments.astype(float).tolist():
            space.add_line(start, end, dxfattribs={"layer": LAYER})
        if len(world):
            low, high = world.segments.min(axis=(0, 1)), world.segments.max(axis=(0, 1))
            # What a program shows on opening: all of it, and a little air.
            drawing.set_modelspace_vport(height=1.1 * float((high - low).max()), center=((low + high) / 2).tolist())
        drawing.write(file)


@contextmanager
def _fixed_dates(ezdxf: Any) -> Iterator[None]:
    """The only switch for dates that ezdxf has is one for the process; put it back."""
    before = ezdxf.options.write_fixed_meta_data_for_testing
    ezdxf.options.write_fixed_meta_data_for_testing = True
    try:
        yield
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = before


def load_ezdxf(path: str | os.PathLike[str]) -> Any:
    """The library behind this file, or an error that says which extra it comes with."""
    try:
        import ezdxf
    except ImportError:
        extra = "pip install 'jaxsonar[cad]'"
        raise SonarError(f"{shown(path)}: DXF needs the cad extra: {extra}") from None
    return ezdxf

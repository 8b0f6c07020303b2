"""Global maps as CAD drawings (DXF). Needs the extra ``cad``."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from jaxsonar.fileio.atomic_files import atomic_write, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.mapping.global_map import GlobalMap

LAYER = "WALLS"
"""Name of the layer that contains the walls."""
CIRCLE_LAYER = "CIRCLES"
"""Name of the layer that contains the circles."""
_METRES = 6  # code of metres in $INSUNITS


def save_dxf(world: GlobalMap, filename: str | os.PathLike[str]) -> None:
    """Write the walls and circles of a map as a drawing, in metres, world frame.

    Each wall is a LINE on the layer WALLS, each circle a CIRCLE on the layer CIRCLES.

    The same map gives the same bytes: the drawing has fixed dates and no random identifiers.

    Args:
        world: the map.
        filename: the file; it is replaced only after everything is written.

    Raises:
        SonarError: the file cannot be written, or the extra is missing.
    """
    ezdxf = load_ezdxf(filename)
    with _fixed_dates(ezdxf), atomic_write(filename) as file:
        drawing = ezdxf.new("R2010", units=_METRES)
        drawing.layers.add(LAYER)
        space = drawing.modelspace()
        for start, end in world.segments.astype(float).tolist():
            space.add_line(start, end, dxfattribs={"layer": LAYER})
        round_ones = world.with_kinds("circle")
        if len(round_ones.points):
            drawing.layers.add(CIRCLE_LAYER)
        for center, radius in zip(round_ones.points.tolist(), round_ones.point_radius.tolist(), strict=True):
            space.add_circle(center, radius, dxfattribs={"layer": CIRCLE_LAYER})
        if len(world):
            low, high = world.segments.min(axis=(0, 1)), world.segments.max(axis=(0, 1))
            # The initial view shows the whole map with a margin.
            drawing.set_modelspace_vport(height=1.1 * float((high - low).max()), center=((low + high) / 2).tolist())
        drawing.write(file)


@contextmanager
def _fixed_dates(ezdxf: Any) -> Iterator[None]:
    """Fix the dates that ezdxf writes. Its only switch is global, so it is restored afterwards."""
    before = ezdxf.options.write_fixed_meta_data_for_testing
    ezdxf.options.write_fixed_meta_data_for_testing = True
    try:
        yield
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = before


def load_ezdxf(filename: str | os.PathLike[str]) -> Any:
    """Import ezdxf, or raise an error that names the extra."""
    try:
        import ezdxf
    except ImportError:
        extra = "pip install 'jaxsonar[cad]'"
        raise SonarError(f"{shown(filename)}: DXF needs the cad extra: {extra}") from None
    return ezdxf

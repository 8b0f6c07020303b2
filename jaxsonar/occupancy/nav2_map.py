"""Occupancy grids as files that Nav2's map_server loads: a YAML file and an image beside it."""

import json
import os
from pathlib import Path

from jaxsonar.fileio.atomic_files import atomic_write, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.occupancy.occupancy_grid import OccupancyGrid


def grid_image_path(path: str | os.PathLike[str]) -> Path:
    """Where the image of a grid goes: beside its YAML file, under the same name.

    Raises:
        SonarError: the path does not end in .yaml or .yml.
    """
    suffix = Path(path).suffix
    if suffix.lower() not in (".yaml", ".yml"):
        came = f"suffix '{shown(suffix)}'" if suffix else "no suffix"
        raise SonarError(f"{shown(path)}: {came} came; allowed for a grid is .yaml or .yml, its .pgm goes beside it")
    return Path(path).with_suffix(".pgm")


def check_grid(grid: OccupancyGrid) -> None:
    """Raise a SonarError for a grid without cells, which is no map."""
    if not grid.free.size:
        why = f"{grid.skipped} scans without a pose" if grid.skipped else "no scan"
        raise SonarError(f"{why} came, the grid is empty; needed is a scan with a pose")


def save_nav2(grid: OccupancyGrid, path: str | os.PathLike[str]) -> None:
    """Write the grid as Nav2's map_server loads it: MAP.yaml, and the image MAP.pgm beside it.

    The threshold for free is 0.196, as map_saver writes it for trinary images: with Nav2's older 0.25 the grey of
    unknown cells would be read as free (navigation2, pull request 5278).

    Args:
        grid: what is known, one cell at least.
        path: the YAML file, .yaml or .yml.

    Raises:
        SonarError: another suffix, a grid without cells, or a place that cannot be written.
    """
    image_path = grid_image_path(path)
    try:
        check_grid(grid)
    except SonarError as error:
        raise SonarError(f"{shown(path)}: {error}") from None
    image = grid.classify()
    rows, columns = image.shape
    x, y = grid.origin
    with atomic_write(image_path, binary=True) as file:
        file.write(f"P5\n{columns} {rows}\n255\n".encode() + image.tobytes())
    with atomic_write(path) as file:
        file.write(
            f"image: {json.dumps(image_path.name)}\n"  # a JSON string is a YAML string, whatever is in the name
            f"mode: trinary\nresolution: {grid.resolution:.9g}\norigin: [{x:.9g}, {y:.9g}, 0.0]\n"
            "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
        )

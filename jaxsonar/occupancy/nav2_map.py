"""Occupancy grids as files of Nav2's map_server: a YAML file, and an image beside it."""

import json
import os
from pathlib import Path

from jaxsonar.fileio.atomic_files import atomic_write, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.occupancy.occupancy_grid import OccupancyGrid


def grid_image_filename(filename: str | os.PathLike[str]) -> Path:
    """The image file of a grid: beside its YAML file, with the suffix .pgm.

    Raises:
        SonarError: the filename does not end in .yaml or .yml.
    """
    suffix = Path(filename).suffix
    if suffix.lower() not in (".yaml", ".yml"):
        came = f"suffix '{shown(suffix)}'" if suffix else "no suffix"
        raise SonarError(
            f"{shown(filename)}: {came} came; allowed for a grid is .yaml or .yml, its .pgm goes beside it"
        )
    return Path(filename).with_suffix(".pgm")


def check_grid(grid: OccupancyGrid) -> None:
    """Raise a SonarError for a grid without cells, which is not a map."""
    if not grid.free.size:
        why = f"{grid.skipped} scans without a pose" if grid.skipped else "no scan"
        raise SonarError(f"{why} came, the grid is empty; needed is a scan with a pose")


def save_nav2(grid: OccupancyGrid, filename: str | os.PathLike[str]) -> None:
    """Write a grid for Nav2's map_server: MAP.yaml, and the image MAP.pgm beside it.

    The threshold of free cells is 0.196, as in map_saver's trinary images. With Nav2's older 0.25, the grey of unknown
    cells would be read as free (navigation2, pull request 5278).

    Args:
        grid: a grid with at least one cell.
        filename: the YAML file, .yaml or .yml.

    Raises:
        SonarError: another suffix, a grid without cells, or a file that cannot be written.
    """
    image_file = grid_image_filename(filename)
    try:
        check_grid(grid)
    except SonarError as error:
        raise SonarError(f"{shown(filename)}: {error}") from None
    image = grid.classify()
    rows, columns = image.shape
    x, y = grid.origin
    with atomic_write(image_file, binary=True) as file:
        file.write(f"P5\n{columns} {rows}\n255\n".encode() + image.tobytes())
    with atomic_write(filename) as file:
        file.write(
            f"image: {json.dumps(image_file.name)}\n"  # a JSON string is a valid YAML string, for any name
            f"mode: trinary\nresolution: {grid.resolution:.9g}\norigin: [{x:.9g}, {y:.9g}, 0.0]\n"
            "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
        )

"""Occupancy grids as files of Nav2's map_server: a YAML file, and an image beside it."""

import json
import os
from io import BytesIO
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from jaxsonar.fileio.atomic_files import atomic_write, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.occupancy.occupancy_grid import OccupancyGrid
from jaxsonar.occupancy.settings import SETTINGS

Nav2Mode = Literal["trinary", "scale"]
"""How map_server reads the image: cells are free, occupied or unknown; or have a probability, too."""


def grid_image_filename(filename: str | os.PathLike[str], *, mode: Nav2Mode = "trinary") -> Path:
    """The image file of a grid: beside its YAML file, with the suffix .pgm, or .png in scale mode.

    Raises:
        SonarError: the filename does not end in .yaml or .yml.
    """
    suffix = Path(filename).suffix
    image = ".png" if mode == "scale" else ".pgm"
    if suffix.lower() not in (".yaml", ".yml"):
        came = f"suffix '{shown(suffix)}'" if suffix else "no suffix"
        raise SonarError(
            f"{shown(filename)}: {came} came; allowed for a grid is .yaml or .yml, its {image} goes beside it"
        )
    return Path(filename).with_suffix(image)


def check_grid(grid: OccupancyGrid) -> None:
    """Raise a SonarError for a grid without cells, which is not a map."""
    if not grid.free.size:
        why = f"{grid.skipped} scans without a pose" if grid.skipped else "no scan"
        raise SonarError(f"{why} came, the grid is empty; needed is a scan with a pose")


def save_nav2(
    grid: OccupancyGrid,
    filename: str | os.PathLike[str],
    *,
    mode: Nav2Mode = "trinary",
    image_file: Path | None = None,
) -> None:
    """Write a grid for Nav2's map_server: MAP.yaml, and the image beside it.

    Trinary: MAP.pgm, as map_saver writes it. Scale: MAP.png, in which cells that are neither free nor occupied are as
    dark as they are likely to be occupied, and cells that were not observed are transparent.

    Args:
        grid: a grid with at least one cell.
        filename: the YAML file, .yaml or .yml.
        mode: how map_server reads the image.
        image_file: in the same folder; by default ``grid_image_filename``.

    Raises:
        SonarError: another suffix, a grid without cells, or a file that cannot be written.
    """
    image_file = image_file or grid_image_filename(filename, mode=mode)
    try:
        check_grid(grid)
    except SonarError as error:
        raise SonarError(f"{shown(filename)}: {error}") from None
    x, y = grid.origin
    with atomic_write(image_file, binary=True) as file:
        file.write(_png(scale_image(grid)) if mode == "scale" else _pgm(grid.classify()))
    with atomic_write(filename) as file:
        file.write(
            f"image: {json.dumps(image_file.name)}\n"  # a JSON string is a valid YAML string, for any name
            f"mode: {mode}\nresolution: {grid.resolution:.9g}\norigin: [{x:.9g}, {y:.9g}, 0.0]\n"
            f"negate: 0\noccupied_thresh: {SETTINGS.occupied_threshold:g}\nfree_thresh: {SETTINGS.free_threshold:g}\n"
        )


def scale_image(grid: OccupancyGrid) -> UInt8[np.ndarray, "rows columns 2"]:
    """Grey values and opacity of the cells for map_server's scale mode; row 0 has the largest y."""
    known = ~np.isnan(grid.probability)
    grey = np.where(known, np.rint(255 * (1 - grid.probability)), 127)
    return np.stack([grey, np.where(known, 255, 0)], axis=-1).astype(np.uint8)[::-1]


def _pgm(image: UInt8[np.ndarray, "rows columns"]) -> bytes:
    rows, columns = image.shape
    return f"P5\n{columns} {rows}\n255\n".encode() + image.tobytes()


def _png(image: UInt8[np.ndarray, "rows columns 2"]) -> bytes:
    from matplotlib.image import imsave

    file = BytesIO()
    imsave(file, np.ascontiguousarray(image[..., [0, 0, 0, 1]]), format="png")
    return file.getvalue()

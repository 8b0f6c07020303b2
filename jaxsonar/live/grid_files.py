"""The files of a grid that is written again and again, while others read them."""

import os
import time
from dataclasses import dataclass
from pathlib import Path

from jaxsonar.occupancy.nav2_map import Nav2Mode, grid_image_filename, save_nav2
from jaxsonar.occupancy.occupancy_grid import OccupancyGrid


@dataclass(frozen=True)
class GridFilesSettings:
    """Timing of the files of a grid. Chosen by hand."""

    reading_time: float = 0.2
    """Seconds that a reader may take from the YAML file to its image; needed once, at the end."""


SETTINGS = GridFilesSettings()


def second_image_filename(filename: str | os.PathLike[str], *, mode: Nav2Mode = "trinary") -> Path:
    """The image of every other grid while a stream runs: MAP.next.pgm beside MAP.yaml."""
    image = grid_image_filename(filename, mode=mode)
    return image.with_suffix(f".next{image.suffix}")


class GridFiles:
    """A YAML file and its image: a reader never combines the origin of one grid with the image of another.

    Both files are replaced atomically, the image first. A grid of another origin or size gets the other of two image
    names, so that the image of the previous YAML file stays. After ``finish`` the image is MAP.pgm, alone.
    """

    def __init__(self, filename: str | os.PathLike[str], *, mode: Nav2Mode = "trinary"):
        """Nothing is written yet.

        Args:
            filename: the YAML file, .yaml or .yml.
            mode: how map_server reads the image.

        Raises:
            SonarError: another suffix.
        """
        self.filename = filename
        self.mode: Nav2Mode = mode
        self._image = self._final = grid_image_filename(filename, mode=mode)
        self._second = second_image_filename(filename, mode=mode)
        self._place: tuple[tuple[int, int], tuple[int, ...]] | None = None
        self._grid: OccupancyGrid | None = None
        self._written = 0.0

    def write(self, grid: OccupancyGrid) -> None:
        """Write a grid with at least one cell.

        Raises:
            SonarError: a file that cannot be written.
        """
        place = grid.corner, grid.free.shape
        if self._place is None:
            self._image = self._second if os.path.exists(self._final) else self._final  # of an earlier run
        elif place != self._place:
            self._image = self._final if self._image == self._second else self._second
        save_nav2(grid, self.filename, mode=self.mode, image_file=self._image)
        self._place, self._grid, self._written = place, grid, time.monotonic()

    def finish(self) -> None:
        """Give the image its final name. Does nothing if no grid was written.

        Raises:
            SonarError: a file that cannot be written.
        """
        if self._grid is not None and self._image == self._second:
            time.sleep(max(0.0, self._written + SETTINGS.reading_time - time.monotonic()))
            self._image = self._final
            save_nav2(self._grid, self.filename, mode=self.mode)
        self._second.unlink(missing_ok=True)

"""The options of occupancy grids, and the grid of a log, for all commands that write one."""

import argparse
import os
from typing import TYPE_CHECKING

from jaxsonar.cli.arguments import filename_ending_in
from jaxsonar.cli.console import errors_in

if TYPE_CHECKING:
    from jaxsonar.mapping.global_map import GlobalMap
    from jaxsonar.occupancy.occupancy_grid import OccupancyGrid
    from jaxsonar.scans.scan_log import Log
    from jaxsonar.sensors.ring import Ring


def add_grid_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--grid`` and its options."""
    parser.add_argument(
        "--grid",
        type=filename_ending_in(".yaml", ".yml"),
        metavar="YAML",
        help="occupancy grid for Nav2, with a .pgm or .png beside",
    )
    parser.add_argument(
        "--grid-method",
        choices=("counts", "elfes", "wilkes", "logodds", "em"),
        help="how echoes become obstacles: those that no wall explains (counts, default); log-odds of the first "
        "(elfes) or all (wilkes) direct echoes, or of all echoes (logodds); all echoes, iterated (em)",
    )
    parser.add_argument(
        "--grid-mode",
        choices=("trinary", "scale"),
        help="trinary (default), or scale: a .png with probabilities of the undecided cells",
    )


def grid_outputs(options: argparse.Namespace) -> "dict[str, str | os.PathLike[str] | None]":
    """The files of the grid, for ``check_outputs``.

    Raises:
        SonarError: options of a grid without ``--grid``.
    """
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.occupancy.nav2_map import grid_image_filename

    if options.grid is None:
        for name in ("grid_method", "grid_mode"):
            if getattr(options, name) is not None:
                option = "--" + name.replace("_", "-")
                raise SonarError(f"{option} came without --grid; allowed is it with --grid")
        return {}
    return {
        "--grid": options.grid,
        "--grid's image": grid_image_filename(options.grid, mode=options.grid_mode or "trinary"),
    }


def grid_of(options: argparse.Namespace, ring: "Ring", log: "Log", world: "GlobalMap") -> "OccupancyGrid | None":
    """The grid that the options ask for; None without ``--grid``."""
    if options.grid is None:
        return None
    from jaxsonar.occupancy.direct_readings import certain_angle
    from jaxsonar.occupancy.incremental_grid import occupancy
    from jaxsonar.occupancy.known_reflectors import KnownReflectors
    from jaxsonar.occupancy.nav2_map import check_grid
    from jaxsonar.sensors.ring_toml import load_detection

    detection = load_detection(options.ring)
    certain = None if detection is None else certain_angle(*detection)
    with errors_in(f"--grid {options.grid}"):
        known, method = KnownReflectors.of_map(world), options.grid_method or "counts"
        grid = occupancy(ring, log, walls=known, method=method, certain=certain)
        check_grid(grid)
    return grid


def save_grid(options: argparse.Namespace, grid: "OccupancyGrid | None") -> None:
    """Write the files of a grid."""
    if grid is not None:
        from jaxsonar.occupancy.nav2_map import save_nav2

        save_nav2(grid, options.grid, mode=options.grid_mode or "trinary")

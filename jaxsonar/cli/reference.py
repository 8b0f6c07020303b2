"""``jaxsonar reference``: reference walls from a laser on the same robot."""

import argparse

from jaxsonar.cli.arguments import figure_filename, filename, finite, number
from jaxsonar.cli.console import laser_files, print_status, write_figure
from jaxsonar.reports.text import plural

SUMMARY = "Reference walls of a run, from the laser of the same robot."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar reference``."""
    parser.add_argument("recording", type=filename, metavar="RECORDING", help="folder with laser.txt and poses.txt")
    parser.add_argument("--from", dest="from_", choices=("corridor8",), default="corridor8", help="its format")
    parser.add_argument(
        "--reach", type=finite(0.1, 100), default=3.5, metavar="M", help="maximum laser range (default: 3.5 m)"
    )
    parser.add_argument(
        "--scan", type=number(int, 0, 2**62), metavar="N", help="polygonal model of this scan only, laser frame"
    )
    parser.add_argument(
        "-o", "--output", type=filename, metavar="REF", required=True, help="GeoJSON, metres; - = stdout"
    )
    parser.add_argument("--figure", type=figure_filename, metavar="FIG", help="draw the walls, .svg, .png or .pdf")


def run(options: argparse.Namespace) -> None:
    """Run ``jaxsonar reference``."""
    import numpy as np

    from jaxsonar.evaluation.laser_polygonal_model import polygonal_model
    from jaxsonar.evaluation.laser_reference_map import laser_points, reference_map, save_reference
    from jaxsonar.fileio.atomic_files import check_outputs, shown
    from jaxsonar.geometry.se2 import unit
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.hardware.laser_datasets import read_corridor8_laser
    from jaxsonar.reports.plot_map import laser_figure

    check_outputs({"-o": options.output, "--figure": options.figure}, laser_files(options.recording))
    laser = read_corridor8_laser(options.recording)
    if options.scan is not None and options.scan >= len(laser.stamp):
        held = f"0 to {len(laser.stamp) - 1}" if len(laser.stamp) else "none"
        raise SonarError(f"--scan {options.scan}: no such scan in {shown(options.recording)}; it holds {held}")
    if options.scan is None:
        try:
            walls, points = reference_map(laser, reach=options.reach), laser_points(laser, every=4)
        except SonarError as error:
            raise SonarError(f"{shown(options.recording)}: {error}") from None
        length = np.hypot(*(walls[:, 1] - walls[:, 0]).T).sum()
        what = f"{plural(len(laser.stamp), 'scan')}, {plural(len(walls), 'wall')}, {length:.1f} m"
    else:
        ranges = laser.ranges[options.scan]
        walls = polygonal_model(laser.bearing, ranges)
        points = (ranges[:, None] * unit(laser.bearing))[np.isfinite(ranges)]
        what = (
            f"{plural(len(walls.segments), 'segment')}, {plural(len(walls.pseudo), 'pseudo segment')}, "
            f"{plural(len(walls.intersections), 'intersection')}"
        )
    figure = laser_figure(walls, points) if options.figure else None
    save_reference(walls, options.output)
    write_figure(figure, options.figure)
    print_status(what)

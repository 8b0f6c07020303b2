"""Argument types and options shared by several commands. Nothing heavy is imported, so that ``--help`` is fast."""

import argparse
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING

from jaxsonar.fileio.atomic_files import FIGURE_FORMATS

if TYPE_CHECKING:
    from jaxsonar.estimation.odometry_noise import OdometryNoise


RING_HELP = "ring TOML, or the name of a shipped ring: faw, bumper4, corridor8, scitos24, sew-amr"

SIGMA_HELP = "standard deviation of the ranges, for ml (default: estimated for each scan)"

SETTINGS_HELP = "settings of accumulator and low pass, for hough also threshold (default: the paper's)"

ODOMETRY_HELP = (
    "standard deviation of the odometry after 1 m: %% of the distance and deg (default: 3,1.5; slam with few sensors: "
    "3,0.6)"
)


def number(kind: type, least: float | int, most: float | int):
    """An argparse type: a number within [least, most]."""

    def parse(text: str):
        try:
            value = kind(text)
        except ValueError:
            value = None
        if value is None or not least <= value <= most:
            name = "a whole number" if kind is int else "a number"
            upper = "" if most == float("inf") else f" to {most:g}"
            raise argparse.ArgumentTypeError(f"{text!r} came; allowed is {name} from {least:g}{upper or ' on'}")
        return value

    return parse


def finite(least: float | int, most: float | int = 1e9):
    """An argparse type: a finite number within [least, most]."""
    return number(float, least, most)


def noise(text: str) -> float:
    """An argparse type: a standard deviation of ranges, metres."""
    try:
        return finite(1e-4, 1)(text)
    except argparse.ArgumentTypeError as error:
        try:
            hint = " metres; is it in mm?" if 1 < float(text) < 1e4 else " metres"
        except ValueError:
            hint = " metres"
        raise argparse.ArgumentTypeError(f"{error}{hint}") from None


def filename(text: str) -> str:
    """An argparse type: a filename. The file need not exist."""
    if not text or "\0" in text:
        raise argparse.ArgumentTypeError(f"{text!r} came; allowed is the name of a file")
    return text


def filename_ending_in(*suffixes: str):
    """An argparse type: a filename with one of these suffixes, checked before the computation."""

    def parse(text: str) -> str:
        if Path(text).suffix.lower() not in suffixes:
            raise argparse.ArgumentTypeError(f"{text!r} came; allowed is a file name ending in {', '.join(suffixes)}")
        return text

    return parse


figure_filename = filename_ending_in(*FIGURE_FORMATS)


def odometry_error(text: str) -> tuple[float, float]:
    """An argparse type: odometry error after 1 m as PERCENT,DEG."""
    try:
        percent, degrees = map(finite(0, 100), text.split(","))
    except (ValueError, argparse.ArgumentTypeError):
        allowed = "two numbers from 0 to 100, PERCENT,DEG, such as 2,1"
        raise argparse.ArgumentTypeError(f"{text!r} came; allowed is {allowed}") from None
    return percent, degrees


def add_detection_arguments(command: argparse.ArgumentParser) -> None:
    """Add ``--ring``, ``--method``, ``--sigma`` and ``--settings`` of commands that detect lines."""
    command.add_argument("--ring", type=filename, required=True, help=RING_HELP)
    command.add_argument(
        "--method",
        choices=("ml", "hough"),
        default="ml",
        help="ml: maximum likelihood (default); hough: the paper's, faster",
    )
    command.add_argument("--sigma", type=noise, metavar="METRES", help=SIGMA_HELP)
    command.add_argument("--settings", type=filename, metavar="TOML", help=SETTINGS_HELP)


def add_slam_arguments(command: argparse.ArgumentParser) -> None:
    """Add ``--ring``, ``--sigma`` and ``--odometry`` as ``slam`` and ``localize`` have them."""
    command.add_argument("--ring", type=filename, required=True, help=RING_HELP)
    command.add_argument(
        "--sigma", type=noise, metavar="METRES", help="standard deviation of the ranges (default: estimated)"
    )
    command.add_argument("--odometry", type=odometry_error, metavar="PERCENT,DEG", help=ODOMETRY_HELP)


def odometry_noise(error: tuple[float, float] | None) -> "OdometryNoise":
    """Odometry noise from per cent of the distance and degrees, after one metre; None: the default."""
    from jaxsonar.estimation.odometry_noise import OdometryNoise

    if error is None:
        return OdometryNoise()
    position, heading = max(error[0] / 100, 1e-4), max(math.radians(error[1]), 1e-4)
    return OdometryNoise(
        position_per_meter=position, heading_per_meter=heading, heading_per_radian=max(position, heading)
    )


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

"""The command line: what can be said, and how mistakes are answered. What is done stands in ``commands``.

Nothing heavy is imported here, so that help comes at once.
"""

import argparse
import os
import re
import sys
from collections.abc import Sequence
from functools import partial
from importlib import import_module, metadata
from pathlib import Path
from typing import NoReturn

from jaxsonar.cli.batch import add_command as add_batch_command
from jaxsonar.cli.live import add_commands as add_live_commands
from jaxsonar.cli.slam import add_commands as add_slam_commands
from jaxsonar.fileio.atomic_files import FIGURE_FORMATS as FIGURES
from jaxsonar.hardware.errors import SonarError

SIGMA_HELP = "standard deviation of the ranges, for ml (default: estimated for each scan)"
SETTINGS_HELP = "accumulator and low pass, for hough also threshold, instead of the paper's"
ODOMETRY_HELP = "how wrong the odometry is after 1 m: %% of the way and deg (default: 3,1.5)"
COMPILING = ("demo", "lines", "map", "slam", "localize", "calibrate", "check")
"""Commands that run kernels: their compiled programs are kept (``stream`` and ``batch`` see to it themselves)."""
RING_HELP = "ring TOML, or the name of a shipped ring: faw, corridor8, scitos24, sew-amr"


class _Parser(argparse.ArgumentParser):
    """Answers a wrong call with one line and exit code 2."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {' '.join(message.split())}; see {self.prog} --help\n")


def _number(kind: type, least: float | int, most: float | int):
    """A number from ``least`` to ``most``, or a message that says so."""

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


def _finite(least: float | int, most: float | int = 1e9):
    return _number(float, least, most)


def _file(text: str) -> str:
    if not text or "\0" in text:
        raise argparse.ArgumentTypeError(f"{text!r} came; allowed is the name of a file")
    return text


def _ending_in(*suffixes: str):
    """A name with one of these suffixes: a wrong one is refused before the work, not after it."""

    def parse(text: str) -> str:
        if Path(text).suffix.lower() not in suffixes:
            raise argparse.ArgumentTypeError(f"{text!r} came; allowed is a file name ending in {', '.join(suffixes)}")
        return text

    return parse


_figure = _ending_in(*FIGURES)


def _odometry(text: str) -> tuple[float, float]:
    """Two numbers, per cent of the way and degrees."""
    try:
        percent, degrees = map(_finite(0, 100), text.split(","))
    except (ValueError, argparse.ArgumentTypeError):
        allowed = "two numbers from 0 to 100, PERCENT,DEG, such as 2,1"
        raise argparse.ArgumentTypeError(f"{text!r} came; allowed is {allowed}") from None
    return percent, degrees


def _choose_method(command: argparse.ArgumentParser) -> None:
    command.add_argument("--method", choices=("ml", "hough"), default="ml", help="default: ml; hough: the paper's")
    command.add_argument(
        "--sigma",
        type=_finite(1e-4, 1),
        metavar="METRES",
        help=SIGMA_HELP,
    )


def parser() -> argparse.ArgumentParser:
    """The whole command line."""
    top = _Parser(prog="jaxsonar", description="Maps from the echoes of an ultrasonic ring.", allow_abbrev=False)
    top.add_argument("--version", action="version", version=f"jaxsonar {metadata.version('jaxsonar')}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, summary: str) -> argparse.ArgumentParser:
        return commands.add_parser(name, help=summary, description=summary, allow_abbrev=False)

    demo = command("demo", "The embedded office, 17 scans: figures and a table of deviations.")
    demo.add_argument("-o", "--output", metavar="DIR", default="demo", help="where to write (default: demo)")
    demo.add_argument("--seed", type=_number(int, 0, 2**32 - 1), default=1, help="of the simulated noise (default: 1)")

    lines = command("lines", "Straight lines around the robot, from every scan of a log.")
    lines.add_argument("log", metavar="LOG", help="scan log, .csv or .parquet")
    lines.add_argument("--ring", required=True, help=RING_HELP)
    _choose_method(lines)
    lines.add_argument("--settings", metavar="TOML", help=SETTINGS_HELP)
    lines.add_argument(
        "-o", "--output", metavar="LINES", required=True, help="JSON Lines, an object a scan; - = stdout"
    )
    lines.add_argument(
        "--figure", type=_figure, metavar="FIG", help="draw arcs and lines of one scan, .svg, .png or .pdf"
    )
    lines.add_argument("--scan", type=_number(int, -(2**62), 2**62), metavar="N", help="scan to draw (default: first)")

    map_ = command("map", "The walls of the world, from a log of scans with poses.")
    map_.add_argument("log", type=_file, metavar="LOG", help="scan log with poses, .csv or .parquet")
    map_.add_argument("--ring", type=_file, required=True, help=RING_HELP)
    _choose_method(map_)
    map_.add_argument(
        "--settings",
        type=_file,
        metavar="TOML",
        help=SETTINGS_HELP,
    )
    map_.add_argument(
        "--window",
        type=_finite(0.01, 100),
        metavar="METRES",
        help="gather the echoes of this much path into one local model, for rings of few sensors (try 1.5)",
    )
    map_.add_argument(
        "--merging", choices=("fused", "paper"), default="fused", help="how segments become walls (default: fused)"
    )
    map_.add_argument(
        "-o", "--output", type=_file, metavar="MAP", required=True, help="GeoJSON, world metres; - = stdout"
    )
    map_.add_argument("--figure", type=_figure, metavar="FIG", help="draw the map, .svg, .png or .pdf")
    map_.add_argument(
        "--grid", type=_ending_in(".yaml", ".yml"), metavar="YAML", help="occupancy grid for Nav2, with a .pgm beside"
    )
    map_.add_argument("--dxf", type=_ending_in(".dxf"), metavar="DXF", help="the walls for CAD (extra cad)")
    map_.add_argument(
        "--laser", type=_file, metavar="RECORDING", help="draw the laser points of a corridor8 recording below"
    )

    reference = command("reference", "Reference walls of a run, from the laser of the same robot.")
    reference.add_argument("recording", type=_file, metavar="RECORDING", help="folder with laser.txt and poses.txt")
    reference.add_argument("--from", dest="from_", choices=("corridor8",), default="corridor8", help="its format")
    reference.add_argument(
        "--reach", type=_finite(0.1, 100), default=3.5, metavar="M", help="of what came this near (default: 3.5 m)"
    )
    reference.add_argument(
        "--scan", type=_number(int, 0, 2**62), metavar="N", help="the polygonal model of this scan alone, laser frame"
    )
    reference.add_argument(
        "-o", "--output", type=_file, metavar="REF", required=True, help="GeoJSON, metres; - = stdout"
    )
    reference.add_argument("--figure", type=_figure, metavar="FIG", help="draw it, .svg, .png or .pdf")

    evaluate = command("evaluate", "How well a map agrees with a reference: deviations, precision, recall.")
    evaluate.add_argument("map", type=_file, metavar="MAP", help="GeoJSON, world metres")
    evaluate.add_argument(
        "reference", type=_file, metavar="REFERENCE", help="GeoJSON of the same world: a reference or a room"
    )
    evaluate.add_argument("--gate", type=_finite(1e-6, 100), default=0.15, metavar="M", help="default: 0.15 m")
    evaluate.add_argument("--gate-deg", type=_finite(1e-3, 90), default=10.0, metavar="DEG", help="default: 10 deg")
    evaluate.add_argument(
        "--json", type=_file, metavar="FILE", help="the same figures as JSON; - = stdout instead of the table"
    )

    simulate = command("simulate", "The echoes that a ring hears along a path through a room.")
    simulate.add_argument("room", metavar="ROOM", help="room GeoJSON: walls, polygons, points of kind pole; metres")
    simulate.add_argument("--ring", required=True, help=RING_HELP)
    simulate.add_argument("--path", required=True, metavar="CSV", help="poses: columns x, y (m), theta (rad), [stamp]")
    simulate.add_argument("-o", "--output", metavar="LOG", required=True, help=".csv or .parquet; - = CSV on stdout")
    simulate.add_argument("--sigma", type=_finite(0), default=0.0, metavar="M", help="range noise, metres (default: 0)")
    simulate.add_argument("--drift", type=_finite(0), default=0.0, metavar="M", help="slow drift, metres (default: 0)")
    simulate.add_argument("--dropout", type=_finite(0, 1), default=0.0, metavar="P", help="echoes lost (default: 0)")
    simulate.add_argument("--clutter", type=_finite(0, 100), default=0.0, metavar="P", help="false echoes per real one")
    simulate.add_argument("--seed", type=_number(int, 0, 2**32 - 1), default=0, help="of the noise (default: 0)")
    simulate.add_argument("--max-echoes", type=_number(int, 1, 64), default=3, metavar="N", help="a path (default: 3)")
    logged = simulate.add_mutually_exclusive_group()
    logged.add_argument(
        "--odometry",
        type=_odometry,
        metavar="PERCENT,DEG",
        help="poses of the log drift as from wheels: %% of the way and deg after 1 m, growing with its root (try 2,1)",
    )
    logged.add_argument("--no-odometry", action="store_true", help="no poses in the log")
    simulate.add_argument("--truth", type=_file, metavar="TRAJ", help="the true poses, for evo: TUM; - = stdout")

    calibrate = command("calibrate", "Find out how a ring really is, from ordinary scans of a room nobody measured.")
    calibrate.add_argument(
        "logs", nargs="+", type=_file, metavar="LOG", help="scan logs of this ring, .csv or .parquet"
    )
    calibrate.add_argument("--ring", type=_file, required=True, help=f"the ring as it should be: {RING_HELP}")
    calibrate.add_argument(
        "-o", "--output", type=_file, metavar="RING2", required=True, help="the calibrated ring, TOML; - = stdout"
    )
    calibrate.add_argument(
        "--poses",
        choices=("trust", "estimate"),
        default="trust",
        help="of the logs: right (default), or odometry if anything, and to be estimated",
    )
    calibrate.add_argument(
        "--free",
        type=lambda text: tuple(name.strip() for name in text.split(",")),
        default=("offset", "speed"),
        metavar="LIST",
        help="what is estimated: offset, speed, position, radius, heading, with commas (default: offset,speed)",
    )
    calibrate.add_argument(
        "--odometry",
        type=_finite(1e-4, 1),
        default=0.02,
        metavar="SHARE",
        help="of the way that odometry is wrong by (default: 0.02)",
    )
    calibrate.add_argument(
        "--temperature", type=_finite(-60, 85), metavar="DEG_C", help="of the air, if it was measured"
    )
    calibrate.add_argument(
        "--sigma", type=_finite(1e-4, 1), metavar="METRES", help="noise of the ranges (default: estimated)"
    )
    calibrate.add_argument(
        "--window", type=_finite(0.01, 100), metavar="METRES", help="gather so much path, for rings of few sensors"
    )
    calibrate.add_argument("--figure", type=_figure, metavar="FIG", help="report on a page, .svg, .png or .pdf")

    check = command("check", "The health of a ring, sensor by sensor, from what it heard.")
    check.add_argument("log", type=_file, metavar="LOG", help="scan log, .csv or .parquet; poses are not needed")
    check.add_argument("--ring", type=_file, required=True, help=RING_HELP)
    check.add_argument(
        "--sigma", type=_finite(1e-4, 1), metavar="METRES", help="noise of the ranges (default: estimated)"
    )
    check.add_argument("--json", type=_file, metavar="FILE", help="the same as JSON; - = stdout instead of the table")
    check.add_argument("--figure", type=_figure, metavar="FIG", help="draw it on a page, .svg, .png or .pdf")

    convert = command("convert", "Scan logs between CSV and Parquet, and recordings of devices into scan logs.")
    convert.add_argument("source", metavar="IN", help="log or recording")
    convert.add_argument("destination", metavar="OUT", help="scan log, .csv or .parquet")
    formats = ("corridor8", "scitos24", "sew-amr", "csv", "parquet")
    convert.add_argument("--from", dest="from_", choices=formats, help="format of IN (default: by its suffix)")

    texts = {"ring": RING_HELP, "sigma": SIGMA_HELP, "settings": SETTINGS_HELP, "odometry": ODOMETRY_HELP}
    whole = partial(_number, int)
    add_slam_commands(command, number=_finite, file=_file, figure=_figure, odometry=_odometry, texts=texts)
    add_batch_command(command, whole=whole, file=_file, choose_method=_choose_method, texts=texts)
    add_live_commands(command, whole=whole, number=_finite, ending_in=_ending_in, odometry=_odometry, texts=texts)
    return top


def _joined(arguments: Sequence[str]) -> list[str]:
    """With negative numbers that follow an option written as one with it: argparse takes -0.1,0,90 for an option."""
    out: list[str] = []
    for one in arguments:
        if out and out[-1] in ("--start", "--odometry") and re.match(r"-[\d.]", one):
            out[-1] += f"={one}"
        else:
            out.append(one)
    return out


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; the exit code: 0 done, 2 the input or the call was wrong, 1 anything else, or a part undone."""
    options = parser().parse_args(_joined(sys.argv[1:] if arguments is None else arguments))
    if sys.stdout is None:  # closed by whoever called
        with open(os.devnull, "w") as sys.stdout:
            return main(arguments)
    try:
        if options.command in COMPILING:
            import_module("jaxsonar.fileio.compilation_cache").use_compilation_cache()
        code = getattr(import_module("jaxsonar.cli.console"), options.command)(options)
        sys.stdout.flush()
    except SonarError as error:
        print(f"jaxsonar {options.command}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"jaxsonar {options.command}: interrupted", file=sys.stderr)
        return 1
    except BrokenPipeError:
        # The reader of our output has gone: what is left goes nowhere, or Python complains about it at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:  # a full disk behind standard output
        print(f"jaxsonar {options.command}: {error.strerror or error}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return code or 0

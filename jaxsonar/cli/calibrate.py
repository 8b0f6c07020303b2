"""``jaxsonar calibrate``: estimate the parameters of a ring from ordinary scans."""

import argparse

from jaxsonar.cli.arguments import RING_HELP, figure_filename, filename, finite
from jaxsonar.cli.console import plain_name, print_status, step_status

SUMMARY = "Find out how a ring really is, from ordinary scans of a room nobody measured."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar calibrate``."""
    parser.add_argument(
        "logs", nargs="+", type=filename, metavar="LOG", help="scan logs of this ring, .csv or .parquet"
    )
    parser.add_argument("--ring", type=filename, required=True, help=f"the ring as it should be: {RING_HELP}")
    parser.add_argument(
        "-o", "--output", type=filename, metavar="RING2", required=True, help="the calibrated ring, TOML; - = stdout"
    )
    parser.add_argument(
        "--poses",
        choices=("trust", "estimate"),
        default="trust",
        help="of the logs: right (default), or odometry if anything, and to be estimated",
    )
    parser.add_argument(
        "--free",
        type=lambda text: tuple(name.strip() for name in text.split(",")),
        default=("offset", "speed"),
        metavar="LIST",
        help="what is estimated: offset, speed, position, radius, heading, with commas (default: offset,speed)",
    )
    parser.add_argument(
        "--odometry",
        type=finite(1e-4, 1),
        default=0.02,
        metavar="SHARE",
        help="of the way that odometry is wrong by (default: 0.02)",
    )
    parser.add_argument("--temperature", type=finite(-60, 85), metavar="DEG_C", help="of the air, if it was measured")
    parser.add_argument(
        "--sigma", type=finite(1e-4, 1), metavar="METRES", help="noise of the ranges (default: estimated)"
    )
    parser.add_argument(
        "--window", type=finite(0.01, 100), metavar="METRES", help="gather so much path, for rings of few sensors"
    )
    parser.add_argument("--figure", type=figure_filename, metavar="FIG", help="report on a page, .svg, .png or .pdf")


def run(options: argparse.Namespace) -> None:
    """``jaxsonar calibrate``."""
    from jaxsonar.calibration.calibrate import calibrate as calibrate_ring
    from jaxsonar.calibration.calibration_toml import save_calibration
    from jaxsonar.fileio.atomic_files import check_outputs
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.scans.log_file import load_log
    from jaxsonar.sensors.ring_toml import load_ring

    check_outputs({"-o": options.output, "--figure": options.figure}, [*options.logs, options.ring])
    ring, logs = load_ring(options.ring), [load_log(path) for path in options.logs]
    choices = {key: getattr(options, key) for key in ("free", "poses", "odometry", "temperature", "sigma", "window")}
    try:
        with step_status() as step:
            found = calibrate_ring(ring, logs, **choices, on_step=step)
    except SonarError as error:
        raise SonarError(f"{', '.join(plain_name(path) for path in options.logs)}: {error}") from None
    figure = None
    if options.figure:
        from jaxsonar.reports import plot_calibration as figures_calibration

        figure = figures_calibration.calibration_figure(found)
    save_calibration(found, options.output)
    if figure is not None:
        from jaxsonar.reports import plot_style as figures

        figures.save(figure, options.figure)
    for line in found.summary():
        print_status(line)

"""``jaxsonar calibrate``: estimate the parameters of a ring from ordinary scans."""

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxsonar.scans.scan_log import Log
    from jaxsonar.sensors.ring import Ring

from jaxsonar.cli.arguments import RING_HELP, figure_filename, filename, finite, noise
from jaxsonar.cli.console import ascii_name, errors_in, laser_files, print_status, step_status, write_figure
from jaxsonar.cli.inputs import LOG_HELP, InputMessages, add_log_arguments, load_all_inputs, nothing_used
from jaxsonar.hardware.errors import SonarError

DEFAULT_FREE = ("offset", "speed")
"""Parameters that are estimated unless others are chosen."""
SUMMARY = "Calibrate a ring from ordinary scans of an unknown room."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar calibrate``."""
    add_log_arguments(parser, name="logs", nargs="+", help=f"logs of this ring: {LOG_HELP}")
    parser.add_argument("--ring", type=filename, required=True, help=f"the nominal ring: {RING_HELP}")
    parser.add_argument(
        "-o", "--output", type=filename, metavar="RING2", required=True, help="the calibrated ring, TOML; - = stdout"
    )
    parser.add_argument(
        "--poses",
        choices=("trust", "estimate"),
        default="trust",
        help="poses of the logs: exact (trust, default), or odometry or missing (estimate)",
    )
    parser.add_argument(
        "--free",
        type=lambda text: tuple(name.strip() for name in text.split(",")),
        default=DEFAULT_FREE,
        metavar="LIST",
        help="estimated parameters: offset, speed, position, radius, heading, with commas (default: offset,speed)",
    )
    parser.add_argument(
        "--odometry",
        type=finite(1e-4, 1),
        metavar="SHARE",
        help="relative error of the odometry, for --poses estimate (default: 0.02); not for rings with few sensors",
    )
    parser.add_argument("--temperature", type=finite(-60, 85), metavar="DEG_C", help="measured air temperature")
    parser.add_argument(
        "--sigma", type=noise, metavar="METRES", help="standard deviation of the ranges (default: estimated)"
    )
    parser.add_argument(
        "--window",
        type=finite(0.01, 100),
        metavar="METRES",
        help="combine the echoes of this distance driven, for rings with few sensors (default for them: 1.5 or more)",
    )
    parser.add_argument(
        "--laser",
        type=filename,
        metavar="RECORDING",
        help="fit offsets and speed of sound to the laser of a corridor8 recording of the same run",
    )
    parser.add_argument("--figure", type=figure_filename, metavar="FIG", help="draw the results, .svg, .png or .pdf")


def run(options: argparse.Namespace) -> int:
    """Run ``jaxsonar calibrate``. Returns 1 if no echo could be used."""
    from jaxsonar.calibration.calibrate import calibrate as calibrate_ring
    from jaxsonar.calibration.calibration_toml import save_calibration
    from jaxsonar.fileio.atomic_files import check_outputs

    inputs = [*options.logs, options.ring, *laser_files(options.laser)]
    check_outputs({"-o": options.output, "--figure": options.figure}, inputs)
    if options.laser is not None:
        _check_laser_options(options)
    messages = InputMessages(strict=options.strict)
    ring, logs = load_all_inputs(options, options.logs, messages=messages)
    unused = [nothing_used(ring, log, name) for log, name in zip(logs, options.logs, strict=True)]
    if all(unused):
        return 1
    if options.laser is not None:
        return _fit_to_laser(options, ring, logs[0])
    choices = {key: getattr(options, key) for key in ("free", "poses", "odometry", "temperature", "sigma", "window")}
    with errors_in(", ".join(ascii_name(log) for log in options.logs)), step_status() as step:
        try:
            calibration = calibrate_ring(ring, logs, **choices, on_step=step)
        except SonarError as error:
            raise SonarError(_shortened(str(error), messages.warnings)) from None
    figure = None
    if options.figure:
        from jaxsonar.reports.plot_calibration import calibration_figure

        figure = calibration_figure(calibration)
    save_calibration(calibration, options.output)
    write_figure(figure, options.figure)
    for line in calibration.summary():
        print_status(line)
    return 0


def _check_laser_options(options: argparse.Namespace) -> None:
    """Raise a SonarError for options that contradict ``--laser``."""
    if len(options.logs) > 1:
        raise SonarError(f"--laser came with {len(options.logs)} logs; allowed is one, of the same run as the laser")
    names = ("temperature", "sigma", "window", "odometry")
    unused = [f"--{name}" for name in names if getattr(options, name) is not None]
    unused += ["--free"] if tuple(options.free) != DEFAULT_FREE else []
    unused += ["--poses estimate"] if options.poses == "estimate" else []
    if unused:
        raise SonarError(
            f"--laser came with {unused[0]}; allowed is --laser without it: it fits offset and speed of sound at the "
            "poses of the log"
        )


def _fit_to_laser(options: argparse.Namespace, ring: "Ring", log: "Log") -> int:
    """Fit the ring to a laser, write it, and draw the residuals."""
    from jaxsonar.evaluation.laser_range_fit import fit_ranges_to_laser, save_laser_fit
    from jaxsonar.hardware.laser_datasets import read_corridor8_laser

    with errors_in(f"--laser {options.laser}"):
        fit = fit_ranges_to_laser(ring, log, read_corridor8_laser(options.laser))
    figure = None
    if options.figure:
        from jaxsonar.reports.plot_calibration import laser_fit_figure

        figure = laser_fit_figure(fit)
    save_laser_fit(fit, options.output)
    write_figure(figure, options.figure)
    for line in fit.summary():
        print_status(line)
    return 0


def _shortened(error: str, warnings: list[str]) -> str:
    """An error that refers to a warning that was printed instead of repeating it."""
    repeated = next((one for one in warnings if one in error), "")
    return error.replace(repeated, f"{repeated.split('; ')[1]}: see the warning") if repeated else error

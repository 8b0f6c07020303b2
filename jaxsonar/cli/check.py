"""``jaxsonar check``: the health of a ring, sensor by sensor."""

import argparse
import sys
from functools import partial

from jaxsonar.cli.arguments import RING_HELP, figure_filename, filename, finite
from jaxsonar.cli.console import count, print_left_out, print_status, progress_bar

SUMMARY = "The health of a ring, sensor by sensor, from what it heard."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar check``."""
    parser.add_argument("log", type=filename, metavar="LOG", help="scan log, .csv or .parquet; poses are not needed")
    parser.add_argument("--ring", type=filename, required=True, help=RING_HELP)
    parser.add_argument(
        "--sigma", type=finite(1e-4, 1), metavar="METRES", help="noise of the ranges (default: estimated)"
    )
    parser.add_argument(
        "--json", type=filename, metavar="FILE", help="the same as JSON; - = stdout instead of the table"
    )
    parser.add_argument("--figure", type=figure_filename, metavar="FIG", help="draw it on a page, .svg, .png or .pdf")


def run(options: argparse.Namespace) -> None:
    """``jaxsonar check``."""
    import json

    from rich.console import Console

    from jaxsonar.diagnostics.check_ring import check as check_ring
    from jaxsonar.fileio.atomic_files import check_outputs, open_output, shown
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.reports.terminal_tables_health import health_table
    from jaxsonar.scans.log_file import load_log
    from jaxsonar.sensors.ring_toml import load_ring

    check_outputs({"--json": options.json, "--figure": options.figure}, [options.log, options.ring])
    ring, log = load_ring(options.ring), load_log(options.log)
    try:
        with progress_bar("scans", None) as show:
            health = check_ring(
                ring,
                log,
                sigma=options.sigma,
                progress=lambda done, _: show(done),
                on_left_out=partial(print_left_out, ring.name),
            )
    except SonarError as error:
        raise SonarError(f"{shown(options.log)}: {error}") from None
    figure = None
    if options.figure:
        from jaxsonar.reports import plot_health as figures_health

        figure = figures_health.health_figure(health)
    if options.json:
        with open_output(options.json) as file:
            json.dump(health.as_json(), file, allow_nan=False, indent=1)
            file.write("\n")
    if figure is not None:
        from jaxsonar.reports import plot_style as figures

        figures.save(figure, options.figure)
    if options.json != "-":
        Console(width=None if sys.stdout.isatty() else 140).print(health_table(health))
    for finding in health.findings:
        print_status(finding)
    print_status(f"{len(log)} scans, {count(len(health.findings), 'finding')}" if health.source else health.empty)

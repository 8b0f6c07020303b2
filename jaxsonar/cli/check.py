"""``jaxsonar check``: the health of a ring, sensor by sensor."""

import argparse
from functools import partial
from itertools import chain

from jaxsonar.cli.arguments import RING_HELP, figure_filename, filename, noise
from jaxsonar.cli.console import (
    errors_in,
    print_left_out,
    print_status,
    print_tables,
    progress_bar,
    write_figure,
    write_json,
)
from jaxsonar.cli.inputs import LOG_HELP, add_log_arguments, load_inputs
from jaxsonar.reports.text import plural

SUMMARY = "Check the health of a ring, sensor by sensor, from a log."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar check``."""
    add_log_arguments(parser, help=f"poses are not needed: {LOG_HELP}")
    parser.add_argument("--ring", type=filename, required=True, help=RING_HELP)
    parser.add_argument(
        "--sigma", type=noise, metavar="METRES", help="standard deviation of the ranges (default: estimated)"
    )
    parser.add_argument(
        "--json", type=filename, metavar="FILE", help="the same as JSON; - = stdout instead of the table"
    )
    parser.add_argument("--figure", type=figure_filename, metavar="FIG", help="draw the results, .svg, .png or .pdf")


def run(options: argparse.Namespace) -> None:
    """Run ``jaxsonar check``."""
    from jaxsonar.diagnostics.check_ring import check as check_ring
    from jaxsonar.fileio.atomic_files import check_outputs
    from jaxsonar.reports.terminal_tables import health_table

    check_outputs({"--json": options.json, "--figure": options.figure}, [options.log, options.ring])
    ring, log = load_inputs(options, as_recorded=True)
    with errors_in(options.log), progress_bar("scans", None) as show:
        health = check_ring(
            ring,
            log,
            sigma=options.sigma,
            progress=lambda done, _: show(done),
            on_left_out=partial(print_left_out, ring.name),
        )
    figure = None
    if options.figure:
        from jaxsonar.reports.plot_health import health_figure

        figure = health_figure(health)
    if options.json:
        write_json(health.as_json(), options.json)
    write_figure(figure, options.figure)
    if options.json != "-":
        print_tables(health_table(health))
    for line in chain.from_iterable(finding.lines() for finding in health.findings):
        print_status(line)
    print_status(f"{len(log)} scans, {plural(len(health.findings), 'finding')}" if health.source else health.empty)

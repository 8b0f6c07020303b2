"""``jaxsonar ring``: what a ring is, and what it can observe."""

import argparse

from jaxsonar.cli.arguments import RING_HELP, figure_filename, filename, noise
from jaxsonar.cli.console import print_tables, progress_bar, write_figure, write_json
from jaxsonar.cli.inputs import InputMessages, add_strict, load_checked_ring

SUMMARY = "Describe a ring, and compute what it can observe."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar ring``."""
    parser.add_argument("ring", type=filename, metavar="RING", help=RING_HELP)
    parser.add_argument(
        "--bounds",
        action="store_true",
        help="Cramer-Rao bounds of walls, corners, edges and circles, and error rates of the kinds, over distance",
    )
    parser.add_argument(
        "--sigma", type=noise, metavar="METRES", help="with --bounds: standard deviation of the ranges (default: 0.001)"
    )
    parser.add_argument(
        "--json", type=filename, metavar="FILE", help="with --bounds: the same as JSON; - = stdout instead of the table"
    )
    parser.add_argument(
        "--figure", type=figure_filename, metavar="FIG", help="with --bounds: draw the bounds, .svg, .png or .pdf"
    )
    add_strict(parser)


def run(options: argparse.Namespace) -> None:
    """Run ``jaxsonar ring``."""
    from jaxsonar.fileio.atomic_files import check_outputs
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.reports.observability_tables import bounds_table, ring_lines

    for name in ("sigma", "json", "figure"):
        if getattr(options, name) is not None and not options.bounds:
            raise SonarError(f"--{name} came without --bounds; allowed is it with --bounds")
    check_outputs({"--json": options.json, "--figure": options.figure}, [options.ring])
    messages = InputMessages(strict=options.strict)
    ring = load_checked_ring(options.ring, messages)
    if options.sigma is not None:
        messages.warn_of_noise(options.sigma)
    messages.check()
    if options.json != "-":
        print("\n".join(ring_lines(ring)))
    if not options.bounds:
        return

    from jaxsonar.observability.ring_bounds import distances_of, ring_bounds

    with progress_bar("rows", 2 * len(distances_of(ring))) as show:
        bounds = ring_bounds(ring, sigma=options.sigma or 0.001, progress=show)
    if options.json:
        write_json(bounds.as_json(), options.json)
    if options.figure:
        from jaxsonar.reports.plot_observability import observability_figure

        write_figure(observability_figure(ring, bounds), options.figure)
    if options.json != "-":
        print_tables(bounds_table(bounds, "shot"), bounds_table(bounds, "scan"))

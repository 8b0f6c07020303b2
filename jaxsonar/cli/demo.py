"""``jaxsonar demo``: the embedded office, from simulation to map and figures."""

import argparse
from pathlib import Path

from jaxsonar.cli.arguments import number
from jaxsonar.cli.console import print_status, print_tables, progress_bar

SUMMARY = "The embedded office, 17 scans: figures and a table of deviations."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar demo``."""
    parser.add_argument("-o", "--output", metavar="DIR", default="demo", help="output folder (default: demo)")
    parser.add_argument(
        "--seed", type=number(int, 0, 2**32 - 1), default=1, help="seed of the simulated noise (default: 1)"
    )


def run(options: argparse.Namespace) -> None:
    """Run ``jaxsonar demo``."""
    from jaxsonar.demo.comparison import PAPER, line_summary
    from jaxsonar.demo.run_demo import SETTINGS, run_demo
    from jaxsonar.reports.terminal_tables import line_accuracy_table, map_accuracy_table

    with progress_bar("rooms", SETTINGS.random_rooms) as show:
        comparisons, map_rows = run_demo(Path(options.output), seed=options.seed, on_step=print_status, on_room=show)
    rows = [(name, line_summary(accuracy, sigma=SETTINGS.sigma)) for name, accuracy in comparisons]
    print_tables(line_accuracy_table(rows, paper=PAPER), map_accuracy_table(map_rows))
    print_status(f"all results: {options.output}/index.html; the map: {options.output}/map.geojson")

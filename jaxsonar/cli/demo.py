"""``jaxsonar demo``: the embedded office from simulation to map and figures."""

import argparse
import sys
from pathlib import Path

from jaxsonar.cli.arguments import number
from jaxsonar.cli.console import print_status, progress_bar

SUMMARY = "The embedded office, 17 scans: figures and a table of deviations."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar demo``."""
    parser.add_argument("-o", "--output", metavar="DIR", default="demo", help="where to write (default: demo)")
    parser.add_argument("--seed", type=number(int, 0, 2**32 - 1), default=1, help="of the simulated noise (default: 1)")


def run(options: argparse.Namespace) -> None:
    """``jaxsonar demo``."""
    from rich.console import Console

    from jaxsonar.demo.run_demo import PAPER, RANDOM_ROOMS, run_demo, summary
    from jaxsonar.reports.terminal_tables import deviation_table, map_table

    with progress_bar("rooms", RANDOM_ROOMS) as show:
        rows, maps = run_demo(Path(options.output), seed=options.seed, on_step=print_status, on_room=show)
    console = Console(width=None if sys.stdout.isatty() else 140)
    console.print(deviation_table([(name, summary(row)) for name, row in rows], paper=PAPER))
    console.print(map_table(maps))
    print_status(f"all of it: {options.output}/index.html; the map: {options.output}/map.geojson")

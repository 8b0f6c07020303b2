"""``jaxsonar evaluate``: accuracy, precision and recall of a map against a reference."""

import argparse
import sys

from jaxsonar.cli.arguments import filename, finite

SUMMARY = "How well a map agrees with a reference: deviations, precision, recall."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar evaluate``."""
    parser.add_argument("map", type=filename, metavar="MAP", help="GeoJSON, world metres")
    parser.add_argument(
        "reference", type=filename, metavar="REFERENCE", help="GeoJSON of the same world: a reference or a room"
    )
    parser.add_argument("--gate", type=finite(1e-6, 100), default=0.15, metavar="M", help="default: 0.15 m")
    parser.add_argument("--gate-deg", type=finite(1e-3, 90), default=10.0, metavar="DEG", help="default: 10 deg")
    parser.add_argument(
        "--json", type=filename, metavar="FILE", help="the same figures as JSON; - = stdout instead of the table"
    )


def run(options: argparse.Namespace) -> None:
    """``jaxsonar evaluate``."""
    import json

    import numpy as np
    from rich.console import Console

    from jaxsonar.evaluation.map_accuracy import evaluate as evaluate_map
    from jaxsonar.fileio.atomic_files import check_outputs, open_output
    from jaxsonar.mapping.map_geojson import load_walls
    from jaxsonar.reports.terminal_tables_evaluation import evaluation_table

    check_outputs({"--json": options.json}, [options.map, options.reference])
    found = evaluate_map(
        load_walls(options.map),
        load_walls(options.reference),
        gate_distance=options.gate,
        gate_angle=float(np.radians(options.gate_deg)),
    )
    if options.json:
        with open_output(options.json) as file:
            json.dump(found.as_json(), file, allow_nan=False, indent=1)
            file.write("\n")
    if options.json != "-":
        Console(width=None if sys.stdout.isatty() else 140).print(evaluation_table(found))

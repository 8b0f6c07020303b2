"""``jaxsonar evaluate``: accuracy, precision and recall of a map against a reference."""

import argparse

from jaxsonar.cli.arguments import filename, finite
from jaxsonar.cli.console import print_tables, write_json
from jaxsonar.cli.inputs import InputMessages, add_strict

SUMMARY = "Compare a map with a reference: deviations, precision, recall."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar evaluate``."""
    parser.add_argument("map", type=filename, metavar="MAP", help="GeoJSON, world metres")
    parser.add_argument(
        "reference", type=filename, metavar="REFERENCE", help="GeoJSON of the same world: a reference or a room"
    )
    parser.add_argument(
        "--gate",
        type=finite(1e-6, 100),
        default=0.15,
        metavar="M",
        help="maximum distance of a match (default: 0.15 m)",
    )
    parser.add_argument(
        "--gate-deg",
        type=finite(1e-3, 90),
        default=10.0,
        metavar="DEG",
        help="maximum angle of a match (default: 10 deg)",
    )
    parser.add_argument(
        "--json", type=filename, metavar="FILE", help="the same figures as JSON; - = stdout instead of the table"
    )
    add_strict(parser)


def run(options: argparse.Namespace) -> None:
    """Run ``jaxsonar evaluate``."""
    import numpy as np

    from jaxsonar.evaluation.map_accuracy import evaluate as evaluate_map
    from jaxsonar.evaluation.point_accuracy import KIND_OF_REFERENCE, evaluate_points
    from jaxsonar.fileio.atomic_files import check_outputs
    from jaxsonar.mapping.global_map import POINT_KINDS
    from jaxsonar.mapping.map_geojson import load_points, load_walls
    from jaxsonar.reports.terminal_tables import evaluation_table, point_table

    check_outputs({"--json": options.json}, [options.map, options.reference])
    messages = InputMessages(strict=options.strict)
    walls, reference = load_walls(options.map), load_walls(options.reference)
    messages.warn_of_walls(options.map, walls)
    messages.warn_of_walls(options.reference, reference)
    messages.check()
    evaluation = evaluate_map(
        walls,
        reference,
        gate_distance=options.gate,
        gate_angle=float(np.radians(options.gate_deg)),
    )
    # Poles and circles of a room, against the points of the map.
    points = load_points(options.map, kinds=(*POINT_KINDS, "pole"))
    there, kinds, radii = load_points(options.reference, kinds=tuple(KIND_OF_REFERENCE))
    of_points = evaluate_points(*points, walls, there, kinds, np.nan_to_num(radii), reference, gate=options.gate)
    has_points = bool(len(there))
    if options.json:
        more = {"points": of_points.as_json()} if has_points else {}
        write_json(evaluation.as_json() | more, options.json)
    if options.json != "-":
        print_tables(evaluation_table(evaluation), *([point_table(of_points)] if has_points else []))

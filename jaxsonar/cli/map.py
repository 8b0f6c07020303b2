"""``jaxsonar map``: a map from scans with known poses."""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from jaxsonar.detection.local_model import LocalModel
    from jaxsonar.kernels import HoughSettings
    from jaxsonar.mapping.global_map import GlobalMap
    from jaxsonar.mapping.map_evidence import MapEvidence
    from jaxsonar.scans.scan_log import Log
    from jaxsonar.sensors.ring import Ring

from jaxsonar.cli.arguments import (
    add_detection_arguments,
    add_grid_arguments,
    figure_filename,
    filename,
    filename_ending_in,
    finite,
    grid_outputs,
)
from jaxsonar.cli.console import (
    ascii_name,
    check_sigma_is_used,
    errors_in,
    grid_of,
    laser_files,
    print_left_out,
    print_status,
    save_grid,
    settings_filename,
    stage_status,
    write_figure,
)
from jaxsonar.cli.inputs import LOG_HELP, InputMessages, add_log_arguments, load_inputs, nothing_used
from jaxsonar.reports.text import plural

SUMMARY = "Build a map of walls, from a log of scans with poses."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar map``."""
    add_log_arguments(parser, help=f"with poses: {LOG_HELP}")
    add_detection_arguments(parser)
    parser.add_argument(
        "--window",
        type=finite(0.01, 100),
        metavar="METRES",
        help="combine the echoes of this distance driven into one local model (default: none, or for rings with few "
        "sensors a length that is chosen from ring and trajectory)",
    )
    parser.add_argument(
        "--merging",
        choices=("fused", "paper"),
        default="fused",
        help="method that merges segments to walls (default: fused)",
    )
    parser.add_argument(
        "-o", "--output", type=filename, metavar="MAP", required=True, help="GeoJSON, world metres; - = stdout"
    )
    parser.add_argument("--figure", type=figure_filename, metavar="FIG", help="draw the map, .svg, .png or .pdf")
    add_grid_arguments(parser)
    parser.add_argument("--dxf", type=filename_ending_in(".dxf"), metavar="DXF", help="the walls for CAD (extra cad)")
    parser.add_argument(
        "--laser", type=filename, metavar="RECORDING", help="draw the laser points of a corridor8 recording below"
    )


def run(options: argparse.Namespace) -> int:
    """Run ``jaxsonar map``. Returns 1 if no echo could be used."""
    import numpy as np

    from jaxsonar.detection.settings import hough_settings, widened
    from jaxsonar.detection.settings_toml import load_settings
    from jaxsonar.fileio.atomic_files import check_outputs, write_toml
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.mapping.build_map import check_poses, required_scans
    from jaxsonar.mapping.map_geojson import save_map
    from jaxsonar.scans.sliding_windows import automatic_window, check_window

    settings_file = settings_filename(options.output)
    if settings_file and options.settings and Path(options.settings).resolve() == settings_file.resolve():
        settings_file = None  # it already holds these settings
    check_outputs(
        {
            "-o": options.output,
            "settings beside the map:": settings_file,
            "--figure": options.figure,
            **grid_outputs(options),
            "--dxf": options.dxf,
        },
        [options.log, options.ring, options.settings, *laser_files(options.laser)],
    )
    if options.laser is not None and not options.figure:
        raise SonarError("--laser came alone; allowed is --laser with --figure, to which it belongs")
    if options.dxf:
        from jaxsonar.mapping.map_dxf import load_ezdxf

        load_ezdxf(options.dxf)
    check_window(options.window)
    check_sigma_is_used(options.sigma, options.method)
    messages = InputMessages(strict=options.strict)
    ring, log = load_inputs(options, messages=messages)
    given = None if options.settings is None else load_settings(options.settings)
    window = options.window
    settings = hough_settings(ring, given, window=window)
    if nothing_used(ring, log, options.log):
        return 1
    with errors_in(options.log):
        check_poses(log)
    if nothing_used(ring, log, options.log, with_poses=True):
        return 1
    messages.warn_of_scale(ring, log)
    if window is None and (window := automatic_window(ring, log)) is not None:
        settings = hough_settings(ring, None, window=window) if given is None else widened(ring, given, window=window)
        if given is not None and settings.rho_cells > given.rho_cells:
            cells = f"{given.rho_cells} rho_cells are too few for windows of {window:g} m"
            print_status(f"--settings {options.settings}: {cells}; {settings.rho_cells} are used")
    points = None if options.laser is None else _laser_points(options.laser)
    left_out: list[int] = []
    models, evidence, world = _build(ring, log, settings, options, window, left_out.append)

    # Compute everything before the first file is written.
    figure = None
    has_pose = np.all(np.isfinite(log.pose), axis=1)
    grid = grid_of(options, ring, log, world)
    if options.figure:
        from jaxsonar.reports.plot_map import map_figure

        figure = map_figure(
            world,
            aggregated=evidence.segments.endpoints,
            poses=log.pose[has_pose],
            laser_points=points,
            title=f"{plural(len(world), 'wall')} from {ascii_name(options.log)}",
        )
    save_map(world, options.output)
    if settings_file is not None:
        choices: dict[str, object] = {name: getattr(options, name) for name in ("method", "sigma", "merging")}
        choices["window"] = window
        write_toml(_run_settings(settings, choices), settings_file)
    save_grid(options, grid)
    if options.dxf:
        from jaxsonar.mapping.map_dxf import save_dxf

        save_dxf(world, options.dxf)
    write_figure(figure, options.figure)
    if left_out:
        print_left_out(ring.name, left_out[0])
    if window is not None and options.window is None:
        print_status(f"single scans of {ring.name!r} do not determine lines: --window {window:g} is used")
    without_pose = int((~has_pose).sum())
    remark = f"; {plural(without_pose, 'scan')} without a pose left out" if without_pose else ""
    if not len(world):
        print_status(f"no wall: {_why_no_wall(models, evidence, options.merging, required_scans(window))}")
    print_status(
        f"{plural(len(log), 'scan')}, {plural(len(models), 'local model')}, "
        f"{plural(len(evidence.segments), 'segment')}, {plural(len(world), 'wall')}, {world.length.sum():.1f} m{remark}"
    )
    return 0


def _build(
    ring: "Ring",
    log: "Log",
    settings: "HoughSettings",
    options: argparse.Namespace,
    window: float | None,
    on_left_out: Callable[[int], None],
) -> "tuple[Sequence[LocalModel], MapEvidence, GlobalMap]":
    """The map of a log, with progress; also the local models (with windows, of the given length) and their evidence."""
    from jaxsonar.mapping.build_map import build_map

    observed: list[tuple[Sequence[LocalModel], MapEvidence]] = []
    with errors_in(options.log), stage_status() as progress:
        world = build_map(
            ring,
            log,
            method=options.method,
            settings=settings,
            sigma=options.sigma,
            window=window,
            merging=options.merging,
            on_left_out=on_left_out,
            on_observed=lambda models, evidence: observed.append((models, evidence)),
            progress=progress,
        )
    return *observed[0], world


def _why_no_wall(models: "Sequence[LocalModel]", evidence: "MapEvidence", merging: str, min_scans: int) -> str:
    """Why local models give a map without walls.

    Args:
        models: all local models.
        evidence: theirs.
        merging: method that merges segments to walls.
        min_scans: number of scans that must have observed a wall.
    """
    from collections import Counter

    from jaxsonar.mapping.build_map import assemble_map

    count = len(evidence.segments)
    if not count:
        reasons = Counter(model.empty for model in models if model.empty).most_common()
        why = [f"{number} without: {reason}" for reason, number in reasons]
        if min_scans > 1:
            why.append("try --window 1.5 if the ring has few sensors")
        return "; ".join([f"no line in {plural(evidence.models, 'local model')} with a pose", *why])
    lines = f"{plural(count, 'line')} in {plural(evidence.models, 'local model')}"
    seen = max(map(len, assemble_map(evidence, merging=merging, min_scans=1).scans), default=0)
    if 0 < seen < min_scans:
        few = f"no wall is seen by more than {plural(seen, 'scan')}, and {min_scans} are needed"
        return f"{lines}, but {few}; are the poses right, with x and y in metres and the heading in radians?"
    return f"{lines}, but later scans see through them, or they belong to poles and corners; are the poses right?"


def _laser_points(recording: str) -> "np.ndarray":
    from jaxsonar.evaluation.laser_reference_map import laser_points
    from jaxsonar.hardware.laser_datasets import read_corridor8_laser

    return laser_points(read_corridor8_laser(recording), reach=5.0, every=4)


def _run_settings(settings: "HoughSettings", options: dict[str, object]) -> dict[str, object]:
    """The settings and options of a run, as a table for TOML."""
    from dataclasses import asdict

    table: dict[str, object] = asdict(settings)
    table["command"] = {name: value for name, value in options.items() if value is not None}
    return table

"""``jaxsonar slam``: trajectory and map, from echoes with or without odometry."""

import argparse

from jaxsonar.cli.arguments import (
    add_grid_arguments,
    add_slam_arguments,
    figure_filename,
    filename,
    filename_ending_in,
    finite,
    grid_outputs,
    odometry_noise,
)
from jaxsonar.cli.console import (
    ascii_name,
    errors_in,
    grid_of,
    print_left_out,
    print_status,
    save_grid,
    stage_status,
    write_figure,
    write_json,
)
from jaxsonar.cli.inputs import LOG_HELP, InputMessages, add_log_arguments, load_inputs, nothing_used
from jaxsonar.reports.text import plural

SUMMARY = "Trajectory and map, from echoes and odometry, or from echoes alone."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar slam``."""
    add_log_arguments(parser, help=f"poses are odometry, or missing: {LOG_HELP}")
    add_slam_arguments(parser)
    parser.add_argument(
        "-o", "--output", type=filename, metavar="MAP", required=True, help="GeoJSON, world metres; - = stdout"
    )
    parser.add_argument("--trajectory", type=filename, metavar="TRAJ", help="the poses, TUM format; - = stdout")
    parser.add_argument(
        "--log",
        dest="corrected_log",
        type=filename_ending_in(".csv", ".parquet"),
        metavar="LOG",
        help="the log with the estimated poses: .csv or .parquet",
    )
    add_grid_arguments(parser)
    parser.add_argument(
        "--figure", type=figure_filename, metavar="FIG", help="poses, odometry, walls: .svg, .png or .pdf"
    )
    parser.add_argument(
        "--truth", type=filename, metavar="TRAJ", help="true trajectory (TUM), to compute errors and to draw"
    )
    parser.add_argument(
        "--json", type=filename, metavar="FILE", help="closures, errors, noise, scales as JSON; - = stdout"
    )
    parser.add_argument(
        "--window",
        type=finite(0.01, 100),
        metavar="METRES",
        help="combine the echoes of this distance driven (default: 1.5 for rings with few sensors, else none)",
    )
    parser.add_argument("--speed", action="store_true", help="estimate the speed of sound, too")
    parser.add_argument("--scale", action="store_true", help="estimate the scale errors of the odometry, too")
    parser.add_argument(
        "--smoothing",
        action=argparse.BooleanOptionalAction,
        help="smooth all poses and landmarks at the end (default: up to 2000 scans; a minute per thousand)",
    )


def run(options: argparse.Namespace) -> int:
    """Run ``jaxsonar slam``. Returns 1 if no echo could be used."""
    import numpy as np

    from jaxsonar.cli.slam_summary import (
        as_json,
        check_truth,
        closure_rows,
        errors_against_truth,
        summary_lines,
        truth_in_estimate_frame,
    )
    from jaxsonar.estimation.trajectory import load_trajectory, save_trajectory
    from jaxsonar.fileio.atomic_files import check_outputs
    from jaxsonar.graph_slam.slam import slam as run_slam
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.mapping.map_geojson import save_map
    from jaxsonar.scans.flat_echoes import FlatEchoes
    from jaxsonar.scans.log_file import save_log

    check_outputs(
        {
            "-o": options.output,
            "--trajectory": options.trajectory,
            "--log": options.corrected_log,
            **grid_outputs(options),
            "--figure": options.figure,
            "--json": options.json,
        },
        [options.log, options.ring, options.truth],
    )
    messages = InputMessages(strict=options.strict)
    ring, log = load_inputs(options, messages=messages)
    if nothing_used(ring, log, options.log):
        return 1
    messages.warn_of_scale(ring, log)
    truth = None if options.truth is None else load_trajectory(options.truth)
    if truth is not None:
        check_truth(truth, log, truth_name=str(options.truth), log_name=options.log)
    with errors_in(options.log):
        _, left_out = FlatEchoes.from_log(ring, log)
        with stage_status() as progress:
            result = run_slam(
                ring,
                log,
                sigma=options.sigma,
                window=options.window,
                odometry_noise=None if options.odometry is None else odometry_noise(options.odometry),
                smooth=options.smoothing,
                speed=options.speed,
                scale=options.scale,
                progress=progress,
            )
        trajectory = result.trajectory
        if not len(trajectory):
            raise SonarError("no scan has a pose; allowed are scans that see walls or corners, or odometry")

    # Compute everything before the first file is written.
    errors = None if truth is None else errors_against_truth(result, truth, truth_name=str(options.truth))
    figure = None
    if options.figure:
        from jaxsonar.reports.plot_slam import slam_figure

        walls = plural(len(result.world), "wall")
        figure = slam_figure(
            result.world,
            trajectory,
            odometry=result.odometry if np.isfinite(result.odometry).any() else None,
            truth=None if truth is None else truth_in_estimate_frame(trajectory, truth),
            closures=closure_rows(result, "accepted"),
            withdrawn=closure_rows(result, "withdrawn"),
            title=f"{plural(len(trajectory), 'pose')}, {walls} from {ascii_name(options.log)}",
        )
    table = as_json(result, errors)
    corrected = result.corrected(log)
    grid = grid_of(options, ring, corrected, result.world)
    save_map(result.world, options.output)
    if options.trajectory:
        save_trajectory(trajectory, options.trajectory)
    if options.corrected_log:
        save_log(corrected, options.corrected_log, on_note=print_status)
    save_grid(options, grid)
    write_figure(figure, options.figure)
    if options.json:
        write_json(table, options.json)
    if left_out:
        print_left_out(ring.name, left_out)
    for line in summary_lines(result, errors):
        print_status(line)
    return 0

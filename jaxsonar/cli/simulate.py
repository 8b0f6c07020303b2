"""``jaxsonar simulate``: the echoes of a ring along a trajectory through a floor plan."""

import argparse
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

from jaxsonar.cli.arguments import RING_HELP, filename, finite, number, odometry_error
from jaxsonar.cli.console import print_status, progress_bar, settings_filename
from jaxsonar.cli.inputs import InputMessages, add_strict, load_checked_ring

SUMMARY = "Simulate the echoes of a ring along a trajectory through a room."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar simulate``."""
    parser.add_argument("room", metavar="ROOM", help="room GeoJSON: walls, polygons, points of kind pole; metres")
    parser.add_argument("--ring", required=True, help=RING_HELP)
    parser.add_argument("--path", required=True, metavar="CSV", help="poses: columns x, y (m), theta (rad), [stamp]")
    parser.add_argument("-o", "--output", metavar="LOG", required=True, help=".csv or .parquet; - = CSV on stdout")
    parser.add_argument("--sigma", type=finite(0), default=0.0, metavar="M", help="range noise, metres (default: 0)")
    parser.add_argument(
        "--drift", type=finite(0), default=0.0, metavar="M", help="slow drift of the ranges, metres (default: 0)"
    )
    parser.add_argument(
        "--dropout", type=finite(0, 1), default=0.0, metavar="P", help="probability that an echo is lost (default: 0)"
    )
    parser.add_argument(
        "--clutter", type=finite(0, 100), default=0.0, metavar="P", help="false echoes per real echo (default: 0)"
    )
    parser.add_argument(
        "--beams",
        choices=("soft", "hard"),
        default="soft",
        help="soft: by amplitude, also outside of the cones; hard: only within both cones (default: soft)",
    )
    parser.add_argument("--seed", type=number(int, 0, 2**32 - 1), default=0, help="seed of the noise (default: 0)")
    parser.add_argument(
        "--max-echoes",
        type=number(int, 1, 64),
        default=3,
        metavar="N",
        help="maximum number of echoes per path (default: 3)",
    )
    logged = parser.add_mutually_exclusive_group()
    logged.add_argument(
        "--odometry",
        type=odometry_error,
        metavar="PERCENT,DEG",
        help="poses of the log as from wheel odometry, with this error after 1 m: %% of the distance and deg (try 2,1)",
    )
    logged.add_argument("--no-odometry", action="store_true", help="no poses in the log")
    parser.add_argument("--truth", type=filename, metavar="TRAJ", help="the true poses, for evo: TUM; - = stdout")
    add_strict(parser)


def run(options: argparse.Namespace) -> None:
    """Run ``jaxsonar simulate``."""
    from jaxsonar.estimation.trajectory import Trajectory, save_trajectory
    from jaxsonar.fileio.atomic_files import check_outputs, write_toml
    from jaxsonar.floor_plans.room_geojson import load_room
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.scans.csv_log import csv_lines
    from jaxsonar.scans.log_file import save_log
    from jaxsonar.scans.scan_log import log_format
    from jaxsonar.simulation.poses_csv import load_poses
    from jaxsonar.simulation.simulator import simulate as simulate_scans

    settings_file = settings_filename(options.output)
    outputs = {"-o": options.output, "settings beside the log:": settings_file, "--truth": options.truth}
    check_outputs(outputs, [options.room, options.ring, options.path])
    if options.output == "-" and options.truth == "-":
        raise SonarError("--truth -: the log goes to standard output, too; allowed are different places")
    if options.output != "-":
        log_format(options.output)  # checks the suffix before the simulation
    messages = InputMessages(strict=options.strict)
    ring, room = load_checked_ring(options.ring, messages), load_room(options.room)
    poses, stamps = load_poses(options.path)
    messages.warn_of_room(room, poses, stamps)
    messages.warn_of_noise(options.sigma, drift=options.drift, clutter=options.clutter)
    messages.check()
    with progress_bar("scans", len(poses)) as show:
        simulation = simulate_scans(
            ring,
            room,
            poses,
            sigma=options.sigma,
            drift=options.drift,
            dropout=options.dropout,
            clutter=options.clutter,
            seed=options.seed,
            beams=options.beams,
            max_echoes=options.max_echoes,
            stamps=stamps,
            progress=lambda done, _: show(done),
        )
    log = simulation.as_log(ring, _logged_poses(poses, options))
    if not log.echo_count:
        what = f"no echo from any wall, pole or circle within {ring.max_range:g} m of the path"
        messages.warn(f"{what}; room and path probably do not belong together; give both in one frame, in metres")
        messages.check()
    if options.output == "-":
        sys.stdout.writelines(csv_lines(log))
    else:
        save_log(log, options.output)
    if options.truth:
        save_trajectory(Trajectory(stamps, poses), options.truth)
    if settings_file:
        unused = ("command", "output", "truth", "strict")
        used_options = {key: value for key, value in vars(options).items() if key not in unused}
        write_toml(
            {key: value for key, value in used_options.items() if value is not None and value is not False},
            settings_file,
        )
    print_status(f"{len(log)} scans, {len(log.range)} echoes")


def _logged_poses(poses: "np.ndarray", options: argparse.Namespace) -> "np.ndarray":
    """The poses of the simulated log: true poses, none, or simulated odometry."""
    import numpy as np

    from jaxsonar.simulation.wheel_odometry import simulate_odometry

    if options.no_odometry:
        return np.full_like(poses, np.nan)
    if options.odometry is None:
        return poses
    percent, degrees = options.odometry
    return simulate_odometry(poses, distance=percent / 100, turn=float(np.radians(degrees)), seed=options.seed)

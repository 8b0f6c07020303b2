"""``jaxsonar simulate``: the echoes of a ring along a trajectory through a floor plan."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from jaxsonar.sensors.ring import Ring
    from jaxsonar.simulation.walker import Walker

from jaxsonar.cli.arguments import RING_HELP, filename, finite, number, odometry_error
from jaxsonar.cli.console import print_status, progress_bar, settings_filename
from jaxsonar.cli.inputs import InputMessages, add_strict, load_checked_ring

SUMMARY = "Simulate the echoes of a ring along a trajectory through a room."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar simulate``."""
    parser.add_argument(
        "room", metavar="ROOM", help="room GeoJSON: walls, polygons, points of kind pole or circle; metres"
    )
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
    parser.add_argument(
        "--no-crosstalk",
        action="store_true",
        help="no echoes of other sensors of the firing group; with hard beams there are none anyway",
    )
    parser.add_argument(
        "--walker",
        action="append",
        default=None,
        metavar="CSV[:RADIUS]",
        help="a walking person: columns stamp (s), x, y (m); radius in metres (default: 0.2); may come several times",
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
    from jaxsonar.simulation.walker import load_walker

    settings_file = settings_filename(options.output)
    outputs = {"-o": options.output, "settings beside the log:": settings_file, "--truth": options.truth}
    sources = [_walker_source(text) for text in options.walker or ()]
    check_outputs(outputs, [options.room, options.ring, options.path, *(file for file, _ in sources)])
    if options.output == "-" and options.truth == "-":
        raise SonarError("--truth -: the log goes to standard output, too; allowed are different places")
    if options.output != "-":
        log_format(options.output)  # checks the suffix before the simulation
    messages = InputMessages(strict=options.strict)
    ring, room = load_checked_ring(options.ring, messages), load_room(options.room)
    poses, stamps = load_poses(options.path)
    messages.warn_of_room(room, poses, stamps)
    walkers = [load_walker(*source) for source in sources]
    for (file, _), walker in zip(sources, walkers, strict=True):
        _warn_of_walker(messages, file, walker, ring, poses, stamps)
    _warn_of_columns(messages, room.circles, ring, poses)
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
            crosstalk=False if options.no_crosstalk else None,
            max_echoes=options.max_echoes,
            walkers=walkers,
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


def _walker_source(text: str) -> tuple[str, float]:
    """File and radius (metres) of ``--walker CSV[:RADIUS]``."""
    from jaxsonar.fileio.atomic_files import shown
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.simulation.walker import WALKER_RADIUS

    file, colon, radius = text.rpartition(":")
    if not (colon and file) or Path(text).exists():
        return text, WALKER_RADIUS
    try:
        return file, float(radius)
    except ValueError:
        came = f"--walker {shown(text)}: radius {shown(radius, 40)!r} came"
        raise SonarError(f"{came}; allowed is CSV or CSV:RADIUS, the radius a number of metres") from None


def _warn_of_columns(messages: InputMessages, circles: "np.ndarray", ring: "Ring", poses: "np.ndarray") -> None:
    """Warn of circles of the room (x, y, radius) that overlap the robot; those in another unit have a warning."""
    import numpy as np

    from jaxsonar.plausibility.implausible_room import ROOM_SETTINGS

    reach = float(np.linalg.norm(np.asarray(ring.position), axis=-1).max())
    for x, y, radius in circles.tolist():
        inside = np.flatnonzero(np.hypot(*(poses[:, :2] - (x, y)).T) < radius + reach)
        if len(inside) and radius <= ROOM_SETTINGS.column:
            found = f"the robot overlaps the circle at ({x:g}, {y:g}) in {len(inside)} of {len(poses)} scans"
            cause = "sensors inside of it detect nothing; room and path are probably not in one frame"
            messages.warn(f"{found}, first in scan {inside[0]}; {cause}; give both in one frame")


def _warn_of_walker(
    messages: InputMessages, file: str, walker: "Walker", ring: "Ring", poses: "np.ndarray", stamps: "np.ndarray"
) -> None:
    """Warn of a person who overlaps the robot, never comes near it, or walks at another time."""
    import numpy as np

    from jaxsonar.fileio.atomic_files import shown
    from jaxsonar.simulation.walker import distances_to_robot

    distance = distances_to_robot(walker, poses, stamps)
    reach = float(np.linalg.norm(np.asarray(ring.position), axis=-1).max())
    inside = np.flatnonzero(distance < reach)
    if len(inside):
        found = f"the robot overlaps the person in {len(inside)} of {len(poses)} scans, first in scan {inside[0]}"
        messages.warn(f"{shown(file)}: {found}; sensors inside of a person detect nothing")
    elif distance.min() > reach + ring.max_range:
        found = f"the person stays {distance.min():g} m or more from the robot, out of range"
        messages.warn(f"{shown(file)}: {found}; give positions in metres, in the frame of the room")
    if len(walker.stamps) > 1 and (walker.stamps[0] > stamps[-1] or walker.stamps[-1] < stamps[0]):
        when = f"{walker.stamps[0]:g} to {walker.stamps[-1]:g} s, the scans last from {stamps[0]:g} to {stamps[-1]:g} s"
        messages.warn(f"{shown(file)}: the person walks from {when}; give stamps of the same clock")


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

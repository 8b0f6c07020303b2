"""``jaxsonar localize``: the poses of a short log in a known map."""

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxsonar.mapping.global_map import GlobalMap

from jaxsonar.cli.arguments import add_slam_arguments, figure_filename, filename, odometry_noise_of
from jaxsonar.cli.console import count, plain_name, print_status, stage_status

SUMMARY = "Where the robot is in a known map."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar localize``."""
    parser.add_argument("log", type=filename, metavar="LOG", help="scan log of a short path, .csv or .parquet")
    parser.add_argument(
        "--map", type=filename, required=True, metavar="MAP", help="the known map, or a floor plan: GeoJSON"
    )
    add_slam_arguments(parser)
    parser.add_argument(
        "--start",
        type=_pose,
        metavar="X,Y,DEG",
        help="about where the first scan was taken (m, m, deg): within 0.5 m and 20 deg (default: anywhere)",
    )
    parser.add_argument(
        "--trajectory", type=filename, required=True, metavar="TRAJ", help="poses, TUM format; - = stdout"
    )
    parser.add_argument("--figure", type=figure_filename, metavar="FIG", help="poses and map: .svg, .png or .pdf")


def run(options: argparse.Namespace) -> int:
    """``jaxsonar localize``; 1 if the place is not certain."""
    from jaxsonar.estimation.trajectory import save_trajectory
    from jaxsonar.fileio.atomic_files import check_outputs, shown
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.localization.localize import localize as run_localize
    from jaxsonar.scans.log_file import load_log
    from jaxsonar.sensors.ring_toml import load_ring

    check_outputs(
        {"--trajectory": options.trajectory, "--figure": options.figure}, [options.log, options.ring, options.map]
    )
    ring, log, world = load_ring(options.ring), load_log(options.log), _load_known_map(options.map)
    try:
        with stage_status() as progress:
            found = run_localize(
                ring,
                world,
                log,
                start=options.start,
                sigma=options.sigma,
                odometry_noise=odometry_noise_of(options.odometry),
                progress=progress,
            )
    except SonarError as error:
        raise SonarError(f"{shown(options.log)}: {error}") from None
    if not found.is_certain:
        print_status(found.reason)
        return 1
    trajectory = found.trajectory
    figure = None
    if options.figure:
        from jaxsonar.reports import plot_slam as figures_slam

        figure = figures_slam.slam_figure(
            world,
            trajectory,
            title=f"{count(len(trajectory), 'pose')} in {plain_name(options.map)}",
        )
    save_trajectory(trajectory, options.trajectory)
    if figure is not None:
        from jaxsonar.reports import plot_style as figures

        figures.save(figure, options.figure)
    print_status(found.reason)
    if len(trajectory) < len(log):
        print_status(
            f"{len(log) - len(trajectory)} of {count(len(log), 'scan')} could not be registered to the others: no pose"
        )
    return 0


def _load_known_map(path: str) -> "GlobalMap":
    """A map, or a floor plan as one; what is neither is refused as a map."""
    from jaxsonar.fileio.atomic_files import shown
    from jaxsonar.floor_plans.room_geojson import load_room
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.mapping.floor_plan import map_from_room
    from jaxsonar.mapping.map_geojson import load_map

    try:
        world = load_map(path)
    except SonarError as no_map:
        try:
            world = map_from_room(load_room(path))
        except SonarError:
            raise no_map from None
    if not len(world):
        raise SonarError(f"{shown(path)}: no wall; allowed is a map with walls")
    return world


def _pose(text: str) -> tuple[float, float, float]:
    """Three numbers: metres, metres, degrees."""
    import math

    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 3 or not all(abs(value) < 1e8 for value in numbers):  # False for NaN
        raise argparse.ArgumentTypeError(f"{text!r} came; allowed are three numbers X,Y,DEG, such as 1.5,-0.2,90")
    x, y, degrees = numbers
    return x, y, math.radians(degrees)

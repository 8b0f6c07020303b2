"""``jaxsonar localize``: the poses of a short log in a known map."""

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxsonar.mapping.global_map import GlobalMap

from jaxsonar.cli.arguments import add_slam_arguments, figure_filename, filename, odometry_noise
from jaxsonar.cli.console import ascii_name, errors_in, print_status, stage_status, write_figure
from jaxsonar.cli.inputs import LOG_HELP, InputMessages, add_log_arguments, load_inputs, nothing_used
from jaxsonar.reports.text import plural

NAV2_SUFFIXES = (".yaml", ".yml", ".posegraph", ".data", ".pgm", ".png")
"""Files of Nav2 and slam_toolbox, of which the YAML file is read."""

SUMMARY = "Localize the robot in a known map."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar localize``."""
    add_log_arguments(parser, help=f"a short drive: {LOG_HELP}")
    parser.add_argument(
        "--map",
        type=filename,
        required=True,
        metavar="MAP",
        help="the known map: a map or a floor plan (GeoJSON), or a map of Nav2, as slam_toolbox saves it (.yaml)",
    )
    add_slam_arguments(parser)
    parser.add_argument(
        "--start",
        type=_pose,
        metavar="X,Y,DEG",
        help="approximate pose of the first scan (m, m, deg), within 0.5 m and 20 deg (default: unknown)",
    )
    parser.add_argument(
        "--trajectory", type=filename, required=True, metavar="TRAJ", help="poses, TUM format; - = stdout"
    )
    parser.add_argument("--figure", type=figure_filename, metavar="FIG", help="poses and map: .svg, .png or .pdf")


def run(options: argparse.Namespace) -> int:
    """Run ``jaxsonar localize``. Returns 1 if the pose is not certain, or no echo could be used."""
    from jaxsonar.estimation.trajectory import save_trajectory
    from jaxsonar.fileio.atomic_files import check_outputs
    from jaxsonar.localization.localize import localize as run_localize

    inputs = [options.log, options.ring, options.map, *_images_of(options.map)]
    check_outputs({"--trajectory": options.trajectory, "--figure": options.figure}, inputs)
    messages = InputMessages(strict=options.strict)
    world = _load_known_map(options.map, messages)
    ring, log = load_inputs(options, messages=messages)
    if nothing_used(ring, log, options.log):
        return 1
    with errors_in(options.log), stage_status() as progress:
        result = run_localize(
            ring,
            world,
            log,
            start=options.start,
            sigma=options.sigma,
            odometry_noise=odometry_noise(options.odometry),
            progress=progress,
        )
    if not result.is_certain:
        print_status(result.reason)
        return 1
    trajectory = result.trajectory
    figure = None
    if options.figure:
        from jaxsonar.reports.plot_slam import slam_figure

        figure = slam_figure(
            world,
            trajectory,
            title=f"{plural(len(trajectory), 'pose')} in {ascii_name(options.map)}",
        )
    save_trajectory(trajectory, options.trajectory)
    write_figure(figure, options.figure)
    print_status(result.reason)
    if len(trajectory) < len(log):
        print_status(
            f"{len(log) - len(trajectory)} of {plural(len(log), 'scan')} have no pose: they could not be registered"
        )
    return 0


def _load_known_map(map_filename: str, messages: InputMessages) -> "GlobalMap":
    """Load a map, a floor plan, or a map of Nav2; warn of probable mistakes in a plan."""
    from jaxsonar.fileio.atomic_files import shown
    from jaxsonar.floor_plans.room_geojson import load_room
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.mapping.map_from_room import map_from_room
    from jaxsonar.mapping.map_geojson import load_map

    if map_filename.lower().endswith(NAV2_SUFFIXES):
        return _load_nav2_map(map_filename)
    try:
        world = load_map(map_filename)
    except SonarError as not_a_map:
        try:
            room = load_room(map_filename)
        except SonarError:
            raise not_a_map from None
        messages.warn_of_room(room)
        world = map_from_room(room)
    if not len(world) + len(world.points):
        raise SonarError(f"{shown(map_filename)}: no wall and no point; allowed is a map with walls")
    return world


def _images_of(map_filename: str) -> list[str]:
    """The image of a map of Nav2, which no output may replace."""
    if not map_filename.lower().endswith(NAV2_SUFFIXES):
        return []
    from jaxsonar.occupancy.nav2_reader import image_filename

    return [str(image_filename(map_filename))]


def _load_nav2_map(map_filename: str) -> "GlobalMap":
    """Load the walls of a map of Nav2's map_server."""
    from jaxsonar.fileio.atomic_files import shown
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.mapping.map_from_grid import map_from_grid
    from jaxsonar.occupancy.nav2_reader import check_occupancy, load_nav2

    grid = load_nav2(map_filename)
    try:
        check_occupancy(grid)
        world = map_from_grid(grid.occupied, grid.free, resolution=grid.resolution, origin=grid.origin)
        if not len(world):
            raise SonarError("no wall beside free cells; allowed is a map with straight walls of 0.25 m or more")
    except SonarError as error:
        raise SonarError(f"{shown(map_filename)}: {error}") from None
    return world


def _pose(text: str) -> tuple[float, float, float]:
    """An argparse type: a pose as X,Y,DEG (metres, metres, degrees)."""
    import math

    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 3 or not all(abs(value) < 1e8 for value in numbers):  # False for NaN
        raise argparse.ArgumentTypeError(f"{text!r} came; allowed are three numbers X,Y,DEG, such as 1.5,-0.2,90")
    x, y, degrees = numbers
    return x, y, math.radians(degrees)

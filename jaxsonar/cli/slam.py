"""``jaxsonar slam``: trajectory and map together, from echoes with or without odometry."""

import argparse
import json
from collections.abc import Callable
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

    from jaxsonar.estimation.trajectory import Trajectory
    from jaxsonar.evaluation.trajectory_errors import TrajectoryErrors
    from jaxsonar.graph_slam.slam import Slam
    from jaxsonar.scans.scan_log import Log

from jaxsonar.cli.arguments import add_slam_arguments, figure_filename, filename, finite, odometry_noise_of
from jaxsonar.cli.console import count, plain_name, print_left_out, print_status, stage_status

SUMMARY = "Poses and map together, from echoes and odometry, or from echoes alone."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar slam``."""
    parser.add_argument(
        "log", type=filename, metavar="LOG", help="scan log, .csv or .parquet; its poses are odometry, or empty"
    )
    add_slam_arguments(parser)
    parser.add_argument(
        "-o", "--output", type=filename, metavar="MAP", required=True, help="GeoJSON, world metres; - = stdout"
    )
    parser.add_argument("--trajectory", type=filename, metavar="TRAJ", help="the poses, TUM format; - = stdout")
    parser.add_argument(
        "--figure", type=figure_filename, metavar="FIG", help="poses, odometry, walls: .svg, .png or .pdf"
    )
    parser.add_argument(
        "--truth", type=filename, metavar="TRAJ", help="true poses (TUM) to tell the errors against, and to draw"
    )
    parser.add_argument(
        "--json", type=filename, metavar="FILE", help="closures, errors, noise, scales as JSON; - = stdout"
    )
    parser.add_argument(
        "--window",
        type=finite(0.01, 100),
        metavar="METRES",
        help="gather so much path into a local model (default: 1.5 for rings of few sensors, else none)",
    )
    parser.add_argument("--speed", action="store_true", help="estimate the speed of sound, too")
    parser.add_argument("--scale", action="store_true", help="estimate the scales of the odometry, too")
    parser.add_argument(
        "--smoothing",
        action=argparse.BooleanOptionalAction,
        help="adjust all poses and reflectors in the end (default: up to 2000 scans; a minute for a thousand)",
    )


def run(options: argparse.Namespace) -> None:
    """``jaxsonar slam``."""
    import numpy as np

    from jaxsonar.estimation.trajectory import load_trajectory, save_trajectory
    from jaxsonar.evaluation.trajectory_errors import trajectory_errors
    from jaxsonar.fileio.atomic_files import check_outputs, open_output, shown
    from jaxsonar.graph_slam.slam import slam as run_slam
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.mapping.map_geojson import save_map
    from jaxsonar.scans.flat_echoes import FlatEchoes
    from jaxsonar.scans.log_file import load_log
    from jaxsonar.sensors.ring_toml import load_ring

    check_outputs(
        {"-o": options.output, "--trajectory": options.trajectory, "--figure": options.figure, "--json": options.json},
        [options.log, options.ring, options.truth],
    )
    ring, log = load_ring(options.ring), load_log(options.log)
    truth = None if options.truth is None else load_trajectory(options.truth)
    if truth is not None:
        _check_truth(truth, log, str(options.truth), options.log)
    try:
        _, left_out = FlatEchoes.from_log(ring, log)
        with stage_status() as progress:
            found = run_slam(
                ring,
                log,
                sigma=options.sigma,
                window=options.window,
                odometry_noise=odometry_noise_of(options.odometry),
                smooth=options.smoothing,
                speed=options.speed,
                scale=options.scale,
                progress=progress,
            )
        if not len(found.trajectory):
            raise SonarError("no scan could be placed; allowed are scans that see walls, corners, or odometry")
    except SonarError as error:
        raise SonarError(f"{shown(options.log)}: {error}") from None

    # Everything is made before anything is written.
    trajectory = found.trajectory
    against = (
        None if truth is None else _trajectory_errors(trajectory_errors, trajectory, truth, found, str(options.truth))
    )
    figure = None
    if options.figure:
        from jaxsonar.reports import plot_slam as figures_slam

        counted = [tie for tie in found.closures if tie.state == "counted"]
        withdrawn = [tie for tie in found.closures if tie.state == "withdrawn"]
        figure = figures_slam.slam_figure(
            found.world,
            trajectory,
            odometry=found.odometry if np.isfinite(found.odometry).any() else None,
            truth=None if truth is None else _truth_in_estimate_frame(trajectory, truth),
            closures=_closure_rows(counted, found),
            withdrawn=_closure_rows(withdrawn, found),
            title=f"{count(len(trajectory), 'pose')}, {count(len(found.world), 'wall')} from {plain_name(options.log)}",
        )
    said = json.dumps(_as_json(found, against), allow_nan=False, indent=1) + "\n"
    save_map(found.world, options.output)
    if options.trajectory:
        save_trajectory(trajectory, options.trajectory)
    if figure is not None:
        from jaxsonar.reports import plot_style as figures

        figures.save(figure, options.figure)
    if options.json:
        with open_output(options.json) as file:
            file.write(said)
    if left_out:
        print_left_out(ring.name, left_out)
    for line in _summary_lines(found, against):
        print_status(line)


def _trajectory_errors(
    errors: "Callable[..., TrajectoryErrors]", estimate: "Trajectory", truth: "Trajectory", found: "Slam", name: str
) -> "dict[str, TrajectoryErrors | None]":
    """Against the truth: the estimate as it is, best aligned (as evo has it), and odometry."""
    import numpy as np

    from jaxsonar.estimation.trajectory import Trajectory
    from jaxsonar.fileio.atomic_files import shown
    from jaxsonar.hardware.errors import SonarError

    known = np.isfinite(found.odometry).all(axis=1)
    try:
        return {
            "estimate": errors(estimate, truth, align="first"),
            "aligned": errors(Trajectory(estimate.stamp, estimate.poses), truth, align="best"),
            "odometry": errors(Trajectory(found.stamp[known], found.odometry[known]), truth, align="first")
            if known.sum() > 1
            else None,
        }
    except SonarError as error:
        raise SonarError(f"--truth {shown(name)}: {error}") from None


def _check_truth(truth: "Trajectory", log: "Log", name: str, source: str) -> None:
    """Complain before the work about true poses that belong to no scan."""
    import numpy as np

    from jaxsonar.estimation.trajectory import stamps_of
    from jaxsonar.evaluation.trajectory_errors import associate_stamps
    from jaxsonar.fileio.atomic_files import shown
    from jaxsonar.hardware.errors import SonarError

    if not np.array_equal(stamps_of(log), log.stamp):
        raise SonarError(f"{shown(source)}: stamps are missing or do not rise; allowed with --truth are some that do")
    if not len(associate_stamps(log.stamp, truth.stamp, tolerance=0.01)[0]):
        one, other = (f"{stamp.min():g} to {stamp.max():g} s" for stamp in (truth.stamp, log.stamp))
        raise SonarError(f"--truth {shown(name)}: stamps {one}, the log's are {other}; allowed are common ones")


def _truth_in_estimate_frame(estimate: "Trajectory", truth: "Trajectory") -> "np.ndarray":
    """The truth in the frame of the estimate: their first common poses are one."""
    from jaxsonar.evaluation.trajectory_errors import associate_stamps
    from jaxsonar.geometry.se2 import compose, inverse

    mine, theirs = associate_stamps(estimate.stamp, truth.stamp, tolerance=0.01)
    return compose(compose(estimate.poses[mine[0]], inverse(truth.poses[theirs[0]])), truth.poses)


def _closure_rows(ties: list, found: "Slam") -> "np.ndarray":
    """Rows of the trajectory of closures whose scans have poses."""
    import numpy as np

    known = np.asarray(np.isfinite(found.poses).all(axis=1))
    row = np.cumsum(known) - 1
    pairs = [(row[tie.first], row[tie.second]) for tie in ties if known[tie.first] and known[tie.second]]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _as_json(found: "Slam", against: "dict[str, TrajectoryErrors | None] | None") -> dict[str, Any]:
    smoothed = found.smoothed
    said: dict[str, Any] = {
        "scans": len(found.poses),
        "left_out": found.left_out.tolist(),
        "closures": [
            tie._asdict() | {"pose": tie.first_from_second.tolist(), "determined": tie.determined.T.tolist()}
            for tie in found.closures
        ],
    }
    if smoothed is not None:
        said |= {
            "sigma": smoothed.sigma,
            "explained": smoothed.used,
            "speed_of_sound": float(smoothed.ring.speed_of_sound),
            # What was not estimated has no standard deviation: 0 would say that it is known exactly.
            "speed_of_sound_sd": smoothed.speed_of_sound_sd or None,
            "scale": smoothed.scale if any(smoothed.scale_sd) else None,
            "scale_sd": smoothed.scale_sd if any(smoothed.scale_sd) else None,
        }
    if against is not None:
        said["errors"] = {name: None if one is None else _plain_numbers(asdict(one)) for name, one in against.items()}
    return said


def _plain_numbers(table: dict[str, Any]) -> dict[str, Any]:
    """Without arrays, and None for what is not finite."""
    import math

    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in table.items()
        if isinstance(value, (int, float, str))
    }


def _summary_lines(found: "Slam", against: "dict[str, TrajectoryErrors | None] | None") -> list[str]:
    """What is said in the end."""
    import numpy as np

    states = {state: sum(tie.state == state for tie in found.closures) for state in ("counted", "withdrawn")}
    lines = [
        f"{count(len(found.poses), 'scan')}, {len(found.trajectory)} of them placed, "
        f"{count(len(found.world), 'wall')}, {count(len(found.world.points), 'corner')} or edges; "
        f"{count(states['counted'], 'loop closure')}, {states['withdrawn']} withdrawn"
    ]
    smoothed = found.smoothed
    if smoothed is not None:
        line = f"noise of the ranges {1e3 * smoothed.sigma:.2f} mm, {100 * smoothed.used:.0f} % of the echoes explained"
        if smoothed.speed_of_sound_sd:
            line += f"; speed of sound {smoothed.ring.speed_of_sound:.2f} +- {smoothed.speed_of_sound_sd:.2f} m/s"
        if any(smoothed.scale_sd):
            way, turn = (
                f"{100 * one:+.2f} +- {100 * sd:.2f} %"
                for one, sd in zip(smoothed.scale, smoothed.scale_sd, strict=True)
            )
            line += f"; odometry's ways {way} too long, its turns {turn} too far"
        lines.append(line)
    covariance = found.trajectory.covariance
    if covariance is not None:
        sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).mean(axis=0))
        lines.append(
            f"standard deviation of the poses (RMS, from the first one): {1e3 * np.hypot(sd[0], sd[1]):.1f} mm, "
            f"{np.degrees(sd[2]):.2f} deg"
        )
    for name, one in (against or {}).items():
        if one is not None:
            lines.append(f"{_ERROR_LABELS[name]}: {_error_text(one)}")
    return lines


def _error_text(one: "TrajectoryErrors") -> str:
    import math

    nees = f"; squared error over variance {one.nees:.2f}" if math.isfinite(one.nees) else ""
    return (
        f"{1e3 * one.ate:.1f} mm, {math.degrees(one.ate_heading):.2f} deg (RMS of {one.poses} poses), worst "
        f"{1e3 * one.worst:.0f} mm, {math.degrees(one.worst_heading):.1f} deg{nees}"
    )


_ERROR_LABELS = {
    "estimate": "error, first pose on the truth",
    "aligned": "error, best alignment",
    "odometry": "odometry's error, first pose on the truth",
}

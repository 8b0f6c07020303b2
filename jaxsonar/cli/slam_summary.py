"""The results of ``jaxsonar slam`` as JSON and as text, and their errors against a true trajectory."""

import math
from typing import Any

import numpy as np

from jaxsonar.cli.console import errors_in
from jaxsonar.estimation.trajectory import Trajectory, stamps_of
from jaxsonar.evaluation.trajectory_errors import TrajectoryErrors, associate_stamps, trajectory_errors
from jaxsonar.fileio.atomic_files import shown
from jaxsonar.geometry.se2 import compose, inverse
from jaxsonar.graph_slam.slam import Slam
from jaxsonar.hardware.errors import SonarError
from jaxsonar.loop_closure.closure_candidate import ACCEPTED, WITHDRAWN
from jaxsonar.plausibility.odometry_jumps import OdometryJump
from jaxsonar.reports.text import plural, point_counts
from jaxsonar.scans.scan_log import Log
from jaxsonar.smoothing.sparse_smoother import SPARSE_SETTINGS

STAMP_TOLERANCE = 0.01
"""Maximum difference of the stamps of an estimated and a true pose, seconds. Chosen by hand."""

Errors = dict[str, TrajectoryErrors | None]
"""Errors of "estimate" (first poses aligned), "aligned" (best alignment) and "odometry" (None without odometry)."""

_ERROR_LABELS = {
    "estimate": "error, first pose on the truth",
    "aligned": "error, best alignment",
    "odometry": "error of the odometry, first pose on the truth",
}
_ERROR_KEYS = ("poses", "ate", "ate_heading", "worst", "worst_heading", "relative", "relative_heading", "nees")


def check_truth(truth: Trajectory, log: Log, *, truth_name: str, log_name: str) -> None:
    """Check before the computation that true poses and scans have common stamps.

    Raises:
        SonarError: they have none, or the stamps of the log are not ascending.
    """
    if not np.array_equal(stamps_of(log), log.stamp):
        raise SonarError(f"{shown(log_name)}: stamps are missing or do not rise; allowed with --truth are some that do")
    if not len(associate_stamps(log.stamp, truth.stamp, tolerance=STAMP_TOLERANCE)[0]):
        true_span, log_span = (f"{stamp.min():g} to {stamp.max():g} s" for stamp in (truth.stamp, log.stamp))
        raise SonarError(
            f"--truth {shown(truth_name)}: stamps {true_span}, the log's are {log_span}; allowed are common ones"
        )


def errors_against_truth(result: Slam, truth: Trajectory, *, truth_name: str) -> Errors:
    """Errors of estimate and odometry against the true trajectory.

    Raises:
        SonarError: the trajectories cannot be compared.
    """
    estimate, has_odometry = result.trajectory, np.isfinite(result.odometry).all(axis=1)
    odometry = Trajectory(result.stamp[has_odometry], result.odometry[has_odometry])
    with errors_in(f"--truth {shown(truth_name)}"):
        return {
            "estimate": trajectory_errors(estimate, truth, align="first"),
            "aligned": trajectory_errors(Trajectory(estimate.stamp, estimate.poses), truth, align="best"),
            "odometry": trajectory_errors(odometry, truth, align="first") if has_odometry.sum() > 1 else None,
        }


def truth_in_estimate_frame(estimate: Trajectory, truth: Trajectory) -> np.ndarray:
    """The true poses in the frame of the estimate: their first common poses coincide."""
    own, true = associate_stamps(estimate.stamp, truth.stamp, tolerance=STAMP_TOLERANCE)
    return compose(compose(estimate.poses[own[0]], inverse(truth.poses[true[0]])), truth.poses)


def closure_rows(result: Slam, state: str) -> np.ndarray:
    """Pairs of rows of the trajectory that loop closures of this state connect, shape (closures, 2)."""
    has_pose = np.asarray(np.isfinite(result.poses).all(axis=1))
    row = np.cumsum(has_pose) - 1
    pairs = [
        (row[closure.first], row[closure.second])
        for closure in result.closures
        if closure.state == state and has_pose[closure.first] and has_pose[closure.second]
    ]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def as_json(result: Slam, errors: Errors | None) -> dict[str, Any]:
    """The result for a JSON file: SI units and radians."""
    table: dict[str, Any] = {
        "scans": len(result.poses),
        "left_out": result.left_out.tolist(),
        "closures": [
            {
                "first": closure.first,
                "second": closure.second,
                "pose": closure.first_from_second.tolist(),
                "state": "counted" if closure.state == ACCEPTED else closure.state,  # the word of the file format
                "determined": closure.determined.T.tolist(),
            }
            for closure in result.closures
        ],
        "odometry_jumps": [
            {
                "scan": jump.scan,
                "step": jump.step.tolist(),
                "seconds": jump.seconds if math.isfinite(jump.seconds) else None,
                "bridged": is_bridged(result, jump),
            }
            for jump in result.jumps
        ],
    }
    table["heading_slips"] = [{"scan": slip.scan, "angle": slip.angle, "gain": slip.gain} for slip in result.slips]
    table |= {"explained": result.explained.measured, "explained_required": result.explained.required}
    smoothed = result.smoothed
    if smoothed is not None:
        table |= {
            "sigma": smoothed.sigma,
            "speed_of_sound": float(smoothed.ring.speed_of_sound),
            # A parameter that was not estimated has no standard deviation; 0 would mean that it is exact.
            "speed_of_sound_sd": smoothed.speed_of_sound_sd or None,
            "scale": smoothed.scale if any(smoothed.scale_sd) else None,
            "scale_sd": smoothed.scale_sd if any(smoothed.scale_sd) else None,
            "keeps_odometry": smoothed.keeps_odometry,
        }
    if errors is not None:
        table["errors"] = {name: None if one is None else _errors_as_json(one) for name, one in errors.items()}
    return table


def _errors_as_json(errors: TrajectoryErrors) -> dict[str, float | int | None]:
    values = {key: getattr(errors, key) for key in _ERROR_KEYS}
    return {key: value if math.isfinite(value) else None for key, value in values.items()}


def is_bridged(result: Slam, jump: OdometryJump) -> bool:
    """Whether the poses before and after a jump of the odometry are in one frame."""
    return bool(np.isfinite(result.poses[[jump.before, jump.after]]).all())


def _jump_lines(result: Slam) -> list[str]:
    """What happened at the jumps of the odometry."""
    lines = []
    for jump in result.jumps:
        line = f"the odometry jumps {jump}"
        if is_bridged(result, jump):
            lines.append(f"{line}; the trajectory continues there by the motion before and after it")
        else:
            side = "after" if np.isnan(result.poses[jump.after]).any() else "before"
            lines.append(f"{line}; the scans {side} it have no pose, because their place is unknown")
    return lines


def summary_lines(result: Slam, errors: Errors | None) -> list[str]:
    """The result as lines of text for the user."""
    states = {state: sum(closure.state == state for closure in result.closures) for state in (ACCEPTED, WITHDRAWN)}
    lines = [
        f"{plural(len(result.poses), 'scan')}, {len(result.trajectory)} of them with a pose, "
        f"{', '.join([plural(len(result.world), 'wall'), *point_counts(result.world.point_kinds)])}; "
        f"{plural(states[ACCEPTED], 'loop closure')}, {states[WITHDRAWN]} withdrawn"
    ]
    smoothed = result.smoothed
    if smoothed is None:
        lines.append(str(result.explained))
    else:
        noise = "" if smoothed.sigma is None else f"range noise {1e3 * smoothed.sigma:.2f} mm; "
        line = f"{noise}{result.explained}"
        if smoothed.speed_of_sound_sd:
            line += f"; speed of sound {smoothed.ring.speed_of_sound:.2f} +- {smoothed.speed_of_sound_sd:.2f} m/s"
        if any(smoothed.scale_sd):
            distance, rotation = (
                f"{100 * scale:+.2f} +- {100 * sd:.2f} %"
                for scale, sd in zip(smoothed.scale, smoothed.scale_sd, strict=True)
            )
            line += f"; scale error of the odometry: distances {distance}, rotations {rotation}"
        lines.append(line)
        if smoothed.keeps_odometry:
            gain, least = (100 * (share or 0) for share in (smoothed.heading_gain, SPARSE_SETTINGS.least_heading_gain))
            odometry = "odometry with its slips repaired" if result.slips else "odometry"
            lines.append(
                f"the poses are those of the {odometry}: long walls would "
                f"remove {gain:.0f} % of the variance of its headings; {least:.0f} % is the least to move poses"
            )
    covariance = result.trajectory.covariance
    if covariance is not None and len(covariance) > 1:  # the first pose is exact by definition
        sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).mean(axis=0))
        lines.append(
            f"standard deviation of the poses (RMS, from the first one): {1e3 * np.hypot(sd[0], sd[1]):.1f} mm, "
            f"{np.degrees(sd[2]):.2f} deg"
        )
    lines += _jump_lines(result)
    lines += [f"{slip}; the poses after it are turned by {np.degrees(slip.angle):+.0f} deg" for slip in result.slips]
    lines += [f"{_ERROR_LABELS[name]}: {_error_text(one)}" for name, one in (errors or {}).items() if one is not None]
    return lines


def _error_text(errors: TrajectoryErrors) -> str:
    nees = f"; NEES {errors.nees:.2f}" if math.isfinite(errors.nees) else ""
    return (
        f"{1e3 * errors.ate:.1f} mm, {math.degrees(errors.ate_heading):.2f} deg (RMS of {errors.poses} poses), maximum "
        f"{1e3 * errors.worst:.0f} mm, {math.degrees(errors.worst_heading):.1f} deg{nees}"
    )

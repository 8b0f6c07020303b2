"""Steps at which the odometry jumps or begins again, although the robot did not move so."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.geometry.se2 import relative, wrap_angle
from jaxsonar.plausibility.implausibility import Implausibility
from jaxsonar.plausibility.jump_bridging import jump_support
from jaxsonar.scans.measured_paths import path_rows
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class OdometryJumpSettings:
    """When a step of the odometry is a jump. Chosen by hand; no real recording at hand has a jump."""

    least: tuple[float, float] = (0.12, float(np.radians(20.0)))
    """Least displacement or rotation of a jump, metres and radians."""
    ratio: float = 3.0
    """Least speed of a jump, in speeds of the other steps; in a log without times, of displacement and rotation."""
    other_quantile: float = 0.98
    """Quantile of the speeds of all steps that stands for the other steps."""
    neighbors: int = 3
    """Steps before and after a jump; none of them may be as fast as a jump."""
    restart: tuple[float, float] = (0.03, float(np.radians(5.0)))
    """Least displacement or rotation of a jump to the pose (0, 0, 0), or to the first pose, metres and radians."""
    restart_ratio: float = 2.0
    """Least speed of such a jump, in speeds of the other steps."""
    speed_without_echoes: tuple[float, float] = (1.5, float(np.radians(360.0)))
    """Least speed of a jump if the echoes tell nothing about it, metres and radians per second."""
    impossible_speed: tuple[float, float] = (5.0, float(np.radians(1080.0)))
    """Speeds that no robot with such sensors reaches; then the robot was carried if no motion explains the echoes."""
    agree: float = 0.8
    """Least support of scans on both sides of a step, as a fraction of that of each side alone, if they agree."""
    disagree: float = 0.75
    """Largest such support if they do not agree."""
    contrast: float = 0.1
    """Least difference between the support of two motions, as the same fraction, to prefer one of them."""
    least_paths: int = 4
    """Paths heard before and after a step, for a statement about their ranges."""
    kept_paths: float = 0.5
    """Least share of the usual number of these paths after a step during which the ranges do not change."""
    same_range: float = 0.02
    """Median change of ranges that is always small, metres: noise and some motion."""
    usual_changes: float = 3.0
    """Largest median change of ranges, in those of the steps around."""
    step_share: float = 0.25
    """Largest median change of ranges as a fraction of the step."""
    arm: float = 0.5
    """Metres of a step that a rotation by one radian is worth."""
    merged_scans: int = 3
    """Scans before and after a step that are searched for the range of a path."""
    compared_steps: int = 8
    """Steps before and after a jump whose ranges tell what is usual."""
    largest: float = 1e7
    """Poses with larger numbers are none, metres and radians."""
    most_candidates: int = 64
    """Steps whose ranges are compared; a log with more fast steps has other faults."""


SETTINGS = OdometryJumpSettings()


@dataclass(frozen=True, eq=False)
class OdometryJump:
    """A step of the odometry that the robot did not make."""

    before: int
    """Row of the last scan with a pose before it."""
    after: int
    """Row of the first scan with a pose after it."""
    scan: int
    """Number of the scan after it."""
    pose: Float[np.ndarray, "3"]
    """Pose of this scan, metres and radians."""
    step: Float[np.ndarray, "3"]
    """The pose after it in the frame of the pose before it, metres and radians."""
    seconds: float
    """Time between the two scans; NaN if it is not known."""
    restarts: bool
    """Whether the poses begin again: at (0, 0, 0), or at the first pose of the log."""
    ranges_continue: bool | None
    """Whether the echoes show that the robot went on as before and after it; False: it is elsewhere; None: unknown."""

    @property
    def displacement(self) -> float:
        """Length of the step, metres."""
        return float(np.hypot(self.step[0], self.step[1]))

    def __str__(self) -> str:
        """Size, duration and scan."""
        size = f"by {self.displacement:.2f} m and {abs(np.degrees(wrap_angle(self.step[2]))):.0f} deg"
        time = f" in {self.seconds:.2f} s" if np.isfinite(self.seconds) else ""
        begins = ""
        if self.restarts:
            x, y, theta = (self.pose.round(6) + 0.0).tolist()
            begins = f", to ({x:.3g}, {y:.3g}, {theta:.3g})"
        echoes = ", which the echoes do not confirm" if self.ranges_continue else ""
        return f"{size}{time} at scan {self.scan}{begins}{echoes}"


def find_odometry_jumps(ring: Ring, log: Log) -> tuple[OdometryJump, ...]:
    """Steps at which the odometry jumps or begins again.

    A jump is much faster than all steps around it, and than most steps of the log. Scans before and after it agree if
    the robot went on as before and after it, but not with the step itself. If they agree with the step, the robot made
    it. If they agree with neither, only an impossible speed is a jump: the robot was carried.

    Args:
        ring: the sensors.
        log: the scans; their poses are odometry, and may be missing.
    """
    posed = np.flatnonzero(np.isfinite(log.pose).all(axis=1))
    pose, stamp = log.pose[posed], log.stamp[posed]
    if len(posed) < 2 * SETTINGS.neighbors or np.abs(pose).max() > SETTINGS.largest:
        return ()
    step = relative(pose[:-1], pose[1:])
    size = np.stack([np.hypot(step[:, 0], step[:, 1]), np.abs(wrap_angle(step[:, 2]))], axis=-1)
    seconds = _durations(stamp, size[:, 0])
    timed = seconds is not None
    speed = size if seconds is None else size / seconds[:, None]
    other = np.maximum(_most(speed), _fastest_neighbor(speed))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.nan_to_num(speed / other, nan=0.0, posinf=np.inf)
    is_large = (size > SETTINGS.least) & (ratio > SETTINGS.ratio)
    restarts = _begins_again(pose) & ((size > SETTINGS.restart) & (_ratio(size) > SETTINGS.restart_ratio)).any(axis=1)
    candidates = np.flatnonzero(is_large.any(axis=1) | restarts)
    if not 0 < len(candidates) <= SETTINGS.most_candidates:
        return ()
    changes = _RangeChanges(ring, log, posed)
    jumps = []
    for k in candidates.tolist():
        before, after = int(posed[k]), int(posed[k + 1])
        verdict = _verdict(ring, log, before, after)
        if verdict == "step":
            continue
        continues = {"jump": True, "carried": False}.get(verdict)
        if verdict == "unknown":
            continues = changes.are_small(k, size[k, 0] + SETTINGS.arm * size[k, 1])
        if not (restarts[k] or continues):
            least = SETTINGS.speed_without_echoes if continues is None else SETTINGS.impossible_speed
            if not (timed and (is_large[k] & (speed[k] >= least)).any()):
                continue
        if verdict == "unknown" and continues is False and changes.over(0, k + 1)[1] <= SETTINGS.same_range:
            continue  # the robot is indeed where it began
        duration = float(stamp[k + 1] - stamp[k]) if timed else np.nan
        scan = int(log.scan[after])
        jumps.append(OdometryJump(before, after, scan, pose[k + 1], step[k], duration, bool(restarts[k]), continues))
    return tuple(jumps)


def implausible_odometry(ring: Ring, log: Log) -> Iterator[Implausibility]:
    """A statement about the jumps of the odometry of a log, if there are any."""
    jumps = find_odometry_jumps(ring, log)
    if not jumps:
        return
    first = jumps[0]
    times = "" if len(jumps) == 1 else f"{len(jumps)} times, first "
    what = f"the odometry jumps {times}{first}"
    cause = "the odometry was reset or restarted" if first.restarts else "the odometry was corrected or reset"
    if not first.restarts and first.ranges_continue is False:
        cause = "the robot was moved by hand, or logs were joined"
    remedy = "split the log there, or estimate the poses with slam, which does not use this step"
    yield Implausibility("odometry jump", what, cause, remedy)


def _verdict(ring: Ring, log: Log, before: int, after: int) -> str:
    """What the echoes tell: "step": the robot made it; "jump": it went on as before and after; "carried": neither."""
    support = jump_support(ring, log, before, after)
    if support is None or not support.sides:
        return "unknown"
    given, bridged = support.given / support.sides, support.bridged / support.sides
    if given >= SETTINGS.agree and given > bridged - SETTINGS.contrast:
        return "step"
    if bridged >= SETTINGS.agree:
        return "jump"
    return "carried" if max(given, bridged) < SETTINGS.disagree else "unknown"


def _durations(
    stamp: Float[np.ndarray, " poses"], displacement: Float[np.ndarray, " steps"]
) -> Float[np.ndarray, " steps"] | None:
    """Durations of the steps, seconds, at least the usual one (clocks jitter); None for a log without real times."""
    duration = np.diff(stamp)
    rising = duration[duration > 0]  # False for NaN
    if 2 * len(rising) < len(duration):
        return None
    usual = float(np.median(rising))
    seconds = np.maximum(np.nan_to_num(duration, nan=usual), usual)
    return None if _most(displacement / seconds) > SETTINGS.impossible_speed[0] else seconds


def _most(speed: Float[np.ndarray, "steps *axes"]) -> Float[np.ndarray, "*axes"]:
    """Speed that most steps do not exceed; always without the largest one."""
    return np.asarray(np.quantile(speed, SETTINGS.other_quantile, axis=0, method="lower"))


def _fastest_neighbor(speed: Float[np.ndarray, "steps 2"]) -> Float[np.ndarray, "steps 2"]:
    """Largest speed of the steps around each step."""
    reach = SETTINGS.neighbors
    padded = np.pad(speed, ((reach, reach), (0, 0)))
    shifts = [padded[reach + k : reach + k + len(speed)] for k in range(-reach, reach + 1) if k]
    return np.max(shifts, axis=0)


def _ratio(size: Float[np.ndarray, "steps 2"]) -> Float[np.ndarray, "steps 2"]:
    """Size of each step in sizes of the steps around."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.nan_to_num(size / _fastest_neighbor(size), nan=0.0, posinf=np.inf)


def _begins_again(pose: Float[np.ndarray, "poses 3"]) -> np.ndarray:
    """Steps that end at exactly (0, 0, 0), or at exactly the first pose."""
    to = pose[1:]
    exact = 1e-9 * (1 + np.abs(pose).max())
    return ((np.abs(to) <= exact).all(axis=1)) | ((np.abs(to - pose[0]) <= exact).all(axis=1))


class _RangeChanges:
    """Changes of the shortest range of each path over steps of the odometry."""

    def __init__(self, ring: Ring, log: Log, rows: Int[np.ndarray, " poses"]):
        self._ring, self._log, self._rows = ring, log, rows

    def are_small(self, step: int, arm: float) -> bool | None:
        """Whether the ranges change as little during a step as during the steps around it; None: too few echoes.

        Args:
            step: the step from one scan with a pose to the next one.
            arm: size of the step, metres.
        """
        reach, steps = SETTINGS.compared_steps, len(self._rows) - 1
        others = [k for k in range(max(step - reach, 0), min(step + reach + 1, steps)) if k != step]
        found = np.array([self.over(k, k + 1) for k in others]).reshape(-1, 2)
        count, change = self.over(step, step + 1)
        usual_count = float(np.median(found[:, 0])) if len(found) else 0.0
        if max(count, usual_count) < SETTINGS.least_paths:
            return None
        if count < SETTINGS.kept_paths * usual_count:
            return False
        if count < SETTINGS.least_paths - 1:
            return None
        usual = float(np.nanmedian(found[:, 1])) if np.isfinite(found[:, 1]).any() else np.inf
        most = min(SETTINGS.usual_changes * usual, SETTINGS.step_share * arm)
        return bool(change <= max(SETTINGS.same_range, most))

    def over(self, before: int, after: int) -> tuple[int, float]:
        """Number of paths heard shortly before and after, and the median change of their ranges, metres."""
        reach, rows = SETTINGS.merged_scans, self._rows
        first = self._latest(rows[max(before - reach + 1, 0) : before + 1])
        second = self._latest(rows[after : after + reach][::-1])
        change = [abs(first[path] - second[path]) for path in first if path in second]
        return len(change), float(np.median(change)) if change else np.nan

    def _latest(self, rows: Int[np.ndarray, " scans"]) -> dict[int, float]:
        """Shortest range of each path in the last one of these scans that heard it."""
        latest: dict[int, float] = {}
        for row in rows.tolist():
            latest |= self._scan(row)
        return latest

    def _scan(self, row: int) -> dict[int, float]:
        """Shortest range of each path of a scan."""
        log = self._log
        part = slice(log.start[row], log.start[row + 1])
        path, distance = path_rows(self._ring, log.tx[part], log.rx[part]), log.range[part]
        fresh = np.isfinite(distance) & (path >= 0) & ~(log.age[part] > 0)
        shortest: dict[int, float] = {}
        for one, metres in zip(path[fresh].tolist(), distance[fresh].tolist(), strict=True):
            shortest[one] = min(metres, shortest.get(one, np.inf))
        return shortest

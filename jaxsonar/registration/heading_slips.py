"""Heading slips: turns during which the wheels slipped, so that the odometry is wrong by a large angle from there on.

The echoes before and after a place vote for walls in one Hough accumulator. If the heading slipped there, the walls
agree better after the later part of the trajectory is turned about that place. Walls must be seen on both sides of it.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.geometry.se2 import compose, inverse, rotate, transform_points, unit, wrap_angle
from jaxsonar.scans.firing_poses import reading_poses
from jaxsonar.scans.measured_paths import path_rows
from jaxsonar.scans.readings import is_repeated
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class HeadingSlipSettings:
    """Constants of the search for heading slips.

    Chosen by hand on one recorded run with a slip of 22 deg, and checked on another one without a slip and on simulated
    ones.
    """

    angle_cell: float = float(np.radians(2.0))
    """Cell of the accumulator, radians; it divides the full turn, ..."""
    range_cell: float = 0.03
    """... and metres. Votes reach the neighboring cells."""
    reach: float = 6.0
    """Metres of trajectory before and after a place whose echoes are compared."""
    place: tuple[float, float] = (0.1, float(np.radians(10.0)))
    """Motion after which echoes count as independent, metres or radians; each such place has one vote per cell."""
    station: tuple[float, float] = (0.3, float(np.radians(10.0)))
    """Motion between places at which a slip is sought, metres or radians."""
    largest: float = float(np.radians(40.0))
    """Largest slip that is sought, radians: beyond it rooms with several wall directions agree by chance."""
    least: float = float(np.radians(12.0))
    """Smallest slip, radians: smaller errors may be drift, and are left to the adjustment of all poses."""
    min_places: int = 4
    """Places before and after a slip."""
    threshold: float = 25.0
    """Least gain of log-likelihood, nats: between the largest one without a slip, 13, and that of the slip, 58."""
    turn: float = 0.3
    """Metres before and after a place whose rotation makes a slip there plausible."""
    slip_per_rotation: float = 0.1
    """Usual size of a slip as a fraction of that rotation; sizes are distributed exponentially."""
    slip_of_straight: float = float(np.radians(2.0))
    """Usual size where the robot does not turn, radians."""
    most: int = 8
    """Largest number of slips of a log."""
    min_range: float = 0.05
    """Shorter echoes are left out, metres."""


SETTINGS = HeadingSlipSettings()
_ANGLES = round(2 * np.pi / SETTINGS.angle_cell)


@dataclass(frozen=True)
class HeadingSlip:
    """An error of the heading that arose at one place, and that the odometry does not report."""

    row: int
    """Row of the last scan before it."""
    scan: int
    """Number of this scan."""
    angle: float
    """By how much the robot turned more than the odometry says, counter-clockwise, radians."""
    gain: float
    """Gain of log-likelihood by the repair, nats."""

    def __str__(self) -> str:
        """Size and place."""
        return f"the heading of the odometry slips by {abs(np.degrees(self.angle)):.0f} deg at scan {self.scan}"


def find_heading_slips(ring: Ring, log: Log) -> tuple[HeadingSlip, ...]:
    """Heading slips of the odometry, in the order of the log.

    Args:
        ring: the sensors.
        log: the scans; their poses are odometry, and may be missing.
    """
    slips: list[HeadingSlip] = []
    pose = log.pose
    while len(slips) < SETTINGS.most:
        slip = _largest_slip(ring, replace(log, pose=pose), {one.row for one in slips})
        if slip is None:
            break
        slips.append(slip)
        pose = np.concatenate([pose[: slip.row + 1], compose(slip_transform(pose, slip), pose[slip.row + 1 :])])
    return tuple(sorted(slips, key=lambda one: one.row))


def slip_transform(pose: Float[np.ndarray, "scans 3"], slip: HeadingSlip) -> Float[np.ndarray, "3"]:
    """Motion of the plane that moves the poses after a slip to where the robot was, metres and radians."""
    pivot = pose[slip.row]
    return compose(compose(pivot, np.array([0.0, 0.0, slip.angle])), inverse(pivot))


def _largest_slip(ring: Ring, log: Log, known: set[int]) -> HeadingSlip | None:
    """The slip with the largest gain; None if there is none."""
    posed = np.flatnonzero(np.isfinite(log.pose).all(axis=1))
    if len(posed) < 2 * SETTINGS.min_places:
        return None
    echoes = _PlacedEchoes.of(ring, log, posed)
    most = int(SETTINGS.largest / SETTINGS.angle_cell)
    cells = np.arange(-most, most + 1)
    sought = np.abs(cells * SETTINGS.angle_cell) >= SETTINGS.least
    stations = [k for k in echoes.stations.tolist() if int(posed[k]) not in known]

    def gains(station: int, center: int) -> Float[np.ndarray, " angles"]:
        evidence = echoes.evidence(station, log.pose[posed[station], :2], cells, center)
        return np.full(len(cells), -np.inf) if evidence is None else evidence - evidence[~sought].max()

    # 1. The place about which the gain is largest. The echoes around it show that there is a slip.
    gain = np.array([np.max(gains(k, k), where=sought, initial=-np.inf) for k in stations])
    if not len(gain) or gain.max() < SETTINGS.threshold:
        return None
    center = stations[int(gain.argmax())]

    # 2. Where it is: the same echoes, turned about each place nearby, then about each scan there. Wheels slip while the
    # robot turns.
    def judge(scan: int) -> tuple[float, float, float]:
        gain = gains(scan, center)
        angle = cells * SETTINGS.angle_cell
        usual = SETTINGS.slip_per_rotation * echoes.rotation_near(scan) + SETTINGS.slip_of_straight
        posterior = np.where(sought & (gain > SETTINGS.threshold), gain - np.abs(angle) / usual, -np.inf)
        k = int(posterior.argmax())
        return float(posterior[k]), _refined(angle, gain, k), float(gain[k])

    distance = np.abs(echoes.length - echoes.length[center])
    near = [k for k in stations if distance[k] < SETTINGS.reach - SETTINGS.turn]
    at = near[int(np.argmax([judge(k)[0] for k in near]))]
    around = range(max([k for k in near if k < at], default=at), min([k for k in near if k > at], default=at) + 1)
    scan = max(around, key=lambda k: judge(k)[0])
    posterior, turn, gain = judge(scan)
    row = int(posed[scan])
    return HeadingSlip(row, int(log.scan[row]), turn, gain) if np.isfinite(posterior) and row not in known else None


def _refined(angle: Float[np.ndarray, " angles"], evidence: Float[np.ndarray, " angles"], k: int) -> float:
    """Position of a maximum between the angles, by a parabola through three of them."""
    if not 0 < k < len(angle) - 1:
        return float(angle[k])
    before, at, after = evidence[k - 1 : k + 2]
    curvature = before - 2 * at + after
    shift = 0.0 if curvature >= 0 else float(np.clip(0.5 * (before - after) / curvature, -0.5, 0.5))
    return float(angle[k] + shift * (angle[1] - angle[0]))


@dataclass(frozen=True, eq=False)
class _PlacedEchoes:
    """The walls for which each echo votes, and where along the trajectory it was received."""

    theta: Int[np.ndarray, "echoes votes"]
    """Normal directions, cells of the accumulator."""
    rho: Float[np.ndarray, "echoes votes"]
    """Distances of the walls from the world's origin, metres."""
    inside: Bool[np.ndarray, "echoes votes"]
    """Which votes exist."""
    place: Int[np.ndarray, " echoes"]
    """Place of the robot, ascending along the trajectory."""
    weight: Float[np.ndarray, " echoes"]
    """Weights of echoes; those of one path at one place are worth one echo."""
    scan: Int[np.ndarray, " echoes"]
    """Row of the scan among the scans with a pose."""
    length: Float[np.ndarray, " scans"]
    """Length of the trajectory up to each scan with a pose, metres."""
    rotation: Float[np.ndarray, " scans"]
    """Sum of the rotations up to it, radians."""
    stations: Int[np.ndarray, " stations"]
    """Scans at which a slip is sought."""
    max_range: float

    @classmethod
    def of(cls, ring: Ring, log: Log, posed: Int[np.ndarray, " scans"]) -> "_PlacedEchoes":
        """The echoes of scans with a pose."""
        pose = log.pose[posed]
        length = np.append(0.0, np.cumsum(np.hypot(*np.diff(pose[:, :2], axis=0).T)))
        rotation = np.append(0.0, np.cumsum(np.abs(wrap_angle(np.diff(pose[:, 2])))))
        place, station = (
            np.floor(length / metres + rotation / radians).astype(np.int64)
            for metres, radians in (SETTINGS.place, SETTINGS.station)
        )
        stations = np.unique(station, return_index=True)[1]
        # The echoes.
        of_row = np.full(len(log), -1)
        of_row[posed] = np.arange(len(posed))
        path = path_rows(ring, log.tx, log.rx)
        ranges = np.asarray(ring.corrected(log.range, log.tx, log.rx))
        used = (of_row[log.echo_scan] >= 0) & (path >= 0) & ~is_repeated(log)
        used &= (ranges > SETTINGS.min_range) & (ranges < ring.max_range)  # False for silent readings
        path, ranges, scan = path[used], ranges[used], of_row[log.echo_scan[used]]
        robot = reading_poses(log)[used]
        # Of the echoes of one path at one place, those with about the same range are one. Together all are worth one.
        key = np.stack([place[scan], path, np.round(ranges / SETTINGS.range_cell).astype(np.int64)])
        kept, row, repeated = np.unique(key, axis=1, return_index=True, return_counts=True)
        _, same = np.unique(kept[:2], axis=1, return_inverse=True)
        weight = repeated / np.bincount(same.ravel(), repeated)[same.ravel()]
        path, ranges, scan, robot = path[row], ranges[row], scan[row], robot[row]
        # Their votes.
        paths = ring.exact_paths
        width = np.asarray(paths.width)[path]
        steps = np.arange(int(np.ceil(width.max(initial=0) / SETTINGS.angle_cell)) + 1) * SETTINGS.angle_cell
        theta = np.round(
            (np.asarray(paths.start)[path] + robot[:, 2])[:, None] / SETTINGS.angle_cell + steps / SETTINGS.angle_cell
        )
        normal = unit(theta * SETTINGS.angle_cell)
        midpoint = transform_points(robot, np.asarray(paths.midpoint)[path])
        baseline = rotate(np.asarray(paths.half_baseline)[path], robot[:, 2])
        across = baseline[:, None, 1] * normal[..., 0] - baseline[:, None, 0] * normal[..., 1]
        height = np.sqrt(np.maximum(ranges[:, None] ** 2 - across**2, 0))
        rho = (midpoint[:, None] * normal).sum(axis=-1) + height
        return cls(
            theta=theta.astype(np.int64) % _ANGLES,
            rho=rho,
            inside=steps <= width[:, None],
            place=place[scan],
            weight=weight,
            scan=scan,
            length=length,
            rotation=rotation,
            stations=stations,
            max_range=ring.max_range,
        )

    def rotation_near(self, station: int) -> float:
        """Rotation of the robot shortly before and after a station, radians."""
        near = np.abs(self.length - self.length[station]) <= SETTINGS.turn
        return float(np.ptp(self.rotation[near]))

    def evidence(
        self, station: int, pivot: Float[np.ndarray, " 2"], turns: Int[np.ndarray, " turns"], center: int
    ) -> Float[np.ndarray, " turns"] | None:
        """Log-likelihood of the echoes around a scan, if those after a station are turned; None: too few.

        The likelihood of an echo is proportional to the number of places that vote for the best wall of its arc.

        Args:
            station: the scan after which they are turned.
            pivot: position of the robot at the station, metres.
            turns: by how many cells of the angle.
            center: the scan around which echoes are compared.
        """
        distance = self.length[self.scan] - self.length[center]
        later = self.scan > station
        parts = [np.flatnonzero(side & (np.abs(distance) < SETTINGS.reach)) for side in (~later, later)]
        if min(len(np.unique(self.place[part])) for part in parts) < SETTINGS.min_places:
            return None
        first, second = (self._votes(part, pivot) for part in parts)
        total = np.zeros(len(turns))
        for (votes, theta, column, inside), (others, *_), sign, part in (
            (first, second, -1, parts[0]),
            (second, first, 1, parts[1]),
        ):
            own = votes[theta, column]
            weight = self.weight[part]
            for k, turn in enumerate((sign * turns).tolist()):
                both = np.where(inside, own + others[(theta + turn) % _ANGLES, column], 1).max(axis=1)
                total[k] += weight @ np.log(both)
        return total

    def _votes(
        self, echo: Int[np.ndarray, " some"], pivot: Float[np.ndarray, " 2"]
    ) -> tuple[
        Int[np.ndarray, "angles distances"],
        Int[np.ndarray, "some votes"],
        Int[np.ndarray, "some votes"],
        Bool[np.ndarray, "some votes"],
    ]:
        """Number of places that vote for each wall about a pivot; rows, columns and existence of each vote."""
        farthest = SETTINGS.reach + self.max_range
        theta, inside = self.theta[echo], self.inside[echo]
        rho = self.rho[echo] - (unit(theta * SETTINGS.angle_cell) * pivot).sum(axis=-1)
        columns = int(2 * farthest / SETTINGS.range_cell) + 3
        column = np.round((rho + farthest) / SETTINGS.range_cell).astype(np.int64) + 1
        inside = inside & (column > 0) & (column < columns - 1)
        column = np.clip(column, 1, columns - 2)
        # Each place has one vote per cell, and votes reach the neighboring cells.
        place = self.place[echo] - self.place[echo].min(initial=0)
        cell = theta * columns + column
        key = (place[:, None] * (_ANGLES * columns) + cell)[inside]
        key = np.unique(key[:, None] + np.array([-1, 0, 1]))
        votes = np.bincount(key % (_ANGLES * columns), minlength=_ANGLES * columns)
        return votes.reshape(_ANGLES, columns), theta, column, inside

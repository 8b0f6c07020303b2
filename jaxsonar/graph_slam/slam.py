"""Poses and map together: scan by scan (``Tracker``), and a whole log at once (``slam``).

scan --local.py--> walls, corners --matching.py--> what is known --kernels.track--> pose, reflectors   (tracking.py)
a submap is finished --submaps.py--> SubmapGraph (loops*.py): joined, closed, withdrawn --posegraph.py--> its place
the log is finished --smoothing.py--> all poses and reflectors on the raw ranges
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsonar import kernels
from jaxsonar.detection.extract import local_model, local_models
from jaxsonar.detection.local_map import LocalModel
from jaxsonar.detection.settings import check_method, check_sigma, hough_settings
from jaxsonar.estimation.odometry_noise import OdometryNoise
from jaxsonar.estimation.trajectory import Trajectory, stamps_of
from jaxsonar.geometry.se2 import compose, compose_with_covariance, relative, rotate_covariance, wrap_angle
from jaxsonar.graph_slam.frontend import BRIDGED, LOST, Track, advance, aside, begin, finished, update
from jaxsonar.hardware.errors import SonarError
from jaxsonar.loop_closure.submap_graph import SubmapGraph
from jaxsonar.loop_closure.verification import ACCEPTED, Decision
from jaxsonar.mapping.build_map import assemble_map, build_map
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.mapping.map_evidence import gather_evidence
from jaxsonar.registration.agglomerative import register_by_ranges
from jaxsonar.registration.sequential import register_scans
from jaxsonar.scans.scan_log import Log, Scan
from jaxsonar.scans.sliding_windows import check_window
from jaxsonar.sensors.ring import Ring
from jaxsonar.smoothing.covisibility import Passages
from jaxsonar.smoothing.smoother import BLUR, Smoothed
from jaxsonar.smoothing.smoother import smooth as smoothing

REACH = 0.85
"""Of the ring's maximum range; nearer than that walls are surely heard."""
MOST_PLACED = 64
"""Scans of a log without odometry that are placed by their ranges, some seconds each; of longer logs by walls and
corners alone, which places fewer of them."""
MOST_SMOOTHED = 2000
"""Scans; longer logs are smoothed only when asked for."""
LEAST_EXPLAINED = 0.1
"""Share of the echoes that poses and map explain, recordings of old narrow sonars included; with less it is no map."""
SPARSE = 4.0
"""Echoes that a long wall sends back to a ring; with fewer, scans are gathered over windows."""
WINDOW = 1.5
"""Metres of path of such a window."""


@dataclass(frozen=True, eq=False)
class TrackerState:
    """What is remembered between two scans: a submap, and where the others lie."""

    track: Track
    graph: SubmapGraph
    """Never changed: a step that finishes a submap makes another one."""
    start: Float[np.ndarray, "3"]
    """world_from_robot of the first scan: its odometry, or the origin."""
    scans: int


class Step(NamedTuple):
    """What one scan came to."""

    model: LocalModel
    pose: Float[np.ndarray, "3"]
    """world_from_robot, metres and radians."""
    covariance: Float[np.ndarray, "3 3"]
    """Of the pose, with respect to the first one."""
    decisions: tuple[Decision, ...]
    """About loop closures, on this occasion."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Tracker:
    """Poses scan by scan: ``state, step = tracker.step(state, scan)``; the poses of the scans are their odometry.

    What a step costs does not depend on how many there were, but for the graph of submaps, one every few metres.

    Raises:
        SonarError: arguments as for ``local_model``.
    """

    ring: Ring
    method: str = "ml"
    settings: kernels.HoughSettings | None = None
    sigma: float | None = None
    """Standard deviation of the ranges, metres; None: learned on the way."""
    odometry_noise: OdometryNoise = field(default_factory=OdometryNoise)
    """How wrong the odometry is."""

    def __post_init__(self):
        check_method(self.method)
        check_sigma(self.sigma)
        object.__setattr__(self, "settings", hough_settings(self.ring, self.settings))

    def start(self) -> TrackerState:
        """A state that knows nothing."""
        return TrackerState(begin(), SubmapGraph(reach=REACH * float(self.ring.max_range)), np.zeros(3), 0)

    def step(
        self,
        state: TrackerState,
        scan: Scan,
        *,
        model: LocalModel | None = None,
        path_pose: Float[np.ndarray, "paths 3"] | None = None,
    ) -> tuple[TrackerState, Step]:
        """Take in one scan; the state given is left as it was.

        Args:
            state: so far.
            scan: its pose is odometry; NaN where there is none.
            model: its local model, if it is known already.
            path_pose: where the robot was when each path fired, as ``local_model`` takes it.

        Raises:
            SonarError: a sensor number that the ring does not have.
        """
        if model is None:
            choices = {"method": self.method, "settings": self.settings, "sigma": self.sigma, "path_pose": path_pose}
            model = local_model(self.ring, scan, **choices)
        row, given = state.scans, {"sigma": self.sigma, "path_pose": path_pose}
        start = scan.pose if row == 0 and np.isfinite(scan.pose).all() else state.start
        track, graph, decisions = state.track, state.graph, ()
        gap = track.odometry is not None and track.bridged < BRIDGED and not np.isfinite(scan.pose).all()
        if gap:
            track = aside(self.ring, track, scan, model, self.odometry_noise, row=row, **given)
        else:
            track = update(self.ring, advance(track, scan.pose, self.odometry_noise), scan, model, row=row, **given)
        lost = not gap and track.strange >= LOST
        if (track.ends and not gap) or lost:
            graph = graph.copy()
            decisions = graph.add(finished(track, lost=lost))
            # The next submap begins with the same scan: of its first pose nothing else is known.
            track = update(self.ring, begin(track), scan, model, row=row, **given)
        elif graph.busy:
            graph = graph.copy()
            decisions = graph.work()
        state = TrackerState(track, graph, start, row + 1)
        pose, covariance = self._here(state)
        return state, Step(model, pose, covariance, decisions)

    def finish(self, state: TrackerState) -> TrackerState:
        """Look for closures of the submap that is being made, too; the next scan begins another one."""
        graph = state.graph.copy()
        graph.settle()
        if len(state.track.rows) < 2:  # a single scan is in the submap before as well
            return replace(state, graph=graph)
        graph.add(finished(state.track))
        graph.settle()
        return replace(state, track=begin(state.track), graph=graph)

    def poses(self, state: TrackerState) -> tuple[Float[np.ndarray, "scans 3"], Float[np.ndarray, "scans 3 3"]]:
        """Of all scans so far: world_from_robot, and the covariance with respect to the first scan."""
        pose, cov = np.full((state.scans, 3), np.nan), np.full((state.scans, 3, 3), np.nan)
        base_cov = state.graph.covariances()
        parts = [(one.rows, one.poses, one.pose_cov) for one in state.graph.submaps]
        track = state.track
        parts.append((np.array(track.rows, dtype=np.int64), np.array(track.poses), np.array(track.covs)))
        for number, (rows, own, own_cov) in enumerate(parts):
            for k, row in enumerate(rows.tolist()):
                pose[row], cov[row] = compose_with_covariance(
                    state.graph.poses[number], base_cov[number], own[k], own_cov[k]
                )
        return _from_start(state.start, pose, cov)

    def _here(self, state: TrackerState) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
        number = len(state.graph.submaps)
        base_cov = state.graph.last_covariance
        pose, cov = compose_with_covariance(
            state.graph.poses[number], base_cov, state.track.poses[-1], state.track.covs[-1]
        )
        return _from_start(state.start, pose, cov)


def _from_start(
    start: Float[np.ndarray, "3"], pose: Float[np.ndarray, "*scans 3"], cov: Float[np.ndarray, "*scans 3 3"]
) -> tuple[Float[np.ndarray, "*scans 3"], Float[np.ndarray, "*scans 3 3"]]:
    """Poses of the first scan's frame and their covariances in the world."""
    return compose(start, pose), rotate_covariance(start[2], cov)


class Tie(NamedTuple):
    """A loop closure."""

    first: int
    """Row of the first scan of the earlier submap."""
    second: int
    """Row of the first scan of the later one."""
    pose: Float[np.ndarray, "3"]
    """The later submap in the frame of the earlier one."""
    state: str
    """"counted", "withdrawn", "refused" or "proposed": not sure enough to count."""
    determined: Float[np.ndarray, "3 rank"]
    """Unit vectors of (x, y, theta) that it determines, earlier frame; parallel walls leave one open, which is as
    everything else has it."""


@dataclass(frozen=True, eq=False)
class Slam:
    """Poses and map of a log."""

    poses: Float[np.ndarray, "scans 3"]
    """world_from_robot; NaN for scans that could not be placed."""
    covariance: Float[np.ndarray, "scans 3 3"]
    """With respect to the first placed scan."""
    stamp: Float[np.ndarray, " scans"]
    """Of every scan (``stamps_of``)."""
    world: GlobalMap
    odometry: Float[np.ndarray, "scans 3"]
    """The poses of the log."""
    closures: tuple[Tie, ...]
    step_ms: Float[np.ndarray, " steps"]
    """Milliseconds of each scan's step; empty where the log was not taken scan by scan."""
    smoothed: Smoothed | None
    """What the smoothing found; None without it."""

    @property
    def trajectory(self) -> Trajectory:
        """Of the scans that have a pose."""
        known = np.isfinite(self.poses).all(axis=1)
        covariance = self.covariance[known]
        return Trajectory(self.stamp[known], self.poses[known], covariance if np.isfinite(covariance).all() else None)

    @property
    def left_out(self) -> np.ndarray:
        """Rows of the scans that could not be placed."""
        return np.flatnonzero(~np.isfinite(self.poses).all(axis=1))


def slam(
    ring: Ring,
    log: Log,
    *,
    sigma: float | None = None,
    window: float | None = None,
    odometry_noise: OdometryNoise | None = None,
    smooth: bool | None = None,
    speed: bool = False,
    scale: bool = False,
    live: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
) -> Slam:
    """Poses of the scans of a log, and the map (paper, section 5, last paragraph).

    With odometry the scans are tracked one after the other, loops are closed, and in the end everything is smoothed.
    Without it scans are placed by their ranges (``placing_ranges``), of long logs by walls and corners (``placing``);
    with few echoes a scan (``SPARSE``) only the smoothing is done, on maps of windows.

    Args:
        ring: the sensors, calibrated.
        log: scans; their poses are odometry, and may be missing.
        sigma: noise of the ranges, metres; estimated if left out.
        window: metres of path gathered into one local model; 1.5 m for sparse rings if left out.
        slip: how wrong the odometry is.
        smooth: whether all poses and reflectors are adjusted together in the end; if left out, of logs with
            ``MOST_SMOOTHED`` scans or fewer, since it takes about a minute for a thousand, and not of scans that were
            placed by their ranges, but with ``speed``.
        speed: whether the smoothing estimates the speed of sound.
        scale: whether it estimates the scales of the odometry.
        live: local models one by one, as a robot makes them, so that ``step_ms`` is all that a step costs.
        progress: told what is being done, and (scans done, scans) of it; (0, 0) where that is not known.

    Raises:
        SonarError: no scan, arguments out of range, odometry in a few scans only, a sparse ring without odometry, no
            wall found, hardly an echo explained.
    """
    check_sigma(sigma)
    check_window(window)
    say = progress or (lambda text, done, total: None)
    odometry_noise = odometry_noise or OdometryNoise()
    if not len(log):
        raise SonarError("slam: no scan in the log; allowed is a log with one or more")
    here = np.asarray(np.isfinite(log.pose).all(axis=1))
    odometry = np.where(here[:, None], log.pose, np.nan)
    measured = bool(here.any())
    if measured and here.sum() < max(2, len(log) / 2):
        raise SonarError(
            f"slam: odometry in {here.sum()} of {len(log)} scans; allowed are half of them or more, or none"
        )
    if scale and not measured:
        raise SonarError("slam: scales of the odometry asked for, and no scan has any; allowed is a log with odometry")
    if smooth is False and (scale or speed):
        raise SonarError("slam: speed or scale came without smoothing, which estimates them; allowed is to leave it in")
    if window is None and float(np.asarray(ring.echo_paths.width).sum() / (2 * np.pi)) < SPARSE:
        window = WINDOW
    ties: tuple[Tie, ...] = ()
    took = np.zeros(0)
    models: list[LocalModel] | None = None
    passages: Passages | None = None
    if window is not None:
        if not measured:
            raise SonarError(
                f"slam: a window of {window:g} m of path, and no scan has a pose; allowed is a log with odometry"
            )
        start, covariance = odometry, np.full((len(log), 3, 3), np.nan)
    elif measured:
        start, covariance, ties, took, models, passages = _tracked(ring, log, sigma, odometry_noise, live, say)
    else:
        models = _models(ring, log, sigma, say)
        start, covariance = _without_odometry(ring, log, models, sigma, say)
    given = odometry if measured else None
    if smooth is None:
        # What was placed by the ranges is adjusted to all of them already, more than are of the map's reflectors.
        settled = not measured and bool(np.isfinite(covariance).any()) and not speed
        smooth = len(log) <= MOST_SMOOTHED and not settled
    if smooth:
        if measured:
            # Nothing leads to scans without odometry: they are laid on the map of the others, or left out.
            led = here | (np.arange(len(log)) == 0)  # all others are seen from the first one
            start = np.where(led[:, None], start, np.nan)
        choices = {
            "odometry": given,
            "sigma": sigma,
            "window": window,
            "speed": speed,
            "scale": scale,
            "slip": odometry_noise,
        }
        found = smoothing(
            ring, log, start, **choices, models=models, passages=passages, progress=lambda text: say(text, 0, 0)
        )
        if found.used < LEAST_EXPLAINED:
            raise SonarError(
                f"slam: {found.used:.0%} of the echoes come from what was found; allowed are {LEAST_EXPLAINED:.0%} or "
                "more: is it the right ring, are ranges and odometry in metres and radians?"
            )
        return Slam(found.poses, found.pose_cov, stamps_of(log), found.world, log.pose, ties, took, found)
    say("building the map", 0, 0)
    at = replace(log, pose=start)
    world = build_map(ring, at, window=window) if models is None else assemble_map(gather_evidence(ring, at, models))
    return Slam(start, covariance, stamps_of(log), world, log.pose, ties, took, None)


def _without_odometry(
    ring: Ring, log: Log, models: list[LocalModel], sigma: float | None, say: Callable[[str, int, int], None]
) -> tuple[Float[np.ndarray, "scans 3"], Float[np.ndarray, "scans 3 3"]]:
    """Poses of scans without odometry, and their covariances: those of the largest part that is sure."""

    def told(done: int, total: int) -> None:
        say("placing", done, total)

    if len(log) <= MOST_PLACED:
        part = register_by_ranges(ring, log, models, sigma=sigma, progress=told)[0]
        return part.poses, part.pose_covariance
    return register_scans(models, None, noise_scale=BLUR, progress=told)[0], np.full((len(log), 3, 3), np.nan)


def _models(ring: Ring, log: Log, sigma: float | None, say: Callable[[str, int, int], None]) -> list[LocalModel]:
    """Of all scans."""
    models: list[LocalModel] = []
    for model in local_models(ring, log, sigma=sigma):
        models.append(model)
        say("local models", len(models), len(log))
    return models


def _tracked(
    ring: Ring,
    log: Log,
    sigma: float | None,
    odometry_noise: OdometryNoise,
    live: bool,
    say: Callable[[str, int, int], None],
) -> tuple[
    Float[np.ndarray, "scans 3"],
    Float[np.ndarray, "scans 3 3"],
    tuple[Tie, ...],
    Float[np.ndarray, " scans"],
    list[LocalModel],
    Passages | None,
]:
    """Poses, covariances, closures, milliseconds of each step, the local models, and what is known to each other."""
    tracker = Tracker(ring=ring, sigma=sigma, odometry_noise=odometry_noise)
    state, took = tracker.start(), np.zeros(len(log))
    models = [] if live else _models(ring, log, sigma, say)
    for row in range(len(log)):
        begun = perf_counter()
        state, step = tracker.step(state, log[row], model=None if live else models[row])
        took[row] = 1e3 * (perf_counter() - begun)
        if live:
            models.append(step.model)
        say("tracking", row + 1, len(log))
    state = tracker.finish(state)
    return *tracker.poses(state), ties_of(state.graph), took, models, passages_of(state)


def passages_of(state: TrackerState) -> Passages | None:
    """The submaps of a run that is finished, as seen from each other; None where there is none."""
    nodes = np.arange(len(state.graph.submaps))
    if not len(nodes):
        return None
    part = np.full(state.scans, -1)
    for number, one in enumerate(state.graph.submaps):
        part[one.rows] = number
    part = np.maximum(np.maximum.accumulate(part), 0)
    return Passages(part, compose(state.start, state.graph.poses[nodes]), state.graph.graph.relative_covariances(nodes))


def ties_of(graph: SubmapGraph) -> tuple[Tie, ...]:
    """The closures of a graph, by the scans that they tie."""
    first = [int(one.rows[0]) for one in graph.submaps]
    ties = []
    for one in graph.closures.proposals:
        now, basis = relative(graph.poses[one.earlier], graph.poses[one.newest]), one.closure.basis
        off = one.closure.relative - now
        off[2] = wrap_angle(float(off[2]))
        pose = now + basis @ (basis.T @ off)  # what the walls leave open is as the graph has it
        state = "counted" if one.state == ACCEPTED else one.state
        ties.append(Tie(first[one.earlier], first[one.newest], pose, state, basis))
    return tuple(ties)

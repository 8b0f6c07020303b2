"""All poses, walls and corners together, on the raw ranges: the batch back end of SLAM.

From poses that are good to centimetres: map the scans, let poses and reflectors settle (``rounds.py``), look again for
the scans that had no place, and say how well everything is known.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.detection.extract import local_models
from jaxsonar.detection.local_map import LocalModel
from jaxsonar.detection.settings import check_sigma
from jaxsonar.estimation.alternation import AGAIN, MAPS, AlternationResult, alternate
from jaxsonar.estimation.batch_data import BatchData
from jaxsonar.estimation.landmark_map import LandmarkMap, landmark_map_of, map_with_tentative_points
from jaxsonar.estimation.odometry_noise import OdometryNoise
from jaxsonar.estimation.robust_adjustment import AdjustmentResult, AdjustmentState, anneal, gnc_adjust
from jaxsonar.estimation.sparse_lm import known
from jaxsonar.geometry.se2 import compose, relative
from jaxsonar.hardware.errors import SonarError
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.registration.sequential import register_remaining
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.sliding_windows import check_window
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring_parameters import PRIOR, ParameterBasis, parameter_basis
from jaxsonar.smoothing.covisibility import Traversals
from jaxsonar.smoothing.odometry_outliers import OdometryOutliers, find_odometry_outliers
from jaxsonar.smoothing.smoothed_map import adjusted_map
from jaxsonar.smoothing.wall_echo_mask import wall_explained_mask

BLUR = 0.2
"""Of local models where scans are placed: of a ring that is calibrated (``placing``)."""
SCALE_SD = 0.05
"""Relative; wheels and track of an odometry that was never calibrated."""
_TOGETHER = 4  # echoes of one reflector in a scan
_WIDEST = 0.04  # m; scale of the first association
_ANCHOR, _LOOSE = 1e-5, (30.0, 30.0, 3.0)  # m, rad; the first pose, and all others: hardly more than the digits ask for
SPARSE_SIGMA = 0.01
"""Metres; noise that is taken for granted of sparse rings."""
_NEAR = (0.05, 0.05, 0.05)  # m, rad; how good the start is, in the first round
_MARGINS = (4.0, 2.0)  # nats; for scans without a place, surely at first; without odometry only so
_NOISIER = 1.15  # so much more noise, and scans were laid together that do not belong together
_ODD = 0.5  # of the share of echoes that is explained elsewhere: a scan with less stands in the wrong place
_MANY, _FEW_STEPS, _FEW_MAPS = 100, 8, 2  # scans; from there on rounds are cut short: the next one goes on
_AGAIN = 2  # times that what broke the odometry is parted, at most
_NONE = np.zeros(0, dtype=np.int64)
_GROWN = 1.005  # more echoes so many times are no more
_LEAST = 3  # echoes that a pose without odometry rests on


@dataclass(frozen=True, eq=False)
class Smoothed:
    """Poses, map, and how well they are known. Frame: the first scan that was placed stays where it was."""

    poses: Float[np.ndarray, "scans 3"]
    """world_from_robot: x, y (metres), theta (radians); NaN for scans that could not be placed."""
    pose_cov: Float[np.ndarray, "scans 3 3"]
    """Covariance of (x, y, theta) with respect to the first scan that was placed; NaN as above. Metres and radians;
    what nothing determines has a standard deviation of many metres."""
    heard: Int[np.ndarray, " scans"]
    """Echoes that determined each pose; 0 where odometry alone did."""
    world: GlobalMap
    """The reflectors that settled, with their standard deviations."""
    used: float
    """Share of the echoes of placed scans that the map explains."""
    sigma: float
    """Noise of the ranges, metres."""
    ring: Ring
    """The ring, with the speed of sound that was found."""
    speed_of_sound_sd: float
    """Metres per second; 0 where it was held."""
    scale: tuple[float, float]
    """By which the odometry's ways are too long and its turns too far, relative; 0 where they were held."""
    scale_sd: tuple[float, float]

    @property
    def left_out(self) -> Int[np.ndarray, " rows"]:
        """Rows of the scans that could not be placed."""
        return np.flatnonzero(np.isnan(self.poses[:, 0]))


def smooth(
    ring: Ring,
    log: Log,
    poses: Float[np.ndarray, "scans 3"],
    *,
    odometry: Float[np.ndarray, "_ 3"] | None = None,
    sigma: float | None = None,
    window: float | None = None,
    speed: bool = False,
    scale: bool = False,
    odometry_noise: OdometryNoise | None = None,
    models: Sequence[LocalModel] | None = None,
    traversals: Traversals | None = None,
    progress: Callable[[str], None] | None = None,
) -> Smoothed:
    """Adjust all poses, walls and corners to the ranges.

    Args:
        ring: the sensors, calibrated; held, but for the speed of sound if asked for.
        log: the echoes. Its poses are not looked at.
        poses: (scans, 3) world_from_robot to start from, good to centimetres and degrees, loops closed to a decimetre;
            NaN where it is not known. Those are led on from their neighbors by odometry, where there is some, or laid
            on the map.
        odometry: (scans, 3) world_from_robot as measured, drifting; NaN where there is none.
        sigma: noise of the ranges, metres; if left out it is estimated, but for a window: 1 cm. (Where a scan has
            hardly more echoes than a pose has freedoms, too little is left over to tell.)
        window: metres of path gathered into one local model for the map, for sparse rings.
        speed: whether the speed of sound is estimated.
        scale: whether the scales of the odometry's ways and turns are.
        odometry_noise: noise model of the odometry; default ``OdometryNoise()``.
        models: the local models of the scans, if they are known already; not with a window.
        passages: which scans are known to each other so well that they hear the same walls; all of them if left out.
        progress: told what is being done.

    Raises:
        SonarError: shapes that do not fit, no pose, no wall found, a scale without odometry.
    """
    given, measured = _checked(log, poses, odometry, sigma, window, scale)
    say = progress or (lambda text: None)
    sigma = SPARSE_SIGMA if sigma is None and window is not None else sigma
    modes = _modes(ring, speed=speed, scale=scale)
    if window is None and models is None:
        say("local models")
        models = list(local_models(ring, log, sigma=sigma))
    job = _Job(
        ring,
        log,
        measured,
        modes,
        odometry_noise or OdometryNoise(),
        sigma,
        window,
        models,
        traversals,
        int(_placed(given).argmax()),
        say,
    )
    # 1. Maps and least squares in turn, from the poses as they came.
    best = job.settled(_led(given, measured))
    # 2. The map is better now: scans that had no place may find one.
    margins = _MARGINS if _placed(measured).any() else _MARGINS[:1]
    for margin in margins if models is not None else ():
        if _placed(best.poses).all():
            break
        say("looking again for scans without a place")
        more = register_remaining(models or [], best.poses, measured, margin=margin, noise_scale=BLUR)
        if _placed(more).sum() > _placed(best.poses).sum():
            fit = job.settled(more)
            best = (
                fit
                if fit.round.explained_count > best.round.explained_count and fit.sigma < _NOISIER * best.sigma
                else best
            )
    # 3. How well all of it is known.
    say("covariances")
    return job.result(best)


class _Fit(NamedTuple):
    """Poses that settled."""

    data: BatchData
    round: AlternationResult
    poses: Float[np.ndarray, "scans 3"]
    """NaN where a scan has no place."""
    heard: Int[np.ndarray, " scans"]

    @property
    def sigma(self) -> float:
        return self.round.adjustment.sigma


@dataclass(frozen=True)
class _Job:
    """What is asked for."""

    ring: Ring
    log: Log
    odometry: Float[np.ndarray, "scans 3"]
    modes: ParameterBasis
    odometry_noise: OdometryNoise
    sigma: float | None
    window: float | None
    models: Sequence[LocalModel] | None
    passages: Traversals | None
    first: int
    """Row of the scan that stays where it is."""
    say: Callable[[str], None]

    def settled(self, poses: Float[np.ndarray, "scans 3"]) -> _Fit:
        """Poses and reflectors from a start; scans of which hardly an echo fits are taken out, and again.

        Where the odometry from one scan to the next is broken, points of either side were taken for one; then all of it
        again with those parted, as long as less is broken for it.
        """
        fit = self._settled(poses)
        fit = fit if _placed(fit.poses).sum() == _placed(poses).sum() else self._settled(fit.poses)
        parted = broken = self._broken(fit)
        for _ in range(_AGAIN):
            if not len(broken):
                break
            self.say("again, less of what broke the odometry")
            again = self._settled(np.where(_placed(fit.poses)[:, None], poses, np.nan), parted)
            left = np.setdiff1d(self._broken(again), parted)
            if len(left) >= len(broken) or again.round.explained_count * _GROWN < fit.round.explained_count:
                break
            fit, broken, parted = again, left, np.union1d(parted, left)
        return fit

    def _broken(self, fit: _Fit) -> Int[np.ndarray, " some"]:
        """Scans from which the odometry to the next one is broken."""
        data, state, rows = fit.data, fit.round.adjustment.state, fit.data.scan_rows[0]
        told, change = data.odometry[:-1].copy(), self.modes.columns @ state.coordinates
        if len(change) > 3 * self.ring.count + 1:
            told *= np.exp(-change[[-2, -2, -1]])
        last = len(rows) - 1
        return rows[find_odometry_outliers(state.poses[: last + 1], told[:last], data.odometry_information[:last])]

    def _settled(self, poses: Float[np.ndarray, "scans 3"], broken: Int[np.ndarray, " some"] = _NONE) -> _Fit:
        log = replace(self.log, pose=poses)
        data = _free(
            BatchData.from_logs(self.ring, [log], [self.odometry], self.odometry_noise, keep_empty_scans=True),
            self.first,
        )
        data = replace(data, min_echoes_per_landmark=_TOGETHER if self.window is None else 1, sparse=True)
        if self.models is not None:
            data = replace(data, wall_explained=wall_explained_mask(self.ring, data, self.models))
        if data.scan_count > _MANY:
            data = replace(data, max_iterations=_FEW_STEPS)
        found = self._alternated(data, log, OdometryOutliers(broken, self._rows))
        if found is None:
            raise SonarError("smooth: no echo fits the walls; is it the right ring, are poses and units right?")
        rows = data.scan_rows[0]
        heard, echoes = np.zeros((2, len(log)), dtype=np.int64)
        heard[rows] = found.adjustment.used.sum(axis=1)[: len(rows)]
        echoes[rows] = np.isfinite(data.reported).sum(axis=1)[: len(rows)]
        odd = self._odd(data, heard, echoes)
        now = data.logs_with_poses([log], found.adjustment.state.poses)[0].pose
        return _Fit(data, found, np.where(odd[:, None], np.nan, now), np.where(odd, 0, heard))

    def _odd(
        self, data: BatchData, heard: Int[np.ndarray, " scans"], echoes: Int[np.ndarray, " scans"]
    ) -> Bool[np.ndarray, " scans"]:
        """Scans that nothing holds where they are: too few echoes fit, and no odometry leads to them."""
        rows = data.scan_rows[0]
        linked = np.zeros(len(heard), dtype=bool)
        tied = (data.odometry_information[: len(rows), 0] > 0)[:-1] if len(rows) else np.zeros(0, dtype=bool)
        linked[rows[:-1]] |= tied
        linked[rows[1:]] |= tied
        usual = heard.sum() / max(echoes.sum(), 1)
        odd = np.zeros(len(heard), dtype=bool)
        odd[rows] = (heard[rows] < np.maximum(_LEAST, _ODD * usual * echoes[rows])) & ~linked[rows]
        odd[self.first] = False
        return odd

    def _mapped(self, data: BatchData, log: Log, state: AdjustmentState, breaks: OdometryOutliers) -> GlobalMap:
        ring = self._heard_with(state)
        world = map_with_tentative_points(
            ring, data.logs_with_poses([log], state.poses)[0], window=self.window, models=self.models
        )
        if not len(world):
            raise SonarError("smooth: no wall found; allowed are scans of a place with straight walls in reach")
        world = world if self.passages is None else self.passages.split_landmarks(world, self._rows)
        return breaks.split_landmarks(world) if len(breaks.steps) else world

    @cached_property
    def _rows(self) -> dict[int, int]:
        """Of the scans by their numbers."""
        return {int(number): row for row, number in enumerate(self.log.scan)}

    def _around(self, data: BatchData, worlds: list[GlobalMap], breaks: OdometryOutliers) -> LandmarkMap:
        """The reflectors of the only map, and who may hear them."""
        around = landmark_map_of(worlds, tie_corners=False)
        if self.passages is None and not len(breaks.steps):
            return around
        world, rows = worlds[0], data.scan_rows[0]
        heard = breaks.visibility_mask(world, len(self.log))
        if self.passages is not None:
            heard &= self.passages.visibility_mask(world, self._rows)[self.passages.segment_id]
        heard_by = np.zeros((len(data.poses), len(around.world)), dtype=bool)
        heard_by[: len(rows), : heard.shape[1]] = heard[rows]
        return around._replace(visible=heard_by)

    def _alternated(self, data: BatchData, log: Log, breaks: OdometryOutliers) -> AlternationResult | None:
        """Map and least squares in turn; at first the poses stay near where they began, until the map has shape."""
        near = replace(data, prior_information=np.maximum(data.prior_information, 1 / np.square(_NEAR)))
        state = AdjustmentState(
            np.zeros(self.modes.columns.shape[1]), data.poses, landmark_map_of([], tie_corners=False)
        )
        self.say("first map")
        start = state._replace(landmark_map=self._around(data, [self._mapped(data, log, state, breaks)], breaks))
        with jax.enable_x64(True):
            start = anneal(self.ring, near, self.modes, start, initial_scale=_WIDEST, sigma=self.sigma)
        return alternate(
            start,
            build_maps=lambda state: [self._mapped(data, log, state, breaks)],
            adjust=lambda state, widest: self._settle(data, state, widest),
            initial_scale=AGAIN,
            progress=self.say,
            max_maps=_FEW_MAPS if data.scan_count > _MANY else MAPS,
            landmarks_of=lambda worlds: self._around(data, worlds, breaks),
        )

    def _settle(self, data: BatchData, state: AdjustmentState, widest: float) -> AdjustmentResult:
        """In double precision."""
        with jax.enable_x64(True):
            return gnc_adjust(
                self.ring, data, self.modes, state, initial_scale=widest, poses_free=True, sigma=self.sigma
            )

    def _heard_with(self, state: AdjustmentState) -> Ring:
        """The ring with the speed of sound so far."""
        faster = float(np.exp((self.modes.columns @ state.coordinates)[self.ring.count]))
        return replace(self.ring, speed_of_sound=float(self.ring.speed_of_sound) * faster)

    def result(self, fit: _Fit) -> Smoothed:
        """With covariances."""
        found, rows = fit.round.adjustment, fit.data.scan_rows[0]
        with jax.enable_x64(True):
            cov = known(found.problem, found.solution.unknowns)
        pose_cov = np.full((len(self.log), 3, 3), np.nan)
        pose_cov[rows] = cov.poses[: len(rows)]
        pose_cov[np.isnan(fit.poses[:, 0])] = np.nan
        columns, count = self.modes.columns, self.ring.count
        change = columns @ found.state.coordinates
        sd = np.sqrt(np.maximum(np.diag(columns @ cov.modes @ columns.T), 0))
        scaled = len(change) > 3 * count + 1
        ring = self._heard_with(found.state)
        return Smoothed(
            poses=fit.poses,
            pose_cov=pose_cov,
            heard=fit.heard,
            world=adjusted_map(fit.round.maps[0], found, cov.reflectors),
            used=float(found.used.sum() / max(fit.data.echo_count, 1)),
            sigma=found.sigma,
            ring=ring,
            speed_of_sound_sd=float(sd[count] * ring.speed_of_sound),
            scale=(float(np.expm1(change[-2])), float(np.expm1(change[-1]))) if scaled else (0.0, 0.0),
            scale_sd=(float(sd[-2]), float(sd[-1])) if scaled else (0.0, 0.0),
        )


def _modes(ring: Ring, *, speed: bool, scale: bool) -> ParameterBasis:
    """The speed of sound, if it is free, and the scales of the odometry."""
    modes = parameter_basis(ring, ("speed",) if speed else (), poses_free=True, speed_sd=PRIOR.speed_sd)
    if not scale:
        return modes
    columns = np.zeros((len(modes.columns) + 2, modes.columns.shape[1] + 2))
    columns[:-2, :-2] = modes.columns
    columns[-2:, -2:] = SCALE_SD * np.eye(2)
    return ParameterBasis(columns, (*modes.names, "way", "turn"))


def _free(data: BatchData, first: int) -> BatchData:
    """With all poses free but that of one scan, and reflectors that may go as far."""
    anchored = np.tile(1 / np.square(_LOOSE), (len(data.poses), 1))
    anchored[int(np.flatnonzero(data.scan_rows[0] == first)[0])] = 1 / _ANCHOR**2
    return replace(data, prior_information=anchored, landmark_prior_sd=_LOOSE[0])


def _led(poses: Float[np.ndarray, "scans 3"], odometry: Float[np.ndarray, "scans 3"]) -> Float[np.ndarray, "scans 3"]:
    """Poses that are missing, from the nearest scan that has one, by odometry."""
    out, known = poses.copy(), np.flatnonzero(_placed(poses) & _placed(odometry))
    if not len(known):
        return out
    for row in np.flatnonzero(~_placed(poses) & _placed(odometry)):
        near = known[np.argmin(np.abs(known - row))]
        out[row] = compose(poses[near], relative(odometry[near], odometry[row]))
    return out


def _placed(poses: Float[np.ndarray, "scans 3"]) -> Bool[np.ndarray, " scans"]:
    return np.isfinite(poses[:, 0])


def _checked(
    log: Log,
    poses: Float[np.ndarray, "_ 3"],
    odometry: Float[np.ndarray, "_ 3"] | None,
    sigma: float | None,
    window: float | None,
    scale: bool,
) -> tuple[Float[np.ndarray, "scans 3"], Float[np.ndarray, "scans 3"]]:
    """Start and odometry, double precision, rows that are not finite NaN; or a SonarError."""
    check_sigma(sigma)
    check_window(window)
    out = []
    for name, given in {"poses": poses, "odometry": odometry}.items():
        values = np.full((len(log), 3), np.nan) if given is None else np.array(given, dtype=np.float64)
        if values.shape != (len(log), 3):
            raise SonarError(f"smooth: {name} of shape {values.shape}; allowed is ({len(log)}, 3): x, y, theta a scan")
        values[~np.isfinite(values).all(axis=1)] = np.nan
        out.append(values)
    if not _placed(out[0]).any():
        raise SonarError(f"smooth: none of the {len(log)} scans has a pose; allowed is one or more to start from")
    if scale and not _placed(out[1]).any():
        raise SonarError("smooth: a scale to be estimated, and no odometry; allowed is odometry, or no scale")
    return out[0], out[1]

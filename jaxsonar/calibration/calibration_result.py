"""The result of a calibration: the ring, its standard deviations, and the residuals."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxsonar import kernels
from jaxsonar.calibration.closing_tracks import ScaleEstimate
from jaxsonar.calibration.echo_model import EchoStatistics
from jaxsonar.estimation.explained_share import ExplainedShare
from jaxsonar.geometry.se2 import unit
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True, eq=False)
class RunResiduals:
    """Echoes at walls in the calibration of a ring with few sensors, and where the scale of the ranges comes from."""

    distance: Float[np.ndarray, " echoes"]
    """Distance of the wall in the calibrated map, metres."""
    off_axis: Float[np.ndarray, " echoes"]
    """Angle from the axis of the path to the normal of the wall, radians."""
    before: Float[np.ndarray, " echoes"]
    """Range as reported minus that which the nominal ring reports at this distance, metres."""
    after: Float[np.ndarray, " echoes"]
    """Range as reported minus that which the calibrated ring reports, metres."""
    scale: ScaleEstimate
    """Scale of the ranges from sensors that approach static targets, relative to the nominal ring (at the measured
    temperature, if any)."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated ring, its standard deviations, and the residuals."""

    ring: Ring
    """The calibrated ring."""
    nominal: Ring
    """The nominal ring."""
    free: tuple[str, ...]
    """Parameter groups that were estimated."""
    held: dict[str, str]
    """Parameters that were not estimated, and why."""
    covariance: Float[np.ndarray, "parameters parameters"]
    """Covariance of range offsets (sensors, metres), log speed of sound and positions (sensors x 2, metres); 0 for
    parameters that were held."""
    heading_sd: Float[np.ndarray, " sensors"]
    """Standard deviations of the headings, radians; 0 if they were held."""
    sigma: float
    """Standard deviation of the noise of reported ranges, metres."""
    residuals: Float[np.ndarray, " echoes"]
    """Reported minus predicted range of the echoes that landmarks explain, metres."""
    residuals_before: Float[np.ndarray, " echoes"]
    """Residuals of the same echoes with the nominal ring (at the measured temperature, if any), after landmarks and
    free poses were adjusted to it, metres."""
    echoes: int
    """Number of all echoes."""
    explained: ExplainedShare
    """The share of the echoes that walls, corners and edges explain."""
    scans: int
    """Number of scans that were used."""
    poses: tuple[Float[np.ndarray, "_ 3"], ...]
    """world_from_robot of the scans of every world, given or estimated; NaN for scans that were not used. A log is a
    world; if poses were estimated, so is every part of a log that could not be registered with the others."""
    maps: tuple[GlobalMap, ...]
    """Map of every world with the calibrated ring."""
    maps_before: tuple[GlobalMap, ...]
    """Map of every world with the nominal ring."""
    problem: kernels.LeastSquaresProblem | None = None
    """The least-squares problem in double precision: echoes, landmarks, priors. ``kernels.residuals`` and
    ``kernels.cost`` take it together with ``unknowns``, for example to add further terms. None for rings with few
    sensors."""
    unknowns: kernels.Unknowns | None = None
    """Solution of ``problem``."""
    echo_model: EchoStatistics | None = None
    """Noise and detection probability; for rings with few sensors only."""
    run: RunResiduals | None = None
    """Residuals over range and angle, and the source of the scale; for rings with few sensors only."""

    @property
    def range_offset_sd(self) -> Float[np.ndarray, " sensors"]:
        """Standard deviations of the range offsets relative to their mean, metres; 0 if they were held."""
        count = self.ring.count
        relative = np.eye(count) - 1 / count
        covariance = relative @ self.covariance[:count, :count] @ relative
        return np.sqrt(np.maximum(np.diag(covariance), 0))

    @property
    def mean_offset_sd(self) -> float:
        """Standard deviation of the mean range offset, metres; 0 if it was held."""
        count = self.ring.count
        return float(np.sqrt(max(self.covariance[:count, :count].mean(), 0)))

    @property
    def speed_of_sound_sd(self) -> float:
        """Standard deviation of the speed of sound, metres per second."""
        return float(np.sqrt(self.covariance[self.ring.count, self.ring.count]) * self.ring.speed_of_sound)

    @property
    def position_sd(self) -> Float[np.ndarray, "sensors 2"]:
        """Standard deviations of the positions (x, y), metres."""
        return np.sqrt(np.diag(self.covariance)[self.ring.count + 1 :]).reshape(-1, 2)

    @property
    def radius(self) -> tuple[float, float]:
        """Mean distance of the sensors from their centroid, and its standard deviation, metres."""
        outward = np.asarray(self.ring.position) - np.mean(self.ring.position, axis=0)
        radius = np.linalg.norm(outward, axis=1)
        gradient = (outward / np.where(radius > 0, radius, 1)[:, None]).ravel() / len(radius)
        covariance = self.covariance[self.ring.count + 1 :, self.ring.count + 1 :]
        return float(radius.mean()), float(np.sqrt(max(gradient @ covariance @ gradient, 0)))

    @property
    def effective_correction(self) -> tuple[Float[np.ndarray, " sensors"], Float[np.ndarray, " sensors"]]:
        """Effective range correction of every sensor along its heading, and its standard deviation, metres.

        It is the change of the range offset minus that of the position along the heading: a sensor farther out reports
        correspondingly smaller ranges. If both are free, only this difference is well determined.
        """
        count = self.ring.count
        direction = unit(np.asarray(self.ring.heading))
        shift = np.asarray(self.ring.position) - np.asarray(self.nominal.position)
        offset = np.asarray(self.ring.range_offset) - np.asarray(self.nominal.range_offset)
        correction = offset - (direction * shift).sum(-1)
        jacobian, sensor = np.zeros((count, len(self.covariance))), np.arange(count)
        jacobian[sensor, sensor] = 1
        jacobian[sensor, count + 1 + 2 * sensor] = -direction[:, 0]
        jacobian[sensor, count + 2 + 2 * sensor] = -direction[:, 1]
        variance = np.einsum("ij,jk,ik->i", jacobian, self.covariance, jacobian)
        return correction, np.sqrt(np.maximum(variance, 0))

    def correlations(self, *, least: float = 0.7, most: int = 12) -> list[tuple[str, str, float]]:
        """Strongly correlated pairs of parameters, the strongest first: two names and their correlation.

        Offsets are relative to their mean, which is a parameter of its own.

        Args:
            least: smallest absolute correlation.
            most: largest number of pairs.
        """
        count, size = self.ring.count, len(self.covariance)
        transform = np.eye(size)
        transform[:count, :count] -= 1 / count
        transform = np.vstack([transform, np.where(np.arange(size) < count, 1 / count, 0)])
        covariance = transform @ self.covariance @ transform.T
        positions = (f"{axis} {k}" for k in range(count) for axis in "xy")
        names = [*(f"offset {k}" for k in range(count)), "speed", *positions, "mean offset"]
        sd = np.sqrt(np.maximum(np.diag(covariance), 0))
        scale = np.outer(sd, sd) * (np.outer(sd, sd) > 1e-12 * sd.max(initial=0) ** 2)
        value = np.where(scale > 0, covariance / np.where(scale > 0, scale, 1), 0)
        a, b = np.triu_indices(len(sd), k=1)
        order = np.argsort(-np.abs(value[a, b]), kind="stable")[:most]
        pairs = [(names[i], names[j], float(value[i, j])) for i, j in zip(a[order], b[order], strict=True)]
        return [pair for pair in pairs if abs(pair[2]) >= least]

    def summary(self) -> tuple[str, ...]:
        """Summary of the result, line by line."""
        lines = [
            f"{self.scans} scans, {self.echoes} echoes; {self.explained}; "
            f"residual RMS {1e3 * self.rms_before:.2f} mm before, {1e3 * self.rms:.2f} mm after"
        ]
        if "offset" in self.free:
            change = np.asarray(self.ring.range_offset) - np.asarray(self.nominal.range_offset)
            lines.append(
                f"range offsets changed by {1e3 * np.sqrt(np.mean(change**2)):.2f} mm RMS, standard deviation "
                f"{1e3 * np.sqrt(np.mean(self.range_offset_sd**2)):.2f} mm relative to their mean"
            )
        if "speed" in self.free:
            lines.append(f"speed of sound {float(self.ring.speed_of_sound):.2f} m/s ± {self.speed_of_sound_sd:.2f}")
        if "radius" in self.free:
            radius, sd = self.radius
            lines.append(f"radius {1e3 * radius:.1f} mm ± {1e3 * sd:.1f}")
        if self.run is not None:
            scale = self.run.scale
            if np.isfinite(scale.sd):
                lines.append(
                    f"range scale {np.exp(scale.log_scale):.4f} ± {scale.sd:.4f} from {scale.tracks} tracks of sensors "
                    f"that approach something, in {scale.stretches} stretches of the trajectory"
                )
        if self.echo_model is not None:
            lines += self.echo_model.describe()
        unexpected = ((name.replace("_", " "), why) for name, why in self.held.items() if "not asked" not in why)
        lines += [f"held: {name}: {why}" for name, why in unexpected]
        return tuple(lines)

    @property
    def rms(self) -> float:
        """Root mean square of the residuals with the calibrated ring, metres."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    @property
    def rms_before(self) -> float:
        """Root mean square of the residuals with the nominal ring, metres."""
        return float(np.sqrt(np.mean(self.residuals_before**2)))

"""The result of a calibration: the ring, its standard deviations, and the residuals."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxsonar import kernels
from jaxsonar.geometry.se2 import unit
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True, eq=False)
class Calibration:
    """A ring as its own echoes describe it, and how well they do."""

    ring: Ring
    """The calibrated ring."""
    nominal: Ring
    """The ring to start from."""
    free: tuple[str, ...]
    """What was estimated."""
    held: dict[str, str]
    """What was not, and why."""
    covariance: Float[np.ndarray, "ring ring"]
    """Of range offsets (sensors, metres), log speed of sound, positions (sensors x 2, metres); 0 where held."""
    heading_sd: Float[np.ndarray, " sensors"]
    """Standard deviations of the headings, radians; 0 where held."""
    sigma: float
    """Noise of the ranges as reported, metres."""
    residuals: Float[np.ndarray, " echoes"]
    """Reported minus expected range of the echoes that reflectors explain, metres."""
    residuals_before: Float[np.ndarray, " echoes"]
    """The same echoes with the ring to start from (at the measured temperature, if there is one), walls and free poses
    fitted to it as well as it can be."""
    echoes: int
    """Echoes that came."""
    scans: int
    """Scans that were used."""
    poses: tuple[Float[np.ndarray, "_ 3"], ...]
    """world_from_robot of the scans of every world, given or estimated; NaN where a scan was not used. A log is a
    world; where poses were estimated, so is every part of a log that could not be laid on the others."""
    maps: tuple[GlobalMap, ...]
    """The map of every world with the calibrated ring."""
    maps_before: tuple[GlobalMap, ...]
    """The same with the nominal ring."""
    problem: kernels.LeastSquaresProblem
    """The least squares that the result solves, in double precision: echoes, reflectors, priors. With ``unknowns`` it
    is what ``kernels.residuals`` and ``kernels.cost`` take, for a loss of one's own on top."""
    unknowns: kernels.Unknowns
    """Its solution."""

    @property
    def range_offset_sd(self) -> Float[np.ndarray, " sensors"]:
        """Standard deviations of the range offsets relative to their mean, metres; 0 where they are held."""
        count = self.ring.count
        relative = np.eye(count) - 1 / count
        own = relative @ self.covariance[:count, :count] @ relative
        return np.sqrt(np.maximum(np.diag(own), 0))

    @property
    def mean_offset_sd(self) -> float:
        """Standard deviation of the mean range offset, metres; 0 where it is held."""
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
        """Mean distance of the sensors from their middle, and its standard deviation, metres."""
        outward = np.asarray(self.ring.position) - np.mean(self.ring.position, axis=0)
        far = np.linalg.norm(outward, axis=1)
        weight = (outward / np.where(far > 0, far, 1)[:, None]).ravel() / len(far)
        places = self.covariance[self.ring.count + 1 :, self.ring.count + 1 :]
        return float(far.mean()), float(np.sqrt(max(weight @ places @ weight, 0)))

    @property
    def effective_correction(self) -> tuple[Float[np.ndarray, " sensors"], Float[np.ndarray, " sensors"]]:
        """Range correction of every sensor in its own direction, and its standard deviation, metres.

        The change of its range offset minus that of its place along its heading: a sensor that sits farther out reports
        as much less. Where both are free only this is well known.
        """
        count = self.ring.count
        ahead = unit(np.asarray(self.ring.heading))
        moved = np.asarray(self.ring.position) - np.asarray(self.nominal.position)
        change = np.asarray(self.ring.range_offset) - np.asarray(self.nominal.range_offset) - (ahead * moved).sum(-1)
        along = np.zeros((count, len(self.covariance)))
        sensor = np.arange(count)
        along[sensor, sensor] = 1
        along[sensor, count + 1 + 2 * sensor] = -ahead[:, 0]
        along[sensor, count + 2 + 2 * sensor] = -ahead[:, 1]
        return change, np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", along, self.covariance, along), 0))

    def correlations(self, *, least: float = 0.7, most: int = 12) -> list[tuple[str, str, float]]:
        """Pairs of parameters that the echoes hardly tell apart, the closest first: two names and their correlation.

        Offsets are meant relative to their mean, which is a parameter of its own.
        """
        count, size = self.ring.count, len(self.covariance)
        turn = np.eye(size)
        turn[:count, :count] -= 1 / count
        turn = np.vstack([turn, np.where(np.arange(size) < count, 1 / count, 0)])
        covariance = turn @ self.covariance @ turn.T
        places = (f"{axis} {k}" for k in range(count) for axis in "xy")
        names = [*(f"offset {k}" for k in range(count)), "speed", *places, "mean offset"]
        sd = np.sqrt(np.maximum(np.diag(covariance), 0))
        both = np.outer(sd, sd) * (np.outer(sd, sd) > 1e-12 * sd.max(initial=0) ** 2)
        value = np.where(both > 0, covariance / np.where(both > 0, both, 1), 0)
        a, b = np.triu_indices(len(sd), k=1)
        order = np.argsort(-np.abs(value[a, b]), kind="stable")[:most]
        pairs = [(names[i], names[j], float(value[i, j])) for i, j in zip(a[order], b[order], strict=True)]
        return [pair for pair in pairs if abs(pair[2]) >= least]

    def summary(self) -> tuple[str, ...]:
        """The result in a few plain lines."""
        share = 100 * len(self.residuals) / max(self.echoes, 1)
        lines = [
            f"{self.scans} scans, {len(self.residuals)} of {self.echoes} echoes explained ({share:.0f} %); "
            f"residual RMS {1e3 * self.rms_before:.2f} mm before, {1e3 * self.rms:.2f} mm after"
        ]
        if "offset" in self.free:
            change = np.asarray(self.ring.range_offset) - np.asarray(self.nominal.range_offset)
            lines.append(
                f"range offsets changed by {1e3 * np.sqrt(np.mean(change**2)):.2f} mm RMS, known to "
                f"{1e3 * np.sqrt(np.mean(self.range_offset_sd**2)):.2f} mm relative to their mean"
            )
        if "speed" in self.free:
            lines.append(f"speed of sound {float(self.ring.speed_of_sound):.2f} m/s ± {self.speed_of_sound_sd:.2f}")
        if "radius" in self.free:
            radius, sd = self.radius
            lines.append(f"radius {1e3 * radius:.1f} mm ± {1e3 * sd:.1f}")
        lines += [f"held: {name.replace('_', ' ')}: {why}" for name, why in self.held.items() if "not asked" not in why]
        return tuple(lines)

    @property
    def rms(self) -> float:
        """Root mean square of the residuals, metres."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    @property
    def rms_before(self) -> float:
        """Root mean square of the residuals with the nominal ring, metres."""
        return float(np.sqrt(np.mean(self.residuals_before**2)))

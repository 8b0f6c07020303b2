"""Data of the maximum-likelihood detector for ONE scan: the echoes, the hypotheses, and the estimate of the scene."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..detection_cones import DEAF
from ..hough_voting import CrosstalkPaths
from ..measurement_model import PredictedEcho
from ..sensor_array import EchoPaths
from .settings import DetectionSettings

Model = Callable[[Float[Array, "2"], EchoPaths], PredictedEcho]
"""The measurement model of one kind of reflector."""


class ScanData(NamedTuple):
    """ONE scan."""

    paths: EchoPaths
    """All paths of the ring, their axis last, so that loops over them are contiguous in memory."""
    echo_paths: EchoPaths
    """The path of each echo, their axis last."""
    path_index: Int[Array, " echoes"]
    """The row of that path."""
    ranges: Float[Array, " echoes"]
    """Corrected ranges, metres."""
    valid: Bool[Array, " echoes"]
    """Which rows are echoes."""
    max_range: Float[Array, ""]
    """Metres."""
    full_wall_paths: Float[Array, ""]
    """Number of measured paths that receive an echo of a wide wall."""
    measured: Bool[Array, " paths"] | None
    """Which of the paths were measured; None: all. The others are evidence neither for nor against a reflector."""
    crosstalk: CrosstalkPaths | None = None
    """Paths from other transmitters to the receiver of each echo, the axis of the echoes last."""


class SceneEstimate(NamedTuple):
    """Walls and nuisance parameters as estimated by the previous pass."""

    walls: Float[Array, "reflectors 2"]
    """rho, theta."""
    covariance: Float[Array, "reflectors 2 2"]
    """Of rho and theta."""
    is_wall: Bool[Array, " reflectors"]
    """Which of the rows are walls."""
    extent: Float[Array, "reflectors 2"]
    """Outermost footpoints of the echoes of each wall: coordinates along it, metres from the foot of the origin."""
    is_corner: Bool[Array, " reflectors"]
    """Which of the rows are corners; ``walls`` holds their x, y."""
    detection_probability: Float[Array, ""]
    """Probability that an echo inside both cones is received."""
    aligned_fraction: Float[Array, ""]
    """Fraction of the walls that are parallel or perpendicular to another one."""
    sigma: Float[Array, ""]
    """Standard deviation of the ranges, metres."""
    threshold: Float[Array, ""]
    """Level of the faintest echoes of walls that are heard outside the cones, dB (``detection_cones.echo_level``)."""
    silence_threshold: Float[Array, ""]
    """The same for missed detections: no echo is expected below this level, dB."""

    @staticmethod
    def initial(sigma: Float[Array, ""], settings: DetectionSettings) -> "SceneEstimate":
        """No walls yet, and the priors of the nuisance parameters."""
        size = settings.reflectors
        return SceneEstimate(
            walls=jnp.zeros((size, 2)),
            covariance=jnp.zeros((size, 2, 2)),
            is_wall=jnp.zeros(size, bool),
            extent=jnp.zeros((size, 2)),
            is_corner=jnp.zeros(size, bool),
            detection_probability=jnp.asarray(settings.detection_probability, sigma.dtype),
            aligned_fraction=jnp.asarray(settings.aligned_fraction, sigma.dtype),
            sigma=sigma,
            threshold=jnp.asarray(settings.initial_threshold, sigma.dtype),
            silence_threshold=jnp.asarray(DEAF, sigma.dtype),
        )


class Hypotheses(NamedTuple):
    """A reflector of one kind, fitted to the scan, and its evidence; or many of them with a leading axis."""

    parameters: Float[Array, "*hypotheses 2"]
    """(rho, theta) or (x, y)."""
    information: Float[Array, "*hypotheses 2 2"]
    """Information matrix of the parameters, from the echoes."""
    log_ratio: Float[Array, "*hypotheses echoes"]
    """Log-likelihood ratio of each echo between this reflector and clutter, nats; -inf where there is no echo."""
    footpoint: Float[Array, "*hypotheses echoes"]
    """Planes: coordinate along the plane of each echo's point of reflection, metres."""
    residual: Float[Array, "*hypotheses echoes"]
    """Measured minus predicted range, metres."""
    base: Float[Array, "*hypotheses"]
    """Evidence without the echoes: missed detections, prior and volume of the posterior, nats."""

    @property
    def covariance(self) -> Float[Array, "2 2"]:
        """Covariance of the parameters of ONE hypothesis."""
        return regularized_inverse(self.information)

    def take(self, rows: Int[Array, " reflectors"]) -> "Hypotheses":
        """Select some of the hypotheses."""
        return jax.tree.map(lambda leaf: leaf[rows], self)


class Selection(NamedTuple):
    """The selected hypotheses, in the order of their evidence."""

    hypothesis: Int[Array, " reflectors"]
    """Its row."""
    kind: Int[Array, " reflectors"]
    """PLANE, CORNER or EDGE."""
    evidence: Float[Array, " reflectors"]
    """Nats; -inf where no hypothesis has enough."""
    involved: Bool[Array, "reflectors echoes"]
    """Echoes that the reflector explains, of those that were left by the reflectors before it."""
    log_odds: Float[Array, "reflectors 3"]
    """Tempered evidence for plane, corner and edge, given these echoes, nats."""


def log_normal(x: Float[Array, "*any"], sigma: Float[Array, "*#any"]) -> Float[Array, "*any"]:
    """Logarithm of the normal density with mean 0."""
    return -0.5 * (x / sigma) ** 2 - jnp.log(sigma * np.sqrt(2 * np.pi))


def count(mask: Bool[Array, "*any"]) -> Float[Array, ""]:
    """Number of true entries, as a float."""
    return mask.sum(dtype=jnp.float32)


def determinant(m: Float[Array, "2 2"]) -> Float[Array, ""]:
    """Determinant of a positive semidefinite matrix."""
    return jnp.maximum(m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0], 0)


def regularized_inverse(m: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    """Inverse of an information matrix with a small prior, so that undetermined parameters have a finite variance."""
    a, b, d = m[0, 0] * (1 + 1e-5) + 1, m[0, 1], m[1, 1] * (1 + 1e-5) + 1
    return jnp.stack([jnp.stack([d, -b]), jnp.stack([-b, a])]) / (a * d - b * b)

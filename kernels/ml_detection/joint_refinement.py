"""Joint refinement of the selected reflectors: they compete with each other and with clutter for every echo.

``likelihood.refine`` fits every hypothesis alone, so that an echo of one reflector can attract another one that
happens to predict a similar range. Here each echo is shared among the reflectors by its responsibilities
(expectation-maximization), and the covariances contain the uncertainty of this assignment (Louis, 1982). Of Louis'
information matrix, each reflector's own block is used, without the contributions below zero of single echoes.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..detection_cones import audibility
from ..measurement_model import EDGE, PLANE, echo_of_kind, plane_echo, point_echo
from ..sensor_array import EchoPaths
from .settings import DetectionSettings
from .state import ScanData, SceneEstimate, log_normal, regularized_inverse


class JointFit(NamedTuple):
    """The reflectors of ONE scan after the joint refinement."""

    parameters: Float[Array, "reflectors 2"]
    """(rho, theta) of planes, (x, y) of corners and edges."""
    covariance: Float[Array, "reflectors 2 2"]
    """Covariance of these, from the noise of the ranges and from the uncertainty of the assignment of the echoes."""


def refine_jointly(
    scan: ScanData,
    kind: Int[Array, " reflectors"],
    start: Float[Array, "reflectors 2"],
    selected: Bool[Array, " reflectors"],
    clutter: Float[Array, " echoes"],
    scene: SceneEstimate,
    settings: DetectionSettings,
) -> JointFit:
    """Maximum likelihood of all reflectors together by expectation-maximization, with Gauss-Newton steps.

    Args:
        scan: the echoes.
        kind: PLANE, CORNER or EDGE of each reflector.
        start: its parameters.
        selected: which of the rows are reflectors.
        clutter: log density of clutter at each echo's range, 1/m.
        scene: detection probability, sigma and thresholds.
        settings: steps and weights.
    """

    def predict(kind: Int[Array, ""], x: Float[Array, "2"], path: EchoPaths):
        is_edge = jnp.where(kind == EDGE, 1, 0).astype(x.dtype)
        point = point_echo(is_edge, x, path)
        echo = echo_of_kind(jnp.where(kind == PLANE, 0, 1), plane_echo(x, path), point)
        return echo.range, echo.d_range_d_landmark, audibility(echo, path, scene.threshold)

    each_echo = jax.vmap(predict, in_axes=(None, None, -1), out_axes=-1)
    each_reflector = jax.vmap(each_echo, in_axes=(0, 0, None))
    usable = selected[:, None] & scan.valid[None]

    def share(x: Float[Array, "reflectors 2"]):
        predicted, jacobian, visible = each_reflector(kind, x, scan.echo_paths)
        detection, residual = scene.detection_probability * visible, scan.ranges[None] - predicted
        odds = jnp.log(detection / (1 - detection) + 1e-9) + log_normal(residual, scene.sigma) - clutter[None]
        odds = jnp.where(usable, odds, -jnp.inf)
        total = jnp.logaddexp(jax.nn.logsumexp(odds, axis=0), 0)
        return jnp.exp(odds - total[None]), residual, jacobian

    def information(weight: Float[Array, "reflectors echoes"], jacobian: Float[Array, "reflectors 2 echoes"]):
        return jnp.einsum("ke,kie,kje->kij", weight / scene.sigma**2, jacobian, jacobian)

    def step(state: tuple[Float[Array, "reflectors 2"], Any], _: None):
        x, _ = state
        shared = weight, residual, jacobian = share(x)
        gradient = jnp.einsum("ke,kie->ki", weight * residual / scene.sigma**2, jacobian)
        change = jnp.einsum("kij,kj->ki", jax.vmap(regularized_inverse)(information(weight, jacobian)), gradient)
        return (x + jnp.clip(change, -settings.max_refinement, settings.max_refinement), (x, *shared)), None

    # The last shares are those at the result; in the loop, they are compiled once.
    nothing = jnp.zeros((len(start), len(scan.ranges)), start.dtype)
    unused = start, nothing, nothing, jnp.stack([nothing] * 2, axis=1)
    (_, (x, weight, residual, jacobian)), _ = jax.lax.scan(step, (start, unused), None, length=settings.joint_steps + 1)
    # Observed information of a mixture: that of the complete data minus that of the missing assignment, each echo's
    # at least zero, and without the blocks between reflectors.
    missing = weight * (1 - weight) * (residual / scene.sigma) ** 2
    observed = jnp.maximum(weight - missing, 0)
    return JointFit(x, jax.vmap(regularized_inverse)(information(observed, jacobian)))

"""Headings of the sensors: ranges do not depend on them, only on what is heard at all."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from jaxsonar import kernels
from jaxsonar.estimation.robust_adjustment import Data, Settled
from jaxsonar.hardware.errors import SonarError
from jaxsonar.kernels.shape_buckets import bucket_size, pad_rows
from jaxsonar.sensors.ring import Ring

_SOFT, _LIKELY = 0.1, 2.0  # rad, log odds; to begin with


def beam_centres(ring: Ring, data: Data, found: Settled) -> tuple[Ring, Float[np.ndarray, " sensors"]]:
    """The ring with the headings that its direct echoes show, and their standard deviations, radians.

    To be called with 64-bit floats enabled. Half width and softness of the cones and the share of echoes that arrive
    are estimated along, one for all sensors.

    Raises:
        SonarError: the scans do not show them.
    """
    around = found.state.around
    scene, candidates = (jax.tree.map(jnp.asarray, tree) for tree in (around.scene, around.candidates))
    angle = np.asarray(
        kernels.off_axis_angles(
            ring.sensors, scene, candidates, jnp.asarray(found.state.poses), jnp.asarray(data.world)
        )
    )
    heard = np.zeros(angle.shape, dtype=bool)
    scan, echo = np.nonzero(found.used & (data.path < ring.count))
    heard[scan, found.candidate[scan, echo], data.path[scan, echo]] = True
    # Walls only: edges are faint, and of corners one cannot say from where they are heard.
    sure = np.isfinite(angle) & (np.asarray(candidates.reflection.kind) == kernels.PLANE)[None, :, None]
    # An echo that two reflectors explain is neither heard nor silence.
    open_ = np.zeros((len(data.path), ring.count), dtype=bool)
    scan, echo = np.nonzero(np.isfinite(data.reported) & (data.path < ring.count) & ~found.used)
    open_[scan, data.path[scan, echo]] = True
    sure &= ~open_[:, None] | heard
    _, _, sensor = np.nonzero(sure)
    room = bucket_size(len(sensor), least=1024)

    def padded(values: np.ndarray) -> jax.Array:
        return jnp.asarray(pad_rows(values, room))

    sightings = (padded(sensor), padded(angle[sure]), padded(heard[sure]), padded(np.ones(len(sensor), bool)))
    half = float(np.median(ring.beam)) / 2
    start = kernels.Beams(jnp.zeros(ring.count), jnp.asarray(half), jnp.asarray(np.log(_SOFT)), jnp.asarray(_LIKELY))
    solver = optx.BFGS(rtol=1e-5, atol=1e-6)
    solved = optx.minimise(lambda beams, seen: kernels.beam_misfit(beams, *seen), solver, start, sightings, throw=False)
    flat, unravel = ravel_pytree(solved.value)
    bend = jax.hessian(lambda x: kernels.beam_misfit(unravel(x), *sightings))(flat)
    if np.linalg.eigvalsh(np.asarray(bend)).min() <= 0:
        raise SonarError("calibration: headings: what was heard does not show where the cones end; hold the headings")
    variance = np.diag(np.linalg.inv(np.asarray(bend)))[: ring.count]
    heading = np.asarray(ring.heading) + np.asarray(solved.value.centre)
    return replace(ring, heading=heading), np.sqrt(variance)

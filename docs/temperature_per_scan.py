"""A loss of one's own on top of a calibration: the air warms up while the robot drives; how warm was it in each scan?

The echo model is differentiable in everything, so a parameter that the library does not have takes twenty lines.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxsonar.office import load_office

import jaxsonar
from jaxsonar import kernels
from jaxsonar.calibration import speed_of_sound

office = load_office()
truth = np.linspace(16, 24, len(office.poses))  # deg C
scans = []
for k, (pose, celsius) in enumerate(zip(office.poses, truth, strict=True)):
    warm = replace(office.ring, speed_of_sound=speed_of_sound(celsius))
    log = jaxsonar.simulate(warm, office.room, pose[None], sigma=0.001, seed=k).as_log(warm, pose[None])
    scans.append(replace(log[0], scan=k))
found = jaxsonar.calibrate(office.ring, jaxsonar.Log.from_scans(scans), free=("speed",))

with jax.enable_x64(True):
    problem, at = found.problem, found.unknowns
    mean = kernels.moved_sensors(problem.sensors, problem.modes @ at.modes)  # one speed of sound for all scans

    def misfit(kelvin, heard, pose, scene):
        """Of ONE scan whose air is so much warmer than the mean."""
        sensors = eqx.tree_at(lambda s: s.range_scale, mean, mean.range_scale * jnp.sqrt(1 + kelvin / 293))
        one = eqx.tree_at(lambda p: (p.sensors, p.modes, p.heard), problem, (sensors, 0 * problem.modes, heard))
        left = kernels.residuals(one, kernels.Unknowns(at.modes, pose[None], scene))
        return (heard.weight * left**2).sum() / 2

    def loss(unknown):
        """Of all scans; the air does not change by kelvins from one to the next."""
        kelvin, scene = unknown
        one_by_one = jax.tree.map(lambda leaf: leaf[:, None], problem.heard)
        smooth = ((jnp.diff(kelvin) / 0.5) ** 2).sum() / 2 + ((scene - at.scene) ** 2).sum() / 2
        return jax.vmap(misfit, (0, 0, 0, None))(kelvin, one_by_one, at.poses, scene).sum() + smooth

    x, unravel = ravel_pytree((jnp.zeros(len(at.poses)), at.scene))  # walls, too: they were fitted to the mean

    @jax.jit
    def newton(x):
        """Of the loss, one step."""
        slope = jax.grad(lambda x: loss(unravel(x)))
        return x - jnp.linalg.solve(jax.jacfwd(slope)(x), slope(x))

    for _ in range(4):
        x = newton(x)
    kelvin, _ = unravel(x)
    middle = 273.15 * ((float(found.ring.speed_of_sound) / 331.3) ** 2 - 1)
    estimate = middle + np.asarray(kelvin)[: len(truth)]

for k in range(0, len(truth), 4):
    print(f"scan {k:2d}: {estimate[k]:5.1f} deg C, simulated {truth[k]:5.1f}")
print(f"RMS error {np.sqrt(np.mean((estimate - truth) ** 2)):.2f} K at sigma 1 mm")

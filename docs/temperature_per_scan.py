"""A custom loss on top of a calibration: the temperature of the air in each scan, while it rises during the run.

The measurement model is differentiable in all its parameters, so a new parameter takes twenty lines.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import jaxsonar
from jaxsonar import kernels
from jaxsonar.sensors.ring import speed_of_sound
from jaxsonar.simulation.office import load_office

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
    mean = kernels.apply_parameters(problem.sensors, problem.basis @ at.coordinates)  # one speed of sound

    def scan_cost(kelvin, factors, pose, landmarks):
        """Cost of ONE scan whose air is warmer than the mean by this many kelvins."""
        sensors = eqx.tree_at(lambda s: s.range_scale, mean, mean.range_scale * jnp.sqrt(1 + kelvin / 293))
        one = eqx.tree_at(lambda p: (p.sensors, p.basis, p.factors), problem, (sensors, 0 * problem.basis, factors))
        residual = kernels.residuals(one, kernels.Unknowns(at.coordinates, pose[None], landmarks))
        return (factors.weight * residual**2).sum() / 2

    def loss(unknown):
        """Cost of all scans and priors: the temperature changes by about 0.5 K between scans."""
        kelvin, landmarks = unknown
        scans = jax.tree.map(lambda leaf: leaf[:, None], problem.factors)
        prior = ((jnp.diff(kelvin) / 0.5) ** 2).sum() / 2 + ((landmarks - at.landmarks) ** 2).sum() / 2
        return jax.vmap(scan_cost, (0, 0, 0, None))(kelvin, scans, at.poses, landmarks).sum() + prior

    # The walls are estimated as well, because they were fitted with the mean temperature.
    x, unravel = ravel_pytree((jnp.zeros(len(at.poses)), at.landmarks))

    @jax.jit
    def newton(x):
        """One Newton step."""
        gradient = jax.grad(lambda x: loss(unravel(x)))
        return x - jnp.linalg.solve(jax.jacfwd(gradient)(x), gradient(x))

    for _ in range(4):
        x = newton(x)
    kelvin, _ = unravel(x)
    middle = 273.15 * ((float(found.ring.speed_of_sound) / 331.3) ** 2 - 1)
    estimate = middle + np.asarray(kelvin)[: len(truth)]

for k in range(0, len(truth), 4):
    print(f"scan {k:2d}: {estimate[k]:5.1f} deg C, simulated {truth[k]:5.1f}")
print(f"RMS error {np.sqrt(np.mean((estimate - truth) ** 2)):.2f} K at sigma 1 mm")

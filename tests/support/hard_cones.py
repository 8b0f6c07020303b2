"""Simulation with hard detection cones: what each path receives follows from the geometry alone.

Most tests derive the expected echoes from the cones of the ring. Tests of soft beams call ``jaxsonar.simulate``.
"""

from functools import partial

import jaxsonar

simulate = partial(jaxsonar.simulate, beams="hard")

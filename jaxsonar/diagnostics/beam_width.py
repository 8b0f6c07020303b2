"""How wide the cones of a ring are, and where they look: from which walls were heard at which angle."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize

from jaxsonar.diagnostics.echo_residuals import MARGIN, Look

BIN = np.radians(2.5)
EDGES = np.arange(-36, 37) * BIN
CENTRES = (EDGES[1:] + EDGES[:-1]) / 2


def cones(
    look: Look, usable: Bool[np.ndarray, " rows"], heard: Bool[np.ndarray, " rows"], beam: Float[np.ndarray, " sensors"]
) -> tuple[Int[np.ndarray, "sensors bins"], Int[np.ndarray, "sensors bins"]]:
    """Direct sightings (sensors, bins) by angle off the axis, and those heard; cones are stretched to their mean."""
    row = np.flatnonzero(usable & (look.tx == look.rx) & (look.beyond <= MARGIN))
    angle = look.angle[row] * (beam.mean() / beam[look.tx[row]])
    slot = np.digitize(angle, EDGES) - 1
    inside = (slot >= 0) & (slot < len(CENTRES))
    row, slot = row[inside], slot[inside]
    asked = np.zeros((len(beam), len(CENTRES)), np.int64)
    answered = np.zeros_like(asked)
    np.add.at(asked, (look.tx[row], slot), 1)
    np.add.at(answered, (look.tx[row], slot), heard[row])
    return asked, answered


def curve_share(curve: Float[np.ndarray, " 4"], angle: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    """Share heard at angles off the axis, radians, by a fitted curve (``Health.curve``)."""
    half, soft, inside, outside = curve
    return outside + (inside - outside) / (1 + np.exp(np.clip((np.abs(angle) - half) / soft, -50, 50)))


def fitted_cone(
    asked: Int[np.ndarray, " bins"], answered: Int[np.ndarray, " bins"]
) -> tuple[Float[np.ndarray, " 4"], float]:
    """Half width, softness, shares inside and outside by maximum likelihood, and the half width's standard deviation.

    NaN where there is not enough: few sightings, or none on one side of the border.
    """
    nothing = np.full(4, np.nan), float("nan")
    if asked.sum() < 100 or answered.sum() < 30:
        return nothing

    def loss(x: np.ndarray) -> float:
        share = np.clip(curve_share(x, CENTRES), 1e-4, 1 - 1e-4)
        return -float(answered @ np.log(share) + (asked - answered) @ np.log(1 - share))

    bounds = [(np.radians(2), np.pi / 2), (np.radians(0.6), np.radians(15)), (0.05, 1.0), (0.0, 0.4)]
    starts = [np.array([np.radians(half), np.radians(3), 0.85, 0.03]) for half in (8, 15, 22, 30, 40, 55, 70)]
    found = min((minimize(loss, start, method="L-BFGS-B", bounds=bounds) for start in starts), key=lambda f: f.fun)
    best = found.x
    steps = np.array([1e-3, 1e-3, 1e-3, 1e-3])
    share = np.clip(curve_share(best, CENTRES), 0.01, 0.99)
    slope = np.stack([(curve_share(best + d, CENTRES) - curve_share(best - d, CENTRES)) / 2e-3 for d in np.diag(steps)])
    scatter = ((answered - asked * share) ** 2 / (share * (1 - share) * np.maximum(asked, 1)))[asked > 0]
    excess = max(1.0, float(scatter.sum()) / max(1, len(scatter) - 4))
    information = (slope * (asked / (share * (1 - share)))) @ slope.T / excess
    wide = np.diag([3.6, 130.0, 4.0, 25.0])  # of what is possible at all: 30 deg, 5 deg, 0.5, 0.2
    error = float(np.sqrt(np.linalg.inv(information + wide)[0, 0]))
    beyond, within = np.abs(CENTRES) > best[0], np.abs(CENTRES) < best[0]
    if asked[beyond].sum() < 20 or asked[within].sum() < 20 or error > np.radians(4):
        return nothing
    return best, error


def each_cone(
    asked: Int[np.ndarray, "sensors bins"],
    answered: Int[np.ndarray, "sensors bins"],
    curve: Float[np.ndarray, " 4"],
) -> tuple[Float[np.ndarray, "sensors 2"], Float[np.ndarray, "sensors 2"]]:
    """Half width and centre of each sensor's cone with standard deviations, radians: means over their likelihood."""
    count = len(asked)
    if not np.isfinite(curve).all():
        return np.full((count, 2), np.nan), np.full((count, 2), np.nan)
    half = np.radians(np.arange(3, 90, 1.0))
    centre = np.radians(np.arange(-30, 30.5, 0.5))
    off = np.abs(CENTRES - centre[:, None])[None] - half[:, None, None]
    shape = 1 / (1 + np.exp(np.clip(off / max(curve[1], BIN / 2), -50, 50)))
    # A sensor that hears less in all directions is not narrower.
    pooled = asked @ curve_share(curve, CENTRES)
    level = np.clip(answered.sum(axis=1) / np.maximum(pooled, 1), 0.2, 1 / curve[2]) * curve[2]
    widths, centres = [], []
    for a, b, inside in zip(asked, answered, level, strict=True):
        share = np.clip(curve[3] + (inside - curve[3]) * shape, 1e-3, 1 - 1e-3)
        nats = np.log(share) @ b + np.log(1 - share) @ (a - b)
        odds = np.exp(nats - nats.max())
        odds /= odds.sum()
        for values, axis, into in ((half, 1, widths), (centre, 0, centres)):
            p = odds.sum(axis=axis)
            mean = float(p @ values)
            into.append((mean, float(np.sqrt(p @ (values - mean) ** 2))))
    enough = (asked.sum(axis=1) >= 40) & (answered.sum(axis=1) >= 15)
    known = [
        np.where((enough & (x[:, 1] < np.radians(4)))[:, None], x, np.nan) for x in map(np.array, (widths, centres))
    ]
    return known[0], known[1]

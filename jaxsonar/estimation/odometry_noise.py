"""How wrong odometry may be: standard deviations of the steps between scans."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.geometry.se2 import relative
from jaxsonar.hardware.errors import SonarError

OdometryNoise = Callable[[Float[np.ndarray, "scans 3"], Int[np.ndarray, " rows"]], Float[np.ndarray, "_ 3"]]
"""From odometry of all scans (NaN where there is none) and the rows of those that are used, to standard deviations of
the steps between these: ahead, to the left (metres) and of the turn (radians); the steps are those as measured."""
_STANDING = (0.0005, 0.001)  # m, rad
_TURN = 0.5  # rad; turn in which odometry slips as much as over a metre


@dataclass(frozen=True)
class Share:
    """Odometry whose steps are wrong by a share of their way and turn, however they are divided."""

    share: float

    def __call__(
        self, measured: Float[np.ndarray, "scans 3"], rows: Int[np.ndarray, " rows"]
    ) -> Float[np.ndarray, "_ 3"]:
        """As ``OdometryNoise``."""
        step = relative(measured[rows[:-1]], measured[rows[1:]])
        way, turn = np.hypot(step[:, 0], step[:, 1]), np.abs(step[:, 2])
        place = self.share * way + _STANDING[0]
        return np.stack([place, place, self.share * (turn + _TURN * way) + _STANDING[1]], axis=-1)


@dataclass(frozen=True)
class Slip:
    """Odometry as a random walk: the variance grows with the way, so that its division into steps means nothing.

    Raises:
        SonarError: a value that is none.
    """

    place: float = 0.03
    """Metres ahead after one metre; to the side half of that, wheels roll."""
    heading: float = float(np.radians(1.5))
    """Radians after one metre."""
    turn: float = 0.03
    """Radians after one radian of turning."""
    standing: tuple[float, float] = (2e-4, 2e-4)
    """Metres and radians, of a step however short."""

    def __post_init__(self):
        for name, value in {"place": self.place, "heading": self.heading, "turn": self.turn}.items():
            if not 0 <= value <= 10:  # False for NaN
                raise SonarError(f"slip: {name} {value:g}; allowed is 0 to 10 (metres or radians after one of them)")
        if not all(0 < value <= 1 for value in self.standing):
            raise SonarError(f"slip: standing {self.standing}; allowed are metres and radians above 0, at most 1")

    def __call__(
        self, measured: Float[np.ndarray, "scans 3"], rows: Int[np.ndarray, " rows"]
    ) -> Float[np.ndarray, "_ 3"]:
        """As ``OdometryNoise``. The way is that along all scans in between, whether they are used or not."""
        known = np.flatnonzero(np.isfinite(measured).all(axis=1))
        step = relative(measured[known[:-1]], measured[known[1:]])
        sums = np.zeros((len(measured), 2))  # way and turn up to each scan
        sums[known[1:], 0], sums[known[1:], 1] = np.hypot(step[:, 0], step[:, 1]), np.abs(step[:, 2])
        way, turn = np.diff(np.cumsum(sums, axis=0)[rows], axis=0).T
        place = np.sqrt(self.place**2 * way + self.standing[0] ** 2)
        heading = np.sqrt(self.heading**2 * way + self.turn**2 * turn + self.standing[1] ** 2)
        return np.stack([place, np.sqrt(self.place**2 * way / 4 + self.standing[0] ** 2), heading], axis=-1)

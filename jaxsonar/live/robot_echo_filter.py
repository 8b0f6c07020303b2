"""``RobotEchoFilter``: removes the echoes of the robot itself from the scans of a device while they arrive."""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from jaxsonar.plausibility.robot_echoes import SETTINGS as SEARCH_SETTINGS
from jaxsonar.plausibility.robot_echoes import RobotEchoes, find_robot_echoes, is_apart, without_robot_echoes
from jaxsonar.scans.scan_log import Log, Scan
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class RobotEchoFilterSettings:
    """When a stream is searched. Chosen by hand: a search of 160 scans of the paper's ring takes about 10 ms."""

    history: int = 160
    """Scans that are remembered; they lie apart as those that ``find_robot_echoes`` compares (about 13 m of path)."""
    interval: int = 16
    """Number of new ones after which they are searched again."""


SETTINGS = RobotEchoFilterSettings()


class RobotEchoFilter:
    """Finds echoes of the robot's own body, cables or the floor in the scans so far, and removes them from new scans.

    Scans without a pose are not searched.
    """

    def __init__(self, ring: Ring, *, on_warning: Callable[[str], None] | None = None):
        """A filter that knows no echo of the robot yet.

        Args:
            ring: the sensors.
            on_warning: called with a message of one line when a path is found that was not named before.
        """
        self._ring, self._on_warning = ring, on_warning
        self._history: deque[Scan] = deque(maxlen=SETTINGS.history)
        self._new, self._named = 0, frozenset[tuple[int, int]]()
        self.found = RobotEchoes((), is_floor=False)
        """Echoes of the robot in the scans that are remembered."""

    def warm_up(self, scan: Scan) -> None:
        """Compile what a search needs, with copies of a scan at different places. The filter remembers them."""
        steps = SEARCH_SETTINGS.spacing * np.arange(SETTINGS.interval)
        self.clean([replace(scan, pose=np.array([2 * x, 0.0, 0.0])) for x in steps])

    def clean(self, scans: Sequence[Scan]) -> list[Scan]:
        """The scans without echoes of the robot; see ``without_robot_echoes``.

        Args:
            scans: the next scans, in order.
        """
        for scan in scans:
            self._remember(scan)
        if self._new >= SETTINGS.interval:
            self._search()
        if not self.found:
            return list(scans)
        cleaned = without_robot_echoes(_log(scans), self.found)
        return [replace(one, scan=scan.scan) for one, scan in zip(cleaned, scans, strict=True)]

    def _remember(self, scan: Scan) -> None:
        if not np.isfinite(scan.pose).all():
            return
        if self._history and not is_apart(self._history[-1].pose, scan.pose):
            return
        self._history.append(scan)
        self._new += 1

    def _search(self) -> None:
        self._new = 0
        self.found = find_robot_echoes(self._ring, _log(self._history))
        if self._on_warning is not None and self.found.paths - self._named:
            self._on_warning(f"warning: {self.found.warning()}")
        self._named |= self.found.paths


def _log(scans: Iterable[Scan]) -> Log:
    """A log of scans; the device may have started its numbers again."""
    return Log.from_scans([replace(scan, scan=number) for number, scan in enumerate(scans)])

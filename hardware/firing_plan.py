"""Which paths a firing group measures: the plan of the device, corrected by the echoes that it reports.

A group that arrived without an echo of a path is evidence only if its transmitter fired and its receiver listened.
"""

import numpy as np
from jaxtyping import Bool, Int


class FiringPlan:
    """Transmitters of each firing group and receivers that listen to them.

    - A transmitter belongs to the group of its latest echo. Before its first echo, the planned groups count if the
      device sends as many groups per scan. A device with one group for each sensor fires one sensor after another. With
      any other number of groups, only a transmitter with an echo is known to have fired. If all scans of a device
      consist of one group and more are planned, sensors fire in turn: only echoes of the scan count.
    - A transmitter listens to its own echo. It listens to the echo of a neighbor once the device reported an echo over
      that offset, because devices may report direct echoes only.
    """

    def __init__(self, group_paths: Int[np.ndarray, "paths 3"], sensors: int):
        """A plan.

        Args:
            group_paths: firing group, transmitter and receiver of every path that the device may report.
            sensors: number of sensors.
        """
        self._sensors = sensors
        self._tx, self._rx = group_paths[:, 1], group_paths[:, 2]
        self._offset = (self._rx - self._tx) % sensors
        self._planned: Int[np.ndarray, " sensors"] = np.full(sensors, -1)
        self._planned[self._tx] = group_paths[:, 0]
        self._planned_groups = int(group_paths[:, 0].max(initial=-1)) + 1
        self._group_of: dict[int, Int[np.ndarray, " sensors"]] = {}
        """Group of each transmitter, -1 if unknown, by the number of groups of a scan."""
        self._listens = np.arange(sensors) == 0
        """Offsets (receiver - transmitter) over which an echo was reported."""

    def silent_paths(
        self,
        arrived: Bool[np.ndarray, " groups"],
        tx: Int[np.ndarray, " echoes"],
        rx: Int[np.ndarray, " echoes"],
        group: Int[np.ndarray, " echoes"],
    ) -> Int[np.ndarray, "silent 3"]:
        """Firing group, transmitter and receiver of the paths that a scan measured and that heard nothing.

        Args:
            arrived: groups of the scan that arrived.
            tx: transmitter of each echo of the scan.
            rx: receiver.
            group: firing group.
        """
        groups = len(arrived)
        group_of = self._transmitter_groups(groups)
        group_of[tx] = group
        self._listens[(rx - tx) % self._sensors] = True
        heard = np.zeros((self._sensors, self._sensors), bool)
        heard[tx, rx] = True
        fired = group_of[self._tx]
        silent = (fired >= 0) & self._listens[self._offset] & ~heard[self._tx, self._rx]
        silent[silent] = arrived[fired[silent]]
        return np.stack([fired[silent], self._tx[silent], self._rx[silent]], axis=-1)

    def _transmitter_groups(self, groups: int) -> Int[np.ndarray, " sensors"]:
        """Group of each transmitter in scans with this number of groups, -1 if unknown; changed by the caller."""
        if groups == 1 < self._planned_groups:
            return np.full(self._sensors, -1)
        if groups not in self._group_of:
            if groups == self._planned_groups:
                known = self._planned.copy()
            else:
                known = np.arange(self._sensors) if groups == self._sensors else np.full(self._sensors, -1)
            self._group_of[groups] = known
        return self._group_of[groups]

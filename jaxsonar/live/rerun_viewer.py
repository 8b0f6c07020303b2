"""The live view: ring, arcs, lines and the growing map in rerun (extra ``viz``), on this machine only.

Nothing else knows rerun. Its own server listens on all interfaces unless told otherwise, so it is started from here,
bound to 127.0.0.1.
"""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsonar.geometry.se2 import transform_points
from jaxsonar.hardware.errors import SonarError
from jaxsonar.kernels.shape_buckets import bucket_size, pad_rows
from jaxsonar.live.live_map import LiveScan
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.reports.plot_scan import arc_points
from jaxsonar.sensors.ring import Ring

HOST = "127.0.0.1"
STARTS = 30.0
"""Seconds that the viewer has to start."""
MEMORY = "500MB"
"""What the viewer keeps before it forgets the oldest scans."""
_RING, _DIRECT, _CROSS, _LINE, _WALL, _POINT = (
    (90, 90, 90),
    (0, 114, 178),
    (150, 190, 220),
    (213, 94, 0),
    (20, 20, 20),
    (0, 158, 115),
)


class View:
    """Shows a stream while it runs; a ``streaming.Viewer``."""

    def __init__(
        self,
        ring: Ring,
        *,
        file: str | os.PathLike[str] | None = None,
        say: Callable[[str], None] = lambda text: None,
    ):
        """Open a window, a page for the browser where there is no screen, or a file.

        Args:
            ring: the sensors.
            file: an ``.rrd`` file to write instead, for ``rerun FILE``.
            say: told where to look.

        Raises:
            SonarError: the extra is missing, or the viewer does not start.
        """
        rerun = self._rerun = load_rerun()
        self._ring = ring
        self._stream: Any = rerun.RecordingStream("jaxsonar")
        self._viewer: subprocess.Popen[bytes] | None = None
        self._way: list[list[float]] = []
        if file is not None:
            try:
                self._stream.save(os.fspath(file))
            except (OSError, RuntimeError) as failure:
                raise SonarError(f"{file}: {failure}; allowed is an .rrd file that you may write") from None
            return
        port, page = _free_port(), _free_port()
        call = [sys.executable, "-m", "rerun", "--bind", HOST, "--port", str(port), "--memory-limit", MEMORY]
        if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or sys.platform == "darwin"):
            call += ["--serve-web", "--web-viewer-port", str(page), "--server-memory-limit", MEMORY]
            say(f"no screen: look at http://{HOST}:{page}?url=rerun%2Bhttp://{HOST}:{port}/proxy")
        none = subprocess.DEVNULL
        # A process group of its own: Ctrl-C ends the stream, and the window stays to be looked at.
        self._viewer = subprocess.Popen(call, stdin=none, stdout=none, stderr=none, start_new_session=True)
        self._wait_for(port)
        self._stream.connect_grpc(f"rerun+http://{HOST}:{port}/proxy")

    @property
    def process(self) -> int | None:
        """Number of the viewer's process; None without one."""
        return None if self._viewer is None else self._viewer.pid

    def show(self, live: LiveScan) -> None:
        """Ring, arcs and lines of the latest scan, where the robot is; at the origin where that is not known."""
        scan, model, ring = live.scan, live.model, self._ring
        known = bool(np.isfinite(scan.pose).all())
        pose = scan.pose if known else np.zeros(3)
        self._stream.set_time("scan", sequence=scan.scan)
        if np.isfinite(scan.stamp):
            self._stream.set_time("device", duration=scan.stamp)
        self._points("ring", transform_points(pose, np.asarray(ring.position)), _RING, 0.015)
        path = ring.path_index[scan.tx, scan.rx]
        reach = np.asarray(ring.corrected(scan.range, scan.tx, scan.rx))
        heard = (path >= 0) & (reach < ring.max_range)
        for name, own, colour in (
            ("direct", heard & (scan.tx == scan.rx), _DIRECT),
            ("cross", heard & (scan.tx != scan.rx), _CROSS),
        ):
            self._strips(f"arcs/{name}", transform_points(pose, self._arcs(path[own], reach[own])), colour, 0.003)
        lines = np.array([line.segment for line in model.lines]).reshape(-1, 2, 2)
        self._strips("lines", transform_points(pose, lines), _LINE, 0.012)
        corners = np.array([[point.x, point.y] for point in model.points]).reshape(-1, 2)
        self._points("points", transform_points(pose, corners), _LINE, 0.03)
        if known:
            self._way = [*self._way[-9999:], pose[:2].tolist()]
            self._strips("way", np.array([self._way]), _RING, 0.005)

    def show_map(self, world: GlobalMap) -> None:
        """The map so far."""
        self._strips("map/walls", world.segments, _WALL, 0.02)
        self._points("map/points", world.points, _POINT, 0.04)

    def close(self) -> None:
        """Hand over what is left; the window stays open."""
        with suppress(RuntimeError):  # the window was closed before
            self._stream.flush(timeout_sec=5.0)
        self._stream.disconnect()

    def _wait_for(self, port: int) -> None:
        """Until the viewer listens: what is sent before that is lost."""
        assert self._viewer is not None
        end = time.monotonic() + STARTS
        while self._viewer.poll() is None and time.monotonic() < end:
            with suppress(OSError), socket.create_connection((HOST, port), timeout=1.0):
                return
            time.sleep(0.1)
        self._viewer.kill()
        self._viewer.wait()
        raise SonarError("--view: the viewer does not start; allowed is a machine on which 'python -m rerun' does")

    def _arcs(self, path: np.ndarray, reach: np.ndarray) -> np.ndarray:
        room = bucket_size(len(path), least=64)  # few different shapes
        return arc_points(self._ring, pad_rows(path, room), pad_rows(reach, room, fill=1.0))[: len(path)]

    def _strips(self, name: str, strips: Float[np.ndarray, "strips points 2"], colour: Any, radius: float) -> None:
        # Rerun's y points down in a plane: seen from above, the robot's left is up.
        self._stream.log(f"world/{name}", self._rerun.LineStrips2D(list(_up(strips)), colors=[colour], radii=[radius]))

    def _points(self, name: str, points: Float[np.ndarray, "points 2"], colour: Any, radius: float) -> None:
        self._stream.log(f"world/{name}", self._rerun.Points2D(_up(points), colors=[colour], radii=[radius]))


def load_rerun() -> Any:
    """The viewer's library.

    Raises:
        SonarError: the extra is missing.
    """
    try:
        import rerun
    except ImportError:
        raise SonarError("--view needs the extra viz: pip install 'jaxsonar[viz]'") from None
    return rerun


def _up(points: np.ndarray) -> np.ndarray:
    return np.asarray(points, np.float32) * np.array([1, -1], np.float32)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return probe.getsockname()[1]

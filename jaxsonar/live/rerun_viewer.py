"""Live viewer: ring, arcs, lines and the growing map in rerun (extra ``viz``), on this machine only.

The only module that imports rerun. By default rerun's server listens on all network interfaces; therefore it is started
here, bound to 127.0.0.1.
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
START_TIMEOUT = 30.0
"""Seconds for the viewer to start. Chosen by hand."""
MEMORY_LIMIT = "500MB"
"""Memory limit of the viewer; it then drops the oldest scans. Chosen by hand."""
MAX_TRAJECTORY = 10_000
"""Number of positions in the drawn trajectory. Chosen by hand."""
ROBOT_COLOR, DIRECT_COLOR, CROSS_COLOR = (90, 90, 90), (0, 114, 178), (150, 190, 220)
LINE_COLOR, WALL_COLOR, POINT_COLOR = (213, 94, 0), (20, 20, 20), (0, 158, 115)
"""Colours, RGB."""


class RerunViewer:
    """Shows a stream in rerun while it runs; implements ``stream_loop.Viewer``."""

    def __init__(
        self,
        ring: Ring,
        *,
        file: str | os.PathLike[str] | None = None,
        print_status: Callable[[str], None] = lambda text: None,
    ):
        """Open a window; without a screen, a web page; or write a file.

        Args:
            ring: the sensors.
            file: ``.rrd`` file to write instead of showing, for ``rerun FILE``.
            print_status: called with the address of the web page.

        Raises:
            SonarError: the extra is missing, or the viewer does not start.
        """
        rerun = self._rerun = load_rerun()
        self._ring = ring
        self._stream: Any = rerun.RecordingStream("jaxsonar")
        self._viewer: subprocess.Popen[bytes] | None = None
        self._trajectory: list[list[float]] = []
        if file is not None:
            try:
                self._stream.save(os.fspath(file))
            except (OSError, RuntimeError) as failure:
                raise SonarError(f"{file}: {failure}; allowed is an .rrd file that you may write") from None
            return
        port, page = _free_port(), _free_port()
        call = [sys.executable, "-m", "rerun", "--bind", HOST, "--port", str(port), "--memory-limit", MEMORY_LIMIT]
        if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or sys.platform == "darwin"):
            call += ["--serve-web", "--web-viewer-port", str(page), "--server-memory-limit", MEMORY_LIMIT]
            print_status(f"no screen: look at http://{HOST}:{page}?url=rerun%2Bhttp://{HOST}:{port}/proxy")
        none = subprocess.DEVNULL
        # In its own process group, so that Ctrl-C ends the stream and the window stays open.
        self._viewer = subprocess.Popen(call, stdin=none, stdout=none, stderr=none, start_new_session=True)
        self._wait_for(port)
        self._stream.connect_grpc(f"rerun+http://{HOST}:{port}/proxy")

    @property
    def process(self) -> int | None:
        """Process id of the viewer; None without a process."""
        return None if self._viewer is None else self._viewer.pid

    def show(self, live: LiveScan) -> None:
        """Show ring, arcs and lines of a scan at the pose of the robot; at the origin if the pose is unknown."""
        scan, model, ring = live.scan, live.model, self._ring
        has_pose = bool(np.isfinite(scan.pose).all())
        pose = scan.pose if has_pose else np.zeros(3)
        self._stream.set_time("scan", sequence=scan.scan)
        if np.isfinite(scan.stamp):
            self._stream.set_time("device", duration=scan.stamp)
        self._points("ring", transform_points(pose, np.asarray(ring.position)), ROBOT_COLOR, 0.015)
        path = ring.path_index[scan.tx, scan.rx]
        ranges = np.asarray(ring.corrected(scan.range, scan.tx, scan.rx))
        valid = (path >= 0) & (ranges < ring.max_range)
        for name, shown, color in (
            ("direct", valid & (scan.tx == scan.rx), DIRECT_COLOR),
            ("cross", valid & (scan.tx != scan.rx), CROSS_COLOR),
        ):
            self._strips(f"arcs/{name}", transform_points(pose, self._arcs(path[shown], ranges[shown])), color, 0.003)
        lines = np.array([line.segment for line in model.lines]).reshape(-1, 2, 2)
        self._strips("lines", transform_points(pose, lines), LINE_COLOR, 0.012)
        corners = np.array([[point.x, point.y] for point in model.points]).reshape(-1, 2)
        self._points("points", transform_points(pose, corners), LINE_COLOR, 0.03)
        if has_pose:
            self._trajectory = [*self._trajectory[1 - MAX_TRAJECTORY :], pose[:2].tolist()]
            self._strips("trajectory", np.array([self._trajectory]), ROBOT_COLOR, 0.005)

    def show_map(self, world: GlobalMap) -> None:
        """Show the current map."""
        self._strips("map/walls", world.segments, WALL_COLOR, 0.02)
        self._points("map/points", world.points, POINT_COLOR, 0.04)

    def close(self) -> None:
        """Send the remaining data; the window stays open."""
        with suppress(RuntimeError):  # the user closed the window
            self._stream.flush(timeout_sec=5.0)
        self._stream.disconnect()

    def _wait_for(self, port: int) -> None:
        """Wait until the viewer listens; data sent earlier would be lost."""
        assert self._viewer is not None
        end = time.monotonic() + START_TIMEOUT
        while self._viewer.poll() is None and time.monotonic() < end:
            with suppress(OSError), socket.create_connection((HOST, port), timeout=1.0):
                return
            time.sleep(0.1)
        self._viewer.kill()
        self._viewer.wait()
        raise SonarError("--view: the viewer does not start; allowed is a machine on which 'python -m rerun' does")

    def _arcs(self, path: np.ndarray, ranges: np.ndarray) -> np.ndarray:
        size = bucket_size(len(path), least=64)  # few different shapes, so that little is compiled
        return arc_points(self._ring, pad_rows(path, size), pad_rows(ranges, size, fill=1.0))[: len(path)]

    def _strips(self, name: str, strips: Float[np.ndarray, "strips points 2"], color: Any, radius: float) -> None:
        # The y axis of rerun points down; flip it, so that the robot's left is up.
        self._stream.log(
            f"world/{name}", self._rerun.LineStrips2D(list(_flip_y(strips)), colors=[color], radii=[radius])
        )

    def _points(self, name: str, points: Float[np.ndarray, "points 2"], color: Any, radius: float) -> None:
        self._stream.log(f"world/{name}", self._rerun.Points2D(_flip_y(points), colors=[color], radii=[radius]))


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


def _flip_y(points: np.ndarray) -> np.ndarray:
    return np.asarray(points, np.float32) * np.array([1, -1], np.float32)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return probe.getsockname()[1]

"""``stream``: from a device to lines, a map and an occupancy grid, live."""

import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from jaxsonar import kernels
from jaxsonar.estimation.odometry_noise import OdometryNoise
from jaxsonar.hardware.drop_oldest_queue import DropOldestQueue
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.reader_thread import ReaderThread
from jaxsonar.hardware.scan_assembler import RawScan
from jaxsonar.hardware.transport_base import LinkEvent, open_source, parse_url, register_transport
from jaxsonar.live.live_grid import LiveGrid
from jaxsonar.live.live_map import LiveMap, LiveScan
from jaxsonar.live.replay import file_opener
from jaxsonar.live.status import Status
from jaxsonar.live.stream_loop import SETTINGS, StreamLoop, Viewer
from jaxsonar.occupancy.grid_evidence import GridMethod
from jaxsonar.occupancy.nav2_map import Nav2Mode
from jaxsonar.recordings.input_options import InputOptions
from jaxsonar.scans.raw_scans import group_paths
from jaxsonar.scans.recording_journal import open_log_recorder
from jaxsonar.sensors.ring import Ring


def stream(
    url: str,
    ring: Ring,
    *,
    method: str = "ml",
    settings: kernels.HoughSettings | None = None,
    sigma: float | None = None,
    record: str | os.PathLike[str] | None = None,
    map_filename: str | os.PathLike[str] | None = None,
    map_interval: float = SETTINGS.map_interval,
    grid: str | os.PathLike[str] | None = None,
    grid_method: GridMethod = "counts",
    grid_mode: Nav2Mode = "trinary",
    grid_certain: float | None = None,
    odometry_noise: OdometryNoise | None = None,
    trajectory: str | os.PathLike[str] | None = None,
    scans: int | None = None,
    no_echo: Sequence[float] = (),
    wait: float = 0.0,
    view: Viewer | None = None,
    on_scan: Callable[[LiveScan], None] | None = None,
    on_status: Callable[[Status], None] | None = None,
    on_event: Callable[[LinkEvent], None] | None = None,
    stop: threading.Event | None = None,
) -> Status:
    """Read a device until it ends: detect lines in every scan, build a map, and record everything.

    Args:
        url: ``tcp://HOST:PORT``, ``udp://HOST:PORT``, ``pty:PATH``, ``serial:///dev/ttyUSB0?baud=921600``,
            ``file:LOG?speed=1``, or a scheme of another package (``hardware.transport_base``).
        ring: the sensors.
        method: "ml" or "hough", as in ``local_models``.
        settings: as in ``local_models``.
        sigma: as in ``local_models``.
        record: file for a recording of everything received, ``.csv``, ``.parquet`` or ``.mcap``; see
            ``open_log_recorder``.
        map_filename: GeoJSON file of the map, written atomically at intervals and at the end.
        map_interval: seconds between two writes of the map, and at least between two writes of the grid.
        grid: YAML file of an occupancy grid for Nav2, its image beside it (``GridFiles``); written at intervals and at
            the end, but not without an echo and a pose (``Status.no_grid``).
        grid_method: how echoes become obstacles, see ``occupancy``.
        grid_mode: how map_server reads the image of the grid, see ``save_nav2``.
        grid_certain: angle off the axis up to which walls are heard for sure, radians, as for ``occupancy``.
        odometry_noise: noise of the device's poses. If given, they are odometry, and the poses of the robot are
            estimated (``slam``). By default the device's poses are exact.
        trajectory: TUM file of the estimated poses, written at the end; needs ``odometry_noise``.
        scans: stop after this many scans.
        no_echo: ranges of a replayed log that mean no echo, metres (``InputOptions.no_echo``).
        wait: seconds in which a device that cannot be opened is tried again.
        view: viewer of the stream.
        on_scan: called for every scan with its local model.
        on_status: called several times per second with the status.
        on_event: called for every link event, in the reading thread, and for warnings about the echoes (``note``), in
            the calling thread.
        stop: set this event, from any thread or signal handler, to stop. Everything received is still written. If only
            a recording is requested, a running compilation is not waited for: its daemon thread remains, and
            ``Status.warm`` is False.

    Returns:
        The final status.

    Raises:
        SonarError: an invalid call, a device that cannot be opened, or a file that cannot be written. Everything
            received before is written.
    """
    if trajectory is not None and odometry_noise is None:
        raise SonarError(
            "stream: a trajectory came without odometry_noise; allowed is a trajectory where poses are estimated"
        )
    # 1. The live map, and the reader: device -> recording -> queue.
    mapping = bool(map_filename) or grid is not None or view is not None

    def on_warning(text: str) -> None:
        if on_event is not None:
            on_event(LinkEvent("note", text))

    live = LiveMap(
        ring,
        method=method,
        settings=settings,
        sigma=sigma,
        mapping=mapping,
        odometry_noise=odometry_noise,
        on_warning=on_warning,
    )
    live_grid = None
    if grid is not None:
        live_grid = LiveGrid(
            live, grid, interval=map_interval, method=grid_method, mode=grid_mode, certain=grid_certain
        )
    queue = DropOldestQueue[RawScan](SETTINGS.warm_up_capacity, size_of=lambda scan: len(scan.echoes))
    stop = threading.Event() if stop is None else stop
    reader = _open_reader(
        url, ring, queue, record=record, scans=scans, no_echo=no_echo, on_event=on_event, wait=wait, stop=stop
    )
    # 2. The loop; it starts to compile in the background.
    loop = StreamLoop(
        live,
        reader,
        queue,
        map_filename=map_filename,
        map_interval=map_interval,
        grid=live_grid,
        trajectory=trajectory,
        view=view,
        on_scan=on_scan,
        on_status=on_status,
    )
    with _switch_interval(SETTINGS.switch_interval):
        # 3. Read in a thread of its own.
        reader.start()
        try:
            # 4. The first scans wait in the queue until everything is compiled; then process scan by scan.
            if loop.wait_until_compiled(stop):
                loop.process_scans(stop)
        finally:
            # 5. Stop reading, process the rest of the queue, write map, grid and trajectory.
            reader.stop()
            loop.finish()
    if on_status is not None:
        on_status(loop.status)
    return loop.status


def _open_reader(
    url: str,
    ring: Ring,
    queue: DropOldestQueue[RawScan],
    *,
    record: str | os.PathLike[str] | None,
    scans: int | None,
    no_echo: Sequence[float],
    on_event: Callable[[LinkEvent], None] | None,
    wait: float,
    stop: threading.Event,
) -> ReaderThread:
    """Open the device and the recording."""
    register_transport("file", file_opener(ring, InputOptions(no_echo=tuple(no_echo))))
    readers: list[ReaderThread] = []

    def on_link_event(event: LinkEvent) -> None:
        for reader in readers:  # empty until the source is open
            reader.event(event)
        if on_event is not None and not any(reader.decoder.ended for reader in readers):
            on_event(event)

    source = open_source(url, on_event=on_link_event, wait=wait, stop=stop)
    try:
        recorder = None if record is None else open_log_recorder(record)
    except SonarError:
        source.close()
        raise
    block_when_full = {"file": True, "udp": False}.get(parse_url(url).scheme)
    readers.append(
        ReaderThread(
            source,
            queue,
            sensors=ring.count,
            group_paths=group_paths(ring),
            recorder=recorder,
            scans=scans,
            block_when_full=block_when_full,
        )
    )
    return readers[0]


@contextmanager
def _switch_interval(interval: float) -> Iterator[None]:
    """Limit the time that one Python thread may hold the interpreter lock, seconds."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(min(before, interval))
    try:
        yield
    finally:
        sys.setswitchinterval(before)

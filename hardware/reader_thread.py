"""The thread that reads a device: bytes to messages to scans, into the recorder and into the queue.

An error in this thread is raised in the thread that takes the scans. The end of the stream closes the queue.
"""

import threading
import time
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Int

from .drop_oldest_queue import DropOldestQueue
from .protocol import Decoder
from .recorder_base import Recorder
from .scan_assembler import RawScan, ScanAssembler
from .transport_base import EndOfStream, LinkEvent, Source


@dataclass(frozen=True)
class ReaderSettings:
    """Timing of the reading thread. All values are chosen by hand."""

    poll_interval: float = 0.1
    """Maximum time of one read, seconds. Between reads the thread checks the clock and the stop event."""
    replay_speed: float = 1.5
    """A device whose clock runs faster than the host clock by this factor is a replay."""
    replay_margin: float = 1.0
    """Seconds that the device clock may run ahead before ``replay_speed`` counts; covers jitter at the start."""
    end_grace: float = 0.3
    """Seconds to keep reading after an end frame; earlier frames may still arrive out of order."""


SETTINGS = ReaderSettings()


class ReaderThread:
    """Reads a source in its own thread until the source ends or ``stop`` is called."""

    def __init__(
        self,
        source: Source,
        queue: DropOldestQueue[RawScan],
        *,
        sensors: int | None = None,
        group_paths: Int[np.ndarray, "paths 3"] | None = None,
        recorder: Recorder | None = None,
        scans: int | None = None,
        block_when_full: bool | None = False,
    ):
        """Take ownership of a source and a recorder. Both are closed when the thread ends.

        Args:
            source: source of bytes. Its link events are to be passed to ``event``.
            queue: receives the scans; closed at the end.
            sensors: number of sensors of the ring; frames with other sensor numbers are rejected.
            group_paths: as in ``ScanAssembler``.
            recorder: receives every message, scan and event, including scans that the queue drops.
            scans: stop after this many scans; None: when the source ends.
            block_when_full: backpressure. True: wait while the queue is full (files). False: drop the oldest scan
                (udp, which loses what is not read). None: wait only for a device that runs faster than the host clock,
                because it is a replay and can wait (tcp, which buffers what is not read).
        """
        self.decoder = Decoder(sensors=sensors)
        self.assembler = ScanAssembler(sensors=sensors, group_paths=group_paths)
        self.last_event: LinkEvent | None = None
        """The latest link event."""
        self.gaps = 0
        """Number of times that the link was lost."""
        self._source, self._queue, self._recorder = source, queue, recorder
        self._scans_left = scans
        self._block_when_full = block_when_full
        self._first_scan: tuple[float, float] | None = None
        """Device time stamp and time of arrival of the first scan, seconds."""
        self._blocked_time = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="jaxsonar reader", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop reading. On return everything received is recorded and in the queue."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join()

    def event(self, event: LinkEvent) -> None:
        """Handle a link event. Pass this method to ``open_source``; it is called in the reading thread."""
        if self.decoder.ended:
            return  # the device sent its end frame; a lost link is expected
        self.last_event = event
        self.gaps += event.kind == "lost"
        if self._recorder is not None:
            self._recorder.event(event)

    @property
    def counts(self) -> dict[str, int]:
        """Counters of decoder, assembler and queue, by name."""
        frames, groups = self.decoder.counts, self.assembler.counts
        both = {"impossible": frames.impossible + groups.impossible, "rejected": frames.rejected + groups.impossible}
        own = {"dropped": self._queue.dropped, "gaps": self.gaps, "bytes": self.decoder.received_bytes}
        return asdict(frames) | asdict(groups) | both | own

    def _run(self) -> None:
        """Read until the end, then close source, recorder and queue, whatever failed."""
        error: BaseException | None = None
        try:
            self._read()
        except BaseException as failure:  # passed to the consumer through the queue
            error = failure
        for close in (self._source.close, self._recorder.close if self._recorder is not None else None):
            try:
                if close is not None:
                    close()
            except BaseException as failure:
                error = error or failure
        self._queue.close(error)

    def _read(self) -> None:
        ended_at: float | None = None
        while not self._stop.is_set() and self._scans_left != 0:
            try:
                data = self._source.read(SETTINGS.poll_interval)
            except EndOfStream:
                break
            now = time.monotonic()
            if data:
                self._process(data, now)
            self._deliver(self.assembler.expire(now))
            if self._recorder is not None:
                self._recorder.tick(now)
            if not self.decoder.ended:
                ended_at = None
            elif ended_at is None:
                ended_at = now
            elif now - ended_at >= SETTINGS.end_grace:
                break
        self._deliver(self.assembler.flush())

    def _process(self, data: bytes, now: float) -> None:
        messages = self.decoder.feed(data)
        counts = self.decoder.counts
        self.assembler.unknown_messages = counts.unknown + counts.newer > 0
        for message in messages:
            if self._scans_left == 0:
                return
            if self._recorder is not None:
                self._recorder.message(message, time.time())
            self._deliver(self.assembler.push(message, now))

    def _deliver(self, scans: list[RawScan]) -> None:
        """Put scans into the recorder first, then into the queue."""
        for scan in scans:
            if self._scans_left == 0:
                return
            if self._scans_left is not None:
                self._scans_left -= 1
            if self._recorder is not None:
                self._recorder.scan(scan)
            wait = self._block_when_full or (self._block_when_full is None and self._is_replay(scan))
            before = time.monotonic()
            self._queue.put(scan, wait=self._stop if wait else None)
            self._blocked_time += time.monotonic() - before

    def _is_replay(self, scan: RawScan) -> bool:
        """Whether the device clock runs far ahead of the host clock, not counting the time blocked by the queue."""
        first_stamp, first_received = self._first_scan = self._first_scan or (scan.stamp, scan.received)
        host_time = scan.received - first_received - self._blocked_time
        return scan.stamp - first_stamp > SETTINGS.replay_speed * host_time + SETTINGS.replay_margin

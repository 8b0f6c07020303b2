"""The thread that reads a device: bytes to messages to scans, into the record and into the queue.

What goes wrong in it is raised where the scans are taken; the end of the stream is the end of the queue.
"""

import threading
import time
from dataclasses import asdict

from .drop_oldest_queue import NewestQueue
from .protocol import Decoder
from .recorder_base import Recorder
from .scan_assembler import Assembler, RawScan
from .transport_base import EndOfStream, Event, Source

LOOK = 0.1
"""Seconds between two looks at the clock and at whether to stop."""
AHEAD = 1.5
"""Times as fast as the host's clock, from which on a device is played back."""
GRACE = 0.3
"""Seconds after a sender's last frame in which others may still come, out of order."""


class Reader:
    """Reads a source in a thread of its own until it ends or ``stop`` is called."""

    def __init__(
        self,
        source: Source,
        queue: NewestQueue[RawScan],
        *,
        sensors: int | None = None,
        recorder: Recorder | None = None,
        scans: int | None = None,
        patient: bool | None = False,
    ):
        """Take over a source and a recorder: both are closed when the thread ends.

        Args:
            source: of bytes; its events are told to ``event``.
            queue: gets the scans, and is closed at the end.
            sensors: sensors of the ring, to refuse others.
            recorder: gets every message, scan and event, also those that the queue drops.
            scans: stop after this many; None: when the source ends.
            patient: wait while the queue is full instead of dropping scans: True for files, False for links that lose
                what is not read (udp), None for those that hold it (tcp): then a device that runs ahead of its own
                clock, which is played back and can wait, is waited for, and a live one is not.
        """
        self.decoder = Decoder(sensors=sensors)
        self.assembler = Assembler(sensors=sensors)
        self.last_event: Event | None = None
        """The latest word about the link."""
        self.gaps = 0
        """Times that the link was lost."""
        self._source, self._queue, self._recorder = source, queue, recorder
        self._left = scans
        self._patient = patient
        self._began: tuple[float, float] | None = None
        self._waited = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="jaxsonar reader", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def stop(self) -> None:
        """Stop reading; on return what came so far is written and in the queue."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join()

    def event(self, event: Event) -> None:
        """Take note of something about the link; for ``open_source``, called in the reading thread."""
        if self.decoder.ended:
            return  # a device that has said its last word may go
        self.last_event = event
        self.gaps += event.kind == "lost"
        if self._recorder is not None:
            self._recorder.event(event)

    @property
    def counts(self) -> dict[str, int]:
        """What decoder, assembler and queue met, by name."""
        frames, groups = self.decoder.counts, self.assembler.counts
        both = {"impossible": frames.impossible + groups.impossible, "rejected": frames.rejected + groups.impossible}
        own = {"dropped": self._queue.dropped, "gaps": self.gaps}
        return asdict(frames) | asdict(groups) | both | own

    def _run(self) -> None:
        error: BaseException | None = None
        try:
            self._read()
        except BaseException as failure:  # the consumer's to handle, whatever it is
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
        while not self._stop.is_set() and self._left != 0:
            try:
                data = self._source.read(LOOK)
            except EndOfStream:
                break
            now = time.monotonic()
            if data:
                self._take(data, now)
            self._hand_on(self.assembler.expire(now))
            if self._recorder is not None:
                self._recorder.tick(now)
            if not self.decoder.ended:
                ended_at = None
            elif ended_at is None:
                ended_at = now
            elif now - ended_at >= GRACE:
                break
        self._hand_on(self.assembler.flush())

    def _take(self, data: bytes, now: float) -> None:
        messages = self.decoder.feed(data)
        counts = self.decoder.counts
        self.assembler.skipped = counts.unknown + counts.newer > 0
        for message in messages:
            if self._left == 0:
                return
            if self._recorder is not None:
                self._recorder.message(message, time.time())
            self._hand_on(self.assembler.push(message, now))

    def _hand_on(self, scans: list[RawScan]) -> None:
        for scan in scans:
            if self._left == 0:
                return
            if self._left is not None:
                self._left -= 1
            if self._recorder is not None:
                self._recorder.scan(scan)
            wait = self._patient or (self._patient is None and self._played_back(scan))
            before = time.monotonic()
            self._queue.put(scan, wait=self._stop if wait else None)
            self._waited += time.monotonic() - before

    def _played_back(self, scan: RawScan) -> bool:
        """Whether the device's clock runs far ahead of the host's, apart from the time that it was made to wait."""
        first_stamp, first_received = self._began = self._began or (scan.stamp, scan.received)
        return scan.stamp - first_stamp > AHEAD * (scan.received - first_received - self._waited) + 1.0

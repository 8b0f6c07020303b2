"""Device emulator: sends a stream of messages over a sink in real time, with optional fault injection."""

import math
import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass

from .errors import SonarError
from .fault_injection import FaultInjector, FaultSettings
from .messages import Message
from .protocol import encode, encode_end
from .transport_servers import SETTINGS, Sink

END_FRAMES = 3
"""Repetitions of the end frame, because a lossy link may lose one. Chosen by hand."""


@dataclass
class EmulationReport:
    """Counters of an emulated device."""

    messages: int = 0
    """Messages sent."""
    frames: int = 0
    """Frames sent, including corrupted ones, without end frames."""
    sent_bytes: int = 0
    """Bytes of those frames."""
    clients: int = 0
    """Clients served, one after the other."""
    damaged: int = 0
    """Frames corrupted by fault injection."""
    dropped: int = 0
    """Frames dropped by fault injection."""
    swapped: int = 0
    """Frames swapped with the next one by fault injection."""
    stalls: int = 0
    """Stalls by fault injection."""
    max_delay: float = 0.0
    """Largest delay of a message against its due time, seconds, including stalls; 0 without real-time pacing."""


def emulate(
    messages: Iterable[Message],
    sink: Sink,
    *,
    speed: float = 1.0,
    faults: FaultSettings | None = None,
    stop: threading.Event | None = None,
) -> EmulationReport:
    """Send messages to clients, each at its device time. The first message is sent as soon as a client connects.

    The emulated device clock stops while there is no client. The next client continues with the message that the last
    client did not receive. After the last message, and after ``stop``, an end frame is sent. The sink stays open.

    Args:
        messages: messages in order of device time.
        sink: server to send to.
        speed: playback speed; 0: as fast as possible.
        faults: faults to inject; none by default.
        stop: set this event from any thread to return within about 0.1 s.

    Raises:
        SonarError: an invalid speed, or a message that cannot be encoded.
    """
    if not (speed >= 0 and math.isfinite(speed)):
        raise SonarError(f"--speed: {speed:g} came; allowed is 0 (as fast as possible) or more")
    device = _EmulatedDevice(sink, speed, FaultInjector(faults or FaultSettings()), stop or threading.Event())
    for message in messages:
        if not device.send(message):
            break
    return device.end()


class _EmulatedDevice:
    """State of one emulation: pacing, current client, and counters."""

    def __init__(self, sink: Sink, speed: float, link: FaultInjector, stop: threading.Event):
        self.sink, self.speed, self.link, self.stop = sink, speed, link, stop
        self.report = EmulationReport()
        self.first_sent = 0.0  # host clock when the first message was sent
        self.start, self.start_us = 0.0, 0  # a message is due at start + (its time - start_us) / speed
        self.sequence = self.time_us = 0

    def send(self, message: Message) -> bool:
        """Send a message at its due time. False if stopped."""
        frames = self.link.transmit(encode(message))
        self.time_us = message.time_us
        if not self.report.clients and not self.next_client():
            return False
        stall = self.link.stall_duration(time.monotonic() - self.first_sent)
        if self.stop.wait(max(stall, self.time_left())):
            return False
        if not all([self.deliver(frame) for frame in frames]):
            return False
        self.sequence = message.sequence
        self.report.messages += 1
        return True

    def time_left(self) -> float:
        """Seconds until the current message is due; 0 if it is late."""
        if not self.speed:
            return 0.0
        left = self.start + (self.time_us - self.start_us) / 1e6 / self.speed - time.monotonic()
        self.report.max_delay = max(self.report.max_delay, -left)
        return max(left, 0.0)

    def deliver(self, frame: bytes) -> bool:
        """Send a frame to the client; if it disconnects before it has all of it, to the next one. False if stopped."""
        while not self.sink.send(frame, self.stop):
            if not self.next_client():
                return False
            frame = b"\0" + frame.lstrip(b"\0")  # separates it from a partial frame
        self.report.frames += 1
        self.report.sent_bytes += len(frame)
        return True

    def next_client(self) -> bool:
        """Wait for a client; it receives the current message at once. False if stopped."""
        if not self.sink.wait_client(self.stop) or self.stop.is_set():
            return False
        self.start, self.start_us = time.monotonic(), self.time_us
        self.first_sent = self.first_sent or self.start
        self.report.clients += 1
        return True

    def end(self) -> EmulationReport:
        """Send the held-back frames and the end frame to the client, if there is one."""
        report, link = self.report, self.link
        timed_out = threading.Event()
        timer = threading.Timer(SETTINGS.linger_time, timed_out.set)
        timer.start()
        end_frame = encode_end((self.sequence + 1) % (1 << 32), self.time_us)
        for frame in [*link.flush(), *[end_frame] * END_FRAMES]:
            if not report.clients or not self.sink.send(frame, timed_out):
                break
            report.frames += frame is not end_frame
        timer.cancel()
        timer.join()
        report.damaged, report.dropped = link.damaged, link.dropped
        report.swapped, report.stalls = link.swapped, link.stalls
        return report

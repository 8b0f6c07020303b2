"""A stream of messages as a device: in time, over a sink, on a link as bad as wanted."""

import math
import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass

from .errors import SonarError
from .fault_injection import BadLink, Faults
from .messages import Message
from .protocol import encode, encode_end
from .transport_servers import LINGER, Sink

ENDINGS = 3
"""Times that the end is said: a line that loses frames may lose it."""


@dataclass
class Served:
    """What an emulated device did."""

    messages: int = 0
    """Taken from the log or the room."""
    frames: int = 0
    """Sent, damaged ones included; the ends are none of them."""
    sent_bytes: int = 0
    """Of those frames."""
    clients: int = 0
    """Clients that were served, one after the other."""
    damaged: int = 0
    """Frames damaged on purpose."""
    dropped: int = 0
    """Frames lost on purpose."""
    swapped: int = 0
    """Frames sent after the one that follows."""
    stalls: int = 0
    """Times of silence on purpose."""
    latest: float = 0.0
    """Seconds that the latest frame was behind its time, stalls included; 0 where there is no time to keep."""


def emulate(
    messages: Iterable[Message],
    sink: Sink,
    *,
    speed: float = 1.0,
    faults: Faults | None = None,
    stop: threading.Event | None = None,
) -> Served:
    """Send messages to a client, each at its time; the first one as soon as there is a client.

    The device's clock stands still while there is no client: the next one continues with the message that the last one
    did not get. After the last message the device says that this was the end, also after ``stop``. The sink stays open.

    Args:
        messages: in their order, with the device's times.
        sink: where to.
        speed: 2 is twice as fast as the times say; 0 is as fast as it goes.
        faults: none if left out.
        stop: set it, from any thread, and this returns within a tenth of a second or so.

    Raises:
        SonarError: a speed that is none, or a message that no frame can hold.
    """
    if not (speed >= 0 and math.isfinite(speed)):
        raise SonarError(f"--speed: {speed:g} came; allowed is 0 (as fast as it goes) or more")
    device = _Device(sink, speed, BadLink(faults or Faults()), stop or threading.Event())
    for message in messages:
        if not device.send(message):
            break
    return device.end()


class _Device:
    def __init__(self, sink: Sink, speed: float, link: BadLink, stop: threading.Event):
        self.sink, self.speed, self.link, self.stop = sink, speed, link, stop
        self.done = Served()
        self.began = 0.0  # when the first message was sent, by the host's clock
        self.start, self.start_us = 0.0, 0  # a message is due at start + (its time - start_us) / speed
        self.sequence = self.time_us = 0

    def send(self, message: Message) -> bool:
        """Send a message at its time; False once stopped."""
        frames = self.link.pass_on(encode(message))
        self.time_us = message.time_us
        if not self.done.clients and not self.next_client():
            return False
        pause = self.link.pause(time.monotonic() - self.began)
        if self.stop.wait(max(pause, self.time_left())):
            return False
        if not all([self.deliver(frame) for frame in frames]):
            return False
        self.sequence = message.sequence
        self.done.messages += 1
        return True

    def time_left(self) -> float:
        """Seconds until the message is due; 0 if it is late."""
        if not self.speed:
            return 0.0
        left = self.start + (self.time_us - self.start_us) / 1e6 / self.speed - time.monotonic()
        self.done.latest = max(self.done.latest, -left)
        return max(left, 0.0)

    def deliver(self, frame: bytes) -> bool:
        """Send a frame to this client or, if that one leaves before it has it, to the next; False once stopped."""
        while not self.sink.send(frame, self.stop):
            if not self.next_client():
                return False
            frame = b"\0" + frame.lstrip(b"\0")  # so that nothing which is still on its way gets joined to it
        self.done.frames += 1
        self.done.sent_bytes += len(frame)
        return True

    def next_client(self) -> bool:
        """Wait for one, who gets the present message at once; False once stopped."""
        if not self.sink.wait_client(self.stop) or self.stop.is_set():
            return False
        self.start, self.start_us = time.monotonic(), self.time_us
        self.began = self.began or self.start
        self.done.clients += 1
        return True

    def end(self) -> Served:
        """Say to the client, if there is one, that this was the end."""
        done, link = self.done, self.link
        patience = threading.Event()
        timer = threading.Timer(LINGER, patience.set)
        timer.start()
        ending = encode_end((self.sequence + 1) % (1 << 32), self.time_us)
        for frame in [*link.rest(), *[ending] * ENDINGS]:
            if not done.clients or not self.sink.send(frame, patience):
                break
            done.frames += frame is not ending
        timer.cancel()
        timer.join()
        done.damaged, done.dropped, done.swapped, done.stalls = link.damaged, link.dropped, link.swapped, link.stalls
        return done

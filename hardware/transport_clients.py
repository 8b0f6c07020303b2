"""Links to a device that are made again when they break: what they have in common, tcp and udp."""

import errno
import select
import socket
import time
from abc import abstractmethod
from contextlib import suppress

from .errors import SonarError
from .transport_base import EndOfStream, Event, OnEvent, Source, Url, reason

FIRST_WAIT, LONGEST_WAIT = 0.1, 5.0
"""Seconds before the first attempt to make a link again, and before the latest ones."""
CONNECT_TIME = 1.0
"""Seconds that an attempt may take."""
HELLO, GOODBYE = b"\0", b""
"""What a udp source sends to its device, once a second and when it leaves."""
AT_ONCE = 1 << 16
RECEIVE_BUFFER = 1 << 22


class Link(Source):
    """What tcp, udp and terminals have in common: waiting, silence, and making the link again."""

    def __init__(self, url: Url, *, on_event: OnEvent, reconnect: bool, silence: float):
        """Make the link.

        Raises:
            SonarError: it cannot be made.
        """
        self.url = url.text
        self._parsed = url
        self._tell = on_event
        self._reconnect = reconnect
        self._silence = silence
        self._over: str | None = None  # why no more will come
        self._broken_since: float | None = None
        self._wait = FIRST_WAIT
        self._attempt_at = 0.0
        self._after_gap = False
        self._connected = False
        try:
            self._open()
        except (OSError, UnicodeError) as failure:  # the latter from a host that no name can be
            self._shut()
            raise SonarError(f"{self.url}: {reason(failure)}; needed is a device that can be opened there") from None
        self._connected = True
        self._heard_at = time.monotonic()
        self._told_silence = False

    @abstractmethod
    def _open(self) -> None:
        """Make the link, in ``CONNECT_TIME``.

        Raises:
            OSError: it cannot be made now.
        """

    @abstractmethod
    def _shut(self) -> None:
        """Give back what ``_open`` took, if anything."""

    @abstractmethod
    def _descriptor(self) -> int:
        """What to wait for."""

    @abstractmethod
    def _receive(self) -> bytes | None:
        """What is there now; None if that is nothing yet.

        Raises:
            EndOfStream: the device closed the link in order.
            OSError: the link is broken.
        """

    def _keep_alive(self) -> float:
        """Called before every wait; how long that may be at most, seconds."""
        return LONGEST_WAIT

    def read(self, timeout: float) -> bytes | None:
        """See ``Source``."""
        deadline = time.monotonic() + timeout
        while self._over is None:
            try:
                if self._connected or self._opened_again(deadline):
                    data = self._next(deadline)
                    if data is not None:
                        return self._heard(data)
            except OSError as failure:
                self._lost(failure)
            except EndOfStream as end:
                self.close(str(end))
            if self._over is None and time.monotonic() >= deadline:
                self._look_for_silence()
                return None
        raise EndOfStream(self._over)

    def close(self, why: str | None = None) -> None:
        """See ``Source``; ``why`` is what ``EndOfStream`` says from now on."""
        if self._over is None:
            self._over = why or f"{self.url}: closed"
        self._connected = False
        self._shut()

    def _next(self, deadline: float) -> bytes | None:
        """What comes within the time, or None; less than the time may have passed then."""
        wait = min(deadline, self._heard_at + self._silence if not self._told_silence else deadline)
        wait = min(self._keep_alive(), wait - time.monotonic())
        poll = select.poll()
        poll.register(self._descriptor(), select.POLLIN)
        if poll.poll(max(0.0, wait) * 1000):
            return self._receive()
        self._look_for_silence()
        return None

    def _heard(self, data: bytes) -> bytes:
        now = time.monotonic()
        if self._broken_since is not None:
            self._tell(Event("back", f"{self.url}: back after {now - self._broken_since:.1f} s"))
        elif self._told_silence:
            self._tell(Event("back", f"{self.url}: heard again after {now - self._heard_at:.1f} s"))
        self._broken_since, self._told_silence, self._heard_at, self._wait = None, False, now, FIRST_WAIT
        if self._after_gap:  # what came before the gap must not become one frame with what comes now
            self._after_gap = False
            return b"\0" + data
        return data

    def _look_for_silence(self) -> None:
        quiet = time.monotonic() - self._heard_at
        if self._connected and quiet >= self._silence and not self._told_silence:
            self._told_silence = True
            self._tell(Event("silent", f"{self.url}: nothing for {quiet:.1f} s"))

    def _lost(self, failure: OSError) -> None:
        self._connected = False
        self._shut()
        if not self._reconnect:
            self._over = f"{self.url}: {reason(failure)}"
            return
        self._after_gap = True
        now = time.monotonic()
        self._attempt_at = now + self._wait
        self._wait = min(2 * self._wait, LONGEST_WAIT)
        if self._broken_since is None:
            self._broken_since = now
            self._tell(Event("lost", f"{self.url}: {reason(failure)}; trying again"))

    def _opened_again(self, deadline: float) -> bool:
        time.sleep(max(0.0, min(self._attempt_at, deadline) - time.monotonic()))
        if time.monotonic() < self._attempt_at:
            return False
        self._open()
        self._connected = True
        self._heard_at, self._told_silence = time.monotonic(), False
        return True


class TcpLink(Link):
    """A client of a device. A closed connection is the end; a reset one is made again."""

    _socket: socket.socket | None = None

    def _open(self) -> None:
        link = socket.create_connection(self._parsed.address(), timeout=CONNECT_TIME)
        self._socket = link
        link.setblocking(False)
        # A device without power says nothing at all: ask it after 5 s of silence, and give up 6 s later.
        link.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in (("TCP_KEEPIDLE", 5), ("TCP_KEEPINTVL", 2), ("TCP_KEEPCNT", 3)):
            if hasattr(socket, name):
                link.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)

    def _shut(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _descriptor(self) -> int:
        assert self._socket is not None
        return self._socket.fileno()

    def _receive(self) -> bytes | None:
        assert self._socket is not None
        try:
            data = self._socket.recv(AT_ONCE)
        except BlockingIOError:
            return None
        if not data:
            raise EndOfStream(f"{self.url}: the device closed the connection")
        return data


class UdpLink(Link):
    """Datagrams of whole frames.

    Where HOST:PORT is free on this machine, what is sent there is received. Otherwise it is the device's address: it is
    told once a second that somebody listens.
    """

    _socket: socket.socket | None = None
    _asks: bool | None = None
    _hello_at = 0.0

    def _open(self) -> None:
        host, port = self._parsed.address(default_host="127.0.0.1")
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        link = socket.socket(family, socket.SOCK_DGRAM)
        self._socket = link
        link.setblocking(False)
        link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        if not self._asks:
            try:
                link.bind(address)
                self._asks = False
                return
            except OSError as failure:
                if self._asks is False or failure.errno not in (errno.EADDRINUSE, errno.EADDRNOTAVAIL):
                    raise
        link.connect(address)
        self._asks = True  # for good: the port of a device that restarts must stay its own
        self._hello_at = 0.0

    def _shut(self) -> None:
        if self._socket is not None:
            if self._asks:
                with suppress(OSError):
                    self._socket.send(GOODBYE)
            self._socket.close()
            self._socket = None

    def _descriptor(self) -> int:
        assert self._socket is not None
        return self._socket.fileno()

    def _keep_alive(self) -> float:
        now = time.monotonic()
        if self._asks and now >= self._hello_at and self._socket is not None:
            self._socket.send(HELLO)
            self._hello_at = now + 1.0
        return max(0.0, self._hello_at - now) if self._asks else LONGEST_WAIT

    def _receive(self) -> bytes | None:
        assert self._socket is not None
        datagrams = []
        with suppress(BlockingIOError):
            for _ in range(64):
                datagrams.append(self._socket.recv(AT_ONCE))
        # A datagram that was cut off must not become one frame with the next.
        return b"".join(data if data.endswith(b"\0") else data + b"\0" for data in datagrams if data) or None


def open_tcp(url: Url, *, on_event: OnEvent, reconnect: bool, silence: float) -> Source:
    """``tcp://HOST:PORT``. See ``open_source``."""
    url.check_options()
    url.address()
    return TcpLink(url, on_event=on_event, reconnect=reconnect, silence=silence)


def open_udp(url: Url, *, on_event: OnEvent, reconnect: bool, silence: float) -> Source:
    """``udp://HOST:PORT``, or ``udp://:PORT`` for that port of 127.0.0.1. See ``open_source`` and ``UdpLink``."""
    url.check_options()
    url.address(default_host="127.0.0.1")
    return UdpLink(url, on_event=on_event, reconnect=reconnect, silence=silence)

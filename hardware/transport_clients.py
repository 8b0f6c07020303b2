"""Client transports that reconnect automatically: the common base class, tcp and udp."""

import errno
import select
import socket
import time
from abc import abstractmethod
from contextlib import suppress
from dataclasses import dataclass

from .errors import SonarError, reason
from .transport_base import NEEDED, EndOfStream, LinkEvent, NotOpenedError, OnEvent, Source, Url

HELLO, GOODBYE = b"\0", b""
"""Datagrams that a udp client sends to its device: once per second, and when it closes."""


@dataclass(frozen=True)
class ClientSettings:
    """Timing and buffers of the clients. All values are chosen by hand."""

    initial_backoff: float = 0.1
    """Seconds before the first reconnection attempt; doubled after each failure."""
    max_backoff: float = 5.0
    """Maximum time between two attempts, seconds."""
    connect_timeout: float = 1.0
    """Timeout of one attempt, seconds."""
    read_size: int = 1 << 16
    """Maximum size of one read, bytes. A datagram is never larger."""
    datagrams_per_read: int = 64
    """Maximum number of datagrams returned by one read."""
    udp_receive_buffer: int = 1 << 22
    """Size of the kernel's receive buffer, bytes."""
    hello_interval: float = 1.0
    """Seconds between two hellos of a udp client."""
    keepalive_idle: int = 5
    """Seconds of silence before the first tcp keep-alive probe."""
    keepalive_interval: int = 2
    """Seconds between two probes."""
    keepalive_probes: int = 3
    """Unanswered probes before the connection counts as broken."""


SETTINGS = ClientSettings()


class ReconnectingSource(Source):
    """Base class of tcp, udp and terminal clients: timeouts, detection of silence, and reconnection."""

    def __init__(self, url: Url, *, on_event: OnEvent, reconnect: bool, silence: float):
        """Connect.

        Raises:
            NotOpenedError: the device cannot be opened.
            SonarError: an impossible host name.
        """
        self.url = url.text
        self._parsed = url
        self._on_event = on_event
        self._reconnect = reconnect
        self._silence = silence
        self._end_reason: str | None = None  # message of EndOfStream, once the stream has ended
        self._broken_since: float | None = None
        self._backoff = SETTINGS.initial_backoff
        self._next_attempt = 0.0
        self._after_gap = False
        self._connected = False
        try:
            self._connect()
        except UnicodeError as failure:
            raise SonarError(f"{self.url}: no host name: {reason(failure)}; {NEEDED}") from None
        except OSError as failure:
            self._disconnect()
            raise NotOpenedError(self.url, reason(failure)) from None
        self._connected = True
        self._last_data = time.monotonic()
        self._is_silent = False

    @abstractmethod
    def _connect(self) -> None:
        """Connect within ``connect_timeout``.

        Raises:
            OSError: the connection fails.
        """

    @abstractmethod
    def _disconnect(self) -> None:
        """Release what ``_connect`` opened, if anything."""

    @abstractmethod
    def _descriptor(self) -> int:
        """The file descriptor to poll for input."""

    @abstractmethod
    def _receive(self) -> bytes | None:
        """Read the available bytes without blocking; None if there are none.

        Raises:
            EndOfStream: the device closed the connection.
            OSError: the link is broken.
        """

    def _keep_alive(self) -> float:
        """Send keep-alive data if due. Called before every wait; returns the maximum waiting time, seconds."""
        return SETTINGS.max_backoff

    def read(self, timeout: float) -> bytes | None:
        """See ``Source``."""
        deadline = time.monotonic() + timeout
        while self._end_reason is None:
            try:
                if self._connected or self._reconnected(deadline):
                    data = self._next(deadline)
                    if data is not None:
                        return self._received(data)
            except OSError as failure:
                self._lost(failure)
            except EndOfStream as end:
                self.close(str(end))
            if self._end_reason is None and time.monotonic() >= deadline:
                self._check_silence()
                return None
        raise EndOfStream(self._end_reason)

    def close(self, why: str | None = None) -> None:
        """See ``Source``. ``why`` is the message of ``EndOfStream`` from now on."""
        if self._end_reason is None:
            self._end_reason = why or f"{self.url}: closed"
        self._connected = False
        self._disconnect()

    def _next(self, deadline: float) -> bytes | None:
        """Data received before the deadline, or None, possibly before the deadline."""
        wait = min(deadline, self._last_data + self._silence if not self._is_silent else deadline)
        wait = min(self._keep_alive(), wait - time.monotonic())
        poll = select.poll()
        poll.register(self._descriptor(), select.POLLIN)
        if poll.poll(max(0.0, wait) * 1000):
            return self._receive()
        self._check_silence()
        return None

    def _received(self, data: bytes) -> bytes:
        now = time.monotonic()
        if self._broken_since is not None:
            self._on_event(LinkEvent("back", f"{self.url}: back after {now - self._broken_since:.1f} s"))
        elif self._is_silent:
            self._on_event(LinkEvent("back", f"{self.url}: data again after {now - self._last_data:.1f} s"))
        self._broken_since, self._is_silent, self._last_data, self._backoff = None, False, now, SETTINGS.initial_backoff
        if self._after_gap:
            self._after_gap = False
            # A leading 0x00 separates the data from a partial frame before the gap.
            return b"\0" + data
        return data

    def _check_silence(self) -> None:
        quiet = time.monotonic() - self._last_data
        if self._connected and quiet >= self._silence and not self._is_silent:
            self._is_silent = True
            self._on_event(LinkEvent("silent", f"{self.url}: nothing for {quiet:.1f} s"))

    def _lost(self, failure: OSError) -> None:
        self._connected = False
        self._disconnect()
        if not self._reconnect:
            self._end_reason = f"{self.url}: {reason(failure)}"
            return
        self._after_gap = True
        now = time.monotonic()
        self._next_attempt = now + self._backoff
        self._backoff = min(2 * self._backoff, SETTINGS.max_backoff)
        if self._broken_since is None:
            self._broken_since = now
            self._on_event(LinkEvent("lost", f"{self.url}: {reason(failure)}; trying again"))

    def _reconnected(self, deadline: float) -> bool:
        time.sleep(max(0.0, min(self._next_attempt, deadline) - time.monotonic()))
        if time.monotonic() < self._next_attempt:
            return False
        self._connect()
        self._connected = True
        self._last_data, self._is_silent = time.monotonic(), False
        return True


class TcpSource(ReconnectingSource):
    """A tcp client. A closed connection ends the stream; a reset connection is re-established."""

    _socket: socket.socket | None = None

    def _connect(self) -> None:
        link = socket.create_connection(self._parsed.address(), timeout=SETTINGS.connect_timeout)
        self._socket = link
        link.setblocking(False)
        # A device that lost power sends no RST. Keep-alive probes detect it.
        link.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in (
            ("TCP_KEEPIDLE", SETTINGS.keepalive_idle),
            ("TCP_KEEPINTVL", SETTINGS.keepalive_interval),
            ("TCP_KEEPCNT", SETTINGS.keepalive_probes),
        ):
            if hasattr(socket, name):
                link.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)

    def _disconnect(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _descriptor(self) -> int:
        assert self._socket is not None
        return self._socket.fileno()

    def _receive(self) -> bytes | None:
        assert self._socket is not None
        try:
            data = self._socket.recv(SETTINGS.read_size)
        except BlockingIOError:
            return None
        if not data:
            raise EndOfStream(f"{self.url}: the device closed the connection")
        return data


class UdpSource(ReconnectingSource):
    """Receives datagrams of complete frames.

    If HOST:PORT is free on this machine, the client binds it and receives what is sent there. Otherwise it is the
    address of the device, and the client sends a hello to it once per second.
    """

    _socket: socket.socket | None = None
    _sends_hello: bool | None = None
    _next_hello = 0.0

    def _connect(self) -> None:
        host, port = self._parsed.address(default_host="127.0.0.1")
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        link = socket.socket(family, socket.SOCK_DGRAM)
        self._socket = link
        link.setblocking(False)
        link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SETTINGS.udp_receive_buffer)
        if not self._sends_hello:
            try:
                link.bind(address)
                self._sends_hello = False
                return
            except OSError as failure:
                if self._sends_hello is False or failure.errno not in (errno.EADDRINUSE, errno.EADDRNOTAVAIL):
                    raise
        link.connect(address)
        self._sends_hello = True  # permanently: the port of a device that restarts must stay free
        self._next_hello = 0.0

    def _disconnect(self) -> None:
        if self._socket is not None:
            if self._sends_hello:
                with suppress(OSError):
                    self._socket.send(GOODBYE)
            self._socket.close()
            self._socket = None

    def _descriptor(self) -> int:
        assert self._socket is not None
        return self._socket.fileno()

    def _keep_alive(self) -> float:
        now = time.monotonic()
        if self._sends_hello and now >= self._next_hello and self._socket is not None:
            self._socket.send(HELLO)
            self._next_hello = now + SETTINGS.hello_interval
        return max(0.0, self._next_hello - now) if self._sends_hello else SETTINGS.max_backoff

    def _receive(self) -> bytes | None:
        assert self._socket is not None
        datagrams = []
        with suppress(BlockingIOError):
            for _ in range(SETTINGS.datagrams_per_read):
                datagrams.append(self._socket.recv(SETTINGS.read_size))
        # Separates a truncated datagram from the next one.
        return b"".join(data if data.endswith(b"\0") else data + b"\0" for data in datagrams if data) or None


def open_tcp(url: Url, *, on_event: OnEvent, reconnect: bool, silence: float) -> Source:
    """Opener of ``tcp://HOST:PORT``. See ``open_source``."""
    url.check_options()
    url.address()
    return TcpSource(url, on_event=on_event, reconnect=reconnect, silence=silence)


def open_udp(url: Url, *, on_event: OnEvent, reconnect: bool, silence: float) -> Source:
    """Opener of ``udp://HOST:PORT`` (default host 127.0.0.1). See ``open_source`` and ``UdpSource``."""
    url.check_options()
    url.address(default_host="127.0.0.1")
    return UdpSource(url, on_event=on_event, reconnect=reconnect, silence=silence)

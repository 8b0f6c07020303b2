"""Server transports (device side) for tcp, udp and pty, used by the emulator. One client at a time."""

import errno
import fcntl
import os
import select
import socket
import struct
import termios
import threading
import time
import tty
from abc import ABC, abstractmethod
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from .errors import SonarError, reason
from .transport_base import Url, parse_url
from .transport_clients import GOODBYE


@dataclass(frozen=True)
class ServerSettings:
    """Timing of the servers. All values are chosen by hand."""

    poll_interval: float = 0.05
    """Seconds between two checks of the stop event and of states that cannot be waited for."""
    linger_time: float = 2.0
    """Seconds that a client has to read the last bytes before the server closes."""
    pty_quiet_time: float = 0.25
    """A pty's client has read everything when nothing was unread for this time, seconds."""
    udp_client_timeout: float = 3.0
    """Seconds without a hello after which a udp client can be replaced by another one."""
    datagrams_per_pause: int = 16
    """A udp server pauses after this many datagrams, because udp has no flow control."""
    datagram_pause: float = 0.0005
    """Duration of that pause, seconds."""


SETTINGS = ServerSettings()
DISCARD_SIZE = 1 << 12
"""Bytes read and discarded at once; a device ignores its input."""
PEER_CLOSED = getattr(select, "POLLRDHUP", 0)
"""Poll event of a connection that the client closed; Linux only."""


class Sink(ABC):
    """A sink for the frames of a device. Not thread-safe."""

    url: str
    """The URL that a client opens, with the actual port or pty."""

    @abstractmethod
    def wait_client(self, stop: threading.Event) -> bool:
        """Wait for a client. True if there is one, False if ``stop`` was set."""

    @abstractmethod
    def send(self, data: bytes, stop: threading.Event) -> bool:
        """Send all bytes to the client; block while it does not read.

        Returns:
            False if the client disconnected before it had everything, or ``stop`` was set.
        """

    @abstractmethod
    def disconnect(self) -> None:
        """Drop the client abruptly, like an unplugged cable. The next client can connect at the same URL."""

    @abstractmethod
    def close(self) -> None:
        """Close. The client has ``linger_time`` to read the last bytes."""

    def __enter__(self) -> "Sink":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        self.close()


class TcpSink(Sink):
    """A tcp server. Further clients wait until the current one has disconnected."""

    def __init__(self, url: Url):
        host, port = url.address(default_host="127.0.0.1", lowest_port=0)
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        self._server = socket.create_server(address[:2], family=family, backlog=4)
        self._server.setblocking(False)
        self._client: socket.socket | None = None
        self.url = _bound_url(url, host, self._server)

    def wait_client(self, stop: threading.Event) -> bool:
        """See ``Sink``."""
        while self._client is None and not stop.is_set():
            if _poll(self._server.fileno(), select.POLLIN, SETTINGS.poll_interval):
                with suppress(OSError):  # it disconnected again
                    self._client, _ = self._server.accept()
                    self._client.setblocking(False)
                    self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return self._client is not None

    def send(self, data: bytes, stop: threading.Event) -> bool:
        """See ``Sink``."""
        remaining = memoryview(data)
        while self._client is not None and remaining and not stop.is_set():
            try:
                events = _poll(
                    self._client.fileno(), select.POLLOUT | select.POLLIN | PEER_CLOSED, SETTINGS.poll_interval
                )
                if events & (PEER_CLOSED | select.POLLHUP | select.POLLERR):
                    raise ConnectionResetError
                if events & select.POLLIN:
                    self._client.recv(DISCARD_SIZE)
                if events & select.POLLOUT:
                    remaining = remaining[self._client.send(remaining) :]
            except BlockingIOError:
                continue
            except OSError:
                self._drop()
        return not remaining

    def _drop(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None

    def disconnect(self) -> None:
        """See ``Sink``."""
        if self._client is not None:
            self._client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # RST, not FIN
            self._drop()

    def close(self) -> None:
        """See ``Sink``."""
        if self._client is not None:
            # Closing a socket with unread input would send RST, and the client would lose what it has not read.
            with suppress(OSError):
                self._client.shutdown(socket.SHUT_WR)
                end = time.monotonic() + SETTINGS.linger_time
                while (left := end - time.monotonic()) > 0:
                    if _poll(self._client.fileno(), select.POLLIN, left) and not self._client.recv(DISCARD_SIZE):
                        break
            self._drop()
        self._server.close()


class UdpSink(Sink):
    """One frame per datagram, sent to the client that sent a hello.

    Another client takes its place only after a goodbye or ``udp_client_timeout``.
    """

    def __init__(self, url: Url):
        host, port = url.address(default_host="127.0.0.1", lowest_port=0)
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            self._socket.bind(address)
        except OSError:
            self._socket.close()
            raise
        self._socket.setblocking(False)
        self._client: tuple | None = None
        self._hello_at = 0.0
        self._sent = 0
        self.url = _bound_url(url, host, self._socket)

    def _listen(self) -> None:
        with suppress(BlockingIOError):
            while True:
                try:
                    data, sender = self._socket.recvfrom(DISCARD_SIZE)
                except ConnectionError:  # ICMP error of an earlier datagram
                    continue
                now = time.monotonic()
                if data == GOODBYE:
                    self._client = None if sender == self._client else self._client
                elif self._client in (None, sender) or now > self._hello_at + SETTINGS.udp_client_timeout:
                    self._client, self._hello_at = sender, now

    def wait_client(self, stop: threading.Event) -> bool:
        """See ``Sink``."""
        self._listen()
        while self._client is None and not stop.is_set():
            if _poll(self._socket.fileno(), select.POLLIN, SETTINGS.poll_interval):
                self._listen()
        return self._client is not None

    def send(self, data: bytes, stop: threading.Event) -> bool:
        """See ``Sink``."""
        self._listen()
        # udp has no flow control: give the client time to read.
        self._sent += 1
        if self._sent % SETTINGS.datagrams_per_pause == 0:
            time.sleep(SETTINGS.datagram_pause)
        while self._client is not None and not stop.is_set():
            try:
                self._socket.sendto(data, self._client)
            except BlockingIOError:
                _poll(self._socket.fileno(), select.POLLOUT, SETTINGS.poll_interval)
            except OSError:
                self._client = None
            else:
                return True
        return False

    def disconnect(self) -> None:
        """See ``Sink``."""
        self._client = None

    def close(self) -> None:
        """See ``Sink``."""
        self._socket.close()


class PtySink(Sink):
    """The device end of a pty. The client end is in raw mode, so that bytes pass unchanged.

    With ``pty:PATH``, PATH is a symbolic link to the client end. It stays valid after ``disconnect``.
    """

    def __init__(self, url: Url):
        if url.host or url.port is not None:
            raise url.error("no path came", "pty: for any device, or pty:PATH for a link to it")
        self._link = Path(url.path) if url.path else None
        self._master: int | None = None
        self._client = False
        self._open_pty()
        self.url = f"pty:{self._link or self._client_end}"

    def _open_pty(self) -> None:
        self._master, slave = os.openpty()
        try:
            tty.setraw(slave, when=termios.TCSANOW)
            self._client_end = os.ttyname(slave)
            os.set_blocking(self._master, False)
            if self._link is not None:
                if self._link.is_symlink() and os.readlink(self._link).startswith("/dev/pts/"):
                    self._link.unlink()  # left by an earlier emulator
                self._link.symlink_to(self._client_end)
        except OSError:
            self._close_pty()
            raise
        finally:
            os.close(slave)  # a client end that nobody has open reports POLLHUP; this detects clients

    def _close_pty(self) -> None:
        if self._master is not None:
            os.close(self._master)
            self._master = None

    def wait_client(self, stop: threading.Event) -> bool:
        """See ``Sink``."""
        if self._client and not self._has_no_client():
            return True
        self._client = False
        while not stop.is_set():
            if not self._has_no_client():
                # A client configures the terminal first, which may discard input that is already there.
                stop.wait(2 * SETTINGS.poll_interval)
                self._client = True
                return True
            stop.wait(SETTINGS.poll_interval)
        return False

    def send(self, data: bytes, stop: threading.Event) -> bool:
        """See ``Sink``."""
        assert self._master is not None
        remaining = memoryview(data)
        while self._client and remaining and not stop.is_set():
            events = _poll(self._master, select.POLLOUT | select.POLLIN, SETTINGS.poll_interval)
            try:
                if events & (select.POLLHUP | select.POLLERR):
                    self._client = False
                    break
                if events & select.POLLIN:
                    os.read(self._master, DISCARD_SIZE)
                if events & select.POLLOUT:
                    written = os.write(self._master, remaining)
                    remaining = remaining[written:]
                    if not written:
                        stop.wait(SETTINGS.poll_interval)
            except BlockingIOError:
                stop.wait(0.001)
            except OSError:
                self._client = False
        return not remaining

    def disconnect(self) -> None:
        """See ``Sink``."""
        self._close_pty()
        self._client = False
        self._open_pty()

    def close(self) -> None:
        """See ``Sink``."""
        if self._master is not None:
            # The kernel forwards bytes in steps: for a moment none are unread although more will follow.
            end, last_unread = time.monotonic() + SETTINGS.linger_time, time.monotonic()
            while self._client and (now := time.monotonic()) < min(end, last_unread + SETTINGS.pty_quiet_time):
                last_unread = now if self._has_unread() else last_unread
                self._client = not self._has_no_client()
                time.sleep(SETTINGS.poll_interval / 5)
            self._close_pty()
        if self._link is not None and self._link.is_symlink() and os.readlink(self._link) == self._client_end:
            self._link.unlink()

    def _has_no_client(self) -> bool:
        assert self._master is not None
        return bool(_poll(self._master, 0, 0.0) & select.POLLHUP)

    def _has_unread(self) -> bool:
        """Whether there are bytes that the client has not read."""
        client_end = os.open(self._client_end, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            return fcntl.ioctl(client_end, termios.FIONREAD, bytes(4)) != bytes(4)
        finally:
            os.close(client_end)


def listen(url: str) -> Sink:
    """Open a server for a URL.

    Args:
        url: ``tcp://HOST:PORT`` or ``udp://HOST:PORT`` (default host 127.0.0.1; port 0: any free port), ``pty:``, or
            ``pty:PATH`` for a symbolic link to the pty.

    Raises:
        SonarError: an invalid URL, or an address that cannot be opened.
    """
    parsed = parse_url(url)
    sinks = {"tcp": TcpSink, "udp": UdpSink, "pty": PtySink}
    if parsed.scheme not in sinks:
        raise parsed.error(f"scheme '{parsed.scheme}' came", "tcp://HOST:PORT, udp://HOST:PORT, pty: or pty:PATH")
    parsed.check_options()
    try:
        return sinks[parsed.scheme](parsed)
    except (OSError, UnicodeError) as failure:
        taken = " (does a program that waits for datagrams have it?)" if parsed.scheme == "udp" else ""
        taken = taken if getattr(failure, "errno", None) == errno.EADDRINUSE else ""
        raise SonarError(f"{parsed.text}: {reason(failure)}{taken}; needed is a free address of this machine") from None


def _bound_url(url: Url, host: str, bound: socket.socket) -> str:
    name = f"[{host}]" if ":" in host else host
    return f"{url.scheme}://{name}:{bound.getsockname()[1]}"


def _poll(descriptor: int, events: int, timeout: float) -> int:
    poll = select.poll()
    poll.register(descriptor, events)
    found = poll.poll(timeout * 1000)
    return found[0][1] if found else 0

"""Client transports over terminals: serial ports and ptys."""

import errno
import os
import termios
import tty
from contextlib import suppress
from typing import Any

from .errors import SonarError
from .transport_base import OnEvent, Source, Url
from .transport_clients import SETTINGS, ReconnectingSource


class TerminalSource(ReconnectingSource):
    """A serial port or the client end of a pty. An unplugged port is reopened once its device file exists again."""

    _file: int | None = None
    _port: Any = None
    _baud: int | None = None

    def __init__(self, url: Url, *, baud: int | None, on_event: OnEvent, reconnect: bool, silence: float):
        """Open the terminal.

        Args:
            url: its path is the device file.
            baud: bits per second of a serial port; None for a pty.
            on_event: see ``open_source``.
            reconnect: see ``open_source``.
            silence: see ``open_source``.
        """
        self._baud = baud
        super().__init__(url, on_event=on_event, reconnect=reconnect, silence=silence)

    def _connect(self) -> None:
        if self._baud is None:
            self._file = os.open(self._parsed.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            if not os.isatty(self._file):
                raise OSError(errno.ENOTTY, "this is no terminal")
            tty.setraw(self._file, when=termios.TCSANOW)
            return
        serialx = _serialx(self.url)
        try:
            self._port = serialx.Serial(self._parsed.path, self._baud)
            self._port.open()
        except (serialx.SerialException, ValueError) as failure:
            raise OSError(errno.EIO, str(failure)) from None
        self._file = self._port.fileno()

    def _disconnect(self) -> None:
        port, file = self._port, self._file
        self._port = self._file = None
        with suppress(OSError):  # the device is unplugged
            if port is not None:
                port.close()
            elif file is not None:
                os.close(file)

    def _descriptor(self) -> int:
        assert self._file is not None
        return self._file

    def _receive(self) -> bytes | None:
        assert self._file is not None
        try:
            data = os.read(self._file, SETTINGS.read_size)
        except BlockingIOError:
            return None
        if not data:
            raise OSError(errno.ENODEV, "the device is gone")
        return data


def open_pty(url: Url, *, on_event: OnEvent, reconnect: bool, silence: float) -> Source:
    """Opener of ``pty:PATH``. See ``open_source``."""
    url.check_options()
    _check_path(url)
    return TerminalSource(url, baud=None, on_event=on_event, reconnect=reconnect, silence=silence)


def open_serial(url: Url, *, on_event: OnEvent, reconnect: bool, silence: float) -> Source:
    """Opener of ``serial:///dev/ttyUSB0?baud=921600``. See ``open_source``.

    Raises:
        SonarError: an invalid URL, a device that cannot be opened, or a missing extra ``live``.
    """
    url.check_options("baud")
    _check_path(url)
    baud = url.number("baud", 921600.0, 50.0, 2e7)
    if baud != int(baud):
        raise url.error(f"baud {baud:g} came", "a whole number")
    _serialx(url.text)
    return TerminalSource(url, baud=int(baud), on_event=on_event, reconnect=reconnect, silence=silence)


def _check_path(url: Url) -> None:
    if url.host or url.port is not None or not url.path:
        example = "serial:///dev/ttyUSB0" if url.scheme == "serial" else "pty:/dev/pts/3"
        raise url.error(f"no path of a device came (path '{url.path}')", f"a path as in {example}")


def _serialx(url: str) -> Any:
    try:
        import serialx
    except ImportError:
        raise SonarError(f"{url}: serial ports need the extra live: pip install 'jaxsonar[live]'") from None
    return serialx

"""URLs of transports: parts, invalid ones, addresses, and transports of other packages."""

from importlib.metadata import EntryPoint

import pytest
from support.scripted_device import ScriptedDevice

from jaxsonar.hardware import SonarError
from jaxsonar.hardware import transport_base as transports
from jaxsonar.hardware.transport_base import EndOfStream, LinkEvent, Source, open_source, parse_url
from jaxsonar.hardware.transport_servers import listen

"""A stop event that is never set."""


@pytest.fixture
def pty_url(tmp_path):
    return f"pty:{tmp_path / 'ring'}"


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("tcp://localhost:9000", ("tcp", "localhost", 9000, "", {})),
        ("TCP://[::1]:80/", ("tcp", "::1", 80, "/", {})),
        ("udp://:7", ("udp", "", 7, "", {})),
        ("serial:///dev/ttyUSB0?baud=921600", ("serial", "", None, "/dev/ttyUSB0", {"baud": "921600"})),
        ("pty:/dev/pts/3", ("pty", "", None, "/dev/pts/3", {})),
        ("pty:", ("pty", "", None, "", {})),
        ("file:my log.csv?speed=0", ("file", "", None, "my log.csv", {"speed": "0"})),
        ("file:a/b:c.mcap", ("file", "", None, "a/b:c.mcap", {})),
        ("file:///tmp/log.csv", ("file", "", None, "/tmp/log.csv", {})),
        ("can-fd:x?a=1&b=", ("can-fd", "", None, "x", {"a": "1", "b": ""})),
    ],
)
def test_a_url_is_split_into_its_parts(text, parts):
    url = parse_url(text)
    assert (url.scheme, url.host, url.port, url.path, url.options) == parts
    assert url.text == text


WRONG = {
    "": "came; allowed is a URL",
    "office.csv": "came; allowed is a URL",
    "COM 3:x": "came; allowed is a URL",
    "tcp://a:1\n": "came; allowed is a URL",
    "carrier-pigeon://loft:1": "scheme 'carrier-pigeon' came; allowed is serial:",
    "tcp://host": "no such address came|no such address; allowed is tcp://HOST:PORT",
    "tcp://:9000": "tcp://HOST:PORT",
    "tcp://host:0": "from 1 to 65535",
    "tcp://host:65536": "65536 came; allowed is a whole number from 0 to 65535",
    "tcp://host:99999999999999999999": "0 to 65535",
    "tcp://host:nine": "port 'nine' came",
    "tcp://host:-1": "port '-1' came",
    "tcp://host:": "port '' came",
    "tcp://me@host:1": "host 'me@host' came",
    "tcp://::1:80": "host '::1' came",
    "tcp://localhost:9/path": "tcp://HOST:PORT",
    "tcp://localhost:9?baud=3": "option 'baud' came; allowed is none",
    "tcp://localhost:9?baud": r"'\?baud' came; allowed is",
    "tcp://localhost:9?a=1&a=2": "each name once",
    "udp://127.0.0.1": "udp://HOST:PORT",
    "tcp://a..b:9": "needed is a device",
    "serial:": "a path as in",
    "serial://host/dev": "a path as in",
    "serial:///dev/null?baud=fast": "baud 'fast' came; allowed is a number from 50",
    "serial:///dev/null?baud=nan": "allowed is a number from 50",
    "serial:///dev/null?baud=9600.5": "a whole number",
    "serial:///dev/null?speed=1": "option 'speed' came; allowed is baud",
    "serial:///dev/none-of-these": "needed is a device",
    "pty:": "a path as in pty:/dev/pts/3",
    "pty:/dev/none-of-these": "No such file or directory; needed is a device",
    "pty:/dev/null": "this is no terminal; needed is a device",
}


@pytest.mark.parametrize("url", WRONG)
def test_an_invalid_url_is_answered_in_one_line(url):
    if url.startswith("serial:"):
        pytest.importorskip("serialx")
    with pytest.raises(SonarError, match=WRONG[url]) as caught:
        open_source(url)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("url", ["serial:///dev/ttyS0", "file:x.csv", "tcp://h", "tcp://:1?x=1", "pty://host/x", "x"])
def test_a_server_reports_an_address_it_cannot_open(url):
    with pytest.raises(SonarError, match=r"; (allowed|needed) is ") as caught:
        listen(url)
    assert "\n" not in str(caught.value)


def test_missing_devices_and_used_addresses_are_reported():
    with (
        ScriptedDevice("tcp://127.0.0.1:0") as device,
        pytest.raises(SonarError, match="in use; needed is a free address"),
    ):
        listen(device.url)
    with pytest.raises(SonarError, match="refused; needed is a device"):
        open_source(device.url)
    with (
        ScriptedDevice("udp://127.0.0.1:0") as device,
        pytest.raises(SonarError, match=r"in use .*; needed is a free address"),
    ):
        listen(device.url)


def test_a_pty_does_not_replace_an_existing_file(tmp_path):
    (tmp_path / "precious").write_text("!")
    with pytest.raises(SonarError, match="File exists"):
        listen(f"pty:{tmp_path / 'precious'}")
    (tmp_path / "link").symlink_to("precious")
    with pytest.raises(SonarError, match="File exists"):
        listen(f"pty:{tmp_path / 'link'}")
    assert (tmp_path / "link").read_text() == "!"


@pytest.mark.parametrize("url", ["tcp://:0", "udp://:0"])
def test_without_an_address_only_this_machine_can_connect(url):
    with ScriptedDevice(url) as device:
        assert device.url.startswith(url.replace(":0", "127.0.0.1:"))


class Echo(Source):
    def __init__(self, url, **settings):
        self.url, self.settings = url.text, settings

    def read(self, timeout):
        raise EndOfStream("nothing")

    def close(self):
        pass


def test_entry_points_add_transports(monkeypatch):
    offered = EntryPoint("echo", f"{__name__}:Echo", transports.ENTRY_POINTS)
    monkeypatch.setattr(transports, "entry_points", lambda group: [offered] if group == "jaxsonar.transports" else [])
    with open_source("echo:x", reconnect=False, silence=7.0) as source:
        assert isinstance(source, Echo)
        assert source.url == "echo:x"
        assert source.settings["silence"] == 7.0
        assert source.settings["reconnect"] is False
        assert source.settings["on_event"](LinkEvent("lost", "nobody hears this")) is None
    with pytest.raises(SonarError, match="echo:"):
        open_source("ecco:x")


def test_a_program_can_register_transports(monkeypatch):
    monkeypatch.setattr(transports, "_registered", {})
    transports.register_transport("tcp", Echo)
    assert isinstance(open_source("tcp:whatever"), Echo)

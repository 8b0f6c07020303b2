"""What a file holds, recognized from its first bytes. The suffix of its name does not decide."""

import os
import re
from dataclasses import dataclass
from pathlib import Path

from jaxsonar.fileio.atomic_files import reason, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.mcap_recorder import PROFILE
from jaxsonar.scans.csv_log import COLUMNS
from jaxsonar.scans.scan_log import log_format

HEAD = 1 << 16
"""Bytes of a file that are examined."""
MCAP_MAGIC = b"\x89MCAP0\r\n"

DESCRIPTIONS = {
    "csv": "a scan log as CSV",
    "parquet": "a Parquet file",
    "record": "a raw recording (MCAP)",
    "bag": "a ROS bag",
    "beesoft": "a Beesoft log",
    "player": "a Player log",
    "table": "a table of numbers",
    "corridor8": "a recording like corridor8",
    "scitos24": "a recording like scitos24",
}
"""Formats in words."""

TEXT_FORMATS = ("csv", "beesoft", "player", "table", "scitos24")

SUFFIXES = {
    ".csv": ("csv", "table", "scitos24"),
    ".parquet": ("parquet",),
    ".mcap": ("record", "bag"),
    ".bag": ("bag",),
    ".db3": ("bag",),
}
"""Formats that fit each suffix; any format fits another suffix."""

SEPARATOR_LINE = re.compile(r'\s*"?sep=(.)"?\s*', re.IGNORECASE)
"""First line of a table that tells a spreadsheet the delimiter."""

_BINARY = {
    b"\x89PNG": "a picture (PNG)",
    b"\xff\xd8\xff": "a picture (JPEG)",
    b"%PDF": "a PDF file",
    b"PK\x03\x04": "a ZIP archive or a spreadsheet (XLSX)",
    b"\xd0\xcf\x11\xe0": "a spreadsheet or document (Microsoft Office)",
    b"\x1f\x8b": "a file compressed by gzip",
    b"\x28\xb5\x2f\xfd": "a file compressed by Zstandard",
    b"BZh": "a file compressed by bzip2",
    b"\xfd7zXZ": "a file compressed by xz",
    b"\x89HDF": "an HDF5 file",
    b"\x93NUMPY": "a NumPy array",
    b"RIFF": "a sound or video file (RIFF)",
    b"MATLAB 5.0": "a MATLAB file",
}
"""First bytes of files that are no recordings."""

_TEXTS = {
    r"\{|\[\{": "a JSON file",
    "<": "an XML or HTML file",
    r"\[\[?\w+\]\]?$|\w+ *= *\S": "a TOML file (a ring or settings)",
}
"""First lines of text files that are no recordings."""


@dataclass(frozen=True)
class FileContent:
    """What a file or folder holds."""

    format: str | None
    """The format in which it can be read; None if there is none."""
    description: str
    """The content in words, with an article."""
    is_text: bool = False
    """Whether it is text of any kind."""


def file_content(filename: str | os.PathLike[str]) -> FileContent:
    """What a file or folder holds.

    Raises:
        SonarError: it cannot be read.
    """
    try:
        is_folder = os.path.isdir(filename)
        entries = sorted(os.listdir(filename)) if is_folder else []
        head = b"" if is_folder else _head(filename)
    except (OSError, ValueError) as failure:  # ValueError: a NUL in the filename
        raise SonarError(f"{shown(filename)}: {reason(failure)}; needed is a readable file with a recording") from None
    if is_folder:
        return _folder_content(entries)
    if head.startswith(b"PAR1"):
        return _known("parquet")
    if head.startswith((b"#ROSBAG V", b"SQLite format 3\0")):
        return _known("bag")
    if head.startswith(MCAP_MAGIC):
        # magic, opcode 1, length of the record (8 bytes), length of the profile (4 bytes), profile
        profile = PROFILE.encode()
        return _known("record" if head[21 : 21 + len(profile)] == profile else "bag")
    for magic, what in _BINARY.items():
        if head.startswith(magic):
            return FileContent(None, what)
    return _text_content(head)


def interrupted_content(filename: str | os.PathLike[str]) -> FileContent:
    """What a scan log holds that is being recorded, or whose recording process was killed.

    A Parquet log is empty until then; its scans are in a journal beside it.

    Raises:
        SonarError: its suffix is not that of a scan log.
    """
    return _known(log_format(filename))


def check_suffix(filename: str | os.PathLike[str], content: FileContent) -> str | None:
    """A warning if the suffix of a file promises something else than the file holds; None if both agree."""
    suffix = Path(filename).suffix.lower()
    if suffix not in SUFFIXES or content.format in SUFFIXES[suffix]:
        return None
    what = f"{shown(filename)}: this is {content.description}, not {DESCRIPTIONS[SUFFIXES[suffix][0]]}"
    return f"warning: {what}; it is read as such, because its name is probably wrong; rename it"


def _head(filename: str | os.PathLike[str]) -> bytes:
    with open(filename, "rb") as file:
        return file.read(HEAD)


def _folder_content(entries: list[str]) -> FileContent:
    """Content of a folder with these entries."""
    if "metadata.yaml" in entries:
        return _known("bag")
    if "measurement.txt" in entries and "poses.txt" in entries:
        return _known("corridor8")
    if "sensor_readings_24.data" in entries:
        return _known("scitos24")
    bags = [name for name in entries if name.lower().endswith((".db3", ".mcap"))]
    held = f" with {shown(bags[0], 40)}" if bags else ""
    return FileContent(None, f"a folder{held} without metadata.yaml, which the folder of a ROS 2 bag has")


def _known(format: str) -> FileContent:
    return FileContent(format, DESCRIPTIONS[format], is_text=format in TEXT_FORMATS)


def _text_content(head: bytes) -> FileContent:
    """Content of a file that has no magic number."""
    if not head:
        return FileContent(None, "an empty file", is_text=True)
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return FileContent(None, "text in UTF-16 (save it as UTF-8)")
    text = head.removeprefix(b"\xef\xbb\xbf").decode("utf-8", "replace")
    if "\0" in text or text.count("\ufffd") > 0.01 * len(text) + 1:
        return FileContent(None, "a binary file")
    lines = [line.strip() for line in text.splitlines()]
    if lines and SEPARATOR_LINE.fullmatch(lines[0]):  # of a table written by a spreadsheet
        lines.pop(0)
    first = next((line for line in lines if line), "")
    if re.search(r"^(#(ROBOT|SONAR \d+:)|begin\(pattern)", text, re.MULTILINE):
        return _known("beesoft")
    if re.search(r"^## *Player version", text, re.MULTILINE) or _is_player_line(lines):
        return _known("player")
    if any(re.match(r"\d+\.\d+ \S+ \d+ (sonar|position) \d+ \d+\.\d+ ", line) for line in lines[:200]):
        return FileContent(None, "a log of Player 1.x (versions 2 and 3 are read)", is_text=True)
    if re.match(r"S1,S2,.*,S24,OUTPUT$", first):
        return _known("scitos24")
    if _is_log_header(first):
        return _known("csv")
    for pattern, what in _TEXTS.items():
        if re.match(pattern, first):
            return FileContent(None, what, is_text=True)
    if _is_number_table(lines):
        return _known("table")
    return FileContent(None, f"a text that begins with '{shown(first, 40)}'", is_text=True)


def _is_log_header(line: str) -> bool:
    """Whether a line resembles the header of a scan log. The CSV reader reports what is wrong with it."""
    names = [name.strip(" \"'") for name in re.split(r"[,;\t]", line)]
    return names[0] == "scan" or len(set(names) & set(COLUMNS)) >= 5


def _is_player_line(lines: list[str]) -> bool:
    """Whether any line is one of a Player log: time, host, robot, interface, index."""
    pattern = r"\d+\.\d+ \d+ \d+ (sonar|position2d|position) \d+ "
    return any(re.match(pattern, line) for line in lines[:200])


def _is_number_table(lines: list[str]) -> bool:
    """Whether most lines after the first are rows of numbers."""
    rows = [line for line in lines[1:200] if line and not line.startswith("#")][:-1] or lines[:1]
    numbers = [sum(bool(re.fullmatch(r"[-+\d.,eE]+", field)) for field in re.split(r"[,;\s]+", row)) for row in rows]
    return bool(rows) and sum(count >= 2 for count in numbers) > 0.5 * len(rows)

"""Images of occupancy grids: PGM (plain and binary) and PNG, as arrays of channels from 0 to 1."""

import io
import os
import re

import numpy as np
from jaxtyping import Float

from jaxsonar.fileio.atomic_files import read_bytes, shown
from jaxsonar.hardware.errors import SonarError

_PNG = b"\x89PNG\r\n\x1a\n"


def read_image(filename: str | os.PathLike[str]) -> Float[np.ndarray, "rows columns channels"]:
    """Read a PGM or PNG image; the first row is the top.

    Returns:
        Channels from 0 (black, transparent) to 1 (white, opaque): gray, gray and opacity, RGB, or RGB and opacity.

    Raises:
        SonarError: the file cannot be read, or has another format.
    """
    content = read_bytes(filename, what="the image of a map")
    if content.startswith((b"P2", b"P5")):
        return _read_pgm(content, filename)
    if content.startswith(_PNG):
        return _read_png(content, filename)
    raise SonarError(f"{shown(filename)}: {content[:4]!r} came first; allowed is an image in the format PGM or PNG")


def _read_pgm(content: bytes, filename: str | os.PathLike[str]) -> Float[np.ndarray, "rows columns 1"]:
    """Read a plain (P2) or binary (P5) PGM image. Its header may contain comments."""
    gap = rb"(?:\s|#[^\r\n]*[\r\n])+"
    header = re.match(rb"P[25]" + (gap + rb"(\d{1,9})") * 3, content)
    if not header:
        raise SonarError(
            f"{shown(filename)}: the header is incomplete; allowed is P2 or P5, width, height, largest value"
        )
    columns, rows, largest = (int(number) for number in header.groups())
    if not 0 < largest < 65536:
        raise SonarError(f"{shown(filename)}: the largest value is {largest}; allowed is 1 to 65535")
    rest = content[header.end() :]
    if content.startswith(b"P2"):
        numbers = re.sub(rb"#[^\r\n]*", b"", rest).split()
        if not all(number.isdigit() and len(number) < 9 for number in numbers):
            raise SonarError(f"{shown(filename)}: a pixel is not a number; allowed are numbers up to {largest}")
        pixels = np.array(numbers, dtype=np.float64)
    else:
        # One white space, or the comment that begins with it, ends the header.
        width = 2 if largest > 255 else 1
        body = rest[1:]
        pixels = np.frombuffer(body[: len(body) // width * width], dtype=">u2" if width == 2 else "u1").astype(float)
    if len(pixels) < rows * columns:
        raise SonarError(f"{shown(filename)}: {len(pixels)} pixels came; needed are {columns} x {rows}")
    return np.minimum(pixels[: rows * columns] / largest, 1.0).reshape(rows, columns, 1)


def _read_png(content: bytes, filename: str | os.PathLike[str]) -> Float[np.ndarray, "rows columns channels"]:
    """Read a PNG image by Matplotlib's reader."""
    from matplotlib.image import imread

    try:
        pixels = np.asarray(imread(io.BytesIO(content), format="png"), dtype=np.float64)
    except Exception as error:  # the reader's exceptions are not documented
        raise SonarError(f"{shown(filename)}: the PNG image cannot be read ({error}); save the map again") from None
    return pixels if pixels.ndim == 3 else pixels[..., None]

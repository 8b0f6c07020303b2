"""Maps of Nav2's map_server, as slam_toolbox and map_saver save them: a YAML file, and an image beside it.

The rules are those of map_server (navigation2, ``nav2_map_server/src/map_io.cpp``).
"""

import json
import math
import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.fileio.atomic_files import read_bytes, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.occupancy.grid_images import read_image

UNKNOWN = -1
"""Value of a cell that was not observed."""
_DEFAULTS = {"mode": "trinary"}
"""What map_server takes for missing keys; it needs all others."""
_MODES = ("trinary", "scale", "raw")
_MOST_CELLS = 100_000_000
_SERIALIZED = (".posegraph", ".data")
_IMAGES = (".pgm", ".png")
_LEAST_OCCUPIED, _MOST_FREE = 75, 25
"""Occupancy from which a cell of a map in the mode scale or raw is occupied, and up to which it is free. A probability
of 0.5 is about 65 in such a map."""
_MOST_GRADED = 0.3
"""Largest fraction of known cells that are neither free nor occupied: a map of costs has more."""


@dataclass(frozen=True, eq=False)
class Nav2Map:
    """Cells of a map of map_server."""

    occupancy: Int[np.ndarray, "rows columns"]
    """0 (free) to 100 (occupied), or ``UNKNOWN``; row 0 is at the origin, rows along y, columns along x."""
    resolution: float
    """Side of a cell, metres."""
    origin: Float[np.ndarray, "3"]
    """world_from_map of the outer corner of cell (0, 0): x, y (m), yaw (rad)."""

    @property
    def occupied(self) -> Bool[np.ndarray, "rows columns"]:
        """Cells that are more likely occupied than not."""
        return self.occupancy >= _LEAST_OCCUPIED

    @property
    def free(self) -> Bool[np.ndarray, "rows columns"]:
        """Cells that are free with some certainty."""
        return (self.occupancy >= 0) & (self.occupancy <= _MOST_FREE)


def check_occupancy(grid: Nav2Map) -> None:
    """Raise a SonarError for a grid that shows no walls: one without occupied or free cells, or a map of costs."""
    known = int((grid.occupancy >= 0).sum())
    if not grid.occupied.any() or not grid.free.any():
        kind = "occupied" if grid.free.any() else "free"
        raise SonarError(
            f"no {kind} cell among {known} known ones; allowed is a map of walls, with free cells beside them"
        )
    between = np.bincount(grid.occupancy[(grid.occupancy >= 0) & ~grid.occupied & ~grid.free], minlength=1)
    # One value alone may stand for unobserved cells.
    graded = int(between.sum() - between.max())
    if graded > _MOST_GRADED * known:
        raise SonarError(
            f"{100 * graded / known:.0f} % of the known cells are neither free nor occupied, as in a map of costs or "
            "speeds; allowed is the map of the walls"
        )


def load_nav2(filename: str | os.PathLike[str]) -> Nav2Map:
    """Read a map of map_server, its YAML file and its image (.pgm or .png).

    Raises:
        SonarError: the files cannot be read, or a value is missing or out of range. The message names the file, the key
            and what is allowed.
    """
    values = _values(filename)
    try:
        mode, negate = _mode(values), _negate(values)
        resolution = _number(values, "resolution", 1e-4, 100.0)
        occupied, free = (_number(values, key, 0.0, 1.0) for key in ("occupied_thresh", "free_thresh"))
        if not free < occupied:
            raise SonarError(f"free_thresh {free:g}, occupied_thresh {occupied:g}; allowed is free_thresh below it")
        origin = _origin(values)
    except SonarError as error:
        raise SonarError(f"{shown(filename)}: {error}") from None
    image_file = image_filename(filename)
    channels = read_image(image_file)
    if not 0 < channels.shape[0] * channels.shape[1] <= _MOST_CELLS:
        rows, columns = channels.shape[:2]
        raise SonarError(f"{shown(image_file)}: {columns} x {rows} cells; allowed are 1 to {_MOST_CELLS:,}")
    cells = classify(channels, mode=mode, negate=negate, occupied_thresh=occupied, free_thresh=free)
    # The first row of the image is that of the largest y.
    return Nav2Map(cells[::-1], resolution, origin)


def image_filename(filename: str | os.PathLike[str]) -> Path:
    """The image that the YAML file of a map names.

    Raises:
        SonarError: the YAML file cannot be read, or names none.
    """
    name = _values(filename).get("image")
    if not isinstance(name, str) or not name:
        raise SonarError(f"{shown(filename)}: no image; needed is 'image: MAP.pgm', the file of the cells")
    return Path(filename).parent / name


def classify(
    channels: Float[np.ndarray, "rows columns channels"],
    *,
    mode: str,
    negate: bool,
    occupied_thresh: float,
    free_thresh: float,
) -> Int[np.ndarray, "rows columns"]:
    """Occupancy of the pixels of an image, 0 to 100 or ``UNKNOWN``, by the rules of map_server.

    Args:
        channels: of the image, 0 to 1: gray, gray and opacity, RGB, or RGB and opacity.
        mode: trinary, scale or raw.
        negate: whether light pixels are occupied.
        occupied_thresh: least occupancy probability of an occupied cell.
        free_thresh: largest occupancy probability of a free cell.
    """
    has_alpha = channels.shape[-1] in (2, 4)
    colors = channels[..., :-1] if has_alpha else channels
    if colors.shape[-1] == 1:
        colors = np.repeat(colors, 3, axis=-1)
    # map_server takes the opacity as one more channel of trinary images.
    shade = (np.concatenate([colors, channels[..., -1:]], axis=-1) if has_alpha and mode == "trinary" else colors).mean(
        -1
    )
    if mode == "raw":
        value = np.round(shade * 255).astype(np.int64)
        return np.where(value <= 100, value, UNKNOWN)
    probability = shade if negate else 1 - shade
    between = np.full(shade.shape, UNKNOWN)
    if mode == "scale":
        fraction = (probability - free_thresh) / (occupied_thresh - free_thresh)
        between = np.rint(100 * np.clip(fraction, 0, 1)).astype(np.int64)
    cells = np.where(probability > occupied_thresh, 100, np.where(probability < free_thresh, 0, between))
    if mode == "scale" and has_alpha:
        cells = np.where(channels[..., -1] < 1, UNKNOWN, cells)
    return cells


def _values(filename: str | os.PathLike[str]) -> dict[str, object]:
    """The keys of the YAML file of a map; other files of slam_toolbox are rejected."""
    if Path(filename).suffix.lower() in _SERIALIZED:
        raise SonarError(
            f"{shown(filename)}: a serialized pose graph of slam_toolbox came; allowed is the map that "
            "'ros2 run nav2_map_server map_saver_cli -f MAP' saves: MAP.yaml and its image"
        )
    if Path(filename).suffix.lower() in _IMAGES:
        raise SonarError(
            f"{shown(filename)}: the image of a map came; allowed is its YAML file, which states resolution and origin"
        )
    return _parse_yaml(read_bytes(filename, what="a map of map_server"), filename)


def _parse_yaml(content: bytes, filename: str | os.PathLike[str]) -> dict[str, object]:
    """The keys of a flat YAML mapping, with scalars, ``[a, b, c]`` and block lists as values."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise SonarError(f"{shown(filename)}: no text came; allowed is a YAML file of map_server, with the key image")
    values: dict[str, object] = {}
    key = None
    for number, line in enumerate(text.splitlines(), start=1):
        line = re.sub(
            r"""^((?:"(?:[^"\\]|\\.)*"|'[^']*'|[^"'#]|(?<!\s)#)*?)(?:(?:(?<=\s)|^)#.*)?$""", r"\1", line
        ).rstrip()
        if not line.strip() or line.strip() in ("---", "..."):
            continue
        item = re.match(r"^\s*-\s+(.*)$", line)
        if item and key is not None and isinstance(values[key], list):
            values[key].append(_scalar(item[1]))  # pyright: ignore[reportAttributeAccessIssue]
            continue
        pair = re.match(r"^([A-Za-z_]\w*)\s*:(?:\s+(.*))?$", line)
        if not pair:
            raise SonarError(f"{shown(filename)}: line {number} is {line.strip()!a:.60}; allowed is KEY: VALUE")
        key, value = pair[1], (pair[2] or "").strip()
        listed = re.match(r"^\[(.*)\]$", value)
        if listed:
            values[key] = [_scalar(part) for part in listed[1].split(",")]
        else:
            values[key] = _scalar(value) if value else []
    return _DEFAULTS | values


def _scalar(text: str) -> object:
    """A number or a string; true and false are 1 and 0."""
    text = text.strip()
    if text[:1] == text[-1:] == "'" and len(text) > 1:
        return text[1:-1].replace("''", "'")
    if text[:1] == text[-1:] == '"' and len(text) > 1:
        try:
            return json.loads(text)
        except ValueError:
            return text[1:-1]
    if text.lower() in ("true", "false"):
        return int(text.lower() == "true")
    try:
        return float(text)
    except ValueError:
        return text


def _number(values: dict[str, object], key: str, low: float, high: float) -> float:
    """The number of a key within limits."""
    value = values.get(key)
    if value is None:
        raise SonarError(f"no {key}; needed is a number from {low:g} to {high:g}")
    if not isinstance(value, (int, float)) or not low <= value <= high:  # False for NaN
        raise SonarError(f"{key} {value!a:.40}; allowed is a number from {low:g} to {high:g}")
    return float(value)


def _mode(values: dict[str, object]) -> str:
    mode = values["mode"]
    if not isinstance(mode, str) or mode.lower() not in _MODES:
        raise SonarError(f"mode {mode!a:.40}; allowed are {', '.join(_MODES)}")
    return mode.lower()


def _negate(values: dict[str, object]) -> bool:
    negate = values.get("negate")
    if negate not in (0, 1):
        came = "no negate" if negate is None else f"negate {negate!a:.40}"
        raise SonarError(f"{came}; allowed are 0 and 1")
    return bool(negate)


def _origin(values: dict[str, object]) -> Float[np.ndarray, "3"]:
    """Position (m) and yaw (rad) of the lower left corner of the image."""
    origin = values.get("origin")
    numbers = origin if isinstance(origin, list) else []
    if len(numbers) != 3 or not all(isinstance(one, (int, float)) and math.isfinite(one) for one in numbers):
        raise SonarError(f"origin {origin!a:.60}; allowed is [x, y, yaw] in metres and radians")
    return np.array(numbers, dtype=np.float64)

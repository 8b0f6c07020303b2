"""Maps of Nav2's map_server: cells by its rules, in every image format, and errors that name file and key."""

import struct
import zlib

import numpy as np
import pytest

from jaxsonar import SonarError
from jaxsonar.occupancy.nav2_reader import UNKNOWN, check_occupancy, load_nav2


def map_server_cell(gray, *, mode, negate, occupied_thresh, free_thresh):
    """Rules of nav2_map_server (map_io.cpp) for one opaque gray pixel from 0 to 255."""
    if mode == "raw":
        return gray if gray <= 100 else -1
    occupied = gray / 255 if negate else (255 - gray) / 255
    if occupied > occupied_thresh:
        return 100
    if occupied < free_thresh:
        return 0
    if mode == "trinary":
        return -1
    return round(100 * (occupied - free_thresh) / (occupied_thresh - free_thresh))


def png(pixels):
    """A gray PNG image of 8 bits."""
    rows, columns = pixels.shape
    raw = b"".join(b"\0" + row.tobytes() for row in pixels)
    parts = [
        (b"IHDR", struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0)),
        (b"IDAT", zlib.compress(raw)),
        (b"IEND", b""),
    ]
    chunks = [
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in parts
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def pgm(pixels):
    return b"P5\n# CREATOR: map_saver\n%d %d\n# a comment\n255\n" % pixels.shape[::-1] + pixels.tobytes()


def plain_pgm(pixels):
    numbers = " ".join(str(value) for value in pixels.ravel())
    return f"P2 # plain\n{pixels.shape[1]} {pixels.shape[0]} 255\n{numbers}\n".encode()


IMAGES = {"map.pgm": pgm, "plain.pgm": plain_pgm, "map.png": png}


def write(folder, image="map.pgm", **changes):
    """A YAML file with these values; None leaves a key out."""
    values = {"image": image, "resolution": "0.05", "origin": "[-1.0, 2.0, 0.5]", "negate": "0"}
    values |= {"occupied_thresh": "0.65", "free_thresh": "0.196"} | changes
    lines = [f"{key}: {value}\n" for key, value in values.items() if value is not None]
    (folder / "map.yaml").write_text("".join(lines))
    return folder / "map.yaml"


@pytest.mark.parametrize("name", IMAGES)
@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
@pytest.mark.parametrize("negate", [0, 1])
def test_cells_follow_the_rules_of_map_server(tmp_path, name, mode, negate):
    pixels = np.random.default_rng(3).permutation(np.arange(256, dtype=np.uint8)).reshape(16, 16)[:15]
    (tmp_path / name).write_bytes(IMAGES[name](pixels))
    rules = {"mode": mode, "negate": negate, "occupied_thresh": 0.7, "free_thresh": 0.21}
    found = load_nav2(write(tmp_path, name, **rules))
    expected = [[map_server_cell(int(gray), **rules) for gray in row] for row in pixels]
    # The first row of the image is that of the largest y.
    np.testing.assert_array_equal(found.occupancy, np.array(expected)[::-1])
    np.testing.assert_allclose(found.origin, [-1.0, 2.0, 0.5])
    assert found.resolution == 0.05
    assert UNKNOWN == -1


def test_a_larger_value_is_white(tmp_path):
    """Images of 16 bits, and of few gray levels, have the same shades."""
    wide = np.array([[0, 32768, 65535]], dtype=">u2")
    (tmp_path / "map.pgm").write_bytes(b"P5 3 1 65535\n" + wide.tobytes())
    np.testing.assert_array_equal(load_nav2(write(tmp_path)).occupancy, [[100, -1, 0]])
    (tmp_path / "map.pgm").write_bytes(b"P2\n3 1\n4\n0 2 4\n")
    np.testing.assert_array_equal(load_nav2(write(tmp_path)).occupancy, [[100, -1, 0]])


def test_forms_of_yaml(tmp_path):
    """Quotes, comments, block lists, booleans, capitals, and the mode that map_server takes if there is none."""
    (tmp_path / "my #1 map.pgm").write_bytes(pgm(np.array([[0, 205, 254]], np.uint8)))
    text = "---\n# saved\nimage: 'my #1 map.pgm'\nresolution: 5.0e-2  # m\norigin:\n- -3.5\n- 2\n- 0\nnegate: false\n"
    text += "occupied_thresh: 0.65 # as saved\nfree_thresh: 0.196\n"
    for mode in ("", "mode: Trinary\n"):
        (tmp_path / "map.yaml").write_text(text + mode)
        found = load_nav2(tmp_path / "map.yaml")
        np.testing.assert_array_equal(found.occupancy, [[100, -1, 0]])
        np.testing.assert_array_equal(found.origin, [-3.5, 2, 0])


BAD = {
    "image": ({"image": None}, "image"),
    "missing image": ({"image": "none.pgm"}, "none.pgm"),
    "no resolution": ({"resolution": None}, "resolution"),
    "resolution": ({"resolution": "0"}, "resolution"),
    "a word": ({"resolution": "fine"}, "resolution"),
    "origin": ({"origin": "[1, 2]"}, "origin"),
    "nan": ({"origin": "[1, .nan, 0]"}, "origin"),
    "mode": ({"mode": "speed"}, "trinary, scale, raw"),
    "negate": ({"negate": "2"}, "negate"),
    "no negate": ({"negate": None}, "no negate"),
    "no threshold": ({"free_thresh": None}, "no free_thresh"),
    "thresholds": ({"free_thresh": "0.7"}, "free_thresh"),
    "no pair": ({"what": None, "resolution": "0.05\nnonsense"}, "KEY: VALUE"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_wrong_value_is_named(tmp_path, case):
    (tmp_path / "map.pgm").write_bytes(pgm(np.zeros((2, 2), np.uint8)))
    changes, name = BAD[case]
    with pytest.raises(SonarError, match=name) as error:
        load_nav2(write(tmp_path, **({"image": "map.pgm"} | changes)))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("content", "name"),
    [
        (b"P5 2 2 255\n\0", "1 pixels"),
        (b"P5 2", "header"),
        (b"P5 2 2 0\n1234", "largest value"),
        (b"P2 2 1 9\n1 x", "not a number"),
        (b"\xff\xd8\xff\xe0 jpeg", "PGM or PNG"),
        (b"\x89PNG\r\n\x1a\nbroken", "PNG image cannot be read"),
        (b"P5 0 0 255\n", "cells"),
    ],
)
def test_a_wrong_image_is_named(tmp_path, content, name):
    (tmp_path / "map.pgm").write_bytes(content)
    with pytest.raises(SonarError, match=name):
        load_nav2(write(tmp_path))


def test_other_files_of_slam_toolbox_are_rejected(tmp_path):
    for name, says in (("a.posegraph", "map_saver_cli"), ("a.data", "map_saver_cli"), ("a.pgm", "YAML")):
        (tmp_path / name).write_bytes(b"P5\n")
        with pytest.raises(SonarError, match=says):
            load_nav2(tmp_path / name)


def test_maps_without_walls_are_rejected(tmp_path):
    for pixels, mode, says in (
        (np.full((4, 4), 254), "trinary", "no occupied cell"),
        (np.zeros((4, 4)), "trinary", "no free cell"),
        (np.arange(100).reshape(10, 10), "raw", "costs"),
    ):
        (tmp_path / "map.pgm").write_bytes(pgm(pixels.astype(np.uint8)))
        with pytest.raises(SonarError, match=says):
            check_occupancy(load_nav2(write(tmp_path, mode=mode)))

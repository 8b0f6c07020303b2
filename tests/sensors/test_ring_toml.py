"""Ring files: lossless round trips, and errors that name the key and the allowed values."""

import dataclasses
import os
import tempfile
import tomllib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsonar.hardware.errors import SonarError
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring_toml import load_detection, load_ring, ring_toml, save_ring, shipped_rings

CIRCLE = """\
name = "round"
speed_of_sound = 340.0
[ring]
count = 12
radius = 0.25
first_heading_deg = 15.0
beam_deg = 45.0
neighbors = 2
max_range = 3.5
"""
BUMPER = """\
name = "bumper"
[array]
neighbors = 1
max_range = 4.5
[[sensor]]
x = 0.5
y = 0.25
heading_deg = 10.0
beam_deg = 50.0
range_offset = 0.125
[[sensor]]
x = 0.625
y = -0.375
heading_deg = -20.0
beam_deg = 40.0
"""


def read(text):
    with tempfile.TemporaryDirectory() as folder:
        file = os.path.join(folder, "ring.toml")
        with open(file, "wb") as handle:
            handle.write(text if isinstance(text, bytes) else text.encode())
        return load_ring(file)


def refused(text):
    with pytest.raises(SonarError) as caught:
        read(text)
    message = str(caught.value)
    assert message.isprintable()  # therefore one line
    assert "/ring.toml: " in message
    return message.partition("/ring.toml: ")[2]


def assert_same(one, other):
    assert (one.name, one.neighbors, one.max_range) == (other.name, other.neighbors, other.max_range)
    assert one.closed == other.closed
    for field in ("position", "heading", "beam", "range_offset", "speed_of_sound"):
        np.testing.assert_allclose(getattr(one, field), getattr(other, field), rtol=0, atol=1e-12, err_msg=field)


def saved(ring):
    """The tables of the file, and the ring loaded from it."""
    with tempfile.TemporaryDirectory() as folder:
        file = os.path.join(folder, "ring.toml")
        save_ring(ring, file)
        with open(file, "rb") as handle:
            return tomllib.load(handle), load_ring(file)


def test_every_key_of_a_circle():
    expected = Ring.circular(
        count=12,
        radius=0.25,
        beam=np.radians(45.0),
        neighbors=2,
        max_range=3.5,
        first_heading=np.radians(15.0),
        speed_of_sound=340.0,
        name="round",
    )
    assert_same(read(CIRCLE), expected)


def test_every_key_of_an_array():
    expected = Ring(
        np.array([[0.5, 0.25], [0.625, -0.375]]),
        np.radians([10.0, -20.0]),
        beam=np.radians([50.0, 40.0]),
        neighbors=1,
        max_range=4.5,
        range_offset=np.array([0.125, 0.0]),
        speed_of_sound=343.2,
        name="bumper",
    )
    assert_same(read(BUMPER), expected)


number = st.floats(-3, 3)
beams = st.floats(0.01, np.pi)
common = {"max_range": st.floats(0.1, 50), "speed_of_sound": st.floats(1, 5000), "name": st.text(max_size=8)}


@pytest.mark.slow
@given(
    st.fixed_dictionaries(
        {"count": st.integers(4, 40), "radius": st.floats(0, 3), "beam": beams, "first_heading": st.floats(-6, 6)}
        | {"neighbors": st.integers(0, 3), **common}
    )
)
def test_round_trip_of_a_circular_ring(settings):
    ring = Ring.circular(**settings)
    tables, again = saved(ring)
    assert "ring" in tables
    assert_same(again, ring)


@pytest.mark.slow
@given(
    st.lists(st.tuples(number, number, st.floats(-7, 7), beams, st.floats(-1, 1)), min_size=2, max_size=6),
    st.fixed_dictionaries(common | {"neighbors": st.integers(0, 1)}),
)
def test_round_trip_of_any_arrangement(sensors, settings):
    x, y, heading, beam, offset = (np.array(column) for column in zip(*sensors, strict=True))
    ring = Ring(np.stack([x, y], axis=-1), heading, beam=beam, range_offset=offset, **settings)
    assert_same(saved(ring)[1], ring)


@pytest.mark.parametrize("field", ["position", "heading", "beam", "range_offset"])
def test_rings_that_are_not_circular_are_saved_as_an_array(field):
    ring = Ring.circular()
    fields = {name: np.array(getattr(ring, name)) for name in ("position", "heading", "beam", "range_offset")}
    fields[field][5] += 1e-9
    bent = Ring(
        fields["position"],
        fields["heading"],
        beam=fields["beam"],
        range_offset=fields["range_offset"],
        neighbors=3,
        max_range=2.0,
    )
    tables, again = saved(bent)
    assert set(tables) == {"name", "speed_of_sound", "array", "sensor"}
    assert len(tables["sensor"]) == 24
    assert_same(again, bent)


def test_degrees_are_written_without_rounding_noise(tmp_path):
    save_ring(Ring.circular(name="paper"), tmp_path / "ring.toml")
    assert (tmp_path / "ring.toml").read_text().splitlines() == [
        'name = "paper"',
        "speed_of_sound = 343.2",
        "",
        "[ring]",
        "count = 24",
        "radius = 0.28",
        "first_heading_deg = 0.0",
        "beam_deg = 60.0",
        "neighbors = 3",
        "max_range = 2.0",
    ]
    save_ring(read(BUMPER), tmp_path / "ring.toml")
    text = (tmp_path / "ring.toml").read_text()
    assert "[[sensor]]\nx = 0.5\ny = 0.25\nheading_deg = 10.0\nbeam_deg = 50.0\nrange_offset = 0.125\n" in text


@pytest.mark.parametrize("text", [CIRCLE.replace("count = 12", "count = 3"), BUMPER])
def test_names_of_sensors_in_bags_are_kept(tmp_path, text):
    names = ["topic = '/robot/us_left'", "", "frame = '/us_right'"]
    expected = ["/robot/us_left", "", "us_right"]
    parts = (text if "[[sensor]]" in text else text + "[[sensor]]\n" * 3).split("[[sensor]]\n")
    named = parts[0] + "".join(f"[[sensor]]\n{name}\n{part}" for name, part in zip(names, parts[1:], strict=False))
    ring = read(named)
    assert ring.names == tuple(expected[: ring.count])
    save_ring(ring, tmp_path / "ring.toml")
    assert_same(load_ring(tmp_path / "ring.toml"), ring)
    assert load_ring(tmp_path / "ring.toml").names == ring.names
    assert ring_toml(dataclasses.replace(ring, names=())) == ring_toml(read(text))


def test_other_toml_notations_of_the_same_ring():
    ring = read(CIRCLE)
    for text in (
        CIRCLE.replace("340.0", "340").replace("15.0", "15"),
        b"\xef\xbb\xbf" + CIRCLE.encode(),
        CIRCLE.replace("\n", "\r\n"),
        CIRCLE + '[calibration]\nlogs = ["a.csv"]\nresidual = nan\n',
    ):
        assert_same(read(text), ring)


@pytest.mark.parametrize("text", [CIRCLE, BUMPER])
def test_every_key_except_the_optional_ones_is_required(text):
    lines = text.splitlines(keepends=True)
    for k, line in enumerate(lines):
        key = line.partition(" ")[0].strip()
        rest = "".join(lines[:k] + lines[k + 1 :])
        if key in ("speed_of_sound", "range_offset"):
            read(rest)
        elif "=" in line:
            assert f"{key} is missing; needed is " in refused(rest)


@pytest.mark.parametrize(
    ("text", "old", "new", "message"),
    [
        (CIRCLE, "beam_deg = 45.0", "beam_deg = 0", "ring.beam_deg: 0 came; allowed is a number above 0 and up to 180"),
        (CIRCLE, "beam_deg = 45.0", "beam_deg = 180.1", "ring.beam_deg: 180.1 came; allowed is a number above 0"),
        (CIRCLE, "beam_deg = 45.0", "beam_deg = nan", "ring.beam_deg: nan came; allowed is a number above 0"),
        (CIRCLE, "beam_deg = 45.0", "beam_deg = '45'", "ring.beam_deg: '45' came; allowed is a number above 0"),
        (
            CIRCLE,
            "beam_deg = 45.0",
            "beam = 45.0\nbeam_deg = 45.0",
            "unknown key ring.beam; allowed in [ring] are count,",
        ),
        (CIRCLE, "15.0", "inf", "ring.first_heading_deg: inf came; allowed is a finite number (degrees"),
        (CIRCLE, "15.0", "true", "ring.first_heading_deg: True came; allowed is a finite number (degrees"),
        (CIRCLE, "count = 12", "count = 0", "ring.count: 0 came; allowed is a whole number from 1 to 10000"),
        (CIRCLE, "count = 12", "count = 12.0", "ring.count: 12.0 came; allowed is a whole number"),
        (CIRCLE, "count = 12", "count = 99999999999999999999", "ring.count: 99999999999999999999 came; allowed is"),
        (CIRCLE, "radius = 0.25", "radius = -0.25", "ring.radius: -0.25 came; allowed is a finite number, 0 or more"),
        (CIRCLE, "neighbors = 2", "neighbors = 12", "ring.neighbors: 12 came; allowed is 0 to 11 with 12 sensors"),
        (CIRCLE, "neighbors = 2", "neighbors = -1", "ring.neighbors: -1 came; allowed is a whole number, 0 or more"),
        (CIRCLE, "max_range = 3.5", "max_range = 0", "ring.max_range: 0 came; allowed is a finite number above 0 (m)"),
        (CIRCLE, "340.0", "0", "speed_of_sound: 0 came; allowed is a finite number above 0 (m/s)"),
        (CIRCLE, '"round"', "7", "name: 7 came; allowed is a text"),
        (CIRCLE, "name", "label", "unknown key label; allowed outside of tables are name, speed_of_sound, ring,"),
        (CIRCLE, "[ring]", "[rings]", "unknown key rings; allowed outside of tables are name, speed_of_sound, ring,"),
        (CIRCLE, "[ring]", "", "unknown key "),
        (CIRCLE, "[ring]", "[[ring]]", "ring: [{"),
        (CIRCLE, "[ring]", "[array]\nneighbors = 0\nmax_range = 1.0\n[ring]", "both [ring] and [array] came"),
        (
            CIRCLE,
            "[ring]",
            BUMPER[BUMPER.index("[[") :] + "[ring]",
            "unknown key sensor[0].x; allowed in [[sensor]] beside [ring] are frame, topic",
        ),
        (
            CIRCLE,
            "[ring]",
            "[[sensor]]\nframe = 'us0'\n[ring]",
            "1 [[sensor]] came beside [ring]; allowed is one for each of its 12 sensors, or none",
        ),
        (
            CIRCLE,
            "[ring]",
            "[[sensor]]\nframe = 'us0'\n" * 12 + "[ring]",
            "ring: the name us0 came twice; allowed is one sensor for each name",
        ),
        (CIRCLE, "[ring]", "[[sensor]]\nframe = 7\n[ring]", "sensor[0].frame: 7 came; allowed is a text, the frame or"),
        (BUMPER, "x = 0.5", "topic = '/'\nx = 0.5", "sensor[0].topic: '/' came; allowed is a text, the frame or the"),
        (
            BUMPER,
            "x = 0.5",
            "topic = '/us'\nframe = 'us'\nx = 0.5",
            "sensor[0]: frame and topic came; allowed is one of them",
        ),
        (
            CIRCLE,
            CIRCLE[CIRCLE.index("[ring]") :],
            "",
            "neither [ring] nor [array] came; allowed is [ring], or [array]",
        ),
        (CIRCLE, CIRCLE, "", "name is missing"),
        (CIRCLE, "= 12", "= = 12", "no TOML: Invalid value (at line 4, column 9)"),
        (CIRCLE, "= 12", "= 12\ncount = 12", "no TOML: Cannot overwrite a value"),
        (CIRCLE, '"round"', "[" * 5000, "no TOML: "),
        (BUMPER, BUMPER[BUMPER.index("[[") :], "", "sensor is missing; allowed with [array] is one [[sensor]] each"),
        (BUMPER, "neighbors = 1", "neighbors = 2", "array.neighbors: 2 came; allowed is 0 to 1 with 2 sensors"),
        (
            BUMPER,
            "neighbors = 1",
            "count = 2\nneighbors = 1",
            "unknown key array.count; allowed in [array] are neighbors,",
        ),
        (BUMPER, "y = -0.375", "y = nan", "sensor[1].y: nan came; allowed is a finite number (m)"),
        (BUMPER, "y = -0.375", "y = 'left'", "sensor[1].y: 'left' came; allowed is a finite number (m)"),
        (BUMPER, "beam_deg = 40.0", "beam_deg = 400.0", "sensor[1].beam_deg: 400.0 came; allowed is a number above 0"),
        (
            BUMPER,
            "beam_deg = 50.0",
            "z = 1.0\nbeam_deg = 50.0",
            "unknown key sensor[0].z; allowed in [[sensor]] are x, y,",
        ),
        (BUMPER, "0.125", "-inf", "sensor[0].range_offset: -inf came; allowed is a finite number (m)"),
    ],
)
def test_an_invalid_key_is_named(text, old, new, message):
    assert old in text
    assert message in refused(text.replace(old, new))


@given(st.binary(max_size=40) | st.text(max_size=40).map(str.encode))
def test_arbitrary_bytes_raise_a_one_line_error(garbage):
    for text in (garbage, CIRCLE.encode() + garbage.replace(b"#", b"=") + b"="):
        refused(text)


def test_shipped_rings_load_by_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert set(shipped_rings()) == {"bumper4", "corridor8", "faw", "scitos24", "sew-amr"}
    for name in shipped_rings():
        ring = load_ring(name)
        assert_same(saved(ring)[1], ring)
    assert_same(load_ring("faw"), Ring.circular(name="FAW ring"))
    (tmp_path / "faw").write_text(CIRCLE)  # a file of that name has priority
    assert load_ring("faw").name == "round"


def test_the_shipped_rings_have_the_paths_of_their_devices():
    closed = {name: load_ring(name).closed for name in shipped_rings()}
    assert closed == {"bumper4": False, "corridor8": False, "faw": True, "scitos24": True, "sew-amr": False}
    for name in ("corridor8", "scitos24"):
        ring = load_ring(name)
        np.testing.assert_array_equal(ring.paths, np.column_stack([np.arange(ring.count)] * 2))
    # All pairs, in the order in which they were before arrays could be open.
    every = [(tx, (tx + offset) % 4) for offset in (0, 1, 3, 2) for tx in range(4)]
    for name in ("sew-amr", "bumper4"):
        assert [tuple(pair) for pair in load_ring(name).paths.tolist()] == every
        assert [list(group) for group in load_ring(name).firing_groups] == [[0], [1], [2], [3]]


def test_the_bumper_is_a_line_of_sensors_that_face_forward():
    ring = load_ring("bumper4")
    np.testing.assert_allclose(np.diff(ring.position, axis=0), [[0, 0.45]] * 3, atol=1e-12)
    np.testing.assert_allclose(ring.position.mean(axis=0), [0.3, 0], atol=1e-12)
    np.testing.assert_array_equal(ring.heading, 0)
    np.testing.assert_allclose(np.degrees(ring.beam), 120)


@pytest.mark.parametrize("closed", [True, False])
def test_an_array_can_be_closed_or_open_whatever_its_geometry(closed):
    file = BUMPER.replace("neighbors = 1", f"neighbors = 1\nclosed = {str(closed).lower()}")
    ring = read(file)
    assert ring.closed is closed
    assert_same(saved(ring)[1], ring)
    # A circular ring without [ring], such as a calibrated one.
    around = dataclasses.replace(Ring.circular(count=6, neighbors=1), closed=closed, range_offset=0.1 * np.ones(6))
    tables, again = saved(around)
    assert tables["array"]["closed"] is closed
    assert_same(again, around)


def test_headings_of_the_recorded_rings():
    degrees = np.degrees(np.asarray(load_ring("corridor8").heading))
    np.testing.assert_allclose(degrees, [-90, -37.5, -22.5, -7.5, 7.5, 22.5, 37.5, 90])
    position = np.asarray(load_ring("corridor8").position)
    np.testing.assert_allclose(np.hypot(*position.T), 0.19, atol=1e-6)
    np.testing.assert_allclose(np.degrees(np.arctan2(position[:, 1], position[:, 0])), degrees, atol=1e-3)
    np.testing.assert_allclose(np.degrees(np.asarray(load_ring("scitos24").heading)), -180 + 15 * np.arange(24))


def test_names_of_the_shipped_rings():
    from jaxsonar.sensors.ring_toml import DATA

    for name in shipped_rings():
        assert (DATA / f"ring-{name}.toml").read_text().startswith("# ")


@pytest.mark.parametrize("name", ["fow", "missing.toml", "two\nlines", "nul\0", ""])
def test_a_missing_ring_raises_an_error(name):
    with pytest.raises(SonarError) as caught:
        load_ring(name)
    assert str(caught.value).isprintable()
    assert "corridor8, faw, scitos24, sew-amr" in str(caught.value)


def test_a_folder_raises_an_error(tmp_path):
    with pytest.raises(SonarError, match="Is a directory; needed is a readable file with a ring"):
        load_ring(tmp_path)


def test_a_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
    file = tmp_path / "ring.toml"
    save_ring(Ring.circular(), file)
    before = file.read_text()
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(SonarError, match=r"ring.toml: cannot write: No space left on device"):
        save_ring(Ring.circular(count=8), file)
    assert file.read_text() == before
    assert list(tmp_path.iterdir()) == [file]


def test_the_detections_of_a_calibration_are_read_and_anything_else_is_not(tmp_path):
    file = tmp_path / "ring.toml"
    save_ring(Ring.circular(count=8, neighbors=0), file)
    plain = file.read_text()
    assert load_detection(file) is None
    assert load_detection("faw") is None
    model = "\n[calibration.echo_model]\noff_axis_deg = [0.0, 5.0, 10.0]\nexpected = [40, 20]\nheard = [39, 12]\n"
    file.write_text(plain + model)
    found = load_detection(file)
    assert found is not None
    np.testing.assert_allclose(found.off_axis, np.radians([0, 5, 10]))
    assert (found.expected.tolist(), found.heard.tolist()) == ([40, 20], [39, 12])
    for other in (
        model.replace("10.0", "5.0"),
        model.replace(", 12", ""),
        model.replace("39", '"many"'),
        model.replace("heard", "h"),
    ):
        file.write_text(plain + other)
        assert load_detection(file) is None

"""Readers of published data sets: counts, units and frames are right, and a malformed row is named."""

import math

import numpy as np
import pytest
from support.recordings import recorded, refused

from jaxsonar.hardware.datasets import read_corridor8, read_scitos24, read_sew_amr
from jaxsonar.sensors.ring_toml import load_ring


def dense(recording, sensors):
    """(scans, sensors) ranges in metres, NaN without an echo. Every sensor has one reading a scan."""
    assert len(recording.range) == len(recording.stamp) * sensors
    np.testing.assert_array_equal(recording.tx, recording.rx)
    table = np.zeros((len(recording.stamp), sensors))
    table[recording.scan_index, recording.tx] = recording.range
    return table


# ---- corridor8


@pytest.fixture
def corridor8(tmp_path):
    """Two scans with a distinct value for each field."""
    (tmp_path / "measurement.txt").write_text(
        "1000 110 120 130 140 5110 160 170 180\n1250 210 5110 230 240 250 260 270 5100\n"
    )
    (tmp_path / "poses.txt").write_text("1000 1500 -2500 900\n1250 1600 -2600 2700\n")
    return tmp_path


def test_corridor8_is_read_in_si_units(corridor8):
    heard = read_corridor8(corridor8)
    nan = math.nan
    expected = [[0.11, 0.12, 0.13, 0.14, nan, 0.16, 0.17, 0.18], [0.21, nan, 0.23, 0.24, 0.25, 0.26, 0.27, 5.1]]
    np.testing.assert_allclose(dense(heard, 8), expected)
    np.testing.assert_array_equal(heard.tx, heard.rx)
    np.testing.assert_allclose(heard.stamp, [1.0, 1.25])
    np.testing.assert_allclose(heard.pose, [[1.5, -2.5, np.pi / 2], [1.6, -2.6, -np.pi / 2]])
    assert not heard.age.any()


def test_corridor8_renews_a_reading_in_every_second_row(corridor8):
    readings = {1000: 300, 1200: 300, 1450: 300, 1600: 300, 1900: 310, 2000: 300, 2500: 5110, 2700: 5110}
    others = " ".join(str(100 * (k + 1)) for k in range(7))
    rows = [f"{t} {value} {others}\n" for t, value in readings.items()]
    (corridor8 / "measurement.txt").write_text("".join(rows))
    (corridor8 / "poses.txt").write_text("".join(f"{t} 0 0 0\n" for t in readings))
    age = read_corridor8(corridor8).age.reshape(-1, 8)
    np.testing.assert_allclose(age[:, 0], [0, 0.2, 0, 0.15, 0, 0, 0, 0.2], atol=1e-12)
    np.testing.assert_allclose(age[:, 1], [0, 0.2, 0, 0.15, 0, 0.1, 0, 0.2], atol=1e-12)


@pytest.mark.parametrize(("tenths", "degrees"), [(0, 0), (1799, 179.9), (1800, -180), (1801, -179.9), (3600, 0)])
def test_corridor8_headings_wrap(corridor8, tenths, degrees):
    (corridor8 / "poses.txt").write_text(f"1000 0 0 {tenths}\n1250 0 0 0\n")
    theta = read_corridor8(corridor8).pose[0, 2]
    assert theta == pytest.approx(math.radians(degrees), abs=1e-12)
    assert -np.pi <= theta < np.pi


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("measurement.txt", " 230 ", " 2e0x ", "row 2, column range 2: '2e0x' came; allowed is a finite number"),
        ("measurement.txt", " 230 ", " nan ", "row 2, column range 2: 'nan' came; allowed is a finite number"),
        ("measurement.txt", " 230 ", " -230 ", "row 2, column range 2: '-230' came; allowed is a range above 0"),
        (
            "measurement.txt",
            " 180\n",
            " 5120\n",
            "row 1, column range 7: '5120' came; allowed is a range above 0 and up",
        ),
        ("measurement.txt", " 180\n", "\n", "row 1: 8 columns came; allowed are 9: t_ms, range 0, range 1"),
        ("measurement.txt", "1250", "1000", "row 2, column t_ms: '1000' came; allowed is a later time"),
        ("poses.txt", "1250", "1251", "row 2, column t_ms: '1251' came; allowed is the time in the same row of measu"),
        ("poses.txt", "1250 1600 -2600 2700\n", "", "1 rows beside 2 in measurement.txt came"),
        ("poses.txt", "2700", "3601", "row 2, column heading: '3601' came; allowed is 0 to 3600"),
        ("poses.txt", "-2600", "\0", "row 2, column y_mm: '\\x00' came; allowed is a finite number"),
    ],
)
def test_a_malformed_corridor8_row_is_named(corridor8, file, old, new, message):
    text = (corridor8 / file).read_text()
    assert old in text
    (corridor8 / file).write_text(text.replace(old, new))
    assert f"/{file}: {message}" in refused(read_corridor8, corridor8)


def test_the_published_corridor8_is_read():
    folder = recorded("corridor8")
    heard = read_corridor8(folder)
    columns = np.loadtxt(folder / "measurement.txt")
    assert len(heard.stamp) == len(columns) == 413
    np.testing.assert_allclose(heard.stamp[[0, -1]], columns[[0, -1], 0] / 1000)
    assert np.isfinite(heard.range).sum() == (columns[:, 1:] != 5110).sum()
    assert 0.4 < (heard.age > 0).mean() < 0.5
    assert heard.stamp[-1] - heard.stamp[0] == pytest.approx(93, abs=0.5)
    np.testing.assert_allclose(np.nan_to_num(dense(heard, 8), nan=5.11), columns[:, 1:] / 1000)
    steps = np.hypot(*np.diff(heard.pose[:, :2], axis=0).T)
    assert steps.sum() == pytest.approx(25, abs=1)  # metres of corridor
    forward = np.einsum("ij,ij->i", np.diff(heard.pose[:, :2], axis=0), _direction(heard.pose[:-1, 2]))
    assert forward.sum() > 0.9 * steps.sum()  # it drives forward: headings are counter-clockwise radians
    np.testing.assert_array_equal(read_corridor8(folder / "measurement.txt").range, heard.range)


def _direction(theta):
    return np.stack([np.cos(theta), np.sin(theta)], axis=-1)


def test_corridor8_side_sensors_see_parallel_walls():
    """The laser saw walls with normals 91.4 and 270.0 deg, 1.220 and 1.083 m from the start."""
    heard = read_corridor8(recorded("corridor8"))
    ring = load_ring("corridor8")
    position, heading = np.asarray(ring.position), np.asarray(ring.heading)
    for sensor, normal, distance in ((0, 270.0, 1.083), (7, 91.4, 1.220)):
        of_sensor = (heard.tx == sensor) & (heard.range < 2)
        pose, reach = heard.pose[heard.scan_index[of_sensor]], heard.range[of_sensor]
        cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        mount = np.stack([cos, -sin, sin, cos], axis=-1).reshape(-1, 2, 2) @ position[sensor]
        foot = pose[:, :2] + mount + reach[:, None] * _direction(pose[:, 2] + heading[sensor])
        assert np.median(foot @ _direction(np.radians(normal))) == pytest.approx(distance, abs=0.1)


# ---- scitos24


@pytest.fixture
def scitos24(tmp_path):
    """Three scans; sensor k reads 0.1 (k + 1) m plus the scan's number, if that is below 5 m."""
    header = ",".join([*(f"S{k}" for k in range(1, 25)), "OUTPUT"])
    rows = [",".join([*(f"{0.1 * k + scan:.3f}" for k in range(1, 25)), "Move-Forward"]) for scan in (0, 1, 4)]
    (tmp_path / "sensor_readings_24.data").write_text("\n".join([header, *rows, ""]))
    return tmp_path


def test_scitos24_in_metres_at_9_hz(scitos24):
    heard = read_scitos24(scitos24)
    expected = 0.1 * np.arange(1, 25) + np.array([[0.0], [1.0], [4.0]])
    expected = np.where(expected > 4.999, np.nan, expected)  # 5.000 means no echo
    np.testing.assert_allclose(dense(heard, 24), expected)
    np.testing.assert_allclose(heard.stamp, [0, 1 / 9, 2 / 9])
    assert np.isnan(heard.pose).all()
    assert heard.pose.shape == (3, 3)
    assert not heard.age.any()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("1.300", "far", "row 2, column S13: 'far' came; allowed is a finite number"),
        ("1.300", "inf", "row 2, column S13: 'inf' came; allowed is a finite number"),
        ("1.300", "-1.3", "row 2, column S13: '-1.3' came; allowed is a range above 0 m"),
        ("1.300,", "", "row 2: 24 columns came; allowed are 25: S1 to OUTPUT"),
        ("S1,S2", "S2,S1", "row 1: 'S2,S1"),
    ],
)
def test_a_malformed_scitos24_row_is_named(scitos24, old, new, message):
    file = scitos24 / "sensor_readings_24.data"
    file.write_text(file.read_text().replace(old, new))
    assert f"/{file.name}: {message}" in refused(read_scitos24, file)


def test_the_published_scitos24_is_read():
    heard = read_scitos24(recorded("scitos24"))
    assert len(heard.stamp) == 5456
    assert heard.stamp[-1] == pytest.approx(5455 / 9)
    assert np.isnan(heard.range).mean() == pytest.approx(0.138, abs=5e-4)  # no echo
    assert np.nanmax(heard.range) < 5.0


def test_scitos24_front_left_and_right_are_where_the_ring_says():
    """The minima over sectors that the set contains agree with bearings S_k = -180 + 15 (k - 1) deg."""
    folder = recorded("scitos24")
    bearing = np.degrees(np.asarray(load_ring("scitos24").heading))
    minima = np.loadtxt(folder / "sensor_readings_4.csv", delimiter=",", usecols=(0, 1, 2))
    ranges = np.nan_to_num(dense(read_scitos24(folder), 24), nan=np.inf)
    for column, (low, high) in enumerate([(-30, 30), (75, 105), (-120, -60)]):
        nearest = ranges[:, (bearing > low - 1) & (bearing < high + 1)].min(axis=1)
        silent = minima[:, column] >= 5.0
        np.testing.assert_array_equal(np.isinf(nearest), silent)
        np.testing.assert_allclose(nearest[~silent], minima[~silent, column], atol=1e-9)


# ---- SEW AMR


def sew_text(messages):
    """``dist.csv`` of messages {(tx, rx): [(start, end), ...]} in mm."""
    lines = ["rx0,rx1,rx2,rx3"]
    for message in messages:
        table = np.full((4, 12, 4), 65535)
        for (tx, rx), objects in message.items():
            table[tx, : 2 * len(objects), rx] = np.ravel(objects)
        lines += [",".join(map(str, row)) for row in table.reshape(48, 4)]
    return "\n".join([*lines, ""])


# each start is a distinct number: 1000 (message + 1) + 100 tx + 10 rx + object
MESSAGES = [
    {
        (tx, rx): [(1000 * (n + 1) + 100 * tx + 10 * rx + k, 1000 * (n + 1) + 500) for k in range((tx + rx + n) % 7)]
        for tx in range(4)
        for rx in range(4)
    }
    for n in range(12)
]


def echoes(messages):
    """The expected readings, in order of scan, tx, rx, object; None where a path heard nothing."""
    return [
        (n, tx, rx, None if begin is None else begin / 1000)
        for n, message in enumerate(messages)
        for (tx, rx), pairs in message.items()
        for begin, _ in pairs or [(None, None)]
    ]


def test_starts_of_sew_objects_are_the_echoes_of_each_path(tmp_path):
    (tmp_path / "dist.csv").write_text(sew_text(MESSAGES))
    heard = read_sew_amr(tmp_path / "dist.csv")
    columns = (heard.scan_index, heard.tx, heard.rx, heard.range)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    assert [(n, tx, rx, None if math.isnan(metres) else metres) for n, tx, rx, metres in rows] == echoes(MESSAGES)
    assert not heard.age.any()
    np.testing.assert_allclose(heard.stamp, 0.1 * np.arange(12))
    assert np.isnan(heard.pose).all()


def test_sew_folder_is_read_in_the_order_of_its_numbers(tmp_path):
    for n, message in enumerate(MESSAGES):  # message 10 after message 9, not after message 1
        folder = tmp_path / f"pub_{n}"
        folder.mkdir()
        (folder / "dist.csv").write_text(sew_text([message]).replace("\n", "\r\n"))
        (folder / "temperature.csv").write_text("not ours\n")
    (tmp_path / "dist.csv").write_text(sew_text(MESSAGES))
    whole = read_sew_amr(tmp_path / "dist.csv")
    (tmp_path / "dist.csv").unlink()
    parts = read_sew_amr(tmp_path)
    for name in ("stamp", "scan_index", "tx", "rx", "range"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))


def test_the_sew_ring_corrects_the_range_offsets():
    ring = load_ring("sew-amr")
    tx, rx = np.array([0, 0, 3]), np.array([0, 3, 1])
    metres = ring.corrected(np.array([1.252, 1.2545, 1.2565]), tx, rx)
    np.testing.assert_allclose(metres, 1.0)
    np.testing.assert_allclose(np.asarray(ring.position)[:, 1], [-0.266, 0.089, -0.089, 0.266])
    assert len(ring.paths) == 16  # every sensor receives all others


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: lines[:-1], "47 rows below the header came; allowed are 48 a message"),
        (lambda lines: lines[:1], "0 rows below the header came; allowed are 48 a message"),
        (lambda lines: lines[1:], "row 1: '65535,1010,1020,1030' came; allowed is a header of 4 column names"),
        (lambda lines: [lines[0], "1,2,3", *lines[2:]], "row 2: 3 columns came; allowed are 4"),
        (lambda lines: [lines[0], "1,2,near,4", *lines[2:]], "row 2, column rx2 (rx 2): 'near' came"),
        (lambda lines: [lines[0], "1,0,3,4", *lines[2:]], "row 2, column rx1 (rx 1): '0' came; allowed is above 0"),
        (lambda lines: [lines[0], "1,2,3,65536", *lines[2:]], "row 2, column rx3 (rx 3): '65536' came"),
        (lambda lines: [], "row 1: nothing came"),
    ],
)
def test_a_malformed_sew_row_is_named(tmp_path, change, message):
    lines = sew_text(MESSAGES[:1]).splitlines()
    (tmp_path / "dist.csv").write_text("".join(f"{line}\n" for line in change(lines)))
    assert f"/dist.csv: {message}" in refused(read_sew_amr, tmp_path)


# ---- all of them


@pytest.mark.parametrize("reader", [read_corridor8, read_scitos24, read_sew_amr])
def test_a_missing_recording_is_named(reader, tmp_path):
    assert "No such file or directory" in refused(reader, tmp_path / "missing")
    assert str(tmp_path) in refused(reader, tmp_path)
    (tmp_path / "picture").write_bytes(b"\x89PNG\xff\xfe")
    assert "this is no text" in refused(reader, tmp_path / "picture")

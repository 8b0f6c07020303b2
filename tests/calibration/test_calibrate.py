"""Calibration of rings from ordinary scans: what is found is true within what is said of it; its files and figures."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest

from jaxsonar import Log, Ring, SonarError, calibrate, load_ring, save_calibration, simulate
from jaxsonar.calibration.calibration_result import Calibration
from jaxsonar.geometry.se2 import compose, inverse, relative, wrap_angle
from jaxsonar.reports.plot_calibration import calibration_figure
from jaxsonar.sensors.ring import speed_of_sound
from jaxsonar.sensors.ring_parameters import PARAMETERS, PRIOR, check_parameters, parameter_basis
from jaxsonar.simulation.office import load_office

SIGMA = 0.001
COUNT = 24
FASTER = 1.01
TURNED, BY = 7, np.radians(15.0)
WIDER = 0.005
Z = 4.0  # standard deviations; of 24 sensors one in 700 seeds is beyond


def heard(ring, seed=3, **options):
    """What a ring hears in the office, with the true poses."""
    office = load_office()
    options = {"sigma": SIGMA, "seed": seed, "stamps": office.stamps, **options}
    return simulate(ring, office.room, office.poses, **options).as_log(ring, office.poses)


@pytest.fixture(scope="module")
def nominal():
    return load_office().ring


@pytest.fixture(scope="module")
def true(nominal):
    """Offsets of 5 mm, 0 in the mean, and a speed of sound 1 % higher."""
    offset = np.random.default_rng(101).normal(0, 0.005, COUNT)
    return replace(nominal, range_offset=offset - offset.mean(), speed_of_sound=FASTER * nominal.speed_of_sound)


@pytest.fixture(scope="module")
def log(true):
    return heard(true)


@pytest.fixture(scope="module")
def found(nominal, log):
    return calibrate(nominal, log)


# With one mode only nothing is sharpened, and all of these are of one shape.


@pytest.fixture(scope="module")
def speed(nominal):
    """Only the speed of sound is wrong, and free."""
    faster = replace(nominal, speed_of_sound=FASTER * nominal.speed_of_sound)
    log = heard(faster, seed=5)
    return log, faster, calibrate(nominal, log, free=("speed",))


@pytest.fixture(scope="module")
def wider(nominal):
    """A ring of a larger radius than was thought."""
    true = Ring.circular(radius=0.28 + WIDER)
    return calibrate(nominal, heard(true, seed=8), free=("radius",))


@pytest.fixture(scope="module")
def turned(nominal):
    """One sensor looks 15 deg to the left of where it should."""
    heading = np.array(nominal.heading)
    heading[TURNED] += BY
    return calibrate(nominal, heard(replace(nominal, heading=heading), seed=9), free=("heading",))


@pytest.fixture(scope="module")
def odometry(log):
    """The way as odometry has it that slips by 2 %."""
    rng, poses = np.random.default_rng(4), log.pose
    steps = relative(poses[:-1], poses[1:])
    way = np.hypot(steps[:, 0], steps[:, 1])[:, None]
    steps[:, :2] += 0.02 * way * rng.standard_normal((len(steps), 2))
    steps[:, 2:] += 0.02 * (np.abs(steps[:, 2:]) + 0.5 * way) * rng.standard_normal((len(steps), 1))
    way = [poses[0]]
    for step in steps:
        way.append(compose(way[-1], step))
    return np.array(way)


@pytest.fixture(scope="module")
def estimated(nominal, log, odometry):
    """Odometry instead of poses."""
    return calibrate(nominal, replace(log, pose=odometry), poses="estimate")


def relative_offsets(ring, true):
    """How far the offsets are off, their mean left out."""
    error = np.asarray(ring.range_offset) - np.asarray(true.range_offset)
    return error - error.mean()


def known_to(found: Calibration, count=COUNT):
    """The laws of every result."""
    covariance = found.covariance
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-12 * covariance.max())
    assert np.linalg.eigvalsh((covariance + covariance.T) / 2).min() >= -1e-9 * covariance.max()
    assert covariance.shape == (3 * count + 1,) * 2
    assert len(found.residuals) == len(found.residuals_before) <= found.echoes
    assert found.rms <= found.rms_before * (1 + 1e-9)
    for name, rows in {"offset": slice(count), "speed": slice(count, count + 1)}.items():
        assert (np.diag(covariance)[rows] > 0).all() == (name in found.free)
    for name in ("position", "heading", "beam"):
        free = {"position", "radius"} if name == "position" else {name}
        if not free & set(found.free):
            np.testing.assert_array_equal(getattr(found.ring, name), getattr(found.nominal, name))
    if "offset" not in found.free:
        np.testing.assert_array_equal(found.ring.range_offset, found.nominal.range_offset)


# What may change


@pytest.mark.slow
@pytest.mark.parametrize("poses_free", [False, True])
def test_offset_modes_move_no_mean_and_have_the_spread_that_is_expected(nominal, poses_free):
    modes = parameter_basis(nominal, PARAMETERS, poses_free=poses_free, speed_sd=0.02)
    assert modes.columns.shape == (3 * COUNT + 1, len(modes.names))
    of = {name: modes.columns[:, [name == other for other in modes.names]] for name in set(modes.names)}
    np.testing.assert_allclose(of["offset"][:COUNT].sum(axis=0), 0, atol=1e-15)
    spread = {name: np.sqrt((columns**2).sum(axis=1)) for name, columns in of.items()}
    np.testing.assert_allclose(
        np.hypot(spread["offset"], spread["mean"])[:COUNT] ** 2,
        PRIOR.offset_sd**2 * (1 - 1 / COUNT) + PRIOR.offset_sd**2,
        rtol=1e-12,
    )
    np.testing.assert_allclose(spread["speed"][COUNT], 0.02)
    outward = modes.columns[COUNT + 1 :, modes.names.index("radius")].reshape(-1, 2)
    np.testing.assert_allclose(np.linalg.norm(outward, axis=1), PRIOR.radius_sd)
    freedoms = 2 * COUNT - 3 * poses_free
    np.testing.assert_allclose((of["position"] ** 2).sum(), freedoms * PRIOR.position_sd**2)
    assert np.linalg.matrix_rank(of["position"]) == freedoms


def test_with_free_poses_no_mode_is_a_motion_of_the_robot():
    """Sensors anywhere: what all do together is no change of the ring."""
    place = np.random.default_rng(2).uniform(-0.5, 0.5, (7, 2))
    ring = Ring(place, np.zeros(7), beam=1.0, neighbors=1, max_range=2.0)
    columns = parameter_basis(ring, ("position",), poses_free=True, speed_sd=0.01).columns[8:]
    around = np.stack([-place[:, 1], place[:, 0]], axis=1)
    for motion in (np.tile([1.0, 0.0], (7, 1)), np.tile([0.0, 1.0], (7, 1)), around):
        np.testing.assert_allclose(motion.ravel() @ columns, 0, atol=1e-15)
    # What is no motion stays: the projector is one.
    np.testing.assert_allclose(columns @ columns, PRIOR.position_sd * columns, atol=1e-17)


@pytest.mark.slow
def test_modes_that_are_held_leave_the_shape(nominal):
    modes = parameter_basis(nominal, ("offset", "speed"), poses_free=False, speed_sd=0.01)
    held = modes.only("offset")
    assert held.columns.shape == modes.columns.shape
    np.testing.assert_array_equal(held.columns[:, :COUNT], modes.columns[:, :COUNT])
    np.testing.assert_array_equal(held.columns[:, COUNT:], 0)


@pytest.mark.slow
def test_what_cannot_be_free_is_refused(nominal):
    with pytest.raises(SonarError, match="free 'temper'; allowed are offset, speed, position, radius, heading"):
        check_parameters(("offset", "temper"))
    with pytest.raises(SonarError, match="nothing came"):
        check_parameters(())
    lone = Ring(np.zeros((2, 2)), [0.0, 1.0], beam=1.0, neighbors=1, max_range=2.0)
    with pytest.raises(SonarError, match="all sensors are in one place"):
        parameter_basis(lone, ("radius",), poses_free=False, speed_sd=0.01)


# Offsets and speed


@pytest.mark.slow
def test_offsets_and_speed_are_found_within_what_is_said_of_them(found, true):
    error = relative_offsets(found.ring, true)
    assert np.abs(error / found.range_offset_sd).max() < Z
    assert np.sqrt(np.mean(error**2)) < 0.0006
    assert abs(float(found.ring.speed_of_sound - true.speed_of_sound)) < Z * found.speed_of_sound_sd
    assert found.speed_of_sound_sd < 0.001 * true.speed_of_sound
    assert np.sqrt(np.mean(found.range_offset_sd**2)) < 0.0005
    known_to(found)


@pytest.mark.slow
def test_residuals_are_the_noise(found):
    assert found.rms == pytest.approx(SIGMA, rel=0.15)
    assert found.sigma == pytest.approx(SIGMA, rel=0.15)
    assert found.rms_before > 2 * SIGMA
    assert len(found.residuals) > 0.8 * found.echoes
    assert abs(np.mean(found.residuals)) < 0.2 * SIGMA


@pytest.mark.slow
def test_the_mean_offset_is_known_or_held_with_a_reason(found, true):
    mean = float(np.mean(found.ring.range_offset) - np.mean(true.range_offset))
    if "mean_offset" in found.held:
        assert found.mean_offset_sd == 0
        np.testing.assert_allclose(np.mean(found.ring.range_offset), np.mean(found.nominal.range_offset), atol=1e-12)
        assert "wall" in found.held["mean_offset"]
    else:
        assert 0 < found.mean_offset_sd <= 0.001
        assert abs(mean) < Z * found.mean_offset_sd


@pytest.mark.slow
def test_a_moved_and_turned_world_gives_the_same_ring(found, nominal, log):
    motion = np.array([3.0, -7.0, 2.3])
    again = calibrate(nominal, replace(log, pose=compose(motion, log.pose)))
    np.testing.assert_allclose(relative_offsets(again.ring, found.ring), 0, atol=5e-5)
    assert float(again.ring.speed_of_sound) == pytest.approx(float(found.ring.speed_of_sound), abs=0.02)
    back = compose(inverse(motion), again.poses[0])
    np.testing.assert_allclose(back[:, :2], found.poses[0][:, :2], atol=1e-9)


@pytest.mark.slow
def test_what_was_found_is_found_again_from_there(found, log):
    """The result does not depend on where it began, but for what is expected of offsets: 3 cm."""
    again = calibrate(found.ring, log)
    np.testing.assert_allclose(relative_offsets(again.ring, found.ring), 0, atol=5e-5)
    assert float(again.ring.speed_of_sound) == pytest.approx(float(found.ring.speed_of_sound), abs=0.02)
    assert again.rms_before == pytest.approx(again.rms, rel=0.02)


@pytest.mark.slow
def test_two_logs_tell_as_much_as_one(found, nominal, log):
    """Every other scan in a log of its own: two worlds with fewer echoes each, so a little less is known."""
    again = calibrate(nominal, [log[::2], log[1::2]])
    assert again.scans == found.scans
    assert again.echoes == found.echoes
    assert len(again.maps) == len(again.poses) == 2
    spread = np.hypot(again.range_offset_sd, found.range_offset_sd)
    assert np.abs(relative_offsets(again.ring, found.ring) / spread).max() < Z
    known_to(again)


# One at a time


@pytest.mark.slow
def test_the_speed_of_sound_is_found(speed):
    _, true, found = speed
    assert abs(float(found.ring.speed_of_sound - true.speed_of_sound)) < Z * found.speed_of_sound_sd
    assert found.speed_of_sound_sd < 0.0005 * true.speed_of_sound
    known_to(found)


@pytest.mark.slow
def test_a_thermometer_is_one_more_measurement(nominal, speed):
    """One that is 3 K off: precisions add up, and the result is the mean weighed by them."""
    log, true, free = speed
    temperature = 273.15 * ((float(true.speed_of_sound) / 331.3) ** 2 - 1) + 3.0
    told = calibrate(nominal, log, free=("speed",), temperature=temperature)
    logs = [np.log(float(speed)) for speed in (free.ring.speed_of_sound, nominal.speed_of_sound)]
    weight = (free.ring.speed_of_sound / free.speed_of_sound_sd) ** 2
    by_data = weight - PRIOR.speed_sd**-2
    value = (weight * logs[0] - PRIOR.speed_sd**-2 * logs[1]) / by_data
    both = by_data + PRIOR.measured_speed_sd**-2
    expected = (by_data * value + PRIOR.measured_speed_sd**-2 * np.log(speed_of_sound(temperature))) / both
    sd = told.speed_of_sound_sd / float(told.ring.speed_of_sound)
    assert sd == pytest.approx(both**-0.5, rel=0.05)
    assert abs(np.log(float(told.ring.speed_of_sound)) - expected) < 0.3 * sd


@pytest.mark.slow
def test_a_larger_radius_is_found(wider):
    radius, sd = wider.radius
    assert abs(radius - (0.28 + WIDER)) < Z * sd
    assert sd < 0.001
    outward = np.linalg.norm(np.asarray(wider.ring.position), axis=1)
    np.testing.assert_allclose(outward, radius, atol=1e-9)
    known_to(wider)


@pytest.mark.slow
def test_a_turned_sensor_is_found_by_what_it_hears(turned, nominal):
    change = np.asarray(turned.ring.heading) - np.asarray(nominal.heading)
    expected = np.where(np.arange(COUNT) == TURNED, BY, 0)
    assert np.abs((change - expected) / turned.heading_sd).max() < Z
    assert abs(change[TURNED] - BY) < np.radians(5)
    known_to(turned)


# Poses unknown


@pytest.mark.slow
def test_poses_are_estimated_along(estimated, true):
    error = relative_offsets(estimated.ring, true)
    assert np.sqrt(np.mean(error**2)) < 0.001
    assert np.abs(error / estimated.range_offset_sd).max() < Z
    assert abs(float(estimated.ring.speed_of_sound - true.speed_of_sound)) < Z * estimated.speed_of_sound_sd
    assert estimated.rms == pytest.approx(SIGMA, rel=0.2)
    known_to(estimated)


@pytest.mark.slow
def test_the_estimated_way_is_nearer_to_the_truth_than_odometry(estimated, log, odometry):
    [poses] = estimated.poses
    known = np.isfinite(poses).all(axis=1)
    assert known.sum() >= 15
    first = np.flatnonzero(known)[0]

    def off(way):
        error = relative(*(compose(inverse(path[first]), path[known]) for path in (log.pose, way)))
        return np.hypot(error[:, 0], error[:, 1]).max(), np.abs(wrap_angle(error[:, 2])).max()

    (estimated_way, estimated_turn), (way, turn) = off(poses), off(odometry)
    assert estimated_way < 0.04
    assert estimated_way < way / 2
    assert estimated_turn < min(np.radians(1), turn / 2)


# Refused


def silent(scans=17):
    none = np.zeros(0, int)
    return Log.from_echoes(none, none, none, np.zeros(0), stamp=np.arange(float(scans)), pose=np.zeros((scans, 3)))


def refused(match, *arguments, **options):
    with pytest.raises(SonarError, match=match) as failure:
        calibrate(*arguments, **options)
    assert "\n" not in str(failure.value)


@pytest.mark.slow
def test_a_ring_with_half_the_speed_of_sound_is_refused(nominal, log):
    half = replace(nominal, speed_of_sound=nominal.speed_of_sound / 2)
    refused("speed_of_sound 171.6 m/s; allowed is that of air, 290 to 380", half, log)


@pytest.mark.slow
def test_ranges_that_are_whole_path_lengths_are_refused(nominal, log):
    refused("allowed|needed", nominal, replace(log, range=2 * log.range), free=("speed",))


@pytest.mark.slow
def test_a_log_without_poses_is_not_to_be_trusted(nominal, log):
    unknown = replace(log, pose=np.full_like(log.pose, np.nan))
    refused("0 of 17 scans have a pose; allowed are 3 or more", nominal, unknown, free=("speed",))
    refused("pose", nominal, unknown)
    two = replace(log, pose=np.where(np.arange(17)[:, None] < 2, log.pose, np.nan))
    refused("2 of 17 scans have a pose", nominal, two, free=("speed",))


@pytest.mark.slow
def test_a_log_without_walls_is_refused(nominal, log):
    refused("no wall found", nominal, silent(), free=("speed",))
    refused("allowed", nominal, silent())
    rng = np.random.default_rng(1)
    clutter = replace(log, range=rng.uniform(0.3, 1.9, len(log.range)))
    refused("no wall|no echo fits|explain", nominal, clutter, free=("speed",))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"free": ("offsets",)}, "free 'offsets'; allowed are offset"),
        ({"free": ()}, "nothing came; allowed"),
        ({"poses": "guess"}, "poses 'guess'; allowed is trust or estimate"),
        ({"odometry": 0.0}, "odometry 0; allowed"),
        ({"odometry": float("nan")}, "odometry nan; allowed"),
        ({"temperature": 300.0}, "temperature 300 deg C; allowed is -60 to 85"),
        ({"temperature": float("nan")}, "temperature nan deg C; allowed"),
        ({"sigma": 0.0}, "sigma 0"),
        ({"window": -1.0}, "window"),
    ],
)
def test_choices_that_are_none_are_refused(nominal, log, options, match):
    refused(match, nominal, log, **options)


@pytest.mark.slow
def test_no_log_is_refused(nominal):
    refused("no log came", nominal, [])


# Told


@pytest.mark.slow
def test_the_file_is_a_ring_and_says_how_well_it_is_known(found, tmp_path):
    path = tmp_path / "ring.toml"
    save_calibration(found, path)
    again = load_ring(path)
    for name in ("position", "heading", "beam", "range_offset", "speed_of_sound", "max_range"):
        np.testing.assert_allclose(getattr(again, name), getattr(found.ring, name), atol=1e-9, err_msg=name)
    assert (again.neighbors, again.name) == (found.ring.neighbors, found.ring.name)
    table = tomllib.loads(path.read_text())["calibration"]
    assert table["estimated"] == ["offset", "speed"]
    assert (table["scans"], table["echoes"], table["echoes_explained"]) == (
        found.scans, found.echoes, len(found.residuals),
    )  # fmt: skip
    np.testing.assert_allclose(table["range_offset_sd"], found.range_offset_sd, atol=1e-8)
    np.testing.assert_allclose(table["speed_of_sound_sd"], found.speed_of_sound_sd, atol=1e-8)
    told = [table[name] for name in ("sigma", "residual_rms_before", "residual_rms_after")]
    np.testing.assert_allclose(told, [found.sigma, found.rms_before, found.rms], atol=1e-8)
    assert ("mean_offset_sd" in table) != ("mean_offset" in table["held"])
    assert {"position", "radius", "heading"} <= set(table["held"])
    for pair in table["correlations"]:
        assert 0.7 <= abs(pair["value"]) <= 1
        assert len(pair["between"]) == 2


@pytest.mark.slow
def test_each_parameter_has_its_keys(wider, turned, tmp_path):
    tables = []
    for one in (wider, turned):
        save_calibration(one, tmp_path / "one.toml")
        tables.append(tomllib.loads((tmp_path / "one.toml").read_text())["calibration"])
        np.testing.assert_allclose(load_ring(tmp_path / "one.toml").heading, one.ring.heading, atol=1e-9)
    np.testing.assert_allclose([tables[0]["radius"], tables[0]["radius_sd"]], wider.radius, atol=1e-8)
    np.testing.assert_allclose(tables[1]["heading_sd_deg"], np.degrees(turned.heading_sd), atol=1e-8)
    for table in tables:
        assert not {"range_offset_sd", "mean_offset_sd", "speed_of_sound_sd"} & set(table)
    assert "radius_sd" not in tables[1]
    assert "heading_sd_deg" not in tables[0]


@pytest.mark.slow
def test_the_summary_says_what_was_found(found, wider):
    lines = found.summary()
    assert all("\n" not in line for line in lines)
    assert "17 scans" in lines[0]
    assert any("range offsets" in line for line in lines)
    assert any("speed of sound" in line and "m/s" in line for line in lines)
    assert any("radius" in line and "mm" in line for line in wider.summary())


@pytest.mark.slow
@pytest.mark.parametrize("which", ["found", "wider", "estimated"])
def test_the_figure_has_units_and_legends(which, request, tmp_path):
    figure = calibration_figure(request.getfixturevalue(which))
    figure.savefig(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")
    axes = figure.axes
    assert len(axes) == 4
    labels = [axis.get_label_text() for one in axes for axis in (one.xaxis, one.yaxis)]
    assert all(labels)
    assert sum("mm" in label for label in labels) == 2
    assert sum("(m)" in label for label in labels) == 4
    for one in axes[1:]:
        assert one.get_legend() is not None
    assert axes[2].get_xlim() == axes[3].get_xlim()
    assert axes[2].get_ylim() == axes[3].get_ylim()

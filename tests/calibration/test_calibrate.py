"""Calibration of rings: errors within the standard deviations, invariances, invalid input, files and figures."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest
from support.hard_cones import simulate

from jaxsonar import Log, Ring, SonarError, calibrate, load_ring, save_calibration
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
Z = 4.0  # standard deviations; one of 24 sensors exceeds it in one of 700 seeds


def office_log(ring, seed=3, **options):
    """Scans of the office with the true poses."""
    office = load_office()
    options = {"sigma": SIGMA, "seed": seed, "stamps": office.stamps, **options}
    return simulate(ring, office.room, office.poses, **options).as_log(ring, office.poses)


@pytest.fixture(scope="module")
def nominal():
    return load_office().ring


@pytest.fixture(scope="module")
def true(nominal):
    """Offset errors of 5 mm with mean 0, and a speed of sound that is 1 % higher."""
    offset = np.random.default_rng(101).normal(0, 0.005, COUNT)
    return replace(nominal, range_offset=offset - offset.mean(), speed_of_sound=FASTER * nominal.speed_of_sound)


@pytest.fixture(scope="module")
def log(true):
    return office_log(true)


@pytest.fixture(scope="module")
def found(nominal, log):
    return calibrate(nominal, log)


# With one parameter group there is no autofocus, and all of these compile for the same shapes.


@pytest.fixture(scope="module")
def speed(nominal):
    """Only the speed of sound is wrong and estimated."""
    faster = replace(nominal, speed_of_sound=FASTER * nominal.speed_of_sound)
    log = office_log(faster, seed=5)
    return log, faster, calibrate(nominal, log, free=("speed",))


@pytest.fixture(scope="module")
def wider(nominal):
    """A ring with a larger radius than the nominal one."""
    true = Ring.circular(radius=0.28 + WIDER)
    return calibrate(nominal, office_log(true, seed=8), free=("radius",))


@pytest.fixture(scope="module")
def turned(nominal):
    """The beam of one sensor is 15 deg to the left of its nominal heading."""
    heading = np.array(nominal.heading)
    heading[TURNED] += BY
    return calibrate(nominal, office_log(replace(nominal, heading=heading), seed=9), free=("heading",))


@pytest.fixture(scope="module")
def odometry(log):
    """Poses from odometry with errors of 2 %."""
    rng, poses = np.random.default_rng(4), log.pose
    steps = relative(poses[:-1], poses[1:])
    distance = np.hypot(steps[:, 0], steps[:, 1])[:, None]
    steps[:, :2] += 0.02 * distance * rng.standard_normal((len(steps), 2))
    steps[:, 2:] += 0.02 * (np.abs(steps[:, 2:]) + 0.5 * distance) * rng.standard_normal((len(steps), 1))
    trajectory = [poses[0]]
    for step in steps:
        trajectory.append(compose(trajectory[-1], step))
    return np.array(trajectory)


@pytest.fixture(scope="module")
def estimated(nominal, log, odometry):
    """Calibration with odometry instead of poses."""
    return calibrate(nominal, replace(log, pose=odometry), poses="estimate")


def relative_offsets(ring, true):
    """Errors of the range offsets relative to their mean."""
    error = np.asarray(ring.range_offset) - np.asarray(true.range_offset)
    return error - error.mean()


def assert_consistent(found: Calibration, count=COUNT):
    """Laws of every result."""
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


# The parameter basis


@pytest.mark.slow
@pytest.mark.parametrize("poses_free", [False, True])
def test_offset_columns_keep_the_mean_and_have_the_prior_variance(nominal, poses_free):
    basis = parameter_basis(nominal, PARAMETERS, poses_free=poses_free, speed_sd=0.02)
    assert basis.columns.shape == (3 * COUNT + 1, len(basis.names))
    of = {name: basis.columns[:, [name == other for other in basis.names]] for name in set(basis.names)}
    np.testing.assert_allclose(of["offset"][:COUNT].sum(axis=0), 0, atol=1e-15)
    spread = {name: np.sqrt((columns**2).sum(axis=1)) for name, columns in of.items()}
    np.testing.assert_allclose(
        np.hypot(spread["offset"], spread["mean"])[:COUNT] ** 2,
        PRIOR.offset_sd**2 * (1 - 1 / COUNT) + PRIOR.offset_sd**2,
        rtol=1e-12,
    )
    np.testing.assert_allclose(spread["speed"][COUNT], 0.02)
    outward = basis.columns[COUNT + 1 :, basis.names.index("radius")].reshape(-1, 2)
    np.testing.assert_allclose(np.linalg.norm(outward, axis=1), PRIOR.radius_sd)
    freedoms = 2 * COUNT - 3 * poses_free
    np.testing.assert_allclose((of["position"] ** 2).sum(), freedoms * PRIOR.position_sd**2)
    assert np.linalg.matrix_rank(of["position"]) == freedoms


def test_with_free_poses_no_column_is_a_motion_of_the_whole_ring():
    """For arbitrary positions: a common motion of all sensors is a change of the robot frame."""
    place = np.random.default_rng(2).uniform(-0.5, 0.5, (7, 2))
    ring = Ring(place, np.zeros(7), beam=1.0, neighbors=1, max_range=2.0)
    columns = parameter_basis(ring, ("position",), poses_free=True, speed_sd=0.01).columns[8:]
    around = np.stack([-place[:, 1], place[:, 0]], axis=1)
    for motion in (np.tile([1.0, 0.0], (7, 1)), np.tile([0.0, 1.0], (7, 1)), around):
        np.testing.assert_allclose(motion.ravel() @ columns, 0, atol=1e-15)
    # All other changes are kept: the columns are a projector.
    np.testing.assert_allclose(columns @ columns, PRIOR.position_sd * columns, atol=1e-17)


@pytest.mark.slow
def test_holding_parameters_keeps_the_shape_of_the_basis(nominal):
    basis = parameter_basis(nominal, ("offset", "speed"), poses_free=False, speed_sd=0.01)
    held = basis.only("offset")
    assert held.columns.shape == basis.columns.shape
    np.testing.assert_array_equal(held.columns[:, :COUNT], basis.columns[:, :COUNT])
    np.testing.assert_array_equal(held.columns[:, COUNT:], 0)


@pytest.mark.slow
def test_invalid_parameters_are_refused(nominal):
    with pytest.raises(SonarError, match="free 'temper'; allowed are offset, speed, position, radius, heading"):
        check_parameters(("offset", "temper"))
    with pytest.raises(SonarError, match="nothing came"):
        check_parameters(())
    lone = Ring(np.zeros((2, 2)), [0.0, 1.0], beam=1.0, neighbors=1, max_range=2.0)
    with pytest.raises(SonarError, match="all sensors are in one place"):
        parameter_basis(lone, ("radius",), poses_free=False, speed_sd=0.01)


# Offsets and speed


@pytest.mark.slow
def test_offsets_and_speed_are_found_within_their_standard_deviations(found, true):
    error = relative_offsets(found.ring, true)
    assert np.abs(error / found.range_offset_sd).max() < Z
    assert np.sqrt(np.mean(error**2)) < 0.0006
    assert abs(float(found.ring.speed_of_sound - true.speed_of_sound)) < Z * found.speed_of_sound_sd
    assert found.speed_of_sound_sd < 0.001 * true.speed_of_sound
    assert np.sqrt(np.mean(found.range_offset_sd**2)) < 0.0005
    assert_consistent(found)


@pytest.mark.slow
def test_the_residuals_are_the_noise(found):
    assert found.rms == pytest.approx(SIGMA, rel=0.15)
    assert found.sigma == pytest.approx(SIGMA, rel=0.15)
    assert found.rms_before > 2 * SIGMA
    assert len(found.residuals) > 0.8 * found.echoes
    assert abs(np.mean(found.residuals)) < 0.2 * SIGMA


@pytest.mark.slow
def test_the_mean_offset_is_estimated_or_held_with_a_reason(found, true):
    mean = float(np.mean(found.ring.range_offset) - np.mean(true.range_offset))
    if "mean_offset" in found.held:
        assert found.mean_offset_sd == 0
        np.testing.assert_allclose(np.mean(found.ring.range_offset), np.mean(found.nominal.range_offset), atol=1e-12)
        assert "wall" in found.held["mean_offset"]
    else:
        assert 0 < found.mean_offset_sd <= 0.001
        assert abs(mean) < Z * found.mean_offset_sd


@pytest.mark.slow
def test_the_ring_is_invariant_under_rigid_motions_of_the_world(found, nominal, log):
    motion = np.array([3.0, -7.0, 2.3])
    again = calibrate(nominal, replace(log, pose=compose(motion, log.pose)))
    np.testing.assert_allclose(relative_offsets(again.ring, found.ring), 0, atol=5e-5)
    assert float(again.ring.speed_of_sound) == pytest.approx(float(found.ring.speed_of_sound), abs=0.02)
    back = compose(inverse(motion), again.poses[0])
    np.testing.assert_allclose(back[:, :2], found.poses[0][:, :2], atol=1e-9)


@pytest.mark.slow
def test_the_result_is_a_fixed_point(found, log):
    """The result does not depend on the nominal ring, except for the prior of the offsets, 3 cm."""
    again = calibrate(found.ring, log)
    np.testing.assert_allclose(relative_offsets(again.ring, found.ring), 0, atol=5e-5)
    assert float(again.ring.speed_of_sound) == pytest.approx(float(found.ring.speed_of_sound), abs=0.02)
    assert again.rms_before == pytest.approx(again.rms, rel=0.02)


@pytest.mark.slow
def test_two_logs_yield_the_result_of_one(found, nominal, log):
    """Even and odd scans in separate logs: two maps with fewer echoes each, so slightly larger standard deviations."""
    again = calibrate(nominal, [log[::2], log[1::2]])
    assert again.scans == found.scans
    assert again.echoes == found.echoes
    assert len(again.maps) == len(again.poses) == 2
    spread = np.hypot(again.range_offset_sd, found.range_offset_sd)
    assert np.abs(relative_offsets(again.ring, found.ring) / spread).max() < Z
    assert_consistent(again)


# One parameter group at a time


@pytest.mark.slow
def test_the_speed_of_sound_is_found(speed):
    _, true, found = speed
    assert abs(float(found.ring.speed_of_sound - true.speed_of_sound)) < Z * found.speed_of_sound_sd
    assert found.speed_of_sound_sd < 0.0005 * true.speed_of_sound
    assert_consistent(found)


@pytest.mark.slow
def test_a_thermometer_is_an_additional_measurement(nominal, speed):
    """With an error of 3 K: precisions add up, and the result is the mean weighted by them."""
    log, true, free = speed
    temperature = 273.15 * ((float(true.speed_of_sound) / 331.3) ** 2 - 1) + 3.0
    measured = calibrate(nominal, log, free=("speed",), temperature=temperature)
    logs = [np.log(float(speed)) for speed in (free.ring.speed_of_sound, nominal.speed_of_sound)]
    weight = (free.ring.speed_of_sound / free.speed_of_sound_sd) ** 2
    by_data = weight - PRIOR.speed_sd**-2
    value = (weight * logs[0] - PRIOR.speed_sd**-2 * logs[1]) / by_data
    both = by_data + PRIOR.measured_speed_sd**-2
    expected = (by_data * value + PRIOR.measured_speed_sd**-2 * np.log(speed_of_sound(temperature))) / both
    sd = measured.speed_of_sound_sd / float(measured.ring.speed_of_sound)
    assert sd == pytest.approx(both**-0.5, rel=0.05)
    assert abs(np.log(float(measured.ring.speed_of_sound)) - expected) < 0.3 * sd


@pytest.mark.slow
def test_a_larger_radius_is_found(wider):
    radius, sd = wider.radius
    assert abs(radius - (0.28 + WIDER)) < Z * sd
    assert sd < 0.001
    outward = np.linalg.norm(np.asarray(wider.ring.position), axis=1)
    np.testing.assert_allclose(outward, radius, atol=1e-9)
    assert_consistent(wider)


@pytest.mark.slow
def test_the_heading_of_a_rotated_sensor_is_found(turned, nominal):
    change = np.asarray(turned.ring.heading) - np.asarray(nominal.heading)
    expected = np.where(np.arange(COUNT) == TURNED, BY, 0)
    assert np.abs((change - expected) / turned.heading_sd).max() < Z
    assert abs(change[TURNED] - BY) < np.radians(5)
    assert_consistent(turned)


# Unknown poses


@pytest.mark.slow
def test_offsets_and_speed_are_found_with_unknown_poses(estimated, true):
    error = relative_offsets(estimated.ring, true)
    assert np.sqrt(np.mean(error**2)) < 0.001
    assert np.abs(error / estimated.range_offset_sd).max() < Z
    assert abs(float(estimated.ring.speed_of_sound - true.speed_of_sound)) < Z * estimated.speed_of_sound_sd
    assert estimated.rms == pytest.approx(SIGMA, rel=0.2)
    assert_consistent(estimated)


@pytest.mark.slow
def test_the_estimated_trajectory_is_closer_to_the_truth_than_odometry(estimated, log, odometry):
    [poses] = estimated.poses
    known = np.isfinite(poses).all(axis=1)
    assert known.sum() >= 15
    first = np.flatnonzero(known)[0]

    def largest_errors(trajectory):
        true, other = (compose(inverse(path[first]), path[known]) for path in (log.pose, trajectory))
        error = relative(true, other)
        return np.hypot(error[:, 0], error[:, 1]).max(), np.abs(wrap_angle(error[:, 2])).max()

    (position, heading), (odometry_position, odometry_heading) = largest_errors(poses), largest_errors(odometry)
    assert position < 0.04
    assert position < odometry_position / 2
    assert heading < min(np.radians(1), odometry_heading / 2)


# Invalid input


def log_without_echoes(scans=17):
    none = np.zeros(0, int)
    return Log.from_echoes(none, none, none, np.zeros(0), stamp=np.arange(float(scans)), pose=np.zeros((scans, 3)))


def assert_refused(match, *arguments, **options):
    with pytest.raises(SonarError, match=match) as failure:
        calibrate(*arguments, **options)
    assert "\n" not in str(failure.value)


@pytest.mark.slow
def test_a_ring_with_half_the_speed_of_sound_is_refused(nominal, log):
    half = replace(nominal, speed_of_sound=nominal.speed_of_sound / 2)
    assert_refused("speed_of_sound 171.6 m/s; allowed is that of air, 290 to 380", half, log)


def wrong_logs():
    """Mistakes in a log of the office, and words of the reason why it is refused."""
    yield "ranges of the round trip", "round trip", lambda log: replace(log, range=2 * log.range)
    yield "ranges in millimetres", "millimetres", lambda log: replace(log, range=1000 * log.range)
    yield "poses in millimetres", "millimetres", lambda log: replace(log, pose=log.pose * [1000, 1000, 1])
    yield "headings in degrees", "degrees", lambda log: replace(log, pose=log.pose * [1, 1, np.degrees(1)])
    yield "x and y swapped", "swapped", lambda log: replace(log, pose=log.pose[:, [1, 0, 2]])
    yield "numbered clockwise", "clockwise", lambda log: replace(log, tx=-log.tx % COUNT, rx=-log.rx % COUNT)
    yield "a rotated ring", "rotated by", lambda log: replace(log, tx=(log.tx + 3) % COUNT, rx=(log.rx + 3) % COUNT)


@pytest.mark.parametrize(("words", "mistaken"), [pytest.param(*one, id=name) for name, *one in wrong_logs()])
def test_a_log_that_fits_another_description_is_refused_with_the_reason(nominal, log, words, mistaken):
    for poses in ("trust", "estimate"):
        assert_refused(f"refused, because.*{words}", nominal, mistaken(log), poses=poses)


@pytest.mark.slow
def test_poses_of_other_scans_are_refused(nominal, log):
    """Single scans explain most of their echoes, a map at wrong poses few."""
    other = replace(log, pose=log.pose[np.random.default_rng(0).permutation(len(log))])
    assert_refused("explain .* % of the echoes; needed are [23]. % or more", nominal, other, free=("speed",))


@pytest.mark.slow
def test_a_log_without_poses_is_refused_if_poses_are_trusted(nominal, log):
    unknown = replace(log, pose=np.full_like(log.pose, np.nan))
    assert_refused("0 of 17 scans have a pose; allowed are 3 or more", nominal, unknown, free=("speed",))
    assert_refused("pose", nominal, unknown)
    two = replace(log, pose=np.where(np.arange(17)[:, None] < 2, log.pose, np.nan))
    assert_refused("2 of 17 scans have a pose", nominal, two, free=("speed",))


@pytest.mark.slow
def test_a_log_without_walls_is_refused(nominal, log):
    assert_refused("no wall found", nominal, log_without_echoes(), free=("speed",))
    assert_refused("allowed", nominal, log_without_echoes())
    rng = np.random.default_rng(1)
    clutter = replace(log, range=rng.uniform(0.3, 1.9, len(log.range)))
    assert_refused("no wall|no echo fits|explain|agree", nominal, clutter, free=("speed",))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"free": ("offsets",)}, "free 'offsets'; allowed are offset"),
        ({"free": ()}, "nothing came; allowed"),
        ({"poses": "guess"}, "poses 'guess'; allowed is trust or estimate"),
        ({"odometry": 0.0}, "odometry 0; allowed"),
        ({"odometry": float("nan")}, "odometry nan; allowed"),
        ({"odometry": 0.05}, "odometry 0.05 came with poses 'trust'; allowed is poses 'estimate'"),
        ({"temperature": 300.0}, "temperature 300 deg C; allowed is -60 to 85"),
        ({"temperature": float("nan")}, "temperature nan deg C; allowed"),
        ({"sigma": 0.0}, "sigma 0"),
        ({"window": -1.0}, "window"),
    ],
)
def test_invalid_options_are_refused(nominal, log, options, match):
    assert_refused(match, nominal, log, **options)


@pytest.mark.slow
def test_no_log_is_refused(nominal):
    assert_refused("no log came", nominal, [])


# Output


@pytest.mark.slow
def test_the_file_contains_the_ring_and_its_standard_deviations(found, tmp_path):
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
    assert table["explained"] == pytest.approx(len(found.residuals) / found.echoes, abs=1e-8)
    assert table["explained_required"] == pytest.approx(found.explained.required)
    np.testing.assert_allclose(table["range_offset_sd"], found.range_offset_sd, atol=1e-8)
    np.testing.assert_allclose(table["speed_of_sound_sd"], found.speed_of_sound_sd, atol=1e-8)
    noise = [table[name] for name in ("sigma", "residual_rms_before", "residual_rms_after")]
    np.testing.assert_allclose(noise, [found.sigma, found.rms_before, found.rms], atol=1e-8)
    assert ("mean_offset_sd" in table) != ("mean_offset" in table["held"])
    assert {"position", "radius", "heading"} <= set(table["held"])
    for pair in table["correlations"]:
        assert 0.7 <= abs(pair["value"]) <= 1
        assert len(pair["between"]) == 2


@pytest.mark.slow
def test_each_parameter_group_has_its_keys(wider, turned, tmp_path):
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
def test_the_summary_names_the_results(found, wider):
    lines = found.summary()
    assert all("\n" not in line for line in lines)
    assert "17 scans" in lines[0]
    assert f"{100 * len(found.residuals) / found.echoes:.0f} % of the echoes explained, required: 3" in lines[0]
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

"""Global maps: invariance to motion, order and splitting; simulated rooms; changing rooms; invalid input."""

import dataclasses
import math

import numpy as np
import pytest
import shapely
from support import oracles
from support.hard_cones import simulate

from jaxsonar import Log, Ring, Room, SonarError, load_log, local_models, random_pose, random_room, save_log
from jaxsonar.detection.settings import METHODS
from jaxsonar.geometry.se2 import rotation
from jaxsonar.mapping.build_map import MERGING_METHODS, add_reflectors, assemble_map, build_map
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.mapping.map_evidence import gather_evidence
from jaxsonar.mapping.settings import SETTINGS
from jaxsonar.simulation.traced_echoes import EchoKind

LEAST_SCANS = SETTINGS.evidence.min_scans
SIGMA = 0.003
SEEDS = range(5)
ON_WALL, ON_ANGLE, BEYOND = 0.06, math.radians(6.0), 0.12
"""Tolerances of a segment on a wall: offset (metres), angle (radians), length beyond its ends (metres)."""
RING = Ring.circular()


@pytest.fixture(scope="module")
def office_logs(office):
    """The office with several seeds: (simulation, log) of each."""
    heard = [simulate(office.ring, office.room, office.poses, sigma=SIGMA, seed=s, stamps=office.stamps) for s in SEEDS]
    return [(sim, sim.as_log(office.ring, office.poses)) for sim in heard]


@pytest.fixture(scope="module")
def office_log(office_logs):
    return office_logs[1][1]


@pytest.fixture(scope="module")
def office_maps(office, office_logs):
    return [build_map(office.ring, log) for _, log in office_logs]


def in_order(log, rows):
    """The given scans of a log, in the given order."""
    return Log.from_scans([log[int(row)] for row in rows])


def with_poses(log, pose):
    return dataclasses.replace(log, pose=pose)


def world_moved(log, turn, shift):
    """The same echoes in a world that was rotated and then translated together with the robot."""
    pose = log.pose.copy()
    pose[:, :2] = pose[:, :2] @ rotation(turn).T + shift
    pose[:, 2] += turn
    return with_poses(log, pose)


def one_after_another(*logs):
    """The scans of several logs, one log after the other."""
    scans = [scan for log in logs for scan in log]
    return Log.from_scans([dataclasses.replace(scan, scan=k, stamp=0.5 * k) for k, scan in enumerate(scans)])


def apart(one, other):
    """Largest distance between ends of two segments; a segment has no direction."""
    return min(np.abs(one - other).max(), np.abs(one - other[::-1]).max())


def assert_same_map(one, other, *, atol, turn=0.0, shift=(0.0, 0.0), named=True):
    """Assert that the second map is the first one moved: lines, ends, standard deviations, echoes and scans."""
    assert len(one) == len(other)
    segments = one.segments @ rotation(turn).T + np.asarray(shift)
    taken = []
    for k, segment in enumerate(segments):
        distance = [apart(segment, there) for there in other.segments]
        twin = int(np.argmin(distance))
        assert distance[twin] <= atol
        assert other.echoes[twin] == one.echoes[k]
        assert not named or other.scans[twin] == one.scans[k]
        assert other.sigma_theta[twin] == pytest.approx(one.sigma_theta[k], rel=1e-2, nan_ok=True)
        taken.append(twin)
    assert len(set(taken)) == len(one)


def is_on(segment, wall, *, across=ON_WALL, angle=ON_ANGLE, beyond=BEYOND):
    """Whether a segment lies on a wall: near its line, at a small angle, and not beyond its ends."""
    length = np.linalg.norm(wall[1] - wall[0])
    tangent = (wall[1] - wall[0]) / length
    along, off = (segment - wall[0]) @ tangent, (segment - wall[0]) @ np.array([-tangent[1], tangent[0]])
    run = segment[1] - segment[0]
    turn = oracles.wrap(2 * (math.atan2(run[1], run[0]) - math.atan2(tangent[1], tangent[0]))) / 2
    return np.abs(off).max() < across and abs(turn) < angle and along.min() > -beyond and along.max() < length + beyond


def on_walls(world, walls, **gates):
    """Which segment (row) lies on which wall (column)."""
    hits = [[is_on(segment, wall, **gates) for wall in walls] for segment in world.segments]
    return np.array(hits, dtype=bool).reshape(len(world), len(walls))


def well_heard(sim, room, scans, *, least=8):
    """Walls with enough true echoes in each of at least two scans."""
    counts = np.zeros((scans, len(room.walls)), int)
    plane = sim.kind == EchoKind.PLANE
    np.add.at(counts, (sim.scan[plane], sim.reflector[plane]), 1)
    return np.flatnonzero((counts >= least).sum(axis=0) >= LEAST_SCANS)


def covered(world, line, *, within=0.08):
    """Length of a line that segments of the map cover, metres."""
    near = shapely.LineString(line).buffer(within, cap_style="flat")
    direction = math.atan2(*(np.subtract(line[1], line[0]))[::-1])
    total = 0.0
    for segment in world.segments:
        turn = math.atan2(*(segment[1] - segment[0])[::-1]) - direction
        if abs(oracles.wrap(2 * turn)) / 2 < math.radians(15):
            total += shapely.LineString(segment).intersection(near).length
    return total


@pytest.mark.slow
@pytest.mark.parametrize("merging", MERGING_METHODS)
@pytest.mark.parametrize("shift", [(0.3, -0.7), (-12.1, 4.0), (1000.0, 0.1)])
def test_map_is_equivariant_under_translations_by_whole_cells(office_log, shift, merging):
    """Cells of the floor are 5 and 10 cm, so translations by tenths of a metre map cells to cells."""
    here = build_map(RING, office_log, merging=merging)
    there = build_map(RING, world_moved(office_log, 0.0, np.array(shift)), merging=merging)
    # The paper's merging votes in single precision.
    assert_same_map(here, there, shift=shift, atol=5e-3 if merging == "fused" else 1e-3)
    np.testing.assert_allclose(here.sigma_theta, there.sigma_theta, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_map_is_equivariant_under_rigid_motions(office_log, seed):
    """Other cells give other groups in the fusion, so the result differs slightly: by less than 1 mm."""
    rng = np.random.default_rng(seed)
    turn, shift = (rng.integers(1, 4) * math.pi / 2 if seed == 0 else rng.uniform(-4, 4)), rng.uniform(-5, 5, 2)
    here, there = build_map(RING, office_log), build_map(RING, world_moved(office_log, turn, shift))
    assert_same_map(here, there, turn=turn, shift=shift, atol=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("split", [1, 8, 16])
def test_the_union_of_two_parts_is_the_evidence_of_the_whole(office_log, split):
    parts = [in_order(office_log, rows) for rows in np.split(np.arange(len(office_log)), [split])]
    one, other = (gather_evidence(RING, part, list(local_models(RING, part))) for part in parts)
    whole = gather_evidence(RING, office_log, list(local_models(RING, office_log)))
    for both in (one.union(other), other.union(one)):
        assert both.models == whole.models == 17
        assert (both.linkage_distance, both.gap) == (whole.linkage_distance, whole.gap)
        for merging in MERGING_METHODS:
            came, wanted = assemble_map(both, merging=merging), assemble_map(whole, merging=merging)
            assert_same_map(came, wanted, atol=1e-9 if merging == "fused" else 1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("merging", MERGING_METHODS)
@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_the_scans_does_not_matter(office_log, seed, merging):
    order = np.random.default_rng(seed).permutation(len(office_log)) if seed else np.arange(len(office_log))[::-1]
    here = build_map(RING, office_log, merging=merging)
    there = build_map(RING, in_order(office_log, order), merging=merging)
    assert_same_map(here, there, atol=1e-9 if merging == "fused" else 1e-5)


@pytest.mark.slow
def test_the_same_log_gives_exactly_the_same_map(office_log):
    one, two = build_map(RING, office_log), build_map(RING, office_log)
    for name in ("segments", "rho", "theta", "sigma_rho", "sigma_theta", "echoes"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    assert one.scans == two.scans


@pytest.mark.slow
def test_invariants_of_a_map(office_maps):
    """Lines pass through their segments, walls are sorted by echoes, scans ascend, and enough scans saw each wall."""
    for world in office_maps:
        normal = np.stack([np.cos(world.theta), np.sin(world.theta)], axis=-1)
        np.testing.assert_allclose((world.segments * normal[:, None]).sum(-1), world.rho[:, None] * [1, 1], atol=1e-9)
        assert (world.rho >= 0).all()
        assert ((world.theta >= -np.pi) & (world.theta < np.pi)).all()
        assert (np.diff(world.echoes) <= 0).all()
        assert all(list(scans) == sorted(set(scans)) and len(scans) >= LEAST_SCANS for scans in world.scans)
        several = np.array([len(scans) > 1 for scans in world.scans])
        assert (world.sigma_rho[several] > 0).all()
        assert (world.sigma_theta[several] > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("merging", MERGING_METHODS)
def test_a_single_scan_gives_a_map(office_log, merging, method):
    """No other scan can confirm it, so the map is its local model in the world frame."""
    world = build_map(RING, office_log[:1], merging=merging, method=method)
    (model,) = local_models(RING, office_log[:1], method=method)
    assert 1 <= len(world) <= len(model.lines)
    if len(world) == len(model.lines):  # each line is a wall, whose scatter is unknown
        assert np.isnan(world.sigma_rho).all()
        assert np.isnan(world.sigma_theta).all()
    assert set(world.scans) == {(0,)}


@pytest.mark.parametrize("merging", MERGING_METHODS)
def test_logs_without_usable_echoes_give_an_empty_map(office_log, merging):
    """A log without scans; scans without echoes; scans with echoes beyond the maximum range."""
    empty = build_map(RING, office_log[:0], merging=merging)
    assert isinstance(empty, GlobalMap)
    assert empty.segments.shape == (0, 2, 2)
    assert (len(empty), empty.scans) == (0, ())
    none = np.zeros(0, int)
    deaf = Log.from_echoes(none, none, none, np.zeros(0), stamp=np.arange(5.0), pose=np.zeros((5, 3)))
    assert len(build_map(RING, deaf, merging=merging)) == 0
    five = np.arange(5)
    far = Log.from_echoes(five, five, five, np.full(5, 2.5), stamp=np.arange(5.0), pose=np.zeros((5, 3)))
    assert len(build_map(RING, far, merging=merging)) == 0


@pytest.mark.parametrize("merging", MERGING_METHODS)
def test_a_robot_without_free_space_gets_a_map(merging):
    """All sensors hear something close, so there is no free space."""
    tx = np.arange(24)
    log = Log.from_echoes(np.zeros(24, int), tx, tx, np.full(24, 0.12), stamp=np.zeros(1), pose=np.zeros((1, 3)))
    assert isinstance(build_map(RING, log, merging=merging), GlobalMap)


@pytest.mark.slow
@pytest.mark.parametrize("merging", MERGING_METHODS)
def test_scans_without_a_pose_are_left_out(office_log, merging):
    pose = office_log.pose.copy()
    pose[[0, 5, 16]] = np.nan
    with_some = build_map(RING, with_poses(office_log, pose), merging=merging)
    without = build_map(RING, in_order(office_log, np.delete(np.arange(17), [0, 5, 16])), merging=merging)
    assert_same_map(with_some, without, atol=1e-9)
    assert not {0, 5, 16} & {scan for scans in with_some.scans for scan in scans}


@pytest.mark.parametrize("merging", MERGING_METHODS)
@pytest.mark.parametrize("window", [None, 1.0])
def test_a_log_without_a_single_pose_is_refused(office_log, merging, window):
    lost = with_poses(office_log, np.full((17, 3), np.nan))
    with pytest.raises(SonarError, match=r"none of the 17 scans has a pose; allowed is") as refused:
        build_map(RING, lost, merging=merging, window=window)
    assert "\n" not in str(refused.value)


def test_unknown_methods_are_refused(office_log):
    with pytest.raises(SonarError, match=r"merging 'best'; allowed is fused or paper"):
        build_map(RING, office_log, merging="best")
    with pytest.raises(SonarError, match=r"method 'best'; allowed is ml or hough"):
        build_map(RING, office_log, method="best")
    with pytest.raises(SonarError, match=r"window = 0 m; allowed is"):
        build_map(RING, office_log, window=0.0)
    stranger = Log.from_echoes(
        np.array([0]), np.array([3]), np.array([24]), np.array([1.0]), stamp=np.zeros(1), pose=np.zeros((1, 3))
    )
    with pytest.raises(SonarError, match="tx 3, rx 24; allowed are 0 to 23"):
        build_map(RING, stranger)


@pytest.mark.slow
def test_echoes_of_pairs_that_the_ring_does_not_listen_to_are_reported(office_log):
    first = office_log[0]
    more = dataclasses.replace(
        first, tx=np.append(first.tx, 3), rx=np.append(first.rx, 15), range=np.append(first.range, 1.0),
        amplitude=np.append(first.amplitude, np.nan), t=None, age=None,
    )  # fmt: skip
    reported_counts = []
    with_it = build_map(RING, Log.from_scans([more, *list(office_log)[1:]]), on_left_out=reported_counts.append)
    assert reported_counts == [1]
    assert_same_map(with_it, build_map(RING, office_log), atol=1e-9)


@pytest.mark.parametrize("column", ["range", "x", "theta"])
def test_a_log_with_partial_nan_cannot_be_made(office_log, column):
    reported, pose = office_log.range.copy(), office_log.pose.copy()
    if column == "range":
        reported[7] = np.nan
    else:
        pose[3, {"x": 0, "theta": 2}[column]] = np.nan
    with pytest.raises(SonarError, match=r"scans\[\d+\].*came; allowed is"):
        dataclasses.replace(office_log, range=reported, pose=pose)


def test_a_repeated_scan_number_is_refused_with_its_row(office_log, tmp_path):
    number = office_log.scan.copy()
    number[4] = number[2]
    with pytest.raises(SonarError, match=r"scans\[4\], scan: 2 came; allowed is a whole number that no earlier scan"):
        dataclasses.replace(office_log, scan=number)
    file = tmp_path / "twice.csv"
    save_log(office_log, file)
    lines = file.read_text().splitlines()
    again = next(k for k, line in enumerate(lines) if line.startswith("4,"))
    lines[again:] = ["2," + line.split(",", 1)[1] if line.startswith("4,") else line for line in lines[again:]]
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(SonarError, match=rf"twice\.csv.* row {again + 1}, column scan: '2' came") as refused:
        load_log(file)
    assert "\n" not in str(refused.value)


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_walls_of_the_office_within_reach_are_one_segment_each(office, office_logs, office_maps, seed):
    """Walls with at least 8 true echoes in two scans; every segment is on a wall. One may be missing: the chair."""
    heard, names = well_heard(office_logs[seed][0], office.room, 17), office.room.wall_names
    hits = on_walls(office_maps[seed], office.room.walls)
    false = office_maps[seed].segments[~hits.any(axis=1)]
    assert not len(false), false.round(2).tolist()
    counts = {(k, names[k]): int(hits[:, k].sum()) for k in heard}
    assert max(counts.values()) == 1
    assert sum(counts.values()) >= max(7, len(counts) - 1)
    missing = {name for (_, name), hit in counts.items() if not hit}
    assert missing <= {"chair back-rest"}
    for chair in np.flatnonzero(hits[:, names.index("chair back-rest")]):
        assert 0.3 < np.linalg.norm(np.diff(office_maps[seed].segments[chair], axis=0)) < 0.6


@pytest.mark.slow
def test_walls_of_the_office_are_accurate(office, office_maps):
    """Root mean square errors over all seeds: half a centimetre, two degrees."""
    off, turned = [], []
    for world in office_maps:
        hits = on_walls(world, office.room.walls)
        for k, j in zip(*np.nonzero(hits), strict=True):
            start, end = office.room.walls[j]
            tangent = (end - start) / np.linalg.norm(end - start)
            run = world.segments[k, 1] - world.segments[k, 0]
            off.append((world.segments[k].mean(axis=0) - start) @ np.array([-tangent[1], tangent[0]]))
            turned.append(oracles.wrap(2 * (math.atan2(run[1], run[0]) - math.atan2(tangent[1], tangent[0]))) / 2)
    assert np.sqrt(np.mean(np.square(off))) < 0.005
    assert np.degrees(np.sqrt(np.mean(np.square(turned)))) < 2.0
    assert np.abs(off).max() < 0.0323  # the paper's largest deviation of one scan


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_nothing_bridges_the_doors_recess(office, office_maps, seed):
    """The door lies 12 cm behind the wall: across the recess the map has no wall."""
    jambs = [wall for wall, name in zip(office.room.walls, office.room.wall_names, strict=True) if name == "door jamb"]
    mouth = [jambs[0][0], jambs[1][1]]
    assert 0.85 < math.dist(*mouth) < 0.95
    assert covered(office_maps[seed], mouth, within=0.05) < 0.15


@pytest.mark.slow
def test_the_papers_merging_finds_the_walls_of_the_office(office, office_logs):
    """With wide tolerances: this merging keeps the lines of corners and does not bridge gaps."""
    for sim, log in office_logs[:3]:
        world = build_map(office.ring, log, method="hough", merging="paper")
        hits = on_walls(world, office.room.walls, across=0.1, angle=0.15, beyond=0.3)
        assert hits[:, well_heard(sim, office.room, 17)].any(axis=0).mean() > 0.6


SHELL = [[[-2.5, -2.2], [2.5, -2.2]], [[2.5, -2.2], [2.5, 2.2]], [[2.5, 2.2], [-2.5, 2.2]], [[-2.5, 2.2], [-2.5, -2.2]]]
BOX = [[[-0.3, -0.3], [0.3, -0.3]], [[0.3, -0.3], [0.3, 0.3]], [[0.3, 0.3], [-0.3, 0.3]], [[-0.3, 0.3], [-0.3, -0.3]]]
CHAIR = [[[-0.35, 0.03], [0.35, -0.03]]]


def around(count=28, radius=1.2):
    angle = 2 * math.pi * np.arange(count) / count
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), angle + math.pi / 2])


def heard(walls, poses, *, seed, ring=RING):
    room = Room(np.array(walls, float))
    return simulate(ring, room, poses, sigma=SIGMA, seed=seed).as_log(ring, poses)


@pytest.mark.slow
@pytest.mark.parametrize(("count", "rounds"), [(28, 2), (56, 1)])
@pytest.mark.parametrize("thing", [BOX, CHAIR], ids=["box", "chair"])
def test_vanished_objects_leave_the_map_and_new_ones_enter_it(thing, count, rounds):
    """The same trajectory twice, with an object only in the second half, always, or only in the first half."""
    poses = np.concatenate([around(count)] * rounds)
    full = [heard([*SHELL, *thing], poses, seed=seed) for seed in (0, 1)]
    free = [heard(SHELL, poses, seed=seed) for seed in (0, 1)]
    shell, sides = np.array(SHELL), np.array(thing)
    for first, second, there in [(free[0], full[1], True), (full[0], full[1], True), (full[0], free[1], False)]:
        world = build_map(RING, one_after_another(first, second))
        hits = on_walls(world, sides, across=0.1, angle=0.3, beyond=0.3)
        assert (on_walls(world, shell).sum(axis=0) == 1).all()
        if there:
            assert hits.any(axis=0).all()
        else:
            assert not hits.any(), world.segments[hits.any(axis=1)].round(2).tolist()


DRIVE = np.column_stack([np.arange(-2.0, 2.01, 0.25), np.full(17, -1.0), np.zeros(17)])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("behind", [None, 0.3, 0.8])
def test_an_open_door_stays_open(behind, seed):
    """A wall with a gap of 0.9 m, with nothing or another wall behind it."""
    walls = [[[-3, 0], [-0.45, 0]], [[0.45, 0], [3, 0]]]
    walls += [[[-1.0, behind], [1.0, behind]]] if behind else []
    world = build_map(RING, heard(walls, DRIVE, seed=seed))
    assert covered(world, [(-0.45, 0.0), (0.45, 0.0)]) < 0.25
    assert covered(world, [(-2.0, 0.0), (-0.45, 0.0)]) > 1.2
    assert covered(world, [(0.45, 0.0), (2.0, 0.0)]) > 1.2
    assert on_walls(world, np.array(walls, float)[:2]).sum(axis=0).tolist() == [1, 1]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_wall_occluded_by_a_chair_is_one_segment(seed):
    walls = [[[-3, 0], [3, 0]], [[-0.25, -0.4], [0.25, -0.4]]]
    drive = DRIVE + np.array([0.0, -0.4, 0.0])
    world = build_map(RING, heard(walls, drive, seed=seed))
    assert on_walls(world, np.array(walls, float)).sum(axis=0).tolist() == [1, 1]
    assert covered(world, [(-2.0, 0.0), (2.0, 0.0)]) > 3.6


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_random_rooms_are_recognizable(seed):
    """Loose bounds on recall and precision."""
    rng = np.random.default_rng(seed)
    room = random_room(rng)
    poses = np.array([random_pose(rng, room) for _ in range(40)])
    sim = simulate(RING, room, poses, sigma=SIGMA, seed=seed)
    world = build_map(RING, sim.as_log(RING, poses))
    audible = well_heard(sim, room, len(poses))
    hits = on_walls(world, room.walls, across=0.08, angle=math.radians(8), beyond=0.4)
    assert hits[:, audible].any(axis=0).mean() >= 0.6
    assert hits.any(axis=1).mean() >= 0.6


def test_progress_counts_scans_and_the_observed_evidence_gives_the_map(office_log):
    steps, observed = [], []
    world = build_map(
        RING,
        office_log,
        on_observed=lambda *found: observed.append(found),
        progress=lambda stage, done, total: steps.append((stage, done, total)),
    )
    ((models, evidence),) = observed
    assert len(models) == len(office_log)
    assert steps[: len(models)] == [("local models", k + 1, len(office_log)) for k in range(len(models))]
    again = add_reflectors(assemble_map(evidence), evidence.scans.measurements())
    np.testing.assert_array_equal(again.segments, world.segments)

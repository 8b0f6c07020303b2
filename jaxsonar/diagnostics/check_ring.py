"""The health check of a ring: which sensors are dead, exchanged, off or stuck, and how wide the cones are."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Int

from jaxsonar.detection.settings import check_sigma
from jaxsonar.diagnostics.common_causes import find_common_causes
from jaxsonar.diagnostics.compared_sensors import Comparison, compare_sensors, without_sensors
from jaxsonar.diagnostics.cross_counts import cross_counts
from jaxsonar.diagnostics.findings import Finding
from jaxsonar.diagnostics.health_report import OF_SENSORS
from jaxsonar.diagnostics.health_report import Health as Health
from jaxsonar.diagnostics.local_scene import scene_from_groups
from jaxsonar.diagnostics.log_findings import checked_log
from jaxsonar.diagnostics.measured_sensors import MeasuredSensors
from jaxsonar.diagnostics.reference_scene import (
    ReferenceScene,
    empty_scene,
    evenly_spaced,
    renumber,
    scene_from_scans,
    select_scans,
)
from jaxsonar.diagnostics.repeated_ranges import RepeatedRanges
from jaxsonar.diagnostics.sensor_findings import (
    SensorEvidence,
    described,
    differs_from_nominal,
    plain_findings,
    sensor_findings,
)
from jaxsonar.diagnostics.sensor_measurements import faced_walls, measure_sensors
from jaxsonar.diagnostics.settings import SETTINGS
from jaxsonar.diagnostics.swapped_sensors import find_exchanged_sensors
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.readings import is_repeated
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring_parameters import check_speed_of_sound


def check(
    ring: Ring,
    log: Log,
    *,
    sigma: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    on_left_out: Callable[[int], None] | None = None,
) -> Health:
    """Check the health of a ring.

    Args:
        ring: the ring as it should be.
        log: scans, as they were recorded. Poses, where they exist, show causes that concern all sensors, and gather
            walls where single scans show too few.
        sigma: standard deviation of the ranges, metres; None estimates it.
        progress: called with (scans done, scans) from time to time.
        on_left_out: called once with the number of echoes of pairs (tx, rx) that this ring does not listen to.

    Raises:
        SonarError: a log without scans, a sensor number that the ring does not have, an impossible speed of sound, or a
            sigma out of range.
    """
    check_sigma(sigma)
    check_speed_of_sound(ring)
    if not len(log):
        raise SonarError("check: the log holds no scan; allowed are one or more")
    # Prepare the log: no marks for no echo, no echoes of the robot, ages of held readings, firings grouped into scans.
    log, reported, faults = checked_log(ring, log)
    # Find causes that are common to all sensors, and correct the ring or the log.
    causes = find_common_causes(ring, log, sigma=sigma)
    nominal, ring, log, sigma = ring, causes.ring, causes.log, causes.sigma
    faults = (*faults, *causes.findings)
    _, left_out = FlatEchoes.from_log(ring, log)
    if left_out and on_left_out is not None:
        on_left_out(left_out)
    # Find reference walls, from each scan alone or from a map.
    part, scene, source, empty = _reference_walls(ring, log, sigma, progress)
    as_numbered = measure_sensors(ring, part, scene, sigma)
    # Cones of another width than the ring states are corrected, because walls seem to be missed then.
    if differs_from_nominal(as_numbered.beam, nominal):
        factor = as_numbered.beam[0] / float(np.mean(ring.beam))
        ring = replace(ring, beam=np.minimum(np.asarray(ring.beam) * factor, SETTINGS.cones.largest_beam))
        scene = _detect_walls(ring, part, sigma=sigma, by_poses=scene.by_poses)
        as_numbered = measure_sensors(ring, part, scene, sigma)
    # Walls that longer pieces of the trajectory show tell best what a sensor hears.
    detect = partial(_detect_walls, ring, sigma=sigma, by_poses=scene.by_poses)
    gather = partial(scene_from_groups, ring, long=True)
    gathered = gather(log)
    has_wall = np.flatnonzero(gathered.is_wall.any(axis=1))
    # Are sensors exchanged?
    place = np.arange(ring.count)
    if len(has_wall):
        place = find_exchanged_sensors(ring, log, gathered, gather)
    elif source:
        place = find_exchanged_sensors(ring, part, scene, detect)
    renumbered, all_scans = renumber(part, place), renumber(log, place)
    repeated, measured = RepeatedRanges.of(ring, reported), MeasuredSensors.of(ring, log)
    heard = np.isfinite(log.range) & ~is_repeated(log)
    direct, cross = heard & (log.tx == log.rx), heard & (log.tx != log.rx)

    def walls_without(sensors: Int[np.ndarray, " without"]) -> ReferenceScene:
        return gather(without_sensors(all_scans, sensors)).at(has_wall)

    def judge(scene: ReferenceScene, known: Int[np.ndarray, " known"]) -> tuple[Health, SensorEvidence]:
        """The health of all sensors by these walls, without faulty sensors, by the sensor numbers of the log."""
        found = measure_sensors(ring, renumbered, scene, sigma)
        health = Health(
            ring=nominal,
            scans=len(log),
            used=len(part),
            walls=int(scene.is_wall.sum()) if source else 0,
            source=source,
            empty=empty,
            left_out=left_out,
            sigma=found.offsets.sigma if source else float("nan"),
            direct=np.bincount(log.tx[direct], minlength=ring.count),
            cross=np.bincount(np.append(log.tx[cross], log.rx[cross]), minlength=ring.count),
            expected=found.expected[place],
            heard=found.heard[place],
            place=place,
            fits=np.stack([as_numbered.explained, found.explained[place]], axis=-1),
            offset=found.offsets.offset[place],
            offset_error=found.offsets.error[place],
            median=found.quantiles[place, 2],
            quartiles=found.quantiles[place][:, [0, 1, 3, 4]],
            spread=found.spread[place],
            repeats=repeated.repeats,
            constant=repeated.constant,
            beam=found.beam,
            curve=found.curve,
            asked=found.asked,
            answered=found.answered,
            beam_each=2 * found.cones.half_width[place],
            centre=found.cones.direction[place],
            remarks=("",) * ring.count,
            findings=(),
            unmeasured=measured.unmeasured,
        )
        without_worst, turn_nats = found.without_worst[place], found.cones.nats[place]
        compared = Comparison((), {})
        if len(has_wall):
            compared = compare_sensors(ring, select_scans(all_scans, has_wall), walls_without, known)
        if scene.by_poses:
            offset, error = found.offsets.offset.copy(), found.offsets.error.copy()
            for k, by_others in compared.offset.items():
                offset[k], error[k] = by_others
            health = replace(health, offset=offset[place], offset_error=error[place])
        faced = found.expected[place, 0]
        if source and not measured.any.all() and not measured.certain:  # silent, or not measured?
            faced = faced_walls(ring, renumbered, scene)[place]
        better = None
        if compared.alternatives or (not ring.neighbors and scene.by_poses):
            better = dict(enumerate(compared.alternatives[k] for k in place if compared.alternatives))
        return health, SensorEvidence(repeated.pairs, without_worst, turn_nats, cross_counts(ring, log), faced, better)

    accepted: list[int] = []
    # The most certain fault of a sensor is accepted; the others are judged by walls without the echoes of this sensor,
    # which may have spoiled them.
    first = scene if (place == np.arange(ring.count)).all() else detect(renumbered)
    health, evidence = judge(first, np.zeros(0, np.int64))
    findings = plain_findings(health, measured, evidence, faults)
    for _ in range(int(SETTINGS.findings.most_faulty * ring.count) + 1):
        named = {k for one in findings for k in one.sensors}
        found = sensor_findings(health, measured, evidence, sigma, named)
        if not found:
            break
        accepted, kept = [*accepted, *found[0].finding.sensors], list(accepted)
        others, evidence = judge(
            detect(without_sensors(renumbered, place[accepted])) if source else scene, place[accepted]
        )
        # Measured by these walls, too, the same fault has a better size; otherwise its first measurement stays.
        again = sensor_findings(others, measured, evidence, sigma, named)
        same = [one.finding for one in again if (one.finding.cause, one.finding.sensors) == _key(found[0].finding)]
        findings.append([found[0].finding, *same][-1])
        health = _joined(health, others, kept if same else accepted)
    return described(health, measured, findings, len(faults))


def _key(finding: Finding) -> tuple[str, tuple[int, ...]]:
    return finding.cause, finding.sensors


def _joined(health: Health, others: Health, accepted: list[int]) -> Health:
    """A new result for the other sensors; that of the accepted ones stays, because its walls include their echoes."""

    def joined(name: str) -> np.ndarray:
        values = getattr(others, name).copy()
        values[accepted] = getattr(health, name)[accepted]
        return values

    return replace(others, **{name: joined(name) for name in OF_SENSORS})


def _scans_with_walls(log: Log, scene: ReferenceScene) -> tuple[Log, ReferenceScene]:
    rows = np.flatnonzero((scene.kind >= 0).any(axis=1))
    return select_scans(log, rows), scene.at(rows)


def _reference_walls(
    ring: Ring, log: Log, sigma: float | None, progress: Callable[[int, int], None] | None
) -> tuple[Log, ReferenceScene, str, str]:
    """The scans to analyse, their reference scene, its source, and the reason if there are no walls.

    Scans are explained alone if that shows about as many walls as the poses of the log do.
    """
    settings = SETTINGS.reference
    if not (np.asarray(ring.corrected(log.range, log.tx, log.rx)) < ring.max_range).any():
        nothing = select_scans(log, evenly_spaced(len(log), settings.max_scans))
        if not log.echo_count:
            return nothing, empty_scene(ring, len(nothing)), "", "no echo in any scan"
        reach = f"none of the {log.echo_count} echoes is within the maximum range, {ring.max_range:g} m"
        reason = f"{reach}: are ranges half path lengths in metres?"
        return nothing, empty_scene(ring, len(nothing)), "", reason
    scene = scene_from_groups(ring, log)
    by_poses = int(scene.is_wall.sum())
    if not ring.neighbors and by_poses >= settings.min_walls:
        return *_scans_with_walls(log, scene), "poses", ""
    part = select_scans(log, evenly_spaced(len(log), settings.max_scans))
    alone = scene_from_scans(ring, part, sigma, progress)
    walls = int(alone.is_wall.sum())
    if walls >= max(settings.min_walls, len(part) // 10, settings.min_share * by_poses):
        return part, alone, "scans", ""
    if by_poses:
        return *_scans_with_walls(log, scene), "poses", ""
    if np.isfinite(log.pose).all(axis=1).sum() < 2:
        return part, alone, "", "single scans show too few walls, and the log has no poses to gather them by"
    return part, alone, "", "neither single scans nor pieces of the trajectory show walls"


def _detect_walls(ring: Ring, log: Log, *, sigma: float | None, by_poses: bool) -> ReferenceScene:
    return scene_from_groups(ring, log) if by_poses else scene_from_scans(ring, log, sigma, None)

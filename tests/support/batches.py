"""Logs and shards for tests of batches."""

from dataclasses import replace
from pathlib import Path

import numpy as np

import jaxsonar
from jaxsonar import Log, load_ring
from jaxsonar.batch_jobs.inputs import find_inputs
from jaxsonar.batch_jobs.shards import split_input
from jaxsonar.batch_jobs.worker import job_spec
from jaxsonar.detection.settings import hough_settings
from jaxsonar.simulation.poses_csv import load_poses

RING = load_ring("faw")
JOB = job_spec(RING, method="hough", settings=hough_settings(RING, None), sigma=None)


def office_scans(scans, *, first=0):
    """Repeated scans of the office; one has no echoes, one has no pose and no stamp."""
    data = Path(jaxsonar.__file__).with_name("data")
    poses, stamps = load_poses(data / "office-path.csv")
    room = jaxsonar.load_room(data / "office.geojson")
    log = jaxsonar.simulate(RING, room, poses, sigma=0.003, seed=first, stamps=stamps).as_log(RING, poses)
    rows = [log[k % len(log)] for k in range(scans)]
    rows = [replace(scan, scan=first + k, stamp=0.5 * k) for k, scan in enumerate(rows)]
    none = {name: np.zeros(0) for name in ("range", "amplitude", "t", "age")}
    rows[3] = replace(rows[3], tx=rows[3].tx[:0], rx=rows[3].rx[:0], **none)
    rows[4] = replace(rows[4], pose=np.full(3, np.nan), stamp=np.nan)
    return Log.from_scans(rows)


def one_shard(file, *, scans=100, part=0):
    """One shard of a log file."""
    (log,) = find_inputs([file])
    return split_input(log, staging=Path(file).parent / "copies", ring=RING, scans=scans)[part]

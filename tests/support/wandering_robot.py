"""A robot with narrow sensors that wanders through a rectangular room, simulated by hand in NumPy."""

import numpy as np

from jaxsonar.geometry.se2 import transform_points, unit, wrap_angle
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring

RING = Ring.circular(count=12, radius=0.2, beam=np.radians(28.0), neighbors=0, max_range=5.0)
WALLS = np.radians([0.0, 90.0, 180.0, 270.0]), np.array([3.0, 2.0, 3.0, 2.0])
"""Directions of the normals and distances from the origin, metres."""


def trajectory(scans=400, *, step=0.04):
    """Poses of a robot that drives on a wavy loop around the middle of the room."""
    time = np.linspace(0, 2 * np.pi * scans * step / 9.0, scans)
    x, y = 1.6 * np.sin(time), 0.9 * np.cos(time) + 0.25 * np.sin(3 * time)
    return np.stack([x, y, np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))], axis=-1)


def along_a_wall(scans=300, *, step=0.02):
    """Poses of a robot that drives parallel to two walls, back and forth."""
    x = 2.5 * np.abs((np.arange(scans) * step / 2.5 + 1) % 4 - 2) - 2.5
    return np.stack([x, np.full(scans, 0.4), np.zeros(scans)], axis=-1)


def ranges(pose, *, sigma=0.003, resolution=1e-5, seed=0, ring=RING):
    """Direct ranges (scans, sensors), metres; NaN where no wall is perpendicular to a direction in the cone."""
    position = transform_points(pose[:, None], np.asarray(ring.position)[None])
    axis = pose[:, None, 2] + np.asarray(ring.heading)
    theta, rho = WALLS
    distance = rho - (position[:, :, None] * unit(theta)).sum(axis=-1)
    seen = np.abs(wrap_angle(theta - axis[..., None])) < np.asarray(ring.beam)[0] / 2
    nearest = np.where(seen, distance, np.inf).min(axis=-1)
    nearest += sigma * np.random.default_rng(seed).standard_normal(nearest.shape)
    return np.where(np.isfinite(nearest), np.round(nearest / resolution) * resolution, np.nan)


def log_of(reported, pose, *, period=0.1):
    """An implicit log of direct ranges (scans, sensors); NaN has no row."""
    scan, sensor = np.nonzero(np.isfinite(reported))
    stamp = 100 + period * np.arange(len(pose))
    return Log.from_echoes(scan, sensor, sensor, reported[scan, sensor], stamp=stamp, pose=pose)


def held(reported):
    """The ranges of a driver that repeats the last range while a sensor hears nothing, and which of them are held."""
    filled, last = reported.copy(), np.full(reported.shape[1], np.nan)
    for row in filled:
        row[np.isnan(row)] = last[np.isnan(row)]
        last = row.copy()
    return filled, np.isnan(reported) & np.isfinite(filled)

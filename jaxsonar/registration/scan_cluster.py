"""Scans that are registered to each other by ranges: their poses, and the reflectors of their echo groups."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.geometry.se2 import (
    compose,
    rotate_covariance,
    rotation,
    tangent_of,
    transform_points,
    unit,
    wrap_angle,
)
from jaxsonar.registration.settings import FEATURE_SETTINGS, RANGE_SETTINGS


@dataclass(frozen=True, eq=False)
class ScanCluster:
    """Scans and reflectors in a frame of their own."""

    poses: Float[np.ndarray, "scans 3"]
    """frame_from_robot, metres and radians; NaN where a scan is not in this cluster."""
    reflector: Int[np.ndarray, " groups"]
    """Row of the reflector of each group of echoes; -1 where it is not in this cluster of scans."""
    kind: Int[np.ndarray, " reflectors"]
    """Most likely kind of each reflector."""
    parameters_by_kind: Float[np.ndarray, "reflectors 3 2"]
    """Parameters of each reflector as every kind: (rho, theta) as plane, rho of either sign; (x, y) as corner and as
    edge; metres and radians."""
    kind_evidence: Float[np.ndarray, "reflectors 3"]
    """Log-evidence of every kind, nats."""
    covariance: Float[np.ndarray, "reflectors 2 2"]
    """Covariance of ``parameters``, relative to the scan that was held fixed."""
    pose_covariance: Float[np.ndarray, "scans 3 3"]
    """The same for the poses."""
    squared_residuals: Float[np.ndarray, " groups"]
    """Sum of squared range residuals of each group's echoes, in units of sigma."""
    observed: Float[np.ndarray, "groups 2"]
    """Interval of its wall that each cluster observed: positions along the tangent from the foot point of the origin,
    metres."""
    evidence: float = 0.0
    """Log-evidence (Laplace approximation), nats."""

    @classmethod
    def unadjusted(
        cls,
        poses: Float[np.ndarray, "scans 3"],
        reflector: Int[np.ndarray, " groups"],
        kind: Int[np.ndarray, " reflectors"],
        parameters_by_kind: Float[np.ndarray, "reflectors 3 2"],
    ) -> "ScanCluster":
        """A cluster before its adjustment; covariances, residuals and evidence are empty."""
        count, scans, groups = len(kind), len(poses), len(reflector)
        return cls(
            poses,
            reflector,
            kind,
            parameters_by_kind,
            kind_evidence=np.zeros((count, 3)),
            covariance=np.zeros((count, 2, 2)),
            pose_covariance=np.full((scans, 3, 3), np.nan),
            squared_residuals=np.zeros(groups),
            observed=np.zeros((groups, 2)),
        )

    @property
    def registered(self) -> Bool[np.ndarray, " scans"]:
        """Which scans are in this cluster."""
        return np.isfinite(self.poses[:, 0])

    @property
    def rows(self) -> Int[np.ndarray, " registered"]:
        """Rows of these scans."""
        return np.flatnonzero(self.registered)

    @property
    def is_wall(self) -> Bool[np.ndarray, " reflectors"]:
        """Which reflectors are most likely walls."""
        return self.kind == kernels.PLANE

    @property
    def parameters(self) -> Float[np.ndarray, "reflectors 2"]:
        """Parameters as the most likely kind."""
        return self.parameters_by_kind[np.arange(len(self.kind)), self.kind]

    @property
    def extent(self) -> Float[np.ndarray, "reflectors 2"]:
        """Interval of each wall that any scan observed, as ``observed``."""
        some = np.flatnonzero(self.reflector >= 0)
        out = np.tile([np.inf, -np.inf], (len(self.kind), 1))
        np.minimum.at(out[:, 0], self.reflector[some], self.observed[some, 0])
        np.maximum.at(out[:, 1], self.reflector[some], self.observed[some, 1])
        return out

    def transform(self, new_from_old: Float[np.ndarray, "3"]) -> "ScanCluster":
        """The same cluster in another frame."""
        poses, parameters, covariance = self.poses.copy(), self.parameters_by_kind.copy(), self.covariance.copy()
        poses[self.registered] = compose(new_from_old, self.poses[self.registered])
        theta = self.parameters_by_kind[:, 0, 1] + new_from_old[2]
        shift = tangent_of(theta) @ new_from_old[:2]
        parameters[:, 0, 0] += unit(theta) @ new_from_old[:2]
        parameters[:, 0, 1] = wrap_angle(theta)
        parameters[:, 1:] = transform_points(new_from_old, self.parameters_by_kind[:, 1:])
        jacobian = np.where(self.is_wall[:, None, None], np.eye(2), rotation(float(new_from_old[2])))
        jacobian[:, 0, 1] += np.where(self.is_wall, shift, 0.0)
        covariance = jacobian @ self.covariance @ jacobian.transpose(0, 2, 1)
        observed = self.observed + np.append(shift, 0.0)[self.reflector, None]
        return replace(
            self,
            poses=poses,
            parameters_by_kind=parameters,
            covariance=covariance,
            pose_covariance=rotate_covariance(float(new_from_old[2]), self.pose_covariance),
            observed=observed,
        )

    def without(self, scan_of: Int[np.ndarray, " groups"], scan: int | np.integer) -> "ScanCluster":
        """The cluster without one scan, not adjusted; ``scan_of`` is the scan of each group of echoes."""
        poses, reflector = self.poses.copy(), np.where(scan_of == scan, -1, self.reflector)
        poses[scan] = np.nan
        left = np.unique(reflector[reflector >= 0])
        row = np.full(len(self.kind) + 1, -1)
        row[left] = np.arange(len(left))
        return ScanCluster.unadjusted(poses, row[reflector], self.kind[left], self.parameters_by_kind[left])


def merge_clusters(a: ScanCluster, b: ScanCluster, pairs: Sequence[tuple[int, int]]) -> ScanCluster:
    """Two clusters as one, not adjusted.

    Args:
        a: a cluster.
        b: another one, in the same frame.
        pairs: rows of reflectors of ``a`` and ``b`` that are the same; the merged reflector has the row of ``a``.
    """
    same = {j: i for i, j in pairs}
    row = np.array([same.get(j, -1) for j in range(len(b.kind))], dtype=np.int64)
    new = np.flatnonzero(row < 0)
    row[new] = len(a.kind) + np.arange(len(new))
    reflector = np.where(b.reflector >= 0, np.append(row, -1)[b.reflector], a.reflector)
    poses = np.where(a.registered[:, None], a.poses, b.poses)
    kind = np.concatenate([a.kind, b.kind[new]])
    parameters = np.concatenate([a.parameters_by_kind, b.parameters_by_kind[new]])
    return ScanCluster.unadjusted(poses, reflector, kind, parameters)


def corners_of_walls(
    kind: Int[np.ndarray, " reflectors"], parameters: Float[np.ndarray, "reflectors 2"]
) -> Bool[np.ndarray, " reflectors"]:
    """Which reflectors are corners that lie on two walls which are not parallel."""
    wall = parameters[kind == kernels.PLANE]
    on = (np.abs(parameters @ unit(wall[:, 1]).T - wall[:, 0]) < RANGE_SETTINGS.corner_tolerance).astype(np.float64)
    crossing = np.abs(np.sin(wall[:, None, 1] - wall[:, 1])) > FEATURE_SETTINGS.crossing_sine
    return (kind == kernels.CORNER) & (((on @ crossing) * on).sum(axis=1) > 0)

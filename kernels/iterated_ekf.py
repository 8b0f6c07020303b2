"""Iterated Kalman update of the robot's pose and the landmarks around it by the ranges of ONE scan.

Pose and landmarks have one joint normal distribution, so that common errors are not counted twice (paper, section 5,
last paragraph). The iterated update equals Gauss-Newton on prior and ranges (Bell and Cathey 1993).
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .detection_cones import DEAF, SETTINGS, echo_level, visibility
from .landmarks import AnyArray, Landmarks, landmark_echo, landmark_in_robot_frame, reflector_level
from .measurement_model import PLANE
from .planar_geometry import dot, normal, tangent
from .sensor_array import EchoPaths, widen_cones


@dataclass(frozen=True)
class EkfSettings:
    """Constants of the iterated update; all chosen by hand."""

    iterations: int = 4
    """Gauss-Newton steps with robust weights before the last step."""
    annealing_factor: float = 0.05
    """Factor per iteration on the prior variance of a range in the scale of the robust weights."""
    gate: float = 4.0
    """Standard deviations of a range beyond which an echo is an outlier."""
    wall_margin: float = 0.05
    """Metres that a wall may extend beyond its observed endpoints; farther out an echo is more likely of an edge."""


EKF_SETTINGS = EkfSettings()


class Belief(eqx.Module):
    """Joint normal distribution of the robot's pose and the landmarks around it."""

    pose: Float[AnyArray, "3"]
    """Mean of frame_from_robot: x, y (metres), theta (radians)."""
    landmarks: Landmarks
    """(landmarks,) with the mean of their parameters; rows of kind -1 are unused."""
    covariance: Float[AnyArray, "unknowns unknowns"]
    """Of the pose (3) and of the parameters (2 for each landmark), square metres and radians."""


class EkfUpdate(eqx.Module):
    """The belief after a scan, and the residuals of its echoes."""

    belief: Belief
    residual: Float[Array, " echoes"]
    """Measured minus expected range at the new belief, metres; 0 for echoes without a landmark."""
    used: Float[Array, " echoes"]
    """1 for echoes within the gate, which the update uses; 0 for all others."""


class ExpectedRanges(eqx.Module):
    """Ranges that paths are expected to measure."""

    expected: Float[Array, "landmarks paths"]
    """Range of each landmark on each path, metres; infinite where the path cannot receive its echo."""
    variance: Float[Array, "landmarks paths"]
    """Variance of that range by the belief, square metres; without measurement noise."""


@jax.jit
def ekf_update(
    belief: Belief,
    paths: EchoPaths,
    ranges: Float[Array, " echoes"],
    landmark: Int[Array, " echoes"],
    variance: Float[Array, ""],
) -> EkfUpdate:
    """Update a belief with the echoes of one scan that are assigned to landmarks.

    Robust weights (Geman-McClure) are annealed: their scale shrinks from the prior variance of a range to the
    measurement noise. In the last step every echo has weight 0 or 1, so that the covariance is that of least squares.

    Args:
        belief: prior, after the prediction step; a new landmark has a wide covariance.
        paths: (echoes,) geometry of the path of each echo, robot frame.
        ranges: half path lengths, corrected for range offsets and the speed of sound, metres.
        landmark: row of the landmark that caused each echo; -1 for none.
        variance: measurement noise of a range, square metres.
    """
    mean = jnp.concatenate([jnp.asarray(belief.pose), jnp.asarray(belief.landmarks.parameters).ravel()])
    prior = jnp.asarray(belief.covariance)
    assigned, row = landmark >= 0, jnp.maximum(landmark, 0)
    first, second = 3 + 2 * row, 4 + 2 * row
    each_echo = jax.vmap(_range_and_jacobians, in_axes=(None, 0, 0))

    def linearize(state):
        """Residuals; Jacobians of the expected ranges with respect to the pose and to the landmark's parameters."""
        landmarks = jax.tree.map(lambda leaf: jnp.asarray(leaf)[row], _with_state(belief.landmarks, state))
        expected, by_pose, by_landmark = each_echo(state[:3], landmarks, paths)
        return jnp.where(assigned, ranges - expected, 0), by_pose, by_landmark

    def gauss_newton_step(state, weight):
        """One step from a state on the prior and the weighted ranges."""
        residual, by_pose, by_landmark = linearize(state)
        root = jnp.sqrt(weight / variance)[:, None]
        by_pose, by_landmark = root * by_pose, root * by_landmark
        # A row of the Jacobian H has five entries: three of the pose, two of one landmark.
        p_ht = (
            prior[:, :3] @ by_pose.T
            + prior[:, first] * by_landmark[None, :, 0]
            + prior[:, second] * by_landmark[None, :, 1]
        )
        h_p_ht = by_pose @ p_ht[:3] + by_landmark[:, :1] * p_ht[first] + by_landmark[:, 1:] * p_ht[second]
        factor = jax.scipy.linalg.cho_factor(h_p_ht + jnp.eye(len(row), dtype=state.dtype))
        change = state - mean
        h_change = by_pose @ change[:3] + by_landmark[:, 0] * change[first] + by_landmark[:, 1] * change[second]
        solution = jax.scipy.linalg.cho_solve(factor, root[:, 0] * residual + h_change)
        return mean + p_ht @ solution, p_ht, factor, h_p_ht

    # Prior variances of the ranges.
    *_, h_p_ht = gauss_newton_step(mean, assigned.astype(mean.dtype))
    prior_variance = variance * jnp.diag(h_p_ht)

    # Annealed robust iterations.
    def iterate(step, state):
        annealed = prior_variance * EKF_SETTINGS.annealing_factor ** step.astype(mean.dtype)
        scale = EKF_SETTINGS.gate**2 * (variance + annealed)
        residual, *_ = linearize(state)
        return gauss_newton_step(state, jnp.where(assigned, 1 / (1 + residual * residual / scale) ** 2, 0))[0]

    state = jax.lax.fori_loop(0, EKF_SETTINGS.iterations, iterate, mean)

    # Last step: echoes within the gate, with equal weights; covariance P - P H' S^-1 H P.
    residual, *_ = linearize(state)
    used = (assigned & (residual * residual < EKF_SETTINGS.gate**2 * variance)).astype(mean.dtype)
    state, p_ht, factor, _ = gauss_newton_step(state, used)
    half = jax.scipy.linalg.solve_triangular(factor[0], p_ht.T, lower=factor[1], trans=0 if factor[1] else 1)
    posterior = Belief(state[:3], _with_state(belief.landmarks, state), prior - half.T @ half)
    return EkfUpdate(posterior, linearize(state)[0], used)


@jax.jit
def expected_ranges_with_variance(belief: Belief, paths: EchoPaths) -> ExpectedRanges:
    """Predict the ranges of all landmarks of a belief on paths (paths,) of the robot frame, with their variances."""
    return ExpectedRanges(expected_ranges(belief.pose, belief.landmarks, paths), _range_variances(belief, paths))


@jax.jit
def expected_ranges(
    pose: Float[Array, "3"], landmarks: Landmarks, paths: EchoPaths, threshold: float | Float[Array, ""] = DEAF
) -> Float[Array, "landmarks paths"]:
    """Ranges that paths measure of landmarks, metres; infinite where a path cannot receive the echo.

    Args:
        pose: frame_from_robot.
        landmarks: (landmarks,) in that frame.
        paths: (paths,) in the robot frame; their cones are widened here (``association_cone_factor``).
        threshold: level of the faintest echoes that are heard outside of the cones, dB (``echo_level``); inf: none.
    """
    nominal = paths.cone
    paths = widen_cones(paths, SETTINGS.association_cone_factor)

    def expected_range(landmark: Landmarks, path: EchoPaths, cone: Float[Array, "2"]):
        echo = landmark_echo(landmark_in_robot_frame(pose, landmark), landmark, path)
        along = dot(tangent(landmark.parameters[1]), pose[:2] - landmark.anchor) + echo.footpoint
        margin = EKF_SETTINGS.wall_margin
        beside = (along < landmark.extent[0] - margin) | (along > landmark.extent[1] + margin)
        level = echo_level(echo, eqx.tree_at(lambda p: p.cone, path, cone))
        level += reflector_level(jnp.asarray(landmark.kind), landmark, echo.range)
        heard = (visibility(echo, path) > 0) | (echo.exists & (level > threshold))
        return jnp.where(heard & ((landmark.kind != PLANE) | ~beside), echo.range, jnp.inf)

    each_path = jax.vmap(expected_range, in_axes=(None, 0, 0))
    return jax.vmap(each_path, in_axes=(0, None, None))(landmarks, paths, nominal)


def _range_variances(belief: Belief, paths: EchoPaths) -> Float[Array, "landmarks paths"]:
    """Variances of the expected ranges, square metres."""
    count = belief.landmarks.kind.shape[0]
    own = 3 + 2 * jnp.arange(count)[:, None] + jnp.arange(2)[None]
    pose_cov, cross_cov = belief.covariance[:3, :3], belief.covariance[:3, own]  # (3, landmarks, 2)
    own_cov = belief.covariance[own[:, :, None], own[:, None, :]]

    def range_variance(landmark, cross, own, path):
        _, by_pose, by_landmark = _range_and_jacobians(jnp.asarray(belief.pose), landmark, path)
        return by_pose @ pose_cov @ by_pose + 2 * by_pose @ cross @ by_landmark + by_landmark @ own @ by_landmark

    each_path = jax.vmap(range_variance, in_axes=(None, None, None, 0))
    return jax.vmap(each_path, in_axes=(0, 1, 0, None))(belief.landmarks, cross_cov, own_cov, paths)


def _range_and_jacobians(
    pose: Float[Array, "3"], landmark: Landmarks, path: EchoPaths
) -> tuple[Float[Array, ""], Float[Array, "3"], Float[Array, "2"]]:
    """Range of ONE landmark on ONE path; its derivatives with respect to the pose and to the landmark's parameters."""
    local = landmark_in_robot_frame(pose, landmark)
    echo = landmark_echo(local, landmark, path)
    a, b = echo.d_range_d_landmark
    theta = landmark.parameters[1]
    n, t, forward, left = normal(theta), tangent(theta), normal(pose[2]), tangent(pose[2])
    offset = jnp.asarray(landmark.anchor) - pose[:2]
    # In the robot frame a plane is (distance + n . offset, theta - heading), a point its rotated offset.
    plane = landmark.kind == PLANE
    by_point = a * forward + b * left
    by_position = jnp.where(plane, -a * n, -by_point)
    by_heading = jnp.where(plane, -b, a * local[1] - b * local[0])
    by_landmark = jnp.where(plane, jnp.stack([a, a * dot(t, offset) + b]), by_point)
    return echo.range, jnp.append(by_position, by_heading), by_landmark


def _with_state(landmarks: Landmarks, state: Float[Array, " unknowns"]) -> Landmarks:
    return landmarks.with_parameters(state[3:].reshape(-1, 2))

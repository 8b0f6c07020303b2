"""Scans that lie together: poses and reflectors by least squares on the ranges, and the evidence of that in nats.

A part says which targets (``placing_views``) are one reflector. Its poses and reflectors follow, and so do the kinds:
each reflector is what explains all of its echoes best. Evidence is Laplace's approximation: what fits, against the room
that reflectors and poses might have had.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.geometry.se2 import composed, rotation, to_world, unit, wrap_angle
from jaxsonar.registration.echo_targets import KINDS, OF_KIND, Views, expected
from jaxsonar.registration.feature_map import NOT_PARALLEL, quarter, tangent_of, turned

PLANE_ROOM, POINT_ROOM = 1.0, 4.0
"""Where chance would put a wall (m rad: one in sight is often square to others) and a point (square metres)."""
GATE = 4.0
"""Sigma; farther off an echo counts as false."""
MEETS = 0.1
"""Metres between a corner and the walls that make it."""
_TEMPER = 0.5  # of the odds of local models: their residuals are counted here, too
_CLIP = 0.2  # m, rad; of a step
_DAMPED = np.array([1.0, 1.0, 0.3])  # inverse variances of poses: what nothing determines stays
_HELD, _FREE = 1e10, 1e-2  # inverse variances of the pose that is held, and of reflectors
_FIT, _AGAIN, _LAST, _ROUNDS = 6, 3, 7, 3  # steps of reflectors alone, at first and later; of all; and both in turn


@dataclass(frozen=True, eq=False)
class Part:
    """Scans that lie together, in a frame of their own."""

    poses: Float[np.ndarray, "scans 3"]
    """frame_from_robot, NaN where a scan is not of this part."""
    owner: Int[np.ndarray, " targets"]
    """Row of the reflector of each target; -1 where it is not of this part."""
    kind: Int[np.ndarray, " reflectors"]
    """What each most likely is."""
    places: Float[np.ndarray, "reflectors 3 2"]
    """Each as every kind: (rho, theta), with rho of either sign, and twice (x, y)."""
    nats: Float[np.ndarray, "reflectors 3"]
    """Evidence of every kind."""
    cov: Float[np.ndarray, "reflectors 2 2"]
    """Of ``place``, with respect to the scan that was held."""
    pose_cov: Float[np.ndarray, "scans 3 3"]
    """The same of the poses."""
    squares: Float[np.ndarray, " targets"]
    """Squared residuals in sigma of each target's echoes, summed."""
    stretch: Float[np.ndarray, "targets 2"]
    """What each target saw of its wall, metres along the tangent from the foot of the origin."""
    evidence: float = 0.0
    """Nats."""

    @property
    def placed(self) -> Bool[np.ndarray, " scans"]:
        """Which scans are of this part."""
        return np.isfinite(self.poses[:, 0])

    @property
    def rows(self) -> Int[np.ndarray, " placed"]:
        """Of these scans."""
        return np.flatnonzero(self.placed)

    @property
    def place(self) -> Float[np.ndarray, "reflectors 2"]:
        """Parameters of the kind that each is."""
        return self.places[np.arange(len(self.kind)), self.kind]

    @property
    def extent(self) -> Float[np.ndarray, "reflectors 2"]:
        """From where to where each was seen."""
        some = np.flatnonzero(self.owner >= 0)
        out = np.tile([np.inf, -np.inf], (len(self.kind), 1))
        np.minimum.at(out[:, 0], self.owner[some], self.stretch[some, 0])
        np.maximum.at(out[:, 1], self.owner[some], self.stretch[some, 1])
        return out

    def moved(self, frame: Float[np.ndarray, "3"]) -> "Part":
        """The same in another frame: ``frame`` is new_from_old."""
        poses, places, cov = self.poses.copy(), self.places.copy(), self.cov.copy()
        poses[self.placed] = composed(frame, self.poses[self.placed])
        theta = self.places[:, 0, 1] + frame[2]
        shift = tangent_of(theta) @ frame[:2]
        places[:, 0, 0] += unit(theta) @ frame[:2]
        places[:, 0, 1] = wrap_angle(theta)
        places[:, 1:] = to_world(frame, self.places[:, 1:])
        slope = np.where((self.kind == kernels.PLANE)[:, None, None], np.eye(2), rotation(float(frame[2])))
        slope[:, 0, 1] += np.where(self.kind == kernels.PLANE, shift, 0.0)
        cov = slope @ self.cov @ slope.transpose(0, 2, 1)
        stretch = self.stretch + np.append(shift, 0.0)[self.owner, None]
        turn = np.eye(3)
        turn[:2, :2] = rotation(float(frame[2]))
        pose_cov = turn @ self.pose_cov @ turn.T
        return replace(self, poses=poses, places=places, cov=cov, pose_cov=pose_cov, stretch=stretch)

    def without(self, scan_of: Int[np.ndarray, " targets"], scan: int | np.integer) -> "Part":
        """The same without a scan, not settled; ``scan_of``: scan of each target."""
        poses, owner = self.poses.copy(), np.where(scan_of == scan, -1, self.owner)
        poses[scan] = np.nan
        left = np.unique(owner[owner >= 0])
        row = np.full(len(self.kind) + 1, -1)
        row[left] = np.arange(len(left))
        return _unsettled(poses, row[owner], self.kind[left], self.places[left])


def single(views: Views, scan: int | np.integer) -> Part:
    """One scan, every target a reflector."""
    scans, targets = len(views.ranges), views.targets
    mine = np.flatnonzero(targets.scan == scan)
    poses, owner = np.full((scans, 3), np.nan), np.full(len(targets.scan), -1)
    poses[scan], owner[mine] = 0.0, np.arange(len(mine))
    places = np.stack([targets.plane[mine], targets.point[mine], targets.point[mine]], axis=1)
    kind = targets.odds[mine].argmax(axis=1).astype(np.int32)
    return settled(views, _unsettled(poses, owner, kind, places))


def merged(a: Part, b: Part, pairs: Sequence[tuple[int, int]]) -> Part:
    """Both as one, not settled.

    Args:
        a: a part.
        b: another one, in the same frame.
        pairs: reflectors of both that are the same; they keep the row that they have in the first one.
    """
    of = dict((j, i) for i, j in pairs)
    row = np.array([of.get(j, -1) for j in range(len(b.kind))], dtype=np.int64)
    new = np.flatnonzero(row < 0)
    row[new] = len(a.kind) + np.arange(len(new))
    owner = np.where(b.owner >= 0, np.append(row, -1)[b.owner], a.owner)
    poses = np.where(a.placed[:, None], a.poses, b.poses)
    kind, places = np.concatenate([a.kind, b.kind[new]]), np.concatenate([a.places, b.places[new]])
    return _unsettled(poses, owner, kind, places)


def settled(views: Views, part: Part, *, held: int | None = None) -> Part:
    """Kinds, and poses and reflectors, in turn.

    Args:
        views: the echoes.
        part: good to centimetres and degrees.
        held: scan that stays where it is; the first one if left out.
    """
    part, widest = _as_kinds(views, part, _FIT), 4 * GATE
    for _ in range(_ROUNDS):
        part = adjusted(views, part, steps=_LAST, widest=widest, held=held)
        again = _as_kinds(views, part, _AGAIN)
        if (again.kind == part.kind).all():
            break
        part, widest = again, GATE
    else:
        return adjusted(views, part, steps=_LAST, held=held)
    return replace(part, places=again.places, nats=again.nats)


def adjusted(views: Views, part: Part, *, steps: int, widest: float = GATE, held: int | None = None) -> Part:
    """Poses and reflectors by Gauss and Newton, kinds as they are; arguments as ``settled``.

    Args:
        views: the echoes.
        part: to start from.
        steps: how many; in the last two an echo counts or does not.
        widest: scale of the first robust weights (Geman and McClure), sigma; it halves until it is ``GATE``.
        held: scan that stays where it is; the first one if left out.
    """
    echoes, rows = views.echoes, part.rows
    mine = np.flatnonzero(part.owner[echoes.target] >= 0)
    scan, target, measured = echoes.scan[mine], echoes.target[mine], echoes.range[mine]
    row, every = part.owner[target], np.arange(len(mine))
    column = np.searchsorted(rows, scan)
    of_poses, size = 3 * len(rows), 3 * len(rows) + 2 * len(part.kind)
    prior = np.full(size, _FREE)
    prior[:of_poses] = np.tile(_DAMPED, len(rows))
    fixed = 0 if held is None else int(np.searchsorted(rows, held))
    prior[3 * fixed : 3 * fixed + 3] = _HELD
    poses, place = part.poses.copy(), part.place
    slope, information = np.zeros((len(mine), size)), np.diag(prior)
    for step in range(steps):
        lever, middle, base = _sensors(poses, scan, echoes.middle[mine], echoes.base[mine])
        found = expected(part.kind[row], place[row], middle, base)
        off = (measured - found.reach) / views.sigma
        weight = 1 / (1 + np.square(off / widest)) if step < steps - 2 else (np.abs(off) < GATE).astype(np.float64)
        widest = max(widest / 2, GATE)
        root = weight[:, None] / views.sigma
        slope[:] = 0
        slope[every, 3 * column], slope[every, 3 * column + 1] = (root * found.middle).T
        turn = (found.middle * quarter(lever)).sum(-1) + (found.base * quarter(base)).sum(-1)
        slope[every, 3 * column + 2] = root[:, 0] * turn
        slope[every, of_poses + 2 * row], slope[every, of_poses + 2 * row + 1] = (root * found.own).T
        information = slope.T @ slope + np.diag(prior)
        change = np.clip(np.linalg.solve(information, slope.T @ (weight * off)), -_CLIP, _CLIP)
        poses[rows] += change[:of_poses].reshape(-1, 3)
        place = place + change[of_poses:].reshape(-1, 2)
    poses[rows, 2] = wrap_angle(poses[rows, 2])
    _, middle, base = _sensors(poses, scan, echoes.middle[mine], echoes.base[mine])
    cost = np.square((measured - expected(part.kind[row], place[row], middle, base).reach) / views.sigma)
    cost = np.minimum(cost, GATE**2)
    room = np.where(part.kind == kernels.PLANE, np.log(PLANE_ROOM), np.log(POINT_ROOM))
    own = np.flatnonzero(part.owner >= 0)
    odds = _TEMPER * views.targets.odds[own, part.kind[part.owner[own]]]
    space = (size - 3) / 2 * np.log(2 * np.pi) - (np.linalg.slogdet(information)[1] - 3 * np.log(_HELD)) / 2
    places, pose_cov = part.places.copy(), np.full((len(poses), 3, 3), np.nan)
    places[np.arange(len(part.kind)), part.kind] = place
    cov = np.linalg.inv(information)
    blocks = 3 * np.arange(len(rows))[:, None] + np.arange(3)
    pose_cov[rows] = cov[blocks[:, :, None], blocks[:, None]]
    blocks = of_poses + 2 * np.arange(len(part.kind))[:, None] + np.arange(2)
    return Part(
        poses=poses,
        owner=part.owner,
        kind=part.kind,
        places=places,
        nats=part.nats,
        cov=cov[blocks[:, :, None], blocks[:, None]],
        pose_cov=pose_cov,
        squares=np.bincount(target, weights=cost, minlength=len(part.owner)).astype(np.float64),
        stretch=_stretches(place[row], middle, base, target, len(part.owner)),
        evidence=float(space - cost.sum() / 2 - room.sum() + odds.sum()),
    )


def where_walls_meet(
    kind: Int[np.ndarray, " reflectors"], place: Float[np.ndarray, "reflectors 2"]
) -> Bool[np.ndarray, " reflectors"]:
    """Corners on two walls that are not parallel."""
    wall = place[kind == kernels.PLANE]
    on = (np.abs(place @ unit(wall[:, 1]).T - wall[:, 0]) < MEETS).astype(np.float64)
    apart = np.abs(np.sin(wall[:, None, 1] - wall[:, 1])) > NOT_PARALLEL
    return (kind == kernels.CORNER) & (((on @ apart) * on).sum(axis=1) > 0)


def _unsettled(
    poses: Float[np.ndarray, "scans 3"],
    owner: Int[np.ndarray, " targets"],
    kind: Int[np.ndarray, " reflectors"],
    places: Float[np.ndarray, "reflectors 3 2"],
) -> Part:
    count, scans = len(kind), len(poses)
    covs = np.zeros((count, 2, 2)), np.full((scans, 3, 3), np.nan)
    return Part(
        poses, owner, kind, places, np.zeros((count, 3)), *covs, np.zeros(len(owner)), np.zeros((len(owner), 2))
    )


def _sensors(
    poses: Float[np.ndarray, "scans 3"],
    scan: Int[np.ndarray, " echoes"],
    middle: Float[np.ndarray, "echoes 2"],
    base: Float[np.ndarray, "echoes 2"],
) -> tuple[Float[np.ndarray, "echoes 2"], Float[np.ndarray, "echoes 2"], Float[np.ndarray, "echoes 2"]]:
    """Midpoints from the robot on, midpoints, and half baselines, in the frame of the poses."""
    pose = poses[scan]
    lever = turned(middle, pose[:, 2])
    return lever, pose[:, :2] + lever, turned(base, pose[:, 2])


def _stretches(
    place: Float[np.ndarray, "echoes 2"],
    middle: Float[np.ndarray, "echoes 2"],
    base: Float[np.ndarray, "echoes 2"],
    target: Int[np.ndarray, " echoes"],
    targets: int,
) -> Float[np.ndarray, "targets 2"]:
    """From where to where echoes of targets are reflected along a wall, metres from the foot of the origin."""
    normal, tangent = unit(place[:, 1]), tangent_of(place[:, 1])
    height = place[:, 0] - (middle * normal).sum(-1)
    lean = (base * tangent).sum(-1) * (base * normal).sum(-1)
    foot = (middle * tangent).sum(-1) + lean / np.where(np.abs(height) < MEETS, MEETS, height)
    out = np.tile([np.inf, -np.inf], (targets, 1))
    np.minimum.at(out[:, 0], target, foot)
    np.maximum.at(out[:, 1], target, foot)
    return out


def _as_kinds(views: Views, part: Part, steps: int) -> Part:
    """Each reflector as every kind, with the poses as they are, and as what it most likely is."""
    echoes, count = views.echoes, len(part.kind)
    mine = np.flatnonzero(part.owner[echoes.target] >= 0)
    _, middle, base = _sensors(part.poses, echoes.scan[mine], echoes.middle[mine], echoes.base[mine])
    row, measured = part.owner[echoes.target[mine]], echoes.range[mine]
    member = np.zeros((count, len(mine)))
    member[row, np.arange(len(mine))] = 1.0
    places, scale, information = part.places, 3 * GATE, np.zeros((count, 3, 2, 2))

    def looked() -> tuple[Float[np.ndarray, "3 echoes"], Float[np.ndarray, "3 echoes 2"]]:
        """Residuals and slopes in sigma, as every kind."""
        each = [OF_KIND[kind](places[row, kind], middle, base) for kind in KINDS]
        off = (measured - np.stack([one.reach for one in each])) / views.sigma
        return off, np.stack([one.own for one in each]) / views.sigma

    for _ in range(steps):
        off, own = looked()
        weight = 1 / np.square(1 + np.square(off / scale))
        scale = max(scale / 2, GATE)
        first, second = own[..., 0], own[..., 1]
        products = first * first, first * second, second * second, off * first, off * second
        sums = np.einsum("re,pke->prk", member, weight * np.stack(products), optimize=True)
        aa, ab, bb = sums[0] + 10.0, sums[1], sums[2] + 10.0
        information = np.stack([np.stack([aa, ab], axis=-1), np.stack([ab, bb], axis=-1)], axis=-2)
        step = np.stack([bb * sums[3] - ab * sums[4], aa * sums[4] - ab * sums[3]], axis=-1)
        places = places + np.clip(step / (aa * bb - ab * ab)[..., None], -_CLIP / 2, _CLIP / 2)
    places = places.copy()
    places[:, 0, 1] = wrap_angle(places[:, 0, 1])
    off, _ = looked()
    nats = -(member @ np.minimum(np.square(off), GATE**2).T) / 2 - np.linalg.slogdet(information)[1] / 2
    nats -= np.log([PLANE_ROOM, POINT_ROOM, POINT_ROOM])
    own_targets = np.flatnonzero(part.owner >= 0)
    np.add.at(nats, part.owner[own_targets], _TEMPER * views.targets.odds[own_targets])
    return replace(part, places=places, nats=nats, kind=nats.argmax(axis=1).astype(np.int32))

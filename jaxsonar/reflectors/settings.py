"""Numeric settings of the search for reflectors. ``SETTINGS`` holds the values in use; all were chosen by hand.

Simulated rooms of the seeds from 1000 on served for the choice (``benchmarks.mapping.columns``); accuracies are stated
for other seeds.
"""

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class KeptScanSettings:
    """Scans that are kept for the search."""

    cell: float = 0.05
    """Side of a place, metres."""
    angle: float = float(np.radians(10.0))
    """Its width in heading, radians."""
    scans: int = 3
    """Scans of each place that are kept, the latest ones."""


@dataclass(frozen=True)
class IndependentMeasurementSettings:
    """Measurements that count as one."""

    section: float = 0.1
    """Measurements of one path within this length of the trajectory count as one, metres."""
    turn_length: float = 0.57
    """Length of trajectory that corresponds to a rotation, metres per radian: 10 degrees are 0.1 m."""
    min_distance: float = 0.05
    """Smallest distance between a sensor and a wall, metres. Guards a division."""


@dataclass(frozen=True)
class CenterVotingSettings:
    """Votes of echoes for centers of circles."""

    cell: float = 0.05
    """Side of a cell of the floor, metres."""
    spacing: float = 0.04
    """Distance between the points of an arc that vote, metres."""
    radii: tuple[float, ...] = (0.0, 0.08, 0.2, 0.4)
    """Radii of the circles that are voted for, metres; 0 is an edge. Between them the blur of the cells suffices."""
    beam_margin: float = float(np.radians(8.0))
    """Echoes arrive from up to this far outside of the nominal beam, radians."""
    min_votes: float = 6.0
    """Votes that a cell and its neighbors need, echoes."""
    shared: float = 0.3
    """Seeds are fitted at the same time if they share less than this part of their echoes."""
    most_seeds: int = 120
    """Largest number of seeds that are tried."""


@dataclass(frozen=True)
class KindFitSettings:
    """Joint fit of a reflector over all its echoes."""

    iterations: int = 9
    """Largest number of iterations of the fit."""
    first_sigma: float = 0.03
    """Range noise of the first iteration, metres: the error of a start is about one cell. It falls ..."""
    noise_decay: float = 0.4
    """... by this factor with each iteration, down to the range noise."""
    converged: float = 0.01
    """The fit ends when no parameter changes by more than this, standard deviations of a range."""
    start_gate: float = 0.12
    """Echoes take part in a fit if they are this close to the start, metres, ..."""
    close: float = 0.05
    """... and there must be ``min_echoes`` as close as this."""
    min_distance: float = 0.03
    """Smallest distance between a sensor and a reflector, metres."""
    newton_steps: int = 2
    """Newton steps to the point of reflection of a circle. The error with baselines of 0.2 m and distances of 0.3 m is
    below 0.1 um."""
    radii: tuple[float, ...] = (0.06, 0.25, 0.8)
    """Radii at which the fit of a circle starts, metres."""
    min_radius: float = 0.01
    """Smallest radius of a circle, metres: about a wavelength. A thinner column is a pole, which answers as an edge."""
    max_radius: float = 1.0
    """Largest radius of a circle, metres; thicker columns are rare, and hardly differ from walls."""
    view_margin: float = float(np.radians(20.0))
    """Echoes belong to a reflector up to this far outside of the nominal beam, radians; near reflectors are loud."""
    gate: float = 3.5
    """Largest residual of an echo of a reflector, standard deviations."""
    inlier_share: float = 0.9
    """Prior share of the echoes of a reflector among those near it."""
    max_step: float = 0.1
    """Largest correction of a distance in one iteration, metres."""
    more_echoes: float = 1.15
    """A fit is repeated if this many times its echoes are near its result."""
    damping: float = 1e-3
    """Damping of the iterations, as a share of the diagonal, ..."""
    floor: tuple[float, float, float] = (1.0, 0.1, 1e-3)
    """... and a constant for distance, direction and radius."""
    min_rho: float = 0.05
    """Smallest distance of a reflector, metres."""
    plane_radius: float = 1e4
    """Radius of a circle that stands for a plane, metres: it deviates by less than 1 um over 0.1 m."""


@dataclass(frozen=True)
class ReflectorDecisionSettings:
    """Acceptance and kinds of reflectors."""

    min_echoes: int = 6
    """Echoes that a reflector must have: twice the parameters of a circle."""
    min_free_share: float = 0.8
    """Share of them that no other reflector may have taken meanwhile."""
    min_places: int = 2
    """Places of the robot from which it must answer."""
    place: float = 0.05
    """Distance between two places, metres."""
    min_evidence: float = 12.0
    """Log-likelihood ratio of a reflector to clutter, nats, beyond the prior of its position."""
    min_heard_share: float = 0.35
    """Share of the measurements that must hear it, of those that point at it and hear nothing nearer. What moves is
    heard at one place only."""
    certain_view: float = 0.6
    """Part of the beam in which a measurement must hear a reflector."""
    certain_quantile: float = 0.5
    """A measurement must hear a reflector that is nearer than this quantile of its echoes: edges are heard from nearby
    only."""
    certain_range: float = 0.9
    """Part of the maximum range in which it must."""
    most_missed: int = 3
    """A reflector is gone if this many later scans should have heard it and did not, as a wall is."""
    heard_prior: tuple[float, float] = (3.0, 1.0)
    """Parameters of the beta distribution of the share that hears it."""
    min_probability: float = 0.9
    """Probability of a kind from which on it is decided."""
    min_claim: float = 0.01
    """A reflector claims the echoes that it would cause as a kind of at least this probability."""
    prior: tuple[float, float, float, float] = (0.5, 0.15, 0.15, 0.2)
    """Prior probabilities of plane, corner, edge and circle: most reflectors of rooms are walls."""
    end_distance: float = 0.15
    """A reflector this close to the end of a wall, metres, ..."""
    end_odds: float = 100.0
    """... is less likely to be a circle by this factor: where a wall ends there is an edge, hardly ever a column."""
    hidden: float = 0.05
    """A reflector farther behind a wall than this is not visible, metres."""


@dataclass(frozen=True)
class ExplainedEchoSettings:
    """Echoes that the walls and points of a map explain."""

    gate: float = 3.5
    """Largest residual of an explained echo, standard deviations."""
    beyond: float = 0.1
    """A wall may reflect this far beyond its known ends, metres."""
    corner_reach: float = 1.5
    """Two walls meet if neither has to be extended by more than this, metres."""
    view_margin: float = float(np.radians(25.0))
    """Echoes arrive from up to this far outside of the nominal beam, radians."""
    min_distance: float = 0.05
    """Smallest distance between a sensor and a wall, metres."""
    released_length: float = 1.2
    """Walls shorter than this may be circles or edges; their echoes are fitted again, metres."""
    min_sigma: float = 0.001
    """Smallest standard deviation of ranges about a reflector of a map, metres."""
    sigma_gate: float = 0.05
    """Echoes within this distance of a wall determine the scatter of the ranges, metres."""
    model_error: float = 0.005
    """Error of the walls that is added to the gate, metres."""
    ghost_share: float = 0.7
    """Share of the echoes of a wall that other walls must hide, and explain by two reflections, before it counts as a
    mirror image."""
    vertex_distance: float = 0.1
    """A point this close to the end of a wall, or to where two walls meet, belongs to them; one this close to a found
    reflector is the same, metres."""
    min_wall_probability: float = 0.003
    """A short wall of the map remains if it may be a plane with this probability: most walls of maps are walls."""
    min_new_wall_probability: float = 0.98
    """A plane that the map lacks becomes a wall from this probability on, and is undecided below, or if it crosses a
    wall."""
    min_new_wall_length: float = 0.2
    """A shorter plane that the map lacks is undecided, metres."""
    same_line: float = 0.1
    """A plane both of whose ends are this close to the line of a wall, metres, ..."""
    bridged_gap: float = 1.5
    """... and that is not farther from the wall along it, metres, is a part of it: the map knows best what lies
    between."""
    on_wall: float = 0.03
    """An undecided reflector that may be a plane belongs to a wall that is this close, metres."""
    replaced_share: float = 0.5
    """Share of the echoes of a short wall that other reflectors must explain before they replace it."""
    sigma_iterations: int = 3
    """Times that the search is repeated with the scatter of the ranges about the found reflectors, ..."""
    min_scatter_echoes: int = 30
    """... if they have this many echoes, ..."""
    same_sigma: float = 1.2
    """... and the scatter differs from the assumed one by more than this factor."""


@dataclass(frozen=True)
class ReflectorSearchSettings:
    """All settings of the search for reflectors."""

    places: KeptScanSettings = field(default_factory=KeptScanSettings)
    """Scans that are kept."""
    measurements: IndependentMeasurementSettings = field(default_factory=IndependentMeasurementSettings)
    """Measurements that count as one."""
    voting: CenterVotingSettings = field(default_factory=CenterVotingSettings)
    """Votes for centers."""
    fit: KindFitSettings = field(default_factory=KindFitSettings)
    """Joint fits."""
    decision: ReflectorDecisionSettings = field(default_factory=ReflectorDecisionSettings)
    """Acceptance and kinds."""
    explanation: ExplainedEchoSettings = field(default_factory=ExplainedEchoSettings)
    """What a map explains."""


SETTINGS = ReflectorSearchSettings()
"""The settings in use."""

"""Alternation of mapping and adjustment, the loop that calibration and smoothing share."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from jaxsonar.estimation.adjustment_state import AdjustmentResult, AdjustmentState
from jaxsonar.estimation.landmark_map import LandmarkMap, landmark_map_of
from jaxsonar.mapping.global_map import GlobalMap


@dataclass(frozen=True)
class AlternationSettings:
    """Constants of the alternation. All of them were chosen by hand."""

    max_maps: int = 5
    """Maps that are built at most."""
    later_scale: float = 0.01
    """Initial scale of the robust loss from the second map on, metres."""
    min_growth: float = 1.005
    """Stop when the number of explained echoes grows by less than this factor."""


SETTINGS = AlternationSettings()


class AlternationResult(NamedTuple):
    """Maps, one for each ``map_index``, and the adjustment of their landmarks."""

    maps: list[GlobalMap]
    adjustment: AdjustmentResult

    @property
    def explained_count(self) -> int:
        """Number of echoes that the landmarks explain."""
        return int(self.adjustment.used.sum())


def alternate(
    state: AdjustmentState,
    *,
    build_maps: Callable[[AdjustmentState], list[GlobalMap]],
    adjust: Callable[[AdjustmentState, float], AdjustmentResult],
    initial_scale: float,
    progress: Callable[[str], None],
    max_maps: int = SETTINGS.max_maps,
    landmarks_of: Callable[[list[GlobalMap]], LandmarkMap] | None = None,
    settings: AlternationSettings = SETTINGS,
) -> AlternationResult | None:
    """Build a map from the current poses, adjust poses and landmarks, and repeat while more echoes are explained.

    Args:
        state: initial values; its landmarks are ignored.
        build_maps: the maps at a state, one for each ``map_index``.
        adjust: adjusts a state, with this initial scale of the robust loss (metres).
        initial_scale: that scale for the first map.
        progress: called with a description of each step.
        max_maps: maps that are built at most.
        landmarks_of: the landmarks of maps; by default every scan may observe all landmarks of its map.
        settings: constants of the loop.

    Returns:
        The best result, or None if no echo fits the first map.
    """
    landmarks_of = landmarks_of or (lambda maps: landmark_map_of(maps, tie_corners=False))
    best, best_count = None, 0
    for _ in range(max_maps):
        progress("building the map")
        maps = build_maps(state)
        progress("least squares")
        scale = initial_scale if best is None else settings.later_scale
        found = AlternationResult(maps, adjust(state._replace(landmark_map=landmarks_of(maps)), scale))
        if found.explained_count <= best_count:
            break
        growing = found.explained_count > settings.min_growth * best_count
        best, best_count, state = found, found.explained_count, found.adjustment.state
        if not growing:
            break
    return best

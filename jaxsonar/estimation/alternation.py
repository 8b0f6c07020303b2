"""Map, settle, map again: the loop that calibration and smoothing share."""

from collections.abc import Callable
from typing import NamedTuple

from jaxsonar.estimation.landmark_map import Surroundings, surroundings
from jaxsonar.estimation.robust_adjustment import Settled, State
from jaxsonar.mapping.global_map import GlobalMap

AGAIN = 0.01
"""Metres; scale of the first association after the map was made anew."""
MAPS = 5
"""Made anew at most, as long as each explains more echoes."""
_GROWN = 1.005  # by so much


class Round(NamedTuple):
    """Maps, one for every world, and what settled around them."""

    worlds: list[GlobalMap]
    settled: Settled

    @property
    def used(self) -> int:
        """Echoes that are explained."""
        return int(self.settled.used.sum())


def alternated(
    state: State,
    *,
    mapped: Callable[[State], list[GlobalMap]],
    settle: Callable[[State, float], Settled],
    widest: float,
    say: Callable[[str], None],
    maps: int = MAPS,
    around: Callable[[list[GlobalMap]], Surroundings] | None = None,
) -> Round | None:
    """The map so far; echoes to its reflectors and least squares, closer and closer; the same from there.

    Args:
        state: where to begin; its reflectors are not looked at.
        mapped: the maps of a state.
        settle: lets a state settle, with this scale of the first association (metres).
        widest: that of the first round.
        say: told what is being done.
        maps: made anew so often at most, as long as each explains more echoes.
        around: makes the reflectors of maps; all scans of a world may hear all of them if left out.

    Returns:
        The best round, or None where no echo fits the first map.
    """
    around = around or (lambda worlds: surroundings(worlds, tied=False))
    found = None
    for _ in range(maps):
        say("building the map")
        worlds = mapped(state)
        say("least squares")
        settled = settle(state._replace(around=around(worlds)), widest if found is None else AGAIN)
        before = 0 if found is None else found.used
        if settled.used.sum() <= before:
            break
        found = Round(worlds, settled)
        if found.used <= _GROWN * before:
            break
        state = settled.state
    return found

"""Probabilities of places in a known map, from the evidence of every scan along their tracks."""

import numpy as np
from jaxtyping import Float
from scipy.special import softmax

from jaxsonar.localization.settings import SETTINGS, MapTrust


def relative_log_likelihood(
    evidence: Float[np.ndarray, "places scans"], weight: Float[np.ndarray, " scans"], trust: MapTrust
) -> Float[np.ndarray, " places"]:
    """Log-likelihoods of places relative to the best fit of every scan, nats, at most 0.

    Echoes, and scans that are near each other, are not independent: they share the errors of the map, furniture that
    it does not contain, and doors that it shows otherwise. So a stretch of the trajectory is one observation, and a
    fraction ``trust.wrong_share`` of all stretches says nothing, because the map is wrong there.

    Args:
        evidence: of each scan at each place, nats.
        weight: of each scan: its part of an independent stretch, at most 1.
        trust: in the map.
    """
    behind = (evidence - evidence.max(axis=0)) / trust.temperature
    return (weight * np.log(trust.wrong_share + (1 - trust.wrong_share) * np.exp(behind))).sum(axis=1)


def place_probabilities(log_likelihood: Float[np.ndarray, " places"], none: float) -> Float[np.ndarray, " places"]:
    """Probabilities of places; the rest to 1 is the probability of none of them.

    Args:
        log_likelihood: of each place, nats.
        none: log-likelihood of none of them: the map explains as much as it would by chance.
    """
    count = max(len(log_likelihood), 1)
    prior = np.log(np.append(np.full(len(log_likelihood), (1 - SETTINGS.none_share) / count), SETTINGS.none_share))
    # What a place explains by chance it has in common with every other place.
    beyond_chance = np.maximum(log_likelihood - none, 0.0)
    with np.errstate(divide="ignore"):
        own = none + np.where(beyond_chance > 30, beyond_chance, np.log(np.expm1(np.minimum(beyond_chance, 30))))
    return softmax(np.append(own, none) + prior)[:-1]

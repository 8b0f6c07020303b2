"""Probabilities of places: laws of the evidence of stretches."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from jaxsonar.localization.place_probabilities import place_probabilities, relative_log_likelihood
from jaxsonar.localization.settings import MapTrust

TRUST = MapTrust(stretch=1.5, wrong_share=0.05, temperature=4.0)
SEEDS = st.integers(0, 1000)


def evidence_of(seed, places=4, scans=9):
    rng = np.random.default_rng(seed)
    return rng.uniform(-20, 60, (places, scans)), rng.uniform(0, 0.4, scans)


@given(SEEDS)
def test_what_all_places_have_in_common_says_nothing(seed):
    evidence, weight = evidence_of(seed)
    common = np.random.default_rng(seed + 1).normal(0, 30, evidence.shape[1])
    found = relative_log_likelihood(evidence, weight, TRUST)
    np.testing.assert_allclose(relative_log_likelihood(evidence + common, weight, TRUST), found, atol=1e-9)
    assert (found <= 0).all()


@given(SEEDS, st.floats(1.0, 1e6))
def test_no_stretch_excludes_a_place(seed, worse):
    """However much the map disagrees with the echoes, a place loses at most the log of the share of wrong stretches."""
    evidence, weight = evidence_of(seed)
    changed = evidence.copy()
    changed[0, :3] -= worse
    before, after = (relative_log_likelihood(one, weight, TRUST) for one in (evidence, changed))
    assert after[0] <= before[0] + 1e-9
    assert after[0] >= before[0] + np.log(TRUST.wrong_share) * weight[:3].sum() - 1e-9


@given(SEEDS)
def test_the_division_into_scans_does_not_matter(seed):
    evidence, weight = evidence_of(seed)
    found = relative_log_likelihood(evidence, weight, TRUST)
    finer = relative_log_likelihood(np.repeat(evidence, 3, axis=1), np.repeat(weight / 3, 3), TRUST)
    np.testing.assert_allclose(finer, found, atol=1e-9)


@given(SEEDS)
def test_probabilities(seed):
    """They and that of no place sum to 1, do not depend on the order, and places that are alike share equally."""
    rng = np.random.default_rng(seed)
    score = rng.uniform(-8, 0, 5)
    found = place_probabilities(score, -9.0)
    assert 0 < found.sum() < 1
    order = rng.permutation(5)
    np.testing.assert_allclose(place_probabilities(score[order], -9.0), found[order], rtol=1e-12)
    twins = place_probabilities(np.append(score, score[0]), -9.0)
    np.testing.assert_allclose(twins[0], twins[-1])
    # If nothing fits better than chance, no place is certain.
    assert place_probabilities(np.array([-20.0]), 0.0)[0] < 0.01
    assert len(place_probabilities(np.zeros(0), 0.0)) == 0

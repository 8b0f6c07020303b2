"""A finding: its text, its JSON, and its confidence."""

import json

import pytest

from jaxsonar.diagnostics.findings import Finding, confidence_of

FINDING = Finding("offset", (3,), "sensor 3 reports too much", 0.98765, "12 standard errors", "calibrate")


def test_the_text_has_the_sentence_the_evidence_and_the_remedy():
    sentence, evidence, remedy = FINDING.lines()
    assert sentence == "sensor 3 reports too much"
    assert "12 standard errors" in evidence
    assert "99%" in evidence
    assert remedy.endswith("calibrate")


def test_json_has_all_but_the_sentence():
    plain = json.loads(json.dumps(FINDING.as_json()))
    assert plain == {
        "cause": "offset",
        "sensors": [3],
        "confidence": pytest.approx(0.9877, abs=1e-4),
        "evidence": "12 standard errors",
        "remedy": "calibrate",
    }


def test_the_confidence_follows_the_odds():
    assert confidence_of(0.0) == 0.5
    assert confidence_of(1e9) <= 1
    assert confidence_of(2.0) + confidence_of(-2.0) == pytest.approx(1)
    assert confidence_of(1.0) < confidence_of(2.0)

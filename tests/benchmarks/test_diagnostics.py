"""The diagnostics benchmark: simulated faults are what they are said to be, and results are judged correctly."""

import contextlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.diagnostics import confusion, warning_rates
from benchmarks.diagnostics.faults import FAULTS, LEAST_NOISE, case
from benchmarks.diagnostics.mistakes import WORDS, sound_inputs, wrong_input
from benchmarks.diagnostics.scenes import CLEARANCE, STYLES, random_scene
from jaxsonar import SonarError
from jaxsonar.geometry.segments import point_to_segments


@pytest.mark.parametrize("seed", range(len(STYLES)))
def test_the_robot_keeps_its_clearance_and_its_speed(seed):
    scene = random_scene(seed)
    assert scene.style == STYLES[seed]
    assert (point_to_segments(scene.poses[:, :2], scene.room.walls) >= 0.97 * CLEARANCE).all()
    step = np.hypot(*np.diff(scene.poses[:, :2], axis=0).T)
    assert step.max() < 2 * np.median(step[step > 0])
    assert np.bincount(scene.log().tx, minlength=scene.ring.count).sum() > 300


def test_a_seed_gives_the_same_case_and_another_one_a_different_case():
    first, again, other = case("weak", 4), case("weak", 4), case("weak", 5)
    np.testing.assert_array_equal(first.log.range, again.log.range)
    assert first.sensors == again.sensors
    assert len(other.log.range) != len(first.log.range)


@pytest.mark.parametrize("cause", [cause for cause in FAULTS if cause not in confusion.FAULTLESS])
def test_each_fault_changes_the_log_or_the_ring(cause):
    found = case(cause, 6)
    scene = random_scene(6, styles=FAULTS[cause][1] or STYLES)
    healthy = (replace(scene, sigma=max(scene.sigma, LEAST_NOISE)) if cause == "noise" else scene).log()
    same = len(found.log.range) == len(healthy.range) and bool((found.log.range == healthy.range).all())
    same = same and bool((found.log.pose == healthy.pose).all())
    if cause in ("noise", "beam width"):
        assert same
    else:
        assert not same


def test_a_dead_sensor_is_silent_and_an_own_echo_is_constant():
    dead = case("dead", 3)
    assert dead.sensors[0] not in (*dead.log.tx, *dead.log.rx)
    own = case("own echo", 3)
    direct = own.log.range[(own.log.tx == own.sensors[0]) & (own.log.rx == own.sensors[0])]
    values, count = np.unique(np.round(direct, 2), return_counts=True)
    assert count.max() > 0.4 * len(own.log)
    assert values[np.argmax(count)] < 0.51


def judged(monkeypatch, one, findings):
    monkeypatch.setattr(confusion, "check", lambda ring, log, sigma: SimpleNamespace(findings=findings))
    return confusion.outcome(one)


def finding(cause, *sensors):
    return SimpleNamespace(cause=cause, sensors=sensors, sentence=f"{cause} {sensors}")


def test_findings_are_judged_by_cause_and_sensors(monkeypatch):
    one = case("dead", 3)
    k = one.sensors[0]
    right, other = finding("dead", k), finding("weak", k + 1)
    assert judged(monkeypatch, one, (right,)).result == "correct"
    assert judged(monkeypatch, one, ()).result == "undetected"
    both = judged(monkeypatch, one, (right, other))
    assert (both.result, both.accused, both.others) == ("correct", (k + 1,), 1)
    assert judged(monkeypatch, one, (other, right)).result == "wrong"
    elsewhere = judged(monkeypatch, one, (finding("dead", k + 2),))
    assert (elsewhere.result, elsewhere.accused) == ("wrong", (k + 2,))
    assert judged(monkeypatch, one, (finding("weak", k),)).accused == ()
    healthy = case("healthy", 3)
    assert judged(monkeypatch, healthy, ()).result == "correct"
    assert judged(monkeypatch, healthy, (right,)).result == "wrong"
    shown = confusion.table([both, elsewhere])
    assert shown.row_count == 2


def test_warnings_are_judged_by_their_words(monkeypatch):
    def texts(*found):
        monkeypatch.setattr(warning_rates, "warnings_about", lambda one: iter(found))
        return warning_rates.wrong_of("ranges in mm", 0).result

    assert texts() == "silent"
    assert texts("something else") == "other words"
    assert texts("something else", "ranges are in millimetres") == "named"

    def refusing(one):
        raise SonarError("ranges in mm?")

    monkeypatch.setattr(warning_rates, "warnings_about", refusing)
    found = warning_rates.wrong_of("ranges in mm", 0)
    assert (found.result, found.warnings) == ("named", ("error: ranges in mm?",))
    assert warning_rates.table([found]).row_count == 1


@pytest.mark.slow
def test_all_inputs_can_be_built():
    names = [one.name for one in sound_inputs()]
    assert len(names) >= 50
    for name in WORDS:
        with contextlib.suppress(SonarError):  # refused values
            assert wrong_input(name, 1).name == name

"""Rings from the transforms and messages of a bag."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from support.bags import KINDS, BagMessages
from support.rings import bumper_ring

from jaxsonar.geometry.se2 import compose, inverse
from jaxsonar.hardware.errors import SonarError
from jaxsonar.recordings.input_options import InputOptions
from jaxsonar.recordings.rosbag_log import read_bag, ring_from_bag

pytest.importorskip("rosbags")

RING = dataclasses.replace(bumper_ring(calibrated=False), neighbors=0)
NAMES = [f"us_{chr(ord('a') + k)}" for k in range(RING.count)]


def described(kind="sqlite", names=NAMES, *, quaternion=None, view=None):
    """A bag that describes a ring: sensors on a mount that is turned and moved against the robot."""
    bag = BagMessages(kind)
    mount = np.array([0.2, 0.1, 0.7])
    bag.transform(0.0, "base_link", "mount", mount)
    for k, name in enumerate(names):
        pose = np.array([*RING.position[k], RING.heading[k]])
        bag.transform(0.0, "mount", name, compose(inverse(mount), pose), quaternion=quaternion)
        beam = float(RING.beam[k]) if view is None else view
        bag.range(0.1 * k, 1.0 + 0.25 * k, frame=name, view=beam, limits=(0.02, RING.max_range))
    bag.odometry(0.0, (0.0, 0.0, 0.0))
    return bag


def assert_same_ring(ring, order: Any = slice(None)):
    np.testing.assert_allclose(ring.position, np.asarray(RING.position)[order], atol=2e-6)
    np.testing.assert_allclose(np.exp(1j * ring.heading), np.exp(1j * np.asarray(RING.heading)[order]), atol=1e-8)
    np.testing.assert_allclose(ring.beam, np.asarray(RING.beam)[order], atol=1e-6)
    assert ring.max_range == RING.max_range
    assert ring.neighbors == 0


@pytest.mark.parametrize("kind", KINDS)
def test_transforms_and_fields_of_view_give_the_ring(tmp_path, kind):
    names = [f"us_{k + 1}" for k in range(RING.count)]
    path = described(kind, names).write(tmp_path / "run")
    ring = ring_from_bag(path)
    assert_same_ring(ring)
    assert ring.names == tuple(names)
    log = read_bag(path, ring=ring)  # numbers from 1 are no question with this ring
    assert log.tx.tolist() == list(range(RING.count))
    np.testing.assert_allclose(log.range, 1.0 + 0.25 * np.arange(RING.count))


def test_sensors_without_numbers_are_sorted_by_heading_or_by_option(tmp_path):
    path = described().write(tmp_path / "run")
    order = np.argsort(np.mod(np.asarray(RING.heading) + 1e-6, 2 * np.pi))
    ring = ring_from_bag(path)
    assert_same_ring(ring, order)
    assert ring.names == tuple(np.array(NAMES)[order])
    given = {name: k for k, name in enumerate(NAMES[::-1])}
    assert_same_ring(ring_from_bag(path, options=InputOptions(sensors=given)), slice(None, None, -1))


def test_what_a_ring_needs(tmp_path):
    path = described(view=0.0).write(tmp_path / "view")
    with pytest.raises(SonarError, match="field_of_view is 0; needed for a ring are radians above 0"):
        ring_from_bag(path)
    up = (0.0, -np.sqrt(0.5), 0.0, np.sqrt(0.5))
    with pytest.raises(SonarError, match="the x axis of frame 'us_a' points up or down"):
        ring_from_bag(described(quaternion=up).write(tmp_path / "up"))
    one_frame = BagMessages()
    one_frame.transform(0.0, "base_link", "sonars", (0, 0, 0))
    for k in range(3):
        one_frame.range(0.1 * k, 1.0, frame="sonars", topic=f"/us{k}")
    with pytest.raises(SonarError, match="3 sensors have the frame 'sonars'; needed for a ring is a frame for each"):
        ring_from_bag(one_frame.write(tmp_path / "one"))
    bag = BagMessages()
    bag.range(0.0, 1.0, frame="us_0")
    with pytest.raises(SonarError, match="no robot frame base_link came; no transforms came"):
        ring_from_bag(bag.write(tmp_path / "none"))
    bag.transform(0.0, "base_link", "laser", (0, 0, 0))
    with pytest.raises(
        SonarError, match=r"frame 'us_0' of /us_0 is not connected to 'base_link'.* base_link, laser came"
    ):
        ring_from_bag(bag.write(tmp_path / "other"))


def test_a_question_proposes_the_places_of_the_frames(tmp_path):
    path = described().write(tmp_path / "run")
    with pytest.raises(SonarError, match=r"us_a=0 --sensor us_b=1 --sensor us_c=2 --sensor us_d=3, which is where the"):
        read_bag(path, ring=RING)
    moved = dataclasses.replace(RING, position=np.asarray(RING.position) + 1.0)
    with pytest.raises(SonarError, match="us_a=INDEX"):
        read_bag(path, ring=moved)


def test_sensors_that_look_elsewhere_are_a_warning(tmp_path):
    path = described(names=[f"us_{k}" for k in range(RING.count)]).write(tmp_path / "run")
    notes = []
    read_bag(path, ring=RING, on_note=notes.append)
    assert not any(one.startswith("warning") for one in notes)
    mirrored = dataclasses.replace(RING, heading=np.asarray(RING.heading) + np.radians([0, 0, 0, 90]))
    read_bag(path, ring=mirrored, on_note=notes.append)
    warnings = [one for one in notes if one.startswith("warning")]
    assert len(warnings) == 1
    assert (
        "1 sensors do not look where their frames do: us_3 looks to 15 deg and sensor 3 of the ring to 105"
        in warnings[0]
    )

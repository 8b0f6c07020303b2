"""Names of the sensors of a bag: a mapping or certain numbers, otherwise a question in one line."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsonar.hardware.errors import SonarError
from jaxsonar.recordings.rosbag_sensors import BagSensor, sensor_indices

SIDES = ["front", "front_left", "left", "rear_left", "rear", "rear_right", "right", "front_right"]


def resolved(frames, topics=None, *, count: int | None = 8, ring_names=(), given=None) -> tuple[Any, list[str]]:
    """Indices of sensors, and the notes."""
    topics = topics or [f"/range/{k}" if len(set(frames)) < len(frames) else f"/{one}" for k, one in enumerate(frames)]
    sensors = [BagSensor(topic, frame) for topic, frame in zip(topics, frames, strict=True)]
    notes = []
    options = {"count": count, "ring_names": ring_names, "given": given or {}, "name": "run.bag", "note": notes.append}
    return sensor_indices(sensors, **options), notes


def question(*args, **kwargs):
    with pytest.raises(SonarError) as caught:
        resolved(*args, **kwargs)
    message = str(caught.value)
    assert message.isprintable()
    assert message.startswith(("run.bag: ", "--sensor "))
    return message


NUMBERED = {
    "underscore": "sonar_{}",
    "attached": "us{}",
    "inside": "base_sonar_{}_link",
    "namespace": "robot1/sonar_{}",
    "leading zeros": "sonar_{:02d}",
    "type name with digits": "hcsr04_{}_link",
    "number before the type name": "us_{}_mb1242",
}


@pytest.mark.parametrize("pattern", NUMBERED.values(), ids=NUMBERED)
def test_numbers_from_0_are_indices(pattern, rng):
    order = rng.permutation(12)
    index, notes = resolved([pattern.format(k) for k in order], count=12)
    assert index == order.tolist()
    assert notes == [f"sensors: 12 by the numbers of their frames, {pattern.format(0)} to {pattern.format(11)}"]


@pytest.mark.parametrize("pattern", NUMBERED.values(), ids=NUMBERED)
def test_numbers_from_1_are_a_question_with_the_answer(pattern):
    message = question([pattern.format(k) for k in range(1, 9)])
    assert "seem to count from 1, the ring's sensors are 0 to 7" in message
    for k in range(8):
        assert f"--sensor {pattern.format(k + 1)}={k}" in message


@given(missing=st.sets(st.integers(1, 7), max_size=5))
def test_numbers_with_0_may_be_incomplete(missing):
    present = [k for k in range(8) if k not in missing]
    index, notes = resolved([f"sonar_{k}" for k in present])
    assert index == present
    assert len(notes) == 1 + bool(missing)
    if missing:
        assert notes[1] == f"sensors of the ring without messages: {', '.join(map(str, sorted(missing)))}"


@pytest.mark.parametrize(
    ("frames", "why"),
    [
        ([f"ultrasonic_{side}" for side in SIDES], "do not tell which sensor"),
        ([f"hcsr04_{side}" for side in SIDES], "do not tell which sensor"),
        (["hcsr04_front"], "whether they count from 0 or from 1"),
        (["sonar_0"], "do not show whether"),
        ([f"sonar_{k}" for k in range(1, 7)], "whether they count from 0 or from 1"),
        ([f"sonar_{k}" for k in range(9)], "the numbers 0 to 8 are not those of the ring's sensors 0 to 7"),
        ([f"i2c_{k}" for k in range(112, 120)], "the numbers 112 to 119 are not those of the ring's sensors 0 to 7"),
        (["front_0", "front_1", "rear_0", "rear_1"], "do not tell which sensor"),
        ([f"robot{robot}/sonar_{k}" for robot in (1, 2) for k in range(4)], "do not tell which sensor"),
        (["sonar_0", "sonar_1", "bumper"], "do not tell which sensor"),
        (["front_0", "side_2", "rear_4"], "are not those"),
    ],
)
def test_uncertain_names_are_a_question(frames, why):
    message = question(frames)
    assert why in message
    for one in frames:
        assert f"--sensor {one}=INDEX" in message


def test_numbers_without_a_ring_count_from_0():
    assert resolved(["us0", "us1", "us2"], count=None)[0] == [0, 1, 2]
    assert "--sensor us1=INDEX" in question(["us1", "us2", "us3"], count=None)


def test_frames_of_one_topic_and_topics_of_one_frame():
    assert resolved([f"sonar_{k}" for k in range(8)], ["/sonars"] * 8)[0] == list(range(8))
    assert resolved(["base_link"] * 8, [f"/sonar/{k}/range" for k in range(8)])[0] == list(range(8))
    assert resolved([""] * 8, [f"/us{k}" for k in range(8)])[0] == list(range(8))
    assert "/us_left=INDEX" in question(["sonar"] * 2, ["/us_left", "/us_right"])


def test_frames_and_topics_that_contradict_each_other_are_a_question():
    frames = [f"sonar_{k}" for k in range(8)]
    topics = [f"/us/{k}" for k in range(8)]
    assert resolved(frames, topics)[0] == list(range(8))
    assert "contradict each other" in question(frames, topics[::-1])
    one_based = [f"sonar_{k}" for k in range(1, 9)]
    assert resolved(one_based, topics)[0] == list(range(8))


def test_the_only_sensor_of_a_ring_of_one():
    assert resolved(["ultrasonic"], count=1)[0] == [0]


@pytest.mark.parametrize("place", ["option", "ring"])
def test_names_are_given(place, rng):
    order = rng.permutation(8)
    frames = [f"robot/hcsr04_{SIDES[k]}" for k in order]
    topics = [f"/robot/us/{SIDES[k]}" for k in order]
    for names in (
        [f"robot/hcsr04_{side}" for side in SIDES],
        [f"hcsr04_{side}" for side in SIDES],
        [f"/robot/us/{side}" for side in SIDES],
        [f"/us/{side}" for side in SIDES],
        [f"/hcsr04_{side}" for side in SIDES],
    ):
        pairs = {name: k for k, name in enumerate(names)}
        index, notes = (
            resolved(frames, topics, given=pairs) if place == "option" else resolved(frames, topics, ring_names=names)
        )
        assert index == order.tolist()
        assert notes[0].startswith("sensors: 8 by name: ")


def test_options_are_preferred_to_the_ring_and_others_are_left_out():
    frames = ["us_left", "us_right", "us_rear", "us_new"]
    index, notes = resolved(
        frames, count=3, ring_names=("us_left", "us_right", "us_old"), given={"us_right": 0, "us_left": 1}
    )
    assert index == [1, 0, None, None]
    assert notes[1:] == [
        "sensors of the ring without messages: 2 (us_old)",
        "sensors left out, because they have no name in the ring: us_rear, us_new",
    ]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"us_front": 0}, "no such sensor; the ultrasound sensors us_left, us_right came"),
        ({"us_left": 8}, "--sensor us_left=8: allowed are indices 0 to 7"),
        ({"us_left": -1}, "allowed are indices 0 to 7"),
        ({"us_left": 0, "us_right": 0}, "us_right and us_left came for sensor 0"),
        ({"us_left": 0, "/us_left": 1}, "indices 0 and 1 came for us_left"),
    ],
)
def test_wrong_options_are_named(given, message):
    assert message in question(["us_left", "us_right"], given=given)


def test_a_name_of_two_sensors_is_a_question():
    frames, topics = ["us_left", "us_left", "us_right"], ["/a/range", "/b/range", "/c/range"]
    assert "name the topic instead: --sensor /a/range=2" in question(frames, topics, given={"us_left": 2})
    assert resolved(frames, topics, given={"/b/range": 2, "us_right": 1})[0] == [None, 2, 1]


def test_a_ring_with_other_names_is_a_question():
    message = question(["us_left", "us_right"], ring_names=("a", "b", "", "", "", "", "", ""))
    assert (
        "none of the sensors that the ring names came (a, b); the ultrasound sensors us_left, us_right came" in message
    )


@given(st.lists(st.text(max_size=8), min_size=1, max_size=5), st.integers(1, 5))
def test_any_names_give_distinct_indices_or_one_line(frames, count):
    try:
        index = resolved(frames, count=count)[0]
    except SonarError as error:
        index, message = None, str(error)
    else:
        message = ""
    assert message.isprintable()
    if index is not None:
        assert len(set(index)) == len(frames)
        assert 0 <= min(index) <= max(index) < count

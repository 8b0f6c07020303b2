"""Times of messages in a bag: the stamps of their headers, or the times of recording if the stamps do not agree."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxsonar.recordings.rosbag_messages import Messages


@dataclass(frozen=True)
class ClockSettings:
    """Constants of the comparison of clocks. Chosen by hand."""

    max_disagreement: float = 1.0
    """Header stamps of two topics that differ by more, relative to the time of recording, are of different clocks,
    seconds. It exceeds the delay of messages."""
    max_backward: float = 1.0
    """Stamps of a topic that go back by more are those of a clock that was set, seconds."""


SETTINGS = ClockSettings()


def message_times(streams: Sequence[Messages], note: Callable[[str], None]) -> list[Float[np.ndarray, " messages"]]:
    """The time of each message, seconds, on one clock.

    This is the stamp of the header. A message without one has the time of recording. If the stamps of the topics
    disagree, or if they go back, all messages have the times of recording.

    Args:
        streams: the messages; the first stream is compared with the others.
        note: called with one line that says which times were chosen, and why.
    """
    stamped = [bool(np.isfinite(one.stamp).any()) for one in streams]
    if not any(stamped):
        note("times: those of recording, because no message has a stamp")
        return [one.received for one in streams]
    for one, has_stamps in zip(streams, stamped, strict=True):
        back = -np.diff(one.stamp[np.isfinite(one.stamp)]).min(initial=0) if has_stamps else 0.0
        if back > SETTINGS.max_backward:
            note(f"times: those of recording, because the stamps of {one.topic} go back by {back:.1f} s")
            return [one.received for one in streams]
    reference = max(range(len(streams)), key=lambda k: (stamped[k], -k))
    for one, has_stamps in zip(streams, stamped, strict=True):
        difference = _offset_difference(one, streams[reference], has_stamps)
        if abs(difference) > SETTINGS.max_disagreement:
            other = streams[reference].topic
            came = f"the stamps of {one.topic} and {other} differ by {abs(difference):.1f} s"
            if not has_stamps:
                came = f"{one.topic} has no stamps, and those of {other} are of another clock"
            note(f"times: those of recording, because {came}")
            return [one.received for one in streams]
    unset = sum(int(np.isnan(one.stamp).sum()) for one in streams)
    note("times: stamps of the headers" + (f"; {unset} messages without one have the time of recording" * bool(unset)))
    return [_stamps(one) for one in streams]


def _stamps(one: Messages) -> Float[np.ndarray, " messages"]:
    """Stamps; where they are unset, the time of recording with the median delay of the others."""
    unset = np.isnan(one.stamp)
    if not unset.any():
        return one.stamp
    delay = 0.0 if unset.all() else float(np.median((one.received - one.stamp)[~unset]))
    return np.where(unset, one.received - delay, one.stamp)


def _offset_difference(one: Messages, other: Messages, has_stamps: bool) -> float:
    """Median difference of stamp minus time of recording between two topics, at equal times of recording, seconds."""
    known = np.isfinite(other.stamp)
    order = np.argsort(other.received[known], kind="stable")
    received, offset = other.received[known][order], (other.stamp - other.received)[known][order]
    use = np.isfinite(one.stamp) if has_stamps else np.ones(len(one.stamp), bool)
    own = (one.stamp - one.received)[use] if has_stamps else np.zeros(len(one.stamp))
    return float(np.median(own - np.interp(one.received[use], received, offset)))

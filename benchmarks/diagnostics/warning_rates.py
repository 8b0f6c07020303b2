"""Warnings about inputs: which mistakes are named, and which sound inputs get a warning.

Run ``python -m benchmarks.diagnostics.warning_rates [--quick] [--only NAME ...] [-o DIR]``.
"""

import argparse
import json
import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.diagnostics.mistakes import WORDS, Input, sound_inputs, wrong_input
from benchmarks.metrics import environment
from jaxsonar.fileio.atomic_files import atomic_write, make_folder
from jaxsonar.hardware.errors import SonarError
from jaxsonar.plausibility.implausible_noise import implausible_noise
from jaxsonar.plausibility.implausible_ring import implausible_ring
from jaxsonar.plausibility.implausible_room import implausible_room, implausible_trajectory
from jaxsonar.plausibility.prepared_log import prepared_log


@dataclass(frozen=True)
class Warned:
    """The warnings about one input."""

    name: str
    seed: int
    result: str
    """``named``, ``other words``, ``silent``; for a sound input ``silent`` or ``false alarm``."""
    warnings: tuple[str, ...]
    seconds: float


def warned(one: Input) -> Warned:
    """All warnings about one input, compared with the words that they must contain."""
    start = time.perf_counter()
    try:
        found = tuple(warnings_about(one))
    except SonarError as error:
        found = (f"error: {error}",)
    return Warned(one.name, one.seed, _result(WORDS.get(one.name, ""), found), found, time.perf_counter() - start)


def _result(words: str, found: Sequence[str]) -> str:
    if not words:
        return "false alarm" if found else "silent"
    if not found:
        return "silent"
    return "named" if any(re.search(words, text, re.IGNORECASE) for text in found) else "other words"


def warnings_about(one: Input) -> Iterator[str]:
    """Warnings about ring, room, trajectory, noise and log, as the commands print them.

    Raises:
        SonarError: an input is refused.
    """
    yield from map(str, implausible_ring(one.ring))
    if one.room is not None:
        yield from map(str, implausible_room(one.room))
        if one.poses is not None:
            yield from map(str, implausible_trajectory(one.room, one.poses))
    if one.noise is not None:
        yield from map(str, implausible_noise(one.noise))
    if one.log is not None:
        notes: list[str] = []
        prepared_log(one.ring, one.log, on_note=notes.append)
        yield from (text.removeprefix("warning: ") for text in notes if text.startswith("warning: "))


def wrong_of(name: str, seed: int) -> Warned:
    """Build one wrong input and judge its warnings; so is the message if it is refused."""
    try:
        return warned(wrong_input(name, seed))
    except SonarError as error:
        return Warned(name, seed, _result(WORDS[name], [str(error)]), (f"error: {error}",), 0.0)


def table(found: Sequence[Warned]) -> Table:
    """Results of each mistake, and of all sound inputs together."""
    shown = Table(title="Warnings about inputs")
    for column in ("input", "inputs", "named", "other words", "silent", "false alarms", "s"):
        shown.add_column(column, justify="left" if column == "input" else "right")
    sound = [one for one in found if one.name not in WORDS]
    rows = {name: [one for one in found if one.name == name] for name in WORDS} | {"sound": sound}
    for name, own in rows.items():
        if own:
            results = [one.result for one in own]
            count = [results.count(key) for key in ("named", "other words", "silent", "false alarm")]
            shown.add_row(name, str(len(own)), *map(str, count), f"{np.median([one.seconds for one in own]):.2f}")
    return shown


def main() -> None:
    """Judge all inputs, write the results, print the table."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--quick", action="store_true", help="1 input of each mistake instead of 10")
    options.add_argument("--inputs", type=int, help="inputs of each mistake")
    options.add_argument("--seed", type=int, default=0, help="first seed (default: 0)")
    options.add_argument("--only", nargs="+", choices=("sound", *WORDS), default=("sound", *WORDS), metavar="NAME")
    options.add_argument("-o", "--output", type=Path, default=Path("benchmark-results/diagnostics"))
    options = options.parse_args()
    count, found, stderr = options.inputs or (1 if options.quick else 10), [], Console(stderr=True)

    def add(one: Warned) -> None:
        found.append(one)
        text = f"{one.name} {one.seed}: {one.result}, {one.seconds:.2f} s" + "".join(f"\n    {w}" for w in one.warnings)
        stderr.print(text, highlight=False, soft_wrap=True, markup=False)

    if "sound" in options.only:
        for one in sound_inputs(options.seed):
            add(warned(one))
    for name in WORDS:
        if name in options.only:
            for seed in range(options.seed, options.seed + count):
                add(wrong_of(name, seed))
    make_folder(options.output)
    with atomic_write(options.output / "warnings.json") as file:
        json.dump({"versions": environment(), "inputs": [asdict(one) for one in found]}, file, indent=1)
    Console(width=120).print(table(found))


if __name__ == "__main__":
    main()

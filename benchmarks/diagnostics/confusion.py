"""Confusion table of the health check: simulated faults of known cause against its findings.

Run ``python -m benchmarks.diagnostics.confusion [--quick] [--only CAUSE ...] [-o DIR]``. A case is correct if the first
finding has the right cause and the right sensors; without a fault, if there is no finding. It is undetected if there is
no finding, else wrong. A finding that names a sensor without a fault accuses it.
"""

import argparse
import json
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.diagnostics.faults import ACCEPTED, FAULTS, Case, case
from benchmarks.metrics import environment
from jaxsonar.diagnostics.check_ring import check
from jaxsonar.fileio.atomic_files import atomic_write, make_folder
from jaxsonar.hardware.errors import SonarError

FAULTLESS = "healthy", "waiting robot"
"""Cases without a fault."""


@dataclass(frozen=True)
class Outcome:
    """The findings about one case."""

    cause: str
    seed: int
    result: str
    """``correct``, ``wrong`` or ``undetected``."""
    found: tuple[str, ...]
    """Cause of each finding, in order."""
    accused: tuple[int, ...]
    """Sensors that were named but are healthy."""
    others: int
    """Number of findings with another cause than the right one."""
    sentences: tuple[str, ...]
    detail: str
    seconds: float


def outcome(one: Case) -> Outcome:
    """Check one case and judge the findings."""
    start = time.perf_counter()
    try:
        found = [(f.cause, f.sensors, f.sentence) for f in check(one.ring, one.log, sigma=one.sigma).findings]
    except SonarError as error:
        found = [(f"error: {error}", (), str(error))]
    seconds = time.perf_counter() - start
    allowed = ACCEPTED.get(one.cause, (one.cause,))
    right = [cause in allowed and _same_sensors(one, sensors) for cause, sensors, _ in found]
    if one.cause in FAULTLESS:
        result = "wrong" if found else "correct"
    else:
        result = "correct" if right and right[0] else "wrong" if found else "undetected"
    named = {k for (_, sensors, _), fits in zip(found, right, strict=True) if not fits for k in sensors}
    return Outcome(
        one.cause,
        one.seed,
        result,
        tuple(cause for cause, _, _ in found),
        tuple(sorted(named - set(one.sensors))),
        sum(cause not in allowed for cause, _, _ in found),
        tuple(sentence for _, _, sentence in found),
        one.detail,
        seconds,
    )


def _same_sensors(one: Case, sensors: Sequence[int]) -> bool:
    """Whether a finding names the faulty sensors; for a fault of all it may name any."""
    return not one.sensors or set(sensors) == set(one.sensors)


def table(outcomes: Sequence[Outcome]) -> Table:
    """Correct, wrong and undetected cases of each cause, and what was found instead."""
    versions = environment()
    shown = Table(
        title="Findings of the health check",
        caption="accused: cases in which a healthy sensor is named; others: cases with further findings. "
        f"jax {versions['jax']} on {versions['device']}, {(versions['commit'] or 'no commit')[:10]}",
    )
    for column in ("cause", "logs", "correct", "wrong", "undetected", "accused", "others", "found first if wrong"):
        shown.add_column(column, justify="left" if column in ("cause", "found first if wrong") else "right")
    for cause in [*dict.fromkeys(one.cause for one in outcomes), "all"]:
        own = [one for one in outcomes if cause in (one.cause, "all")]
        counts = Counter(one.result for one in own)
        wrong = Counter(one.found[0] for one in own if one.result == "wrong")
        accused, others = sum(bool(one.accused) for one in own), sum(one.others > 0 for one in own)
        numbers = [len(own), *(counts[key] for key in ("correct", "wrong", "undetected")), accused, others]
        instead = "" if cause == "all" else ", ".join(f"{what} {count}" for what, count in wrong.most_common(4))
        shown.add_row(cause, *map(str, numbers), instead[:80])
    return shown


def main() -> None:
    """Check all cases, write the outcomes, print the table."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--quick", action="store_true", help="3 logs of each cause instead of 30")
    options.add_argument("--logs", type=int, help="logs of each cause")
    options.add_argument("--seed", type=int, default=0, help="first seed (default: 0)")
    options.add_argument("--only", nargs="+", choices=FAULTS, default=list(FAULTS), metavar="CAUSE")
    options.add_argument("-o", "--output", type=Path, default=Path("benchmark-results/diagnostics"))
    options = options.parse_args()
    logs = options.logs or (3 if options.quick else 30)
    outcomes, stderr = [], Console(stderr=True)
    make_folder(options.output)
    for seed in range(options.seed, options.seed + logs):
        for cause in options.only:
            one = outcome(case(cause, seed))
            outcomes.append(one)
            text = f"{cause} {seed} ({one.detail}): {one.result}, {one.seconds:.1f} s" + "".join(
                f"\n    {sentence}" for sentence in one.sentences
            )
            stderr.print(text, highlight=False, soft_wrap=True, markup=False)
        _write(outcomes, options.output / "confusion.json")
    Console(width=160).print(table(outcomes))


def _write(outcomes: Sequence[Outcome], filename: Path) -> None:
    with atomic_write(filename) as file:
        json.dump({"versions": environment(), "outcomes": [asdict(one) for one in outcomes]}, file, indent=1)


if __name__ == "__main__":
    main()

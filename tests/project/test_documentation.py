"""The documentation is correct: all blocks run as printed, tables show what the demo measures, links lead to files.

A block that is not run has an HTML comment with the reason in the line above it, ``<!-- not run: REASON -->``. A block
that needs a recording has ``<!-- needs: NAME -->``; it is skipped where the recording is absent.
"""

import json
import math
import os
import re
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import pytest
from support.documented_blocks import run_bash, run_python
from support.recordings import recorded

ROOT = Path(__file__).parents[2]
INDEX = ROOT / "docs" / "index.md"


def linked(page):
    """Files that a page links to, in order."""
    return [page.parent / target for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text("utf-8"))]


PAGES = [ROOT / "README.md", INDEX, *(file for file in linked(INDEX) if file.suffix == ".md")]


class Block(NamedTuple):
    """A fenced block of a page."""

    page: str
    line: int
    language: str
    text: str
    not_run: str
    """Why it is not run; empty if it is."""
    recording: str
    """The recording that it needs; empty if none."""


def blocks_of(page):
    """All fenced blocks of a page, with the comment above each."""
    pattern = re.compile(r"(?:^<!-- (not run|needs): ([^\n]+) -->\n)?^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
    text = page.read_text("utf-8")
    for found in pattern.finditer(text):
        mark, reason, language, content = found.groups()
        line = text.count("\n", 0, found.start(3)) + 1
        name = page.relative_to(ROOT).as_posix()
        yield Block(name, line, language, content, *(reason if mark == one else "" for one in ("not run", "needs")))


BLOCKS = [block for page in PAGES for block in blocks_of(page)]
RUN = [block for block in BLOCKS if block.language in ("bash", "python") and not block.not_run]


@pytest.fixture(scope="module")
def folder(short_demo):
    """A folder in which the demo has run, with fewer random rooms."""
    return short_demo[0]


@pytest.mark.slow
@pytest.mark.parametrize("block", RUN, ids=lambda block: f"{block.page}:{block.line}")
def test_a_block_runs_as_printed(block, folder):
    """In one folder, page by page."""
    if re.search(r"parquet|jaxsonar batch", block.text):
        pytest.importorskip("pyarrow")
    environment = {
        **os.environ,
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
        "PYTHONPATH": os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")])),
        # Processes share compiled programs with this one.
        "JAX_COMPILATION_CACHE_DIR": getattr(jax.config, "jax_compilation_cache_dir", None) or "",
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.5",
    }
    if block.recording:
        environment[block.recording.upper()] = str(recorded(block.recording))
    if block.language == "python":
        returncode, output = run_python(block.text, folder)
    else:
        returncode, output = run_bash(block.text, folder, environment)
    assert returncode == 0, output[-2000:]
    kind = (block.page, block.language, block.recording)
    if block is next(one for one in RUN if (one.page, one.language, one.recording) == kind):
        CHECKS.get(kind, lambda output, folder: None)(output, folder)


def check_first_example(output, folder):
    assert re.fullmatch(r"(wall 1\.\d+ m away.*\n){3}8 walls, 11\.4 m\n", output)


def check_errors_of_slam(output, folder):
    assert re.search(r"8\.\d mm, 0\.3\d deg \(RMS of 17 poses\)", output)


def check_corridor_table(output, folder):
    found = json.loads((folder / "corridor.json").read_text())
    text = (ROOT / "docs" / "recorded-data.md").read_text("utf-8")
    row = next(line for line in text.splitlines() if re.match(r"\| \d+ \| \d+ \| ", line))
    shown = [float(number) for number in re.findall(r"\d+\.?\d*", row)]
    measured = [
        found["segments"],
        found["segments"] * found["precision"],
        100 * found["precision_length"],
        100 * found["recall_length"],
        1e3 * found["distance_rms_m"],
        math.degrees(found["angle_rms_rad"]),
        1e3 * found["distance_max_m"],
        math.degrees(found["angle_max_rad"]),
    ]
    assert shown == pytest.approx(measured, rel=0.1)
    for key in ("segment_length_m", "reference_length_m"):
        assert f"{found[key]:.1f} m" in text


CHECKS = {
    ("README.md", "python", ""): check_first_example,
    ("docs/slam.md", "bash", ""): check_errors_of_slam,
    ("docs/recorded-data.md", "bash", "corridor8"): check_corridor_table,
}
"""What the output of the first block of a page, language and recording must be. Other builds of JAX may round
differently."""


def test_every_fence_names_its_language():
    assert [f"{one.page}:{one.line}" for one in BLOCKS if one.language not in ("bash", "python", "toml", "text")] == []


def test_blocks_that_are_not_run_have_a_reason_of_a_known_kind():
    known = r"needs a (device|bag) .*|takes (minutes|half an hour|an hour|ten minutes).*|\.ci/run runs it"
    offenders = [f"{one.page}:{one.line}: {one.not_run}" for one in BLOCKS if one.not_run]
    assert [one for one in offenders if not re.fullmatch(known, one.split(": ", 1)[1])] == []


def test_rings_in_the_documentation_are_valid(tmp_path):
    from jaxsonar import load_ring

    rings = [block for block in BLOCKS if block.language == "toml"]
    assert rings
    for block in rings:
        (tmp_path / "ring.toml").write_text(block.text, "utf-8")
        assert load_ring(tmp_path / "ring.toml").count == 24


def test_the_two_set_up_commands_are_in_the_readme_once_each():
    """``.ci/run`` takes them from there."""
    setups = [one.text for one in BLOCKS if one.page == "README.md" and one.text.startswith("python3 -m venv")]
    assert [("bin/jaxsonar demo" in text, "bin/pytest" in text) for text in setups] == [(True, False), (False, True)]
    assert all(text.count("\n") == 1 for text in setups)


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) <= 150


def shown_row(page, name):
    """Cells of the row of a table that begins with a name."""
    lines = (ROOT / "docs" / page).read_text("utf-8").splitlines()
    return next(line for line in lines if line.startswith(f"| {name} |")).split("|")[2:-1]


@pytest.mark.slow
def test_the_table_of_lines_shows_what_the_demo_measures(folder):
    """The rows of the office, which no random room affects."""
    rows = {row["what"]: row for row in json.loads((folder / "demo" / "table.json").read_text())}
    keys = ("scans", "echoes_per_scan", "walls", "recall", "false_per_scan")
    keys += ("rho_rms_mm", "rho_rms_over_crb", "theta_rms_deg", "theta_rms_over_crb")
    office = [name for name in rows if name.startswith("office")]
    assert office
    for name in office:
        shown = [float(cell) for cell in shown_row("lines.md", name)[:-1]]
        assert shown == pytest.approx([rows[name][key] for key in keys], rel=0.1, abs=0.06), name


@pytest.mark.slow
def test_the_table_of_maps_shows_what_the_demo_measures(folder):
    keys = ("segments", "false", "walls", "walls_found", "rho_max_mm", "rho_rms_mm", "theta_max_deg", "theta_rms_deg")
    for row in json.loads((folder / "demo" / "map-table.json").read_text()):
        shown = [float(cell) for cell in shown_row("maps.md", row["what"])]
        assert shown == pytest.approx([row[key] for key in keys], rel=0.1, abs=0.06), row["what"]


def test_links_lead_to_files():
    missing = [f"{page.name}: {file.name}" for page in PAGES for file in linked(page) if not file.exists()]
    more = [ROOT / name for name in ("ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md")]
    missing += [f"{page.name}: {file.name}" for page in more for file in linked(page) if not file.exists()]
    assert missing == []


def test_named_modules_exist():
    """``package/module`` in the architecture and ``folder/file.py`` in all pages are files of the project."""
    packages = {folder.name for folder in (ROOT / "jaxsonar").iterdir() if folder.is_dir()}
    architecture = (ROOT / "ARCHITECTURE.md").read_text("utf-8")
    names = [f"{folder}/{file}.py" for folder, file in re.findall(r"\b(\w+)/(\w+)\b(?![.*/])", architecture)]
    names = [name for name in names if name.split("/")[0] in packages]
    for page in [*PAGES, ROOT / "ARCHITECTURE.md", ROOT / "CONTRIBUTING.md"]:
        names += re.findall(r"(?<![\w/.])(?:\w+/)+\w+\.(?:py|h)\b", page.read_text("utf-8"))
    assert len(names) > 80
    assert (
        sorted({name for name in names if not any((base / name).is_file() for base in (ROOT, ROOT / "jaxsonar"))}) == []
    )


def test_the_python_page_lists_all_public_names():
    import jaxsonar

    table = [line for line in (ROOT / "docs" / "python.md").read_text("utf-8").splitlines() if line.startswith("| ")]
    assert sorted(re.findall(r"`(\w+)`", "".join(table))) == sorted(vars(jaxsonar)["__all__"])


def test_every_page_is_in_the_index():
    assert sorted(file.name for file in INDEX.parent.glob("*.md")) == sorted(page.name for page in PAGES[1:])

"""Files: atomic writing, permissions, links and devices, TOML, and checks of output files."""

import os
import stat

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.logs import HEADER, SMALL, SMALL_CSV

from jaxsonar.fileio.atomic_files import (
    atomic_write,
    check_outputs,
    make_folder,
    open_output,
    read_toml,
    write_toml,
)
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans import csv_log as logs_csv
from jaxsonar.scans.log_file import load_scan_log, save_log

OLD, NEW = b"old content\n", b"new content\n"

scalars = st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | st.text()
tables = st.dictionaries(st.text(), scalars | st.lists(scalars, max_size=3), max_size=4)


@pytest.mark.parametrize("existing", [False, True])
def test_a_file_changes_only_when_it_is_complete(tmp_path, existing):
    file = tmp_path / "file.txt"
    if existing:
        file.write_bytes(OLD)
    with atomic_write(file, binary=True) as handle:
        handle.write(NEW)
        handle.flush()
        assert file.exists() == existing
        assert not existing or file.read_bytes() == OLD
    assert file.read_bytes() == NEW
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("existing", [False, True])
@pytest.mark.parametrize("failure", [RuntimeError("stop"), KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_a_failure_while_writing_changes_nothing(tmp_path, existing, failure):
    file = tmp_path / "file.txt"
    if existing:
        file.write_bytes(OLD)
    expected = SonarError if isinstance(failure, OSError) else type(failure)
    with pytest.raises(expected), atomic_write(file, binary=True) as handle:  # noqa: PT012  the body must fail
        handle.write(NEW)
        raise failure
    assert {entry.name: entry.read_bytes() for entry in tmp_path.iterdir()} == ({"file.txt": OLD} if existing else {})


@pytest.mark.parametrize("failure", [RuntimeError("stop"), KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_a_failed_write_keeps_the_old_file(failure, monkeypatch, small_csv):
    def some_lines(log):
        yield HEADER
        raise failure

    monkeypatch.setattr(logs_csv, "csv_lines", some_lines)
    with pytest.raises(SonarError if isinstance(failure, OSError) else type(failure)) as caught:
        save_log(SMALL[:1], small_csv)
    assert small_csv.read_text() == SMALL_CSV
    assert list(small_csv.parent.iterdir()) == [small_csv]
    if isinstance(failure, OSError):
        assert str(caught.value).startswith(f"{small_csv}: cannot write: No space left on device; allowed is")


def test_unwritable_files_raise_an_error(tmp_path):
    (tmp_path / "folder.csv").mkdir()
    for path in (
        tmp_path / "folder.csv",
        tmp_path / "no" / "log.csv",
        tmp_path / "\0.csv",
        tmp_path / f"{'a' * 300}.csv",
    ):
        with pytest.raises(SonarError) as caught:
            save_log(SMALL, path)
        assert "cannot write: " in str(caught.value)
        assert str(caught.value).isprintable()
    assert [file.name for file in tmp_path.iterdir()] == ["folder.csv"]


def test_permissions_come_from_the_umask_or_the_old_file(tmp_path):
    file = tmp_path / "log.csv"
    before = os.umask(0o027)
    try:
        save_log(SMALL, file)
        assert stat.S_IMODE(file.stat().st_mode) == 0o640
        file.chmod(0o604)
        save_log(SMALL, file)
        assert stat.S_IMODE(file.stat().st_mode) == 0o604
    finally:
        os.umask(before)


def test_symbolic_links_are_kept(small_csv):
    link = small_csv.with_name("link.csv")
    link.symlink_to(small_csv.name)
    save_log(SMALL[:1], link)
    assert link.is_symlink()
    assert load_scan_log(small_csv) == SMALL[:1]


def test_device_files_are_written_not_replaced():
    with atomic_write("/dev/null") as file:
        file.write("nothing")
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


def test_a_dash_is_standard_output(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with open_output("-") as file:
        file.write("text")
    assert capsys.readouterr().out == "text"
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@given(tables, st.dictionaries(st.text(), tables, max_size=2))
def test_toml_round_trip(tmp_path_factory, table, nested):
    file = tmp_path_factory.mktemp("toml") / "table.toml"
    write_toml(table | nested, file)
    assert read_toml(file, what="a table") == table | nested


def test_a_check_of_outputs_creates_nothing(tmp_path):
    (tmp_path / "old.csv").write_bytes(OLD)
    outputs = {"--output": tmp_path / "old.csv", "--figure": tmp_path / "new.svg", "--json": "-", "--grid": None}
    check_outputs(outputs, [tmp_path / "missing.csv", None])
    assert {entry.name: entry.read_bytes() for entry in tmp_path.iterdir()} == {"old.csv": OLD}


@pytest.mark.parametrize(
    ("outputs", "words"),
    [
        ({"--output": "in.csv"}, "--output in.csv: this is an input"),
        ({"--output": "a.csv", "--figure": "./a.csv"}, "--figure ./a.csv: --output goes there, too"),
        ({"--output": "-", "--json": "-"}, "--json -: --output goes to standard output, too"),
        ({"--output": "no/a.csv"}, "no/a.csv: no such folder"),
        ({"--output": "folder"}, "--output folder: cannot write: Is a directory"),
    ],
)
def test_unsuitable_outputs_are_named(tmp_path, monkeypatch, outputs, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in.csv").write_bytes(OLD)
    (tmp_path / "folder").mkdir()
    with pytest.raises(SonarError) as caught:
        check_outputs(outputs, ["in.csv"])
    assert str(caught.value).startswith(words)
    assert "; allowed " in str(caught.value)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["folder", "in.csv"]


def test_a_missing_output_folder_is_created(tmp_path):
    make_folder(tmp_path / "new" / "folder")
    assert (tmp_path / "new" / "folder").is_dir()

"""Text of tables: delimiter, decimal comma, header, and the numbers of single columns."""

import csv
import fnmatch
import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxsonar.fileio.atomic_files import DECIMAL, shown
from jaxsonar.hardware.datasets import text_lines
from jaxsonar.hardware.errors import SonarError
from jaxsonar.recordings.file_content import SEPARATOR_LINE

MISSING = frozenset({"", "nan", "na", "n/a", "none", "null", "-", "--", "inf", "+inf", "-inf", "infinity"})
"""Texts of fields without a value, in lower case."""
NUMBER = re.compile(DECIMAL)
COMMA_NUMBER = re.compile(DECIMAL.replace(r"\.", ","))
"""A number with a decimal comma."""
EXAMINED_ROWS = 50
"""Rows from which delimiter and decimal sign are found out."""
ERROR_VALUE = re.compile(r"#(N/A|NV|[A-Z0/]+[!?])", re.IGNORECASE)
"""What a spreadsheet writes instead of a number; no comment."""
QUOTED = re.compile(r'"[^"]*"')


@dataclass(frozen=True, eq=False)
class TableText:
    """The fields of a table as texts."""

    filename: str
    names: tuple[str, ...]
    """Header; empty names without one."""
    rows: list[list[str]]
    line: list[int]
    """Line of each row in the file, from 1."""
    delimiter: str
    """Character between the columns; a blank stands for any white space."""
    decimal_comma: bool

    @classmethod
    def read(cls, filename: str | os.PathLike[str], *, delimiter: str | None = None) -> "TableText":
        """Read a table, with the quotes of Python's ``csv`` module.

        Empty lines and comments (``#``, ``%``) are skipped; the last comment can be a header. A first line such as
        ``sep=;`` gives the delimiter.

        Raises:
            SonarError: the file cannot be read or is no text, holds no row, or its rows differ in length.
        """
        comment, lines = "", []
        for number, text in enumerate(text_lines(Path(filename)), 1):
            stripped = text.strip()
            if not lines and (separator := SEPARATOR_LINE.fullmatch(text)):
                delimiter = delimiter or separator[1]
            elif stripped.startswith(("#", "%")) and not ERROR_VALUE.match(stripped):
                comment = comment if lines else stripped.lstrip("#% ")
            elif stripped:
                lines.append((number, text.strip("\r\n")))
        if not lines:
            raise SonarError(f"{shown(filename)}: no row came; needed is a table with one row per scan")
        delimiter = _delimiter([text for _, text in lines[:EXAMINED_ROWS]]) if delimiter is None else delimiter
        if len(delimiter) != 1 or delimiter in '"\r\n':
            raise SonarError(f"{shown(filename)}: --delimiter '{shown(delimiter, 40)}' came; allowed is one character")
        try:
            rows, ends = _split([text for _, text in lines], delimiter)
        except csv.Error as failure:
            raise SonarError(f"{shown(filename)}: {failure}; allowed are the quotes of a CSV file") from None
        lines = [lines[end - 1] for end in ends]
        comma = _has_decimal_comma(rows[:EXAMINED_ROWS])
        names = [""] * len(rows[0])
        if _is_header(rows):
            names = rows.pop(0)
            lines.pop(0)
        elif len(of_comment := _split([comment], delimiter)[0][0]) == len(rows[0]):
            names = of_comment
        for row, (number, _) in zip(rows, lines, strict=True):
            if len(row) != len(names):
                raise SonarError(f"{shown(filename)}: row {number}: {len(row)} columns came; allowed are {len(names)}")
        unquoted = tuple(name.strip(" \"'") for name in names)
        return cls(os.fspath(filename), unquoted, rows, [number for number, _ in lines], delimiter, comma)

    def columns(self, wanted: str, option: str) -> list[int]:
        """Columns, from 0, that a text such as ``x,y,7``, ``3-18`` or ``sonar_*`` names.

        Args:
            wanted: the text.
            option: option of the command line that gave it, for messages.

        Raises:
            SonarError: there is no such column, one is named twice, or two have the same name.
        """
        found: list[int] = []
        for part in filter(None, map(str.strip, wanted.split(","))):
            here = self._columns_of(part)
            if not here:
                raise SonarError(
                    f"{shown(self.filename)}: {option} {shown(part, 40)}: no such column; allowed are {self.listed()}"
                )
            for k in here:
                if self.names.count(self.names[k]) > 1 and not _RUN.fullmatch(part):
                    numbers = [str(n + 1) for n, name in enumerate(self.names) if name == self.names[k]]
                    came = f"{option} {shown(part, 40)}: {len(numbers)} columns have the name {self.name(k)}"
                    raise SonarError(f"{shown(self.filename)}: {came}; use their numbers {', '.join(numbers)}")
                if k in found:
                    raise SonarError(f"{shown(self.filename)}: {option}: column {self.name(k)} came twice")
            found += here
        return found

    def _columns_of(self, part: str) -> list[int]:
        count = len(self.names)
        if part in self.names:
            return [self.names.index(part)]
        if run := _RUN.fullmatch(part):
            first, last = int(run[1]), int(run[2] or run[1])
            return list(range(first - 1, last)) if 1 <= first <= last <= count else []
        return [k for k, name in enumerate(self.names) if name and fnmatch.fnmatchcase(name, part)]

    def name(self, column: int) -> str:
        """A column as it appears in messages: its header, or its number from 1."""
        return f"'{shown(self.names[column], 40)}'" if self.names[column] else str(column + 1)

    def listed(self) -> str:
        """All columns in words."""
        if not any(self.names):
            return f"1 to {len(self.names)} (no header)"
        names = ", ".join(name or str(k + 1) for k, name in enumerate(self.names))
        return f"{shown(names, 200)}, or 1 to {len(self.names)}"

    def numbers(self, column: int, *, texts: bool = False) -> Float[np.ndarray, " rows"]:
        """The numbers of a column, NaN where there is none.

        Args:
            column: the column, from 0.
            texts: a text without any digit, such as ``out of range``, is no number either, instead of an error.

        Raises:
            SonarError: a field is no number.
        """
        values = np.full(len(self.rows), np.nan)
        number = COMMA_NUMBER if self.decimal_comma else NUMBER
        for k, row in enumerate(self.rows):
            field = row[column]
            if number.fullmatch(field):
                values[k] = float(field.replace(",", "."))
            elif field.lower() not in MISSING and not (texts and is_words(field)):
                raise self.fault(k, column, f"a number with a decimal {'comma' if self.decimal_comma else 'point'}")
        values[np.isinf(values)] = np.nan
        return values

    def fault(self, row: int, column: int, allowed: str) -> SonarError:
        """An error about one field."""
        came = f"'{shown(self.rows[row][column], 40)}'" if self.rows[row][column] else "nothing"
        place = f"{shown(self.filename)}: row {self.line[row]}, column {self.name(column)}"
        return SonarError(f"{place}: {came} came; allowed is {allowed}")


_RUN = re.compile(r"(\d{1,6})(?:-(\d{1,6}))?")
"""Number of a column, or a run of them."""


def is_words(field: str) -> bool:
    """Whether a field is a text that cannot be meant as a number: it has no digit."""
    return not re.search(r"\d", field) or bool(ERROR_VALUE.fullmatch(field))


def _split(lines: list[str], delimiter: str) -> tuple[list[list[str]], list[int]]:
    """Rows of fields, and the number of lines up to the end of each row: a quoted field may hold line ends."""
    if delimiter == " ":
        rows = [re.findall(r"\"[^\"]*\"|\S+", text) for text in lines]
        return [[field.strip(" \"'") for field in row] for row in rows], list(range(1, len(lines) + 1))
    reader, rows, ends = csv.reader([f"{text}\n" for text in lines], delimiter=delimiter, skipinitialspace=True), [], []
    for row in reader:
        rows.append([field.strip(" \"'") for field in row])
        ends.append(reader.line_num)
    return rows, ends


def _delimiter(lines: list[str]) -> str:
    """The character between the columns; quoted texts do not count."""
    lines = QUOTED.sub('""', "\n".join(lines)).split("\n")
    for delimiter in (";", "\t"):
        if all(delimiter in line for line in lines):
            return delimiter
    last = lines[-1].split()
    commas = ["," in field and not field.endswith(",") and bool(COMMA_NUMBER.fullmatch(field)) for field in last]
    if sum(commas) > 1 and all(comma or "," not in field for comma, field in zip(commas, last, strict=True)):
        return " "  # blanks between numbers with decimal commas
    return "," if all("," in line for line in lines) else " "


def _has_decimal_comma(rows: list[list[str]]) -> bool:
    fields = [field for row in rows for field in row]
    has_comma = any("," in field and COMMA_NUMBER.fullmatch(field) for field in fields)
    return has_comma and not any("." in field and NUMBER.fullmatch(field) for field in fields)


def _is_header(rows: list[list[str]]) -> bool:
    """Whether the first row holds fewer numbers than another one, and no text that another row holds as well."""
    counts = [
        sum(bool(NUMBER.fullmatch(field) or COMMA_NUMBER.fullmatch(field) or field.lower() in MISSING) for field in row)
        for row in rows[:EXAMINED_ROWS]
    ]
    if len(counts) == 1:
        return counts[0] == 0
    texts = {field for field in rows[0] if not (NUMBER.fullmatch(field) or field.lower() in MISSING)}
    return counts[0] < max(counts[1:]) and not any(texts.intersection(row) for row in rows[1:EXAMINED_ROWS])

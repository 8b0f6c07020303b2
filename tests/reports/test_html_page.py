"""HTML pages are well formed and self-contained, and text is escaped."""

import base64
import io
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.figure import Figure

from jaxsonar import SonarError
from jaxsonar.reports import html_page as report
from jaxsonar.reports.html_page import Column, Picture, Section, Table, save_report
from jaxsonar.reports.text import NO_VALUE

VOID = {"meta", "img", "br", "hr", "link", "input"}
HOSTILE = """</title></style><script src="https://example.com/x.js">alert('1')</script> & "quoted" 'too' \0 \udc80"""


class Page(HTMLParser):
    """Elements in the order of the page: tag, attributes, text directly within."""

    def __init__(self, path):
        super().__init__(convert_charrefs=True)
        self.elements, self.open, self.unbalanced = [], [], []
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)
        self.close()

    def handle_starttag(self, tag, attrs):
        assert len(dict(attrs)) == len(attrs), "an attribute came twice"
        element = [tag, dict(attrs), ""]
        self.elements.append(element)
        if tag not in VOID:
            self.open.append(element)

    def handle_endtag(self, tag):
        if self.open and self.open[-1][0] == tag:
            self.open.pop()
        else:
            self.unbalanced.append(tag)

    def handle_data(self, data):
        if self.open:
            self.open[-1][2] += data

    def all(self, tag):
        return [(attributes, text) for name, attributes, text in self.elements if name == tag]

    def texts(self, tag):
        return [text for _, text in self.all(tag)]


def a_figure(points=3):
    figure = Figure(figsize=(4, 3))
    figure.add_subplot().plot(np.arange(points), np.arange(points) % 7)
    return figure


def a_table():
    columns = [Column("what", "what"), Column("n", "scans"), Column("d", "max Δρ", "mm", 1), Column("r", "ratio")]
    rows = [
        {"what": "office", "n": 17, "d": 8.26, "r": np.float32(-0.0123456)},
        {"what": "corridor", "n": np.int64(1200), "d": None, "r": float("nan")},
        {"what": "nothing"},
    ]
    return Table(columns, rows, "Deviations")


def a_page(path, *, sections=None, **words):
    if sections is None:
        sections = [
            Section("Figures", [Picture(a_figure(), "a line", "Figure 1."), Picture(a_figure(), "the same line")]),
            Section("Numbers", ["One paragraph.\n\nAnother.", a_table()]),
        ]
    save_report(path, title=words.get("title", "A title"), intro=words.get("intro", "An intro."), sections=sections)
    return Page(path)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    return a_page(tmp_path_factory.mktemp("report") / "a.html")


def check_well_formed(page):
    assert page.source.startswith("<!DOCTYPE html>")
    assert not page.unbalanced
    assert not page.open
    names = [attributes["id"] for _, attributes, _ in page.elements if "id" in attributes]
    assert len(names) == len(set(names))
    links = [attributes["href"] for attributes, _ in page.all("a")]
    assert {link.removeprefix("#") for link in links} <= set(names)
    labels = [attributes["aria-labelledby"] for _, attributes, _ in page.elements if "aria-labelledby" in attributes]
    assert set(labels) <= set(names)


def check_self_contained(page):
    assert not page.all("script")
    assert not page.all("link")
    for _, attributes, _ in page.elements:
        assert attributes.get("src", "data:").startswith("data:")
        assert attributes.get("href", "#").startswith("#")
        assert not [name for name in attributes if name.startswith("on")]
    (style,) = page.texts("style")
    assert "url(" not in style
    assert "@import" not in style


def decoded(source):
    """Format and bytes of an embedded image."""
    head, data = source.split(",", 1)
    return head, base64.b64decode(data, validate=True)


def test_the_page_is_well_formed_and_self_contained(page):
    check_well_formed(page)
    check_self_contained(page)
    assert "http://" not in page.source
    assert "https://" not in page.source


def test_every_part_occurs_once(page):
    assert page.texts("title") == page.texts("h1") == ["A title"]
    assert page.texts("h2") == ["Figures", "Numbers"]
    assert page.texts("p") == ["An intro.", "One paragraph.", "Another."]
    assert page.texts("figcaption") == ["Figure 1."]
    assert page.texts("a") == page.texts("h2")


def test_the_page_is_accessible(page):
    assert page.all("html") == [({"lang": "en"}, "\n\n\n")]
    assert [attributes["alt"] for attributes, _ in page.all("img")] == ["a line", "the same line"]
    assert [attributes.get("scope") for attributes, _ in page.all("th")] == ["col"] * 4 + ["row"] * 3


def test_numbers_are_right_aligned_with_units_in_the_header(page):
    header = [(text, attributes.get("class")) for attributes, text in page.all("th")[:4]]
    assert header == [("what", None), ("scans", "number"), ("max Δρ ", "number"), ("ratio", "number")]
    assert page.texts("span") == ["(mm)"]
    assert [text for _, text in page.all("th")[4:]] == ["office", "corridor", "nothing"]
    cells = ["17", "8.3", "−0.01235", "1200", *[NO_VALUE] * 5]
    assert page.all("td") == [({"class": "number"}, cell) for cell in cells]


def test_images_are_the_figures(page):
    for attributes, _ in page.all("img"):
        head, data = decoded(attributes["src"])
        assert head == "data:image/svg+xml;base64"
        assert ElementTree.fromstring(data).tag.endswith("svg")
        assert (attributes["width"], attributes["height"]) == ("384", "288")


@pytest.mark.slow
def test_a_figure_too_large_as_svg_becomes_png(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "PAGE_BYTES", 200_000)
    heavy = Section("", [Picture(a_figure(20_000), "many points"), Picture(a_figure(), "few")])
    page = a_page(tmp_path / "a.html", sections=[heavy])
    assert len(page.source) < 200_000
    (first, image), (second, _) = (decoded(attributes["src"]) for attributes, _ in page.all("img"))
    assert (first, second) == ("data:image/png;base64", "data:image/svg+xml;base64")
    from matplotlib.image import imread

    assert imread(io.BytesIO(image)).shape[:2] == (480, 640)


def test_text_is_escaped(tmp_path):
    table = Table([Column("k", HOSTILE, HOSTILE)], [{"k": HOSTILE}], HOSTILE)
    sections = [Section(HOSTILE, [HOSTILE, table, Picture(a_figure(), HOSTILE, HOSTILE)])] * 2
    page = a_page(tmp_path / "a.html", title=HOSTILE, intro=HOSTILE, sections=sections)
    check_well_formed(page)
    check_self_contained(page)
    wanted = HOSTILE.replace("\0", r"\x00").replace("\udc80", r"\udc80")
    for tag in ("title", "h1", "h2", "p", "caption", "figcaption", "a"):
        assert set(page.texts(tag)) == {wanted}
    assert {attributes["alt"] for attributes, _ in page.all("img")} == {wanted}
    assert {text for attributes, text in page.all("th") if attributes["scope"] == "row"} == {wanted}


@pytest.mark.parametrize(
    "sections",
    [[], [Section("", [])], [Section("a", [Table([Column("k", "k")], [])])], [Section("a", [Table([], [])])]],
    ids=["no section", "no part", "no row", "no column"],
)
def test_an_empty_page_is_valid(tmp_path, sections):
    page = a_page(tmp_path / "a.html", intro="", sections=sections)
    check_well_formed(page)
    assert not page.all("nav")


def test_the_same_content_gives_the_same_bytes(tmp_path):
    a_page(tmp_path / "a.html")
    a_page(tmp_path / "b.html")
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_a_file_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(SonarError, match=r"no/a\.html.*cannot write"):
        a_page(tmp_path / "no" / "a.html")

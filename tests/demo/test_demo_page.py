"""The page of the demo contains all figures and tables."""

import pytest
from support.demo_files import FIGURES


@pytest.mark.slow
def test_the_page_contains_all_figures(written):
    folder, _, _ = written
    page = (folder / "index.html").read_text()
    assert page.count("<img") == len(FIGURES)
    assert page.count("<table") == 2
    assert "http" not in page.replace("http-equiv", "")

"""Markup is text in every page and drawing of a report."""

import matplotlib.pyplot as plt
from markupsafe import Markup

from me2e_compress.display import Cell, Table
from me2e_compress.study.report.figures import svg
from me2e_compress.study.report.page import Drawing, Page, Section

MARKUP = "<script>alert(1)</script>"


def test_everything_in_a_page_is_escaped() -> None:
    row, rows = (MARKUP, MARKUP), [(MARKUP, MARKUP, MARKUP)]
    table = Table(MARKUP, row, ((Cell(MARKUP, MARKUP), Cell("", "", MARKUP)),), MARKUP)
    drawing = Drawing(Markup("<svg>"), MARKUP, MARKUP, MARKUP)
    section = Section(MARKUP, (table,), (row,), (drawing,), MARKUP)

    page = Page(MARKUP, MARKUP, [section], [row], rows, [row], MARKUP, [MARKUP]).html()

    assert "<script" not in page
    assert page.count("&lt;script&gt;") > 20


def test_words_in_a_drawing_are_text() -> None:
    figure, axes = plt.subplots()
    axes.set_title(MARKUP)
    axes.plot([1], [1], label=MARKUP)
    axes.legend()
    try:
        drawn = svg(figure)
    finally:
        plt.close(figure)
    assert "<script" not in drawn

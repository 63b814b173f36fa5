"""Markup is text in every page and drawing of a report."""

import matplotlib.pyplot as plt
import pytest

from me2e_compress.study.paper import paper_page
from me2e_compress.study.report import page
from me2e_compress.study.report.style import svg

MARKUP = "<script>alert(1)</script>"


@pytest.mark.parametrize("name", [page.TEMPLATE, paper_page.TEMPLATE])
def test_everything_in_a_page_is_escaped(name: str) -> None:
    environment = page.template(name).environment
    assert environment.from_string("{{ title }}").render(title=MARKUP) == (
        "&lt;script&gt;alert(1)&lt;/script&gt;"
    )


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

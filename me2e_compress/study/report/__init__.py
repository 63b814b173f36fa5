"""One HTML page that holds a study: nothing beside it is needed to read it."""

from me2e_compress.study.report.page import html

__all__ = ["html"]

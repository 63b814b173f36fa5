"""One HTML page that holds a study: nothing beside it is needed to read it."""

from me2e_compress.study.report.page import Section, html

__all__ = ["Section", "html"]

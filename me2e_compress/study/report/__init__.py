"""A study as one self-contained HTML page."""

from me2e_compress.study.report.page import Section, html

__all__ = ["Section", "html"]

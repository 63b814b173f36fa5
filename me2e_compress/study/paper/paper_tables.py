"""The paper's tables, from what was driven; its own figures stand beside, in columns
of their own."""

from typing import TYPE_CHECKING

from me2e_compress.workflows.result import Table

if TYPE_CHECKING:
    from me2e_compress.study.paper.paper_result import PaperResult


def all_paper_tables(result: "PaperResult") -> tuple[Table, ...]:
    return ()

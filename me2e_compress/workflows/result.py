"""Results that show themselves: on a terminal, in a notebook, to a program."""

import abc
from collections.abc import Mapping, Sequence
from typing import Any

from me2e_compress.display import (
    AT_LEAST,
    MOST_ROWS,
    Cell,
    Displayed,
    Table,
    giga,
    megabytes,
    number,
    table,
)
from me2e_compress.errors import MissingPackageError

__all__ = [
    "AT_LEAST",
    "MOST_ROWS",
    "Cell",
    "Result",
    "Table",
    "giga",
    "megabytes",
    "number",
    "table",
]


class Result(Displayed):
    """What a workflow found."""

    @abc.abstractmethod
    def records(self) -> list[dict[str, object]]:
        """Return what there is to compute with: flat rows of one kind."""

    @abc.abstractmethod
    def to_json(self) -> object:
        """Return everything, as JSON data."""

    def to_pandas(self) -> Any:
        """Build a ``pandas.DataFrame`` of the records.

        Raises:
            MissingPackageError: pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError as error:
            raise MissingPackageError("pandas") from error
        return pd.DataFrame(self.records())

    def _repr_html_(self) -> str:
        """Show the tables in a notebook; the records, where there are none."""
        records = () if self.tables() else _table_of(self.records())
        return "".join(each.html() for each in records) + super()._repr_html_()


def _table_of(records: Sequence[Mapping[str, object]]) -> tuple[Table, ...]:
    if not records:
        return ()
    rows = [[str(value) for value in record.values()] for record in records]
    return (table("", list(records[0]), rows),)

"""The result of a whole demo, step by step, as one document."""

import dataclasses
from collections.abc import Mapping

from me2e_compress.workflows.compress_result import CompressResult
from me2e_compress.workflows.result import Result, Table


def figure(found: Result) -> str:
    """Return a step's result, short enough for a line of a terminal."""
    return found.size if isinstance(found, CompressResult) else found.headline


@dataclasses.dataclass(frozen=True, repr=False)
class DemoResult(Result):
    """Of ``compress``, ``weigh``, ``compare`` and ``drive``, in this order."""

    steps: Mapping[str, Result]

    @property
    def _last(self) -> Result:
        return list(self.steps.values())[-1]

    @property
    def headline(self) -> str:
        """The headline of the last step."""
        return self._last.headline

    def lines(self) -> tuple[str, ...]:
        """Return the verdict of the last step."""
        return self._last.lines()

    def alerts(self) -> tuple[str, ...]:
        """Return the warnings of all steps."""
        return tuple(line for each in self.steps.values() for line in each.alerts())

    def tables(self) -> tuple[Table, ...]:
        """Return the tables of the last step, which compares before and after."""
        return self._last.tables()

    def to_json(self) -> object:
        """Return the result of each step."""
        return {name: each.to_json() for name, each in self.steps.items()}

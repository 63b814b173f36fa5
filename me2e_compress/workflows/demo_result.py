"""What a whole demo found, step by step, as one document."""

import dataclasses
from collections.abc import Mapping

from me2e_compress.workflows.compress_result import CompressResult
from me2e_compress.workflows.result import Result, Table


def figure(found: Result) -> str:
    """Return what a step found, short enough for a line of a terminal."""
    return found.size if isinstance(found, CompressResult) else found.headline


@dataclasses.dataclass(frozen=True, repr=False)
class DemoResult(Result):
    """What every step of a demo found.

    Attributes:
        steps: by name, in order: ``compress``, ``weigh``, ``compare``, and ``drive`` or
            ``time``.
    """

    steps: Mapping[str, Result]

    @property
    def _last(self) -> Result:
        return list(self.steps.values())[-1]

    @property
    def headline(self) -> str:
        """What the last step found, in one line."""
        return self._last.headline

    def lines(self) -> tuple[str, ...]:
        """Return the verdict of the last step."""
        return self._last.lines()

    def alerts(self) -> tuple[str, ...]:
        """Return what must not be overlooked in any step."""
        return tuple(line for each in self.steps.values() for line in each.alerts())

    def tables(self) -> tuple[Table, ...]:
        """Return what the last step compares: before and after."""
        return self._last.tables()

    def details(self) -> tuple[Table, ...]:
        """Return the tables of the steps before, and what more the last one tells."""
        *others, last = self.steps.values()
        return (*(each for step in others for each in step.tables()), *last.details())

    def records(self) -> list[dict[str, object]]:
        """Return the rows of the last step."""
        return self._last.records()

    def to_json(self) -> object:
        """Return what each step found."""
        return {name: each.to_json() for name, each in self.steps.items()}

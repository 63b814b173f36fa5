"""Options of int8 that commands have in common."""

import dataclasses
from pathlib import Path

from me2e_compress.errors import RecipeError
from me2e_compress.passes import Pass
from me2e_compress.passes.lower_int8 import LowerInt8
from me2e_compress.passes.quantize_int8 import QuantizeInt8


@dataclasses.dataclass(frozen=True)
class Int8Options:
    """What the command line says about int8; None leaves it to the recipe.

    Attributes:
        scheme: ``feature-ext``, ``prediction`` or ``full``.
        rules: ``paper`` or ``tensorrt``.
        target: who will run the graph.
        overrides: TOML file of exceptions.
        ranges: file of saved ranges.
        method: how ranges are read from frames, or were for ``ranges``.
    """

    scheme: str | None = None
    rules: str | None = None
    target: str | None = None
    overrides: Path | None = None
    ranges: Path | None = None
    method: str | None = None

    def apply(self, passes: tuple[Pass, ...]) -> tuple[Pass, ...]:
        """Put them into the quantization of a pipeline; add one for a scheme.

        Raises:
            RecipeError: there is nothing that they could apply to, or the pipeline
                quantizes twice.
        """
        found = [each for each in passes if isinstance(each, QuantizeInt8)]
        if len(found) + (self.scheme is not None) > 1:
            raise RecipeError(
                f"{QuantizeInt8.name} is twice in the pipeline, a graph is quantized"
                f" once: leave out {'--scheme' if self.scheme else 'one of them'}"
            )
        if self.scheme is not None:
            passes = (*passes, QuantizeInt8(scheme=self.scheme))
        options = {name: value for name, value in vars(self).items() if value}
        options.pop("scheme", None)
        if not options:
            return passes
        if any(isinstance(each, QuantizeInt8) for each in passes):
            return tuple(self._quantize(each) for each in passes)
        names = [name for name in options if name not in ("ranges", "method")]
        if names or not any(isinstance(each, LowerInt8) for each in passes):
            raise RecipeError(
                f"--{next(iter(names or options))} is for int8, and the pipeline has no"
                f" {QuantizeInt8.name}: add --scheme"
            )
        return tuple(self._lower(each) for each in passes)

    def _quantize(self, given: Pass) -> Pass:
        if not isinstance(given, QuantizeInt8):
            return given
        return dataclasses.replace(
            given,
            rules=self.rules or given.rules,
            target=self.target or given.target,
            overrides=self.overrides or given.overrides,
            ranges=self.ranges or given.ranges,
            method=self.method or given.method,
        )

    def _lower(self, given: Pass) -> Pass:
        if not isinstance(given, LowerInt8):
            return given
        return dataclasses.replace(
            given,
            ranges=self.ranges or given.ranges,
            method=self.method or given.method,
        )

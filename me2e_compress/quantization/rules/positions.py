"""Where to look is computed in float."""

import dataclasses
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.quantization.rules.base import Rule, RuleFacts


@dataclasses.dataclass(frozen=True)
class Coordinates(Rule):
    """Layers that positions come from stay float: offsets, reference points.

    A position is right to a fraction of a cell or wrong; 8 bits over a map of 100
    cells leave half a cell. Sampling weights that read the same tensor as the offsets
    go with them: neither then needs it in int8.
    """

    name: ClassVar[str] = "coordinates"

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object to what :func:`~me2e_compress.quantization.coordinates` found."""
        return facts.coordinates.get(node)

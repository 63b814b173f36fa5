"""Variants of one quantization, for the search of its loss's cause."""

import math
from collections.abc import Sequence
from pathlib import Path

import onnx_ir as ir

from me2e_compress.fidelity.compare import Fidelity, Reference
from me2e_compress.manager.report import LossyPass
from me2e_compress.passes import Context
from me2e_compress.runtime.session import Session
from me2e_compress.sensitivity.recipes import overrides_text
from me2e_compress.sensitivity.remedy import Int8Node
from me2e_compress.sensitivity.suffix import Suffix
from me2e_compress.sensitivity.trials import keep_float


class RemedyTrials:
    """The pass that quantized, run again with more nodes in float.

    While a group is narrowed down, everything before it is float and answers as it did:
    where that saves more MACs than it costs, only what is behind the group is run
    again. `context` is that of the first run, so that nothing is measured twice;
    `overrides` is a file to write.
    """

    def __init__(
        self,
        quantizer: LossyPass,
        context: Context,
        reference: Reference,
        overrides: Path,
    ) -> None:
        self._quantizer = quantizer
        self._context = context
        self._reference = reference
        self._overrides = overrides
        self._suffix: tuple[Suffix, Reference] | None = None
        self._within: frozenset[str] = frozenset()

    def measure(
        self, floats: Sequence[Int8Node], group: Sequence[Int8Node] = ()
    ) -> Fidelity:
        """Build a variant and compare it; what the user decided still holds.

        `floats` become float; `group` holds every node that is int8 then, or is empty.
        """
        made = self._build(floats)
        # run only what is behind the group, if that can be cut out of the variant
        found = self._narrowed(group)
        if found is not None:
            suffix, reference = found
            part = suffix.cut(made)
            if part is not None:
                return reference.compare(self._session(part))
        return self._reference.compare(self._session(made))

    def _session(self, model: ir.Model) -> Session:
        return Session(model, release=True, provider=self._context.provider)

    def _build(self, floats: Sequence[Int8Node]) -> ir.Model:
        # the user's overrides stay, and the trial's are added behind
        asked = getattr(self._quantizer.applied, "overrides", None)
        text = "" if asked is None else Path(asked).read_text(encoding="utf-8")
        more = overrides_text(keep_float(each.name, "") for each in floats)
        self._overrides.write_text(f"{text}\n{more}", encoding="utf-8")
        again = self._quantizer.applied.with_options({"overrides": self._overrides})
        return again.run(self._quantizer.before.clone(), self._context).model

    def _narrowed(self, group: Sequence[Int8Node]) -> tuple[Suffix, Reference] | None:
        """Return what is behind a group, if running only that is worth its capture."""
        if not group or len(self._reference.answers) > 1:
            return None  # of several frames the state would be another
        names = frozenset(each.name for each in group)
        known = self._suffix if names <= self._within else None
        whole = 1.0 if known is None else known[0].share
        before = self._quantizer.before
        found = Suffix.behind(before, names)
        if found is None or not found.outputs:
            return None
        # Each trial saves the difference; capturing costs a run of the graph.
        if math.log2(len(names)) * (whole - found.share) > 1:
            known = found, found.capture(before, self._reference)
            self._suffix, self._within = known, names
        return known

"""Load the weights of a published checkpoint into a stack."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from me2e_compress.base.errors import GraphError
from me2e_compress.commands.inspect import WEIGHTS
from models.construct import construct
from models.published_names import PUBLISHED, Mismatch, NameMatch
from models.stacks import Stack, find
from models.state_dict import StateDict, read_state_dict

if TYPE_CHECKING:
    from torch import Tensor, nn


@dataclass(frozen=True)
class ReadWeights:
    """The checkpoint of a stack's weights, and what was not used of it.

    Attributes:
        file: its name.
        averaged: whether its moving averages were taken.
        converted: number of tensors made float32, by old type.
        unread: names of omitted tensors; driving does not use them.
        averages: number of moving averages that were not used.
    """

    file: str
    sha256: str
    epoch: int | None = None
    iteration: int | None = None
    averaged: bool = False
    converted: Mapping[str, int] = field(default_factory=dict)
    unread: Sequence[str] = ()
    averages: int = 0

    def metadata(self) -> dict[str, str]:
        """Return the ONNX metadata property that names the checkpoint."""
        keys = ("file", "sha256", "epoch", "iteration", "averaged")
        return {WEIGHTS: json.dumps({key: getattr(self, key) for key in keys})}

    def lines(self) -> tuple[str, ...]:
        """Return the lines of a report."""
        counts = {"epoch": self.epoch, "iteration": self.iteration}
        stated = [f"{key} {n}" for key, n in counts.items() if n is not None]
        words = [f"weights: {self.file}", *stated, f"sha256 {self.sha256}"]
        said = [", ".join(words)]
        for type_, count in self.converted.items():
            said.append(f"{count} tensors of {type_} converted to float32")
        # What was not used
        if self.unread:
            parts = list(dict.fromkeys(name.split(".")[0] for name in self.unread))
            said.append(
                f"left out, {len(self.unread)} tensors that driving does not read:"
                f" {', '.join(parts)}"
            )
        if self.averages:
            said.append(f"left out: {self.averages} moving averages; --ema takes them")
        return tuple(said)


@dataclass(frozen=True, eq=False)
class PublishedWeights:
    """All tensors of a stack, by our names; float32 except counters."""

    tensors: "Mapping[str, Tensor]"
    record: ReadWeights

    def fill(self, model: "nn.Module") -> None:
        """Set a module's tensors except those in `PublishedNames.computed`."""
        model.load_state_dict({**model.state_dict(), **self.tensors})


def published_weights(
    stack: str, path: Path, *, heads: str | None = None, ema: bool = False
) -> PublishedWeights:
    """Read the weights of a stack from a checkpoint of its original.

    ``ema`` takes the moving averages that mmcv's EMAHook stores with the parameters.

    Raises:
        GraphError: unknown stack or heads, or a file that is unreadable or does not
            hold exactly the stack's tensors.
    """
    spec = _with_original(stack, heads)
    state = read_state_dict(path)
    match = _match(spec, state, ema)
    # Name heads that would fit
    wrong = match.mismatch()
    if wrong:
        line = f"{path}: not the weights of {stack}: {wrong.line()}"
        raise GraphError(line + _other_heads(find(stack), state, ema))
    return taken(match)


def mismatch(
    stack: str, path: Path, *, heads: str | None = None, ema: bool = False
) -> Mismatch:
    """Return every name of a checkpoint that does not fit; see `published_weights`."""
    spec = _with_original(stack, heads)
    return _match(spec, read_state_dict(path), ema).mismatch()


def taken(match: NameMatch) -> PublishedWeights:
    """Return the tensors of a match that has no mismatch, as float32."""
    import torch

    state, keys = match.state, match.keys()
    tensors: dict[str, Tensor] = {}
    converted: Counter[str] = Counter()
    # A missing counter is 0
    for published, (name, like) in match.wanted.items():
        found = state.tensors.get(keys[published])
        tensors[name] = torch.zeros_like(like, device="cpu") if found is None else found
        if like.is_floating_point() and tensors[name].dtype != torch.float32:
            converted[str(tensors[name].dtype).removeprefix("torch.")] += 1
            tensors[name] = tensors[name].float()
    # Record the file and what was not used
    record = ReadWeights(
        file=state.path.name,
        sha256=state.sha256,
        epoch=state.epoch,
        iteration=state.iteration,
        averaged=match.ema,
        converted=dict(converted),
        unread=match.unread(),
        averages=0 if match.ema else len(match.averages()),
    )
    return PublishedWeights(tensors, record)


def _with_original(stack: str, heads: str | None) -> Stack:
    if find(stack).name not in PUBLISHED:
        raise GraphError(f"{stack} has no original whose weights could be read")
    return find(stack).with_heads(heads)


def _other_heads(stack: Stack, state: StateDict, ema: bool) -> str:
    each = ((name, stack.with_heads(name)) for name in stack.heads)
    fits = [name for name, spec in each if not _match(spec, state, ema).mismatch()]
    return "".join(f"; it fits --heads {name}" for name in fits)


def _match(spec: Stack, state: StateDict, ema: bool) -> NameMatch:
    import torch

    with torch.device("meta"):
        shapes = construct(spec)
    return NameMatch(shapes, PUBLISHED[spec.name], state, ema)

"""Weights of a published checkpoint, name by name in a stack of ours."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from me2e_compress.errors import GraphError
from me2e_compress.zoo.construct import construct
from me2e_compress.zoo.name_match import Mismatch, NameMatch
from me2e_compress.zoo.published_names import PUBLISHED
from me2e_compress.zoo.stacks import Stack, find
from me2e_compress.zoo.state_dict import StateDict, read_state_dict
from me2e_compress.zoo.weights_record import WeightsRecord

if TYPE_CHECKING:
    from torch import Tensor, nn


@dataclass(frozen=True, eq=False)
class PublishedWeights:
    """All tensors of a stack, as a checkpoint has them.

    Attributes:
        tensors: By our names; float32 but for counters.
        record: What the file is, and what became of the rest of it.
    """

    tensors: "Mapping[str, Tensor]"
    record: WeightsRecord

    def fill(self, model: "nn.Module") -> None:
        """Set all parameters and buffers of a stack's module, in place.

        What the module computed itself stays (`PublishedNames.computed`).
        """
        model.load_state_dict({**model.state_dict(), **self.tensors})


def published_weights(
    stack: str, path: Path, *, heads: str | None = None, ema: bool = False
) -> PublishedWeights:
    """Read the weights of a stack from a checkpoint of its original.

    Args:
        stack: Name in `STACKS`.
        path: As `read_state_dict` takes it.
        heads: Which last layers; None is the default of the stack.
        ema: Take the moving averages that mmcv's EMAHook keeps beside the parameters.

    Raises:
        MissingExtraError: torch is not installed, or safetensors for such a file.
        GraphError: No such stack or heads, a file that cannot be read, or one that does
            not hold exactly what the stack has.
    """
    spec = _with_original(stack, heads)
    state = read_state_dict(path)
    match = _match(spec, state, ema)
    wrong = match.mismatch()
    if wrong:
        line = f"{path}: not the weights of {stack}: {wrong.line()}"
        raise GraphError(line + _other_heads(find(stack), state, ema))
    return taken(match)


def mismatch(
    stack: str, path: Path, *, heads: str | None = None, ema: bool = False
) -> Mismatch:
    """Compare a checkpoint with a stack, and return every name that does not fit.

    Args:
        stack: Name in `STACKS`.
        path: As `read_state_dict` takes it.
        heads: As in `published_weights`.
        ema: As in `published_weights`.

    Raises:
        MissingExtraError: As `published_weights`.
        GraphError: No such stack or heads, or a file that cannot be read.
    """
    spec = _with_original(stack, heads)
    return _match(spec, read_state_dict(path), ema).mismatch()


def taken(match: NameMatch) -> PublishedWeights:
    """Return the tensors of a match that has no mismatch, as float32."""
    import torch

    state, keys = match.state, match.keys()
    tensors: dict[str, Tensor] = {}
    converted: Counter[str] = Counter()
    for published, (name, like) in match.wanted.items():
        found = state.tensors.get(keys[published])
        tensors[name] = torch.zeros_like(like, device="cpu") if found is None else found
        if like.is_floating_point() and tensors[name].dtype != torch.float32:
            converted[str(tensors[name].dtype).removeprefix("torch.")] += 1
            tensors[name] = tensors[name].float()
    record = WeightsRecord(
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
    """Say which heads the tensors would fit, if any."""
    each = ((name, stack.with_heads(name)) for name in stack.heads)
    fits = [name for name, spec in each if not _match(spec, state, ema).mismatch()]
    return "".join(f"; it fits --heads {name}" for name in fits)


def _match(spec: Stack, state: StateDict, ema: bool) -> NameMatch:
    import torch

    with torch.device("meta"):
        shapes = construct(spec)
    return NameMatch(shapes, PUBLISHED[spec.name], state, ema)

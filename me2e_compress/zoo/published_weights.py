"""Load the weights of a published checkpoint into a stack."""

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
    """All tensors of a stack, by our names; float32 except counters."""

    tensors: "Mapping[str, Tensor]"
    record: WeightsRecord

    def fill(self, model: "nn.Module") -> None:
        """Set a module's tensors except those in `PublishedNames.computed`."""
        model.load_state_dict({**model.state_dict(), **self.tensors})


def published_weights(
    stack: str, path: Path, *, heads: str | None = None, ema: bool = False
) -> PublishedWeights:
    """Read the weights of a stack from a checkpoint of its original.

    ``ema`` takes the moving averages that mmcv's EMAHook stores with the parameters.

    Raises:
        MissingExtraError: torch is not installed, or safetensors for such a file.
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
    each = ((name, stack.with_heads(name)) for name in stack.heads)
    fits = [name for name, spec in each if not _match(spec, state, ema).mismatch()]
    return "".join(f"; it fits --heads {name}" for name in fits)


def _match(spec: Stack, state: StateDict, ema: bool) -> NameMatch:
    import torch

    with torch.device("meta"):
        shapes = construct(spec)
    return NameMatch(shapes, PUBLISHED[spec.name], state, ema)

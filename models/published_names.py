"""Match the names of published checkpoints with those of the stacks."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from models.state_dict import StateDict

if TYPE_CHECKING:
    from torch import Tensor, nn

AVERAGE = "ema_"
"""mmcv's EMAHook keeps the moving average of ``a.b`` as ``ema_a_b``."""

COUNTER = "num_batches_tracked"
"""Of a batch normalisation, read by training alone; 0 where a file lacks it."""

_NAMED = 3


@dataclass(frozen=True)
class PublishedNames:
    """The names of a stack's original.

    Attributes:
        renamed: patterns in our names and their replacements in the original; other
            names are equal.
        unread: patterns of the original's names that our graph omits, since driving
            does not use them.
        computed: patterns of our names for tables that no file holds, since they follow
            from the sizes.
    """

    renamed: Sequence[tuple[str, str]] = ()
    unread: Sequence[str] = ()
    computed: Sequence[str] = ()

    def published(self, name: str) -> str:
        """Return the original's name of our parameter or buffer."""
        for ours, theirs in self.renamed:
            name = re.sub(ours, theirs, name)
        return name

    def is_unread(self, name: str) -> bool:
        """Return whether our graph omits this name of the original."""
        return any(re.match(pattern, name) for pattern in self.unread)

    def is_computed(self, name: str) -> bool:
        """Return whether one of our names is of a table that no file holds."""
        return any(re.match(pattern, name) for pattern in self.computed)


PUBLISHED: dict[str, PublishedNames] = {
    "vad-tiny": PublishedNames(
        renamed=(
            (r"(\.lmlp_\d)\.linear\.", r"\1.mlp.0."),
            (r"(\.lmlp_\d)\.norm\.", r"\1.mlp.1."),
        ),
    ),
    "uniad-tiny": PublishedNames(
        unread=(
            r"criterion\.",
            r"pts_bbox_head\.past_traj_reg_branches\.",
            r"seg_head\.(bev_embedding|stuff_query|stuff_mask_head)\.",
            r"seg_head\.(reg_branches2|cls_thing_branches|cls_stuff_branches)\.",
            r"motion_head\.layer_track_query_fuser\.",
        ),
        computed=(r"seg_head\.positional_encoding\.",),
    ),
    "tcp": PublishedNames(
        unread=(r"speed_branch\.", r"value_branch_\w+\.", r"feature_branch_\w+\."),
    ),
}
"""By the name of the stack.

* vad-tiny: hustvl/VAD, ``VAD_head.py``; Bench2DriveZoo has the same.
* uniad-tiny: Bench2DriveZoo, ``uniad_track.py`` and the heads. Its motion anchors lie
  in a file of their own; they belong under ``motion_head.kmeans_anchors``.
* tcp: OpenDriveLab/TCP, ``TCP/model.py``, and Bench2DriveZoo, branch tcp/admlp.
"""


@dataclass(frozen=True)
class Mismatch:
    """The differences between a checkpoint and a stack; false if there are none.

    ``missing`` are names of the original, the others names of the file.
    ``other_shapes`` are name, shape in the file and shape in the stack. ``not_finite``
    includes overflows of float32.
    """

    wanted: int
    missing: Sequence[str]
    unexpected: Sequence[str]
    other_shapes: Sequence[tuple[str, Sequence[int], Sequence[int]]]
    other_types: Sequence[tuple[str, str]]
    not_finite: Sequence[str]

    def __bool__(self) -> bool:
        """Return whether there are differences."""
        return bool(self.line())

    def line(self) -> str:
        """Return the number and first names of every kind of difference."""
        shapes = [
            f"{name} is {[*found]} in it, {[*own]} here"
            for name, found, own in self.other_shapes
        ]
        kinds: tuple[tuple[str, Sequence[str]], ...] = (
            (f"of {self.wanted} names missing", self.missing),
            ("unexpected", self.unexpected),
            ("of another shape", shapes),
            ("not floating-point", [f"{name} is {t}" for name, t in self.other_types]),
            ("not finite", self.not_finite),
        )
        parts = [f"{len(all_)} {what} ({_first(all_)})" for what, all_ in kinds if all_]
        return ", ".join(parts)


def _first(names: Sequence[str]) -> str:
    return ", ".join([*names[:_NAMED], *["..."][: len(names) - _NAMED]])


@dataclass(frozen=True)
class NameMatch:
    """Pairs each tensor of a module with the one of its published name.

    The module may be on meta. With ``ema`` moving averages are taken; buffers without
    one are taken as they are.
    """

    module: "nn.Module"
    names: PublishedNames
    state: StateDict
    ema: bool = False

    @cached_property
    def wanted(self) -> "Mapping[str, tuple[str, Tensor]]":
        """Our name and a tensor of the same shape and type, by published name."""
        return {
            self.names.published(name): (name, tensor)
            for name, tensor in self.module.state_dict().items()
            if not self.names.is_computed(name)
        }

    def keys(self) -> Mapping[str, str]:
        """Return the name of the tensor to read from the file, by published name."""
        if not self.ema:
            return {name: name for name in self.wanted}
        parameters = dict(self.module.named_parameters())
        # The moving average of every tensor that has one
        averages = {name: AVERAGE + name.replace(".", "_") for name in self.wanted}
        return {
            name: average
            if own in parameters or average in self.state.tensors
            else name
            for (name, average), (own, _) in zip(
                averages.items(), self.wanted.values(), strict=True
            )
        }

    def averages(self) -> Sequence[str]:
        """Return the names of moving averages in the file."""
        names = self.state.tensors
        return [each for each in names if each.startswith(AVERAGE) and "." not in each]

    def unread(self) -> Sequence[str]:
        """Return the names in the file that the stack does not use."""
        return [name for name in self.state.tensors if self.names.is_unread(name)]

    def mismatch(self) -> Mismatch:
        """Return the differences."""
        tensors, keys = self.state.tensors, self.keys()
        # Find the tensors of the file
        known = {*self.wanted, *self.averages(), *self.unread()}
        found = {
            keys[name]: (tensors[keys[name]], like)
            for name, (_, like) in self.wanted.items()
            if keys[name] in tensors
        }
        # Compare shapes, then types and values
        shapes = [
            (key, tuple(tensor.shape), tuple(like.shape))
            for key, (tensor, like) in found.items()
            if tensor.shape != like.shape
        ]
        floats = {k: t for k, (t, like) in found.items() if like.is_floating_point()}
        plain = {key: tensor for key, tensor in floats.items() if _is_plain(tensor)}
        return Mismatch(
            wanted=len(self.wanted),
            missing=[
                key
                for key in keys.values()
                if key not in tensors and not key.endswith(COUNTER)
            ],
            unexpected=[name for name in tensors if name not in known],
            other_shapes=shapes,
            other_types=[(k, _type_of(t)) for k, t in floats.items() if k not in plain],
            not_finite=[key for key, tensor in plain.items() if not _finite(tensor)],
        )


def _type_of(tensor: "Tensor") -> str:
    layout = str(tensor.layout).removeprefix("torch.")
    type_ = str(tensor.dtype).removeprefix("torch.")
    return type_ if layout == "strided" else f"{type_}, {layout}"


def _is_plain(tensor: "Tensor") -> bool:
    import torch

    dense = tensor.layout == torch.strided and not tensor.is_quantized
    return dense and not tensor.is_meta and tensor.is_floating_point()


def _finite(tensor: "Tensor") -> bool:
    return bool(tensor.float().isfinite().all())

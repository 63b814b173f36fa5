"""Map our parameter names to those of published checkpoints."""

import re
from collections.abc import Sequence
from dataclasses import dataclass


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

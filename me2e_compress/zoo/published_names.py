"""What parameters are called in published checkpoints, where we call them otherwise."""

import re
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class PublishedNames:
    """The names of a stack's original.

    Attributes:
        renamed: Patterns in our names, and what the original has in their place; names
            that none matches are the original's.
        unread: Patterns of names of the original that our graph leaves out, since
            driving does not read them.
    """

    renamed: Sequence[tuple[str, str]] = ()
    unread: Sequence[str] = ()

    def published(self, name: str) -> str:
        """Return what the original calls our parameter or buffer."""
        for ours, theirs in self.renamed:
            name = re.sub(ours, theirs, name)
        return name

    def is_unread(self, name: str) -> bool:
        """Return whether a name of the original is one that we leave out."""
        return any(re.match(pattern, name) for pattern in self.unread)


PUBLISHED: dict[str, PublishedNames] = {
    "vad-tiny": PublishedNames(
        renamed=(
            (r"(\.lmlp_\d)\.linear\.", r"\1.mlp.0."),
            (r"(\.lmlp_\d)\.norm\.", r"\1.mlp.1."),
        ),
    ),
    "tcp": PublishedNames(
        unread=(r"speed_branch\.", r"value_branch_\w+\.", r"feature_branch_\w+\."),
    ),
}
"""By the name of the stack: hustvl/VAD, ``VAD_head.py`` (Bench2DriveZoo has the same),
and OpenDriveLab/TCP, ``TCP/model.py``, with Bench2DriveZoo's branch tcp/admlp."""

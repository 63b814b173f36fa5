"""Patterns over dotted paths: which names a module of a stack goes by."""

import dataclasses
import functools
from fnmatch import fnmatchcase

_ANYWHERE = ("*", "**")


@dataclasses.dataclass(frozen=True)
class Pattern:
    """A glob over whole components of a dotted path.

    ``pts_bbox_head.transformer.encoder`` matches that path and everything below it;
    ``*`` and ``?`` are wild within a component (``layers.*.norms``, ``pos_mlp*``).
    A pattern that begins with ``*.`` or ``**.`` may match anywhere in the path, not
    only from its root: ``*.cls_branches`` matches ``head.cls_branches.0.weight``.
    ``**`` alone matches every path.
    """

    text: str

    @functools.cached_property
    def components(self) -> tuple[str, ...]:
        """What is written out, without the leading ``*.`` of an anywhere pattern."""
        parts = tuple(self.text.split("."))
        return parts[1:] if self.anywhere else parts

    @functools.cached_property
    def anywhere(self) -> bool:
        """Whether the match may begin below the root."""
        head, dot, _ = self.text.partition(".")
        return head == "**" or (head == "*" and bool(dot))

    def reach(self, path: tuple[str, ...]) -> int | None:
        """Count the components of a path up to the end of the deepest match.

        None if the pattern does not match the path.
        """
        last = len(path) - len(self.components) if self.anywhere else 0
        for start in range(last, -1, -1):
            if self._matches_at(path, start):
                return start + len(self.components)
        return None

    def _matches_at(self, path: tuple[str, ...], start: int) -> bool:
        window = path[start : start + len(self.components)]
        return len(window) == len(self.components) and all(
            part == wanted or fnmatchcase(part, wanted)
            for part, wanted in zip(window, self.components, strict=True)
        )


def is_malformed(text: str) -> bool:
    """Whether a text cannot be a pattern: empty, or with an empty component."""
    return not text or any(not part for part in text.split("."))

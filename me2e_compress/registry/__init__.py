"""Everything that can be added, by name: ours, and what other packages bring."""

from me2e_compress.registry.registry import (
    Entry,
    NamedItem,
    Option,
    Registry,
    describe,
    options_of,
)
from me2e_compress.registry.text import name_in

__all__ = [
    "Entry",
    "NamedItem",
    "Option",
    "Registry",
    "describe",
    "name_in",
    "options_of",
]

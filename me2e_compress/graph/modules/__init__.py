"""Modules: which node of a graph belongs to which part of the driving stack."""

from me2e_compress.graph.modules.assign import (
    Assignment,
    Item,
    Placement,
    assign,
    detect,
    itemise,
    map_of,
)
from me2e_compress.graph.modules.module_map import (
    Module,
    ModuleMap,
    PathGlob,
    Role,
    Substitute,
    presets,
    scope_of,
)

__all__ = [
    "Assignment",
    "Item",
    "Module",
    "ModuleMap",
    "PathGlob",
    "Placement",
    "Role",
    "Substitute",
    "assign",
    "detect",
    "itemise",
    "map_of",
    "presets",
    "scope_of",
]

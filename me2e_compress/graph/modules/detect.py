"""Find the preset that fits a graph."""

from collections.abc import Iterable

import onnx_ir as ir

from me2e_compress.errors import ModuleMapError
from me2e_compress.graph.modules.module_map import ModuleMap, presets
from me2e_compress.graph.modules.paths import PathGlob, parameter_path, scope_of

STACK = "me2e.stack"
"""Model metadata in which our exporters name the stack, e.g. ``vad-tiny``."""


def detect(model: ir.Model) -> ModuleMap:
    """Find the preset of a graph.

    The model's metadata decides (``me2e.stack``: a preset's name, or one followed by
    ``-`` and a variant, as in ``vad-tiny``). Without it, the preset of which the
    largest share of modules is found in the graph, then the one that claims most of its
    names; at least half of the modules must be there.

    Raises:
        ModuleMapError: no preset fits.
    """
    stack, paths = model.metadata_props.get(STACK), _paths(model)
    # the stack's own name decides
    for name in presets():
        if stack is not None and (stack == name or stack.startswith(f"{name}-")):
            return ModuleMap.load(name)
    # else the best fit
    ranked = sorted(
        ((*_fit(ModuleMap.load(name), paths), name) for name in presets()),
        key=lambda entry: (-entry[0], -entry[1], entry[2]),
    )
    share, _, best = ranked[0]
    if share < 0.5:
        raise ModuleMapError(
            f"no module map fits this graph: {best} comes closest with"
            f" {share:.0%} of its modules (presets: {', '.join(presets())});"
            " give a map file"
        )
    return ModuleMap.load(best)


def map_of(model: ir.Model, name: str | None) -> ModuleMap:
    """Load the preset or TOML file of a name, or find the preset that fits.

    A graph that no preset fits is one module, named ``model``.
    """
    if name is not None:
        return ModuleMap.load(name)
    try:
        return detect(model)
    except ModuleMapError:
        return ModuleMap.whole()


_DEEPEST = 3
"""Components of a prefix that is looked for: wrappers nest this deep at most."""


def behind_a_prefix(modules: ModuleMap, paths: Iterable[str]) -> str:
    """Suggest what a map lacks where a prefix hides its names; empty if none does.

    The prefix behind which most of its patterns match a path is named, with the first
    of them.
    """
    found: dict[str, dict[tuple[str, str], None]] = {}
    for path in paths:
        parts = [part for part in path.split(".") if part]
        for depth in range(1, min(_DEEPEST, len(parts) - 1) + 1):
            if claims := modules.claims(".".join(parts[depth:])):
                prefix = ".".join(parts[:depth])
                found.setdefault(prefix, {}).update(dict.fromkeys(claims))
    # a pattern that matches anywhere matches without a prefix, too
    named = {
        prefix: [text for _, text in claims if not PathGlob(text).anywhere]
        for prefix, claims in found.items()
    }
    best = max(named, key=lambda prefix: (len(named[prefix]), -len(prefix)), default="")
    if not best or not named[best]:
        return ""
    strip = ", ".join(f'"{part}"' for part in best.split("."))
    return (
        f"; behind the prefix {best!r} {len(named[best])} of its patterns match, as"
        f" {f'{best}.{named[best][0]}'!r}: write strip = [{strip}] into a copy of the"
        " map"
    )


def _fit(modules: ModuleMap, paths: list[str]) -> tuple[float, int]:
    claimed = [module for path in paths if (module := modules.match(path)) is not None]
    return len(dict.fromkeys(claimed)) / len(modules.modules), len(claimed)


def _paths(model: ir.Model) -> list[str]:
    names = (name for graph in model.graphs() for name in graph.initializers)
    paths = [parameter_path(name) for name in names]
    paths += [scope_of(node) for node in model.graph.all_nodes()]
    return [path for path in dict.fromkeys(paths) if path]

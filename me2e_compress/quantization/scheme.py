"""Quantization schemes: which modules become int8."""

import dataclasses
from typing import Self

from me2e_compress.base.errors import ModuleMapError, RecipeError
from me2e_compress.graph.modules.module_map import ModuleMap, Role

SCHEMES: dict[str, tuple[Role, ...]] = {
    "feature-ext": ("feature",),
    "prediction": ("prediction",),
    "full": ("feature", "prediction"),
}
"""The three schemes of the paper (Table 4): the feature extraction is backbone, neck
and BEV encoder, the prediction every other functional module, full their union."""


@dataclasses.dataclass(frozen=True)
class QuantScheme:
    """A named choice of modules.

    ``name`` is ``modules`` if the modules were listed one by one.
    """

    name: str
    modules: tuple[str, ...]

    @classmethod
    def named(cls, name: str, modules: ModuleMap) -> Self:
        """Return the modules of a map whose roles a scheme names.

        A scheme of one role needs a map that has modules of both.

        Raises:
            RecipeError: no such scheme; int4 and fp8 are none.
            ModuleMapError: the map has modules of one role only.
        """
        if name not in SCHEMES:
            raise RecipeError(
                f"no scheme {name}; there are {', '.join(SCHEMES)}, all of them int8"
            )
        wanted = SCHEMES[name]
        # a scheme of a part needs a map that knows parts
        lacking = [role for role in SCHEMES["full"] if not modules.names(role)]
        if lacking and name != "full":
            raise ModuleMapError(
                f"scheme {name} is of a part of the graph, and map {modules.name}"
                f" ({', '.join(modules.names())}) has no module of role {lacking[0]}:"
                " name a map that has (--map), or take scheme full"
            )
        chosen = (module.name for module in modules.modules if module.role in wanted)
        return cls(name, tuple(chosen))

    @classmethod
    def of(cls, chosen: tuple[str, ...], modules: ModuleMap) -> Self:
        """Return the scheme of modules chosen by name."""
        for name in chosen:
            modules.module(name)
        return cls("modules", tuple(n for n in modules.names() if n in chosen))

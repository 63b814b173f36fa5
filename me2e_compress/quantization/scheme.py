"""Schemes: which modules become int8."""

import dataclasses
from typing import Self

from me2e_compress.errors import ModuleMapError, RecipeError
from me2e_compress.modules import ModuleMap, Role

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

    Attributes:
        name: of the scheme; ``modules`` where the modules were listed one by one.
        modules: which are int8, in the order of the module map.
    """

    name: str
    modules: tuple[str, ...]

    @classmethod
    def named(cls, name: str, modules: ModuleMap) -> Self:
        """Return the modules of a map whose roles a scheme names.

        Raises:
            RecipeError: no such scheme, int4 and fp8 among them.
            ModuleMapError: the map has no module of that role.
        """
        if name not in SCHEMES:
            raise RecipeError(
                f"no scheme {name}; there are {', '.join(SCHEMES)}, all of them int8"
            )
        wanted = SCHEMES[name]
        chosen = tuple(each.name for each in modules.modules if each.role in wanted)
        if not chosen:
            raise ModuleMapError(
                f"map {modules.name} has no module of role {' or '.join(wanted)};"
                f" it has {', '.join(modules.names())}"
            )
        return cls(name, chosen)

    @classmethod
    def of(cls, chosen: tuple[str, ...], modules: ModuleMap) -> Self:
        """Return the scheme of modules chosen by name.

        Raises:
            ModuleMapError: the map has no such module.
        """
        for name in chosen:
            modules.module(name)
        return cls("modules", tuple(n for n in modules.names() if n in chosen))

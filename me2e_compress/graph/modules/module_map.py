"""Module maps: the names of the modules of an ME2E stack, as patterns over paths."""

import ast
import dataclasses
import functools
import itertools
from collections.abc import Callable
from fnmatch import fnmatchcase
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import ClassVar, Literal, Self

import onnx_ir as ir
import pydantic

from me2e_compress.base import documents
from me2e_compress.base.errors import ModuleMapError

_SCOPES = "pkg.torch.onnx.name_scopes"
_NAMESPACE = "namespace"


@dataclasses.dataclass(frozen=True)
class PathGlob:
    """A glob over whole components of a dotted path.

    ``pts_bbox_head.transformer.encoder`` matches that path and everything below it;
    ``*`` and ``?`` are wild within a component (``layers.*.norms``, ``pos_mlp*``). A
    pattern that begins with ``*.`` or ``**.`` may match anywhere in the path, not only
    from its root: ``*.cls_branches`` matches ``head.cls_branches.0.weight``. ``**``
    alone matches every path.
    """

    text: str

    @functools.cached_property
    def components(self) -> tuple[str, ...]:
        """The pattern's components, without a leading ``*.``."""
        parts = tuple(self.text.split("."))
        return parts[1:] if self.anywhere else parts

    @functools.cached_property
    def anywhere(self) -> bool:
        """Whether the match may begin below the root."""
        head, dot, _ = self.text.partition(".")
        return head == "**" or (head == "*" and bool(dot))

    @functools.cached_property
    def _is_plain(self) -> bool:
        """Whether it is a literal prefix, the common case, which must be fast."""
        return not self.anywhere and not any(mark in self.text for mark in "*?[")

    def reach(self, path: tuple[str, ...]) -> int | None:
        """Count a path's components up to the end of the deepest match, if any."""
        wanted, count = self.components, len(self.components)
        if self._is_plain:
            return count if path[:count] == wanted else None
        for start in range(len(path) - count if self.anywhere else 0, -1, -1):
            window = path[start : start + count]
            if len(window) == count and all(map(fnmatchcase, window, wanted)):
                return start + count
        return None


def is_malformed(text: str) -> bool:
    """Return whether a text cannot be a pattern: empty, or an empty component."""
    return not text or any(not part for part in text.split("."))


def parameter_path(name: str | None) -> str:
    """Return an initializer's dotted path; empty for names that tools made up."""
    # The TorchScript exporter's `onnx::MatMul_123` and values of nodes
    # (`/img_neck/Constant_output_0`) are not parameter names
    return "" if not name or ":" in name or "/" in name else name


def scope_of(node: ir.Node) -> str:
    """Return the dotted path of the torch module whose forward made a node, or ""."""
    props = node.metadata_props
    if props:
        # The dynamo exporter's metadata, without the node itself: a list of paths, each
        # within the one before, or `path: class/path: class/...`
        if (scopes := props.get(_SCOPES)) is not None:
            try:
                parsed: object = ast.literal_eval(scopes)
            except (ValueError, SyntaxError):
                parsed = []
            paths = [str(path) for path in parsed] if isinstance(parsed, list) else []
            return _last_path(paths[:-1])
        if (namespace := props.get(_NAMESPACE)) is not None:
            paths = [part.partition(": ")[0] for part in namespace.split("/")]
            return _last_path(paths[:-1])
    # The node's name as the TorchScript exporter writes it, where the scope of
    # `/img_neck/lateral/lateral.0/conv/Conv` is `img_neck.lateral.lateral.0.conv`; or
    # the name of its first output, which tools that rename nodes often keep
    return _scope_in(node.name) or (
        _scope_in(node.outputs[0].name) if node.outputs else ""
    )


def leaving(model: ir.Model, holds: Callable[[ir.Node], bool]) -> tuple[ir.Value, ...]:
    """List the values of some nodes that others read or the graph outputs."""
    members = {node: None for node in model.graph if holds(node)}
    return tuple(
        value
        for node in members
        for value in node.outputs
        if value.is_graph_output()
        or any(reader not in members for reader in value.consumers())
    )


def entering(model: ir.Model, holds: Callable[[ir.Node], bool]) -> tuple[ir.Value, ...]:
    """List the values that some nodes read, without weights and their own values."""
    members = {node: None for node in model.graph if holds(node)}
    read = dict.fromkeys(value for node in members for value in node.inputs)
    return tuple(
        value
        for value in read
        if value is not None
        and value.producer() not in members
        and (value.producer() is not None or value.is_graph_input())
        and value.const_value is None
    )


def _scope_in(name: str | None) -> str:
    return ".".join(part for part in (name or "").split("/")[:-1] if part)


def _last_path(paths: list[str]) -> str:
    return next((path for path in reversed(paths) if path), "")


Role = Literal["feature", "prediction"]

# Name of the map of a graph that is not an ME2E stack; see `ModuleMap.whole`
WHOLE = "whole"


@dataclasses.dataclass(frozen=True)
class Substitute:
    """What substitutes the result of a scope while a module is ablated.

    The result of ``scope``, a pattern or a module, must no longer depend on that
    module: ``reader`` (None for all readers) reads the result of ``by`` instead, None
    for zeros.
    """

    __pydantic_config__: ClassVar = pydantic.ConfigDict(extra="forbid")

    scope: str
    by: str | None = None
    reader: str | None = None

    def __post_init__(self) -> None:
        """Refuse a reader that would read nothing."""
        if self.reader is not None and self.by is None:
            raise ValueError("a substitute with a reader needs by=")


@dataclasses.dataclass(frozen=True)
class Module:
    """One module of a stack.

    The role is "feature" for backbone, neck and BEV encoder, "prediction" for the rest,
    and quantization schemes choose by it. Each of ``patterns``, as :class:`PathGlob`,
    must match something; ``optional`` ones, of other exports of the same stack, may
    not. Whatever ``substitutes`` do not re-wire reads zeros when the module is ablated.
    """

    name: str
    role: Role
    patterns: tuple[str, ...]
    optional: tuple[str, ...] = ()
    substitutes: tuple[Substitute, ...] = ()


class _Strict(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


class Ports(_Strict):
    """Which output is the plan, and which inputs are fed back.

    ``plan`` has the keys of an adapter's ``[plan]``, None to leave it open;
    ``recurrent`` maps an input to the output that answers it; ``sets`` names outputs
    whose rows are agents, in no order, as the metadata ``me2e.sets`` do.
    """

    plan: dict[str, pydantic.JsonValue] | None = None
    recurrent: dict[str, str] = {}
    sets: dict[str, str | tuple[str, ...]] = {}


@dataclasses.dataclass(frozen=True, repr=False)
class ModuleMap:
    """The modules of a stack and the names they go by.

    One list of patterns per module is matched against both parameter names
    (``img_neck.lateral_convs.0.conv.weight``) and scopes (``img_neck.fpn_convs.0``). If
    several modules match a path, the pattern that reaches deepest into it wins, then
    the one with more components written out, then the earlier in the file; so a module
    may own ``head`` and another ``head.planner``.

    Attributes:
        name: of the preset, or of the file.
        modules: in the order of the file.
        strip: leading components that wrappers add, dropped from every path
            (``module.img_neck`` is ``img_neck``).
        ports: plan and state of the graph.
        optional: those of several exports of a stack; each holds where all its names
            are there, and the graph's metadata do not say it.
    """

    name: str
    modules: tuple[Module, ...]
    strip: tuple[str, ...] = ()
    ports: Ports = dataclasses.field(default=Ports(), hash=False)
    optional: tuple[Ports, ...] = dataclasses.field(default=(), hash=False)

    @classmethod
    def load(cls, source: str | Path) -> Self:
        """Read a preset by its name, or a user's TOML file.

        ``whole`` is the map of a graph that is no stack: one module.

        ```toml
        strip = ["model"]                     # may be left out
        [modules.backbone]
        role = "feature"                      # or "prediction"
        patterns = ["img_backbone"]           # each must match something
        optional = ["encoder.resnet"]         # these need not
        [[modules.map.substitutes]]           # read on ablation only
        scope = "*.ego_map_decoder"
        by = "*.ego_agent_decoder"            # left out: zeros
        reader = "planner"                    # left out: whoever read it
        [plan]                                # or [recurrent]: as in an adapter
        output = "ego_fut_preds"
        [sets]                                # agents, matched by compare
        boxes = "boxes"
        scores = "scores"
        [[optional]]                          # where all names are there
        recurrent = { prev_bev = "bev_embed" }
        ```

        Raises:
            ModuleMapError: no such preset or file, not TOML, or not a map.
        """
        path = Path(source)
        # A user's file
        if path.suffix == ".toml":
            if not path.is_file():
                raise ModuleMapError(f"{path}: no such file")
            with documents.reading(path, ModuleMapError, "not TOML"):
                content = documents.read_bytes(path)
            return cls.parse(content, path.stem, str(path))
        # Presets
        if str(source) == WHOLE:
            return cls.whole()
        if str(source) not in presets():
            raise ModuleMapError(
                f"{source}: no such module map; presets are"
                f" {', '.join((*presets(), WHOLE))}, anything else must be a .toml file"
            )
        text = _folder().joinpath(f"{source}.toml").read_text("utf-8")
        return cls.parse(text, str(source), f"preset {source}")

    @classmethod
    def parse(cls, text: str | bytes, name: str, origin: str = "map") -> Self:
        """Read a map from TOML; ``origin`` is its name in error messages."""
        try:
            draft = _File.model_validate(documents.from_toml(text))
        except documents.MalformedError as error:
            raise ModuleMapError(f"{origin}: not TOML ({error})") from error
        except pydantic.ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            message = f"{origin}: {where}: {first['msg']}"
            raise ModuleMapError(message) from error
        return cls(
            name,
            tuple(table.module(key) for key, table in draft.modules.items()),
            draft.strip,
            Ports(plan=draft.plan, recurrent=draft.recurrent, sets=draft.sets),
            draft.optional,
        )

    @classmethod
    def whole(cls) -> Self:
        """Return the map of a graph that is no ME2E stack: one module, ``model``."""
        return cls(WHOLE, (Module("model", "feature", (), ("**",)),))

    def __repr__(self) -> str:
        """Return the map's name and modules, which fingerprints of drives contain."""
        return f"<ModuleMap: {self.name}: {', '.join(self.names())}>"

    def names(self, role: Role | None = None) -> tuple[str, ...]:
        """List the modules, all or those of a role, in the order of the file."""
        return tuple(m.name for m in self.modules if role in (None, m.role))

    def module(self, name: str) -> Module:
        """Return a module by its name."""
        modules = {module.name: module for module in self.modules}
        if name not in modules:
            there = ", ".join(self.names())
            raise ModuleMapError(
                f"{name}: no such module in map {self.name}; it has {there}"
            )
        return modules[name]

    def match(self, path: str) -> str | None:
        """Return the module that a dotted path belongs to; None if none claims it."""
        return self._match(path)

    def claims(self, path: str) -> list[tuple[str, str]]:
        """List every (module, pattern) that matches a path, the winner first."""
        parts = self._parts(path)
        matches = [
            (-reach, -len(glob.components), order, module, glob.text)
            for order, (module, glob) in enumerate(self._globs)
            if (reach := glob.reach(parts)) is not None
        ]
        return [(module, text) for _, _, _, module, text in sorted(matches)]

    def required(self) -> list[tuple[str, str]]:
        """List every (module, pattern) that must match something."""
        return [(m.name, text) for m in self.modules for text in m.patterns]

    @functools.cached_property
    def _globs(self) -> tuple[tuple[str, PathGlob], ...]:
        return tuple(
            (module.name, PathGlob(text))
            for module in self.modules
            for text in module.patterns + module.optional
        )

    @functools.cached_property
    def _match(self) -> "functools._lru_cache_wrapper[str | None]":
        def winner(path: str) -> str | None:
            claims = self.claims(path)
            return claims[0][0] if claims else None

        return functools.lru_cache(maxsize=None)(winner)

    def _parts(self, path: str) -> tuple[str, ...]:
        parts = filter(None, path.split("."))
        return tuple(itertools.dropwhile(self.strip.__contains__, parts))


def presets() -> tuple[str, ...]:
    """List the maps that come with the package."""
    files = (Path(item.name) for item in _folder().iterdir())
    return tuple(sorted(file.stem for file in files if file.suffix == ".toml"))


def _folder() -> Traversable:
    return resources.files("me2e_compress.graph.modules").joinpath("presets")


def _checked(texts: tuple[str, ...]) -> tuple[str, ...]:
    for text in texts:
        if is_malformed(text):
            raise ValueError(f"{text!r} is not a pattern: a component is empty")
    return texts


class _ModuleTable(_Strict):
    role: Role
    patterns: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()
    substitutes: tuple[Substitute, ...] = ()

    _check = pydantic.field_validator("patterns", "optional")(_checked)

    @pydantic.model_validator(mode="after")
    def _has_a_name(self) -> Self:
        if not self.patterns + self.optional:
            raise ValueError("it has no patterns")
        return self

    def module(self, name: str) -> Module:
        return Module(name, self.role, self.patterns, self.optional, self.substitutes)


class _File(Ports):
    optional: tuple[Ports, ...] = ()
    strip: tuple[str, ...] = ()
    modules: dict[str, _ModuleTable] = pydantic.Field(min_length=1)

"""Read a study from a TOML file."""

import inspect
import json
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from me2e_compress.driving.policies import PythonDriver, driver_named
from me2e_compress.driving.shipped_adapters import adapter_file, shipped_adapters
from me2e_compress.errors import FORMER, StudyError
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.evaluators.highway.evaluator import routes_named
from me2e_compress.manager import recipe
from me2e_compress.passes import Pass
from me2e_compress.registry import documents
from me2e_compress.runtime.providers import PROVIDERS, provider_named
from me2e_compress.shipped.drivers import SHIPPED
from me2e_compress.simulator.routes import Route
from me2e_compress.study.condition import Condition
from me2e_compress.study.definition import Study, Timing, Variant
from me2e_compress.study.study_blocks import FramesToRecord, StudyBlock
from me2e_compress.workflows.checks import model_path
from me2e_compress.workflows.other_evaluators import HIGHWAY, is_highway


def load_study(
    path: str | Path,
    routes: str | None = None,
    provider: str | None = None,
    *,
    trust_code: bool = False,
) -> Study:
    """Read a study.

    Files are looked up next to the study's own file; a policy that is not a file there
    is a shipped model. Nothing that it names is run here.

    Args:
        path: The TOML file.
        routes: Routes to drive instead of the study's.
        provider: Execution provider instead of the study's, as a text.
        trust_code: Accept a study that names code: a Python function that makes a
            policy, or libraries, both of which may lie next to it.

    Raises:
        GraphError: A policy is neither a file nor a shipped model.
        StudyError: The file is missing or not valid TOML, a key is unknown, missing or
            of another type, frames are invalid, code is not trusted, or the study is
            inconsistent.
        RecipeError: A recipe or pass is unknown.
        EvaluationError: Routes or latency are unknown.
        ProviderError: A provider or library is missing.
    """
    # read the file, and check its form
    path = Path(path)
    content = _content(path)
    try:
        # JSON has tables and lists for dataclasses and tuples, but no dates
        text = json.dumps(content, default=lambda date: {"date": str(date)})
        table = _Study.model_validate_json(text)
    except ValidationError as error:
        raise StudyError(f"{path}: {_complaint(error)}") from error
    for each in table.variant:
        each.policy = each.policy or table.policy
        if not each.policy:
            raise StudyError(
                f"{path}: variant {each.name}: neither it nor the study names a policy"
            )
    # options of the caller take precedence, and need no trust
    theirs = not provider
    table.provider = provider or table.provider
    if not trust_code and (named := _code(table, their_provider=theirs)):
        raise StudyError(
            f"{path} runs code: {named[0]}; look at it first, then say --trust-code"
        )
    # resolve its names, and check what it refers to
    study = _Reader(path).study(table, routes)
    study.check_recordings()
    return study


def _content(path: Path) -> dict[str, object]:
    """Return the tables of a file."""
    try:
        return documents.from_toml(documents.content(path))
    except FileNotFoundError as error:
        gone = FORMER.get(f"study {path}")
        raise StudyError(gone or f"no study {path}: no such file") from error
    except OSError as error:
        raise StudyError(f"{path}: cannot be read: {error.strerror}") from error
    except documents.MalformedError as error:
        raise StudyError(f"{path}: not TOML: {error}") from error


class _Table(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid")


class _Variant(_Table):
    name: str
    policy: str = ""
    recipe: str | None = None
    passes: str | None = None
    map: str | None = None
    adapter: str | None = None
    trace: str | None = None
    host_stage: str = ""


class _Pair(_Table):
    of: str
    against: str


class _Study(_Table):
    title: str
    baseline: str
    policy: str = ""
    """Of the variants that name none."""
    evaluator: str = HIGHWAY
    routes: str | int | None = None
    seed: int = 0
    frames: str | None = None
    held_out: str | None = None
    provider: str = "cpu"
    plugins: list[str] = Field(default_factory=list)
    record: FramesToRecord | None = None
    latency: Timing = Field(default_factory=Timing)
    variant: list[_Variant]
    condition: tuple[Condition, ...]
    block: tuple[StudyBlock, ...] = ()
    pair: list[_Pair] = Field(default_factory=list)


_KINDS: dict[object, type] = {
    "variant": _Variant,
    "condition": Condition,
    "latency": Timing,
    "block": StudyBlock,
    "pair": _Pair,
    "record": FramesToRecord,
}


def _complaint(error: ValidationError) -> str:
    """Describe the first error; unknown keys go first, as they may explain others."""
    found = error.errors(include_url=False)
    kinds = ("extra_forbidden", "unexpected_keyword_argument")
    unknown = [each for each in found if each["type"] in kinds]
    first = (unknown or found)[0]
    where = ".".join(str(part) for part in first["loc"])
    if gone := FORMER.get(f"study {where}"):
        return gone
    if not unknown:
        return f"{where}: {first['msg']}"
    inside = _KINDS.get(first["loc"][0], _Study) if len(first["loc"]) > 1 else _Study
    keys = inspect.signature(inside).parameters
    return f"no key {where}; there are {', '.join(keys)}"


def _code(table: _Study, *, their_provider: bool) -> list[str]:
    """List the code that a study runs besides ours and installed packages'."""
    policies = [each.policy for each in table.variant if each.policy not in SHIPPED]
    made = [each for each in policies if isinstance(driver_named(each), PythonDriver)]
    libraries = PROVIDERS.parse(table.provider).plugins if their_provider else ()
    return [*made, *table.plugins, *map(str, libraries)]


class _Reader:
    """Turns tables into a study, with paths relative to its file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def study(self, table: _Study, routes: str | None) -> Study:
        if table.record is not None and (table.frames or table.held_out):
            raise StudyError(
                f"{self.path}: give folders of frames, or what to record, not both"
            )
        # the caller's routes take precedence over the file's
        libraries = [self._beside(each) for each in table.plugins]
        which = routes if table.routes is None or routes else str(table.routes)
        driven, set_size = self._routes(which, table)
        return Study(
            title=table.title,
            variants=tuple(self._variant(each) for each in table.variant),
            conditions=table.condition,
            baseline=table.baseline,
            evaluator=table.evaluator,
            routes=driven,
            set_size=set_size,
            frames=self._file(table.frames),
            held_out=self._file(table.held_out),
            timing=table.latency,
            seed=table.seed,
            provider=provider_named(table.provider, libraries),
            to_record=table.record,
            blocks=table.block,
            pairs=tuple((each.of, each.against) for each in table.pair),
        )

    def _variant(self, table: _Variant) -> Variant:
        policy, adapter, stage = table.policy, table.adapter, table.host_stage
        if policy in SHIPPED:  # a file of that name beside the study wins
            policy = str(model_path(policy, self.path.parent))
        # a named policy may bring its own adapter and host stage
        driver = driver_named(policy)
        if isinstance(driver, OnnxDriver):
            policy = str(model_path(driver.path, self.path.parent))
            if adapter is None and driver.adapter is not None:
                adapter = str(driver.adapter)
            if not stage and driver.host_stage is not None:
                stage = str(driver.host_stage)
        return Variant(
            table.name,
            policy,
            self._passes(table),
            None if table.map is None else self._file_or_name(table.map),
            self._adapter(adapter),
            self._file(table.trace),
            stage,
        )

    def _adapter(self, name: str | None) -> Path | None:
        if name in shipped_adapters() and not self._beside(name).is_file():
            return adapter_file(Path(name))
        return self._file(name)

    def _passes(self, table: _Variant) -> tuple[Pass, ...]:
        if table.recipe is not None and table.passes is not None:
            raise StudyError(
                f"{self.path}: variant {table.name}: give a recipe or passes, not both"
            )
        if table.passes is not None:
            return recipe.parse(table.passes)
        if table.recipe is None:
            return ()
        return recipe.load(self._file_or_name(table.recipe))

    def _file_or_name(self, name: str) -> str:
        """Return the path of a file beside the study, else what ships by that name."""
        return str(self._beside(name)) if self._beside(name).is_file() else name

    def _routes(
        self, which: str | None, table: _Study
    ) -> tuple[tuple[Route, ...], int]:
        if which is None and not is_highway(table.evaluator):
            return (), 0
        return routes_named(which or "all", self.path.parent)

    def _file(self, name: str | None) -> Path | None:
        return None if name is None else self._beside(name)

    def _beside(self, name: str) -> Path:
        return self.path.parent / name

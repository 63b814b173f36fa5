"""A study, as its TOML file describes it: variants, conditions, baseline, routes."""

from __future__ import annotations

import functools
import itertools
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PlainValidator,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    with_config,
)
from pydantic_core import PydanticCustomError

from me2e_compress.base import documents
from me2e_compress.base.errors import EvaluationError, FramesError, StudyError
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.commands.checks import model_path
from me2e_compress.driving.contract import Count, Positive, RouteInfo
from me2e_compress.driving.policies import POLICIES, PythonDriver, driver_named
from me2e_compress.driving.shipped_adapters import adapter_file, shipped_adapters
from me2e_compress.evaluators.contract import Evaluator, evaluator_named
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.manager import recipe as recipes
from me2e_compress.passes import Pass
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.shipped.drivers import SHIPPED
from me2e_compress.study.condition import FORM, Condition, check_name


def check_unique(kind: str, names: Iterable[str]) -> None:
    """Check that there are names, without repetition."""
    counts = Counter(names)
    if not counts:
        raise StudyError(f"the study has no {kind}")
    name, count = counts.most_common(1)[0]
    if count > 1:
        raise StudyError(f"{count} {kind}s are named {name}")


def check_known(what: str, name: str, names: Sequence[str]) -> None:
    """Check that a name is among the known ones."""
    if name not in names:
        raise StudyError(f"{what} {name}; there are {', '.join(names) or 'none'}")


# Paths in a study's file are relative to the file's folder, which is the context of
# the validation. Objects that Python code makes are not validated.


def _folder(info: ValidationInfo) -> Path:
    return Path(info.context or "")


def _beside(name: object, info: ValidationInfo) -> object:
    """Return the path of a file beside the study's."""
    return str(_folder(info) / name) if isinstance(name, str) else name


def _file_or_name(name: str, info: ValidationInfo) -> str:
    """Return the path of a file beside the study's; the name if there is none."""
    file = _folder(info) / name
    return str(file) if file.is_file() else name


def _adapter(name: object, info: ValidationInfo) -> object:
    """Return the path of a file beside the study's, or of a shipped adapter."""
    if isinstance(name, str) and name in shipped_adapters():
        file = _folder(info) / name
        return str(file if file.is_file() else adapter_file(Path(name)))
    return _beside(name, info)


def _policy(text: str, info: ValidationInfo) -> str:
    """Return the policy with the path of its model; a file of a model's name wins."""
    if text in SHIPPED:
        text = str(model_path(text, _folder(info)))
    driver = driver_named(text) if text else None
    if not isinstance(driver, OnnxDriver):
        return text
    return POLICIES.text(replace(driver, path=model_path(driver.path, _folder(info))))


def _passes(text: object) -> tuple[Pass, ...]:
    if not isinstance(text, str):
        raise PydanticCustomError("passes", "Input should be a valid string")
    return recipes.parse(text)


File = Annotated[Path, BeforeValidator(_beside)]
Name = Annotated[str, AfterValidator(_file_or_name)]
PolicyText = Annotated[str, AfterValidator(_policy)]
AtLeastOne = Annotated[int, Field(ge=1)]


@with_config(FORM)
@dataclass(frozen=True)
class Variant:
    """One driver to compare: a file as it is, or the result of passes.

    Raises:
        StudyError: The name is invalid, or passes, an adapter or a trace lack a model.
    """

    name: str  # letters, digits, `_`, `+` and `-`; names its folder of results
    # A policy by name, `blind:8`, or the path of an ONNX file; what it says of adapter
    # and host stage holds where the variant says nothing. Empty takes the study's.
    policy: PolicyText = ""
    # Passes applied to the file; none leaves it as it is
    passes: Annotated[tuple[Pass, ...], PlainValidator(_passes)] = ()
    # Preset or TOML file for the passes; None finds the preset
    module_map: Annotated[Name | None, Field(alias="map")] = None
    # TOML file that adapts the model to the policy contract
    adapter: Annotated[Path | None, BeforeValidator(_adapter)] = None
    trace: File | None = None  # latencies recorded on a device; None measures them here
    # Changes the model's plan on the host, as a text; a trace does not include its
    # time, see the latency source `host-stage`
    host_stage: str = ""
    # Passes by the name or the file of a recipe, instead of `passes`
    recipe: Name | None = None

    def __post_init__(self) -> None:
        check_name("variant", self.name)
        if self.recipe is not None and self.passes:
            raise StudyError(f"variant {self.name}: give a recipe or passes, not both")
        # A recipe becomes its passes, a policy of a model its file and options
        resolved = dict[str, object]()
        if self.recipe is not None:
            resolved |= {"passes": recipes.load(self.recipe), "recipe": None}
        passes = resolved.get("passes", self.passes)
        others = (self.module_map, self.adapter, self.trace, self.host_stage)
        driver = driver_named(self.policy) if self.policy else None
        if isinstance(driver, OnnxDriver):
            resolved |= {
                "policy": str(driver.path),
                "adapter": self.adapter or driver.adapter,
                "module_map": self.module_map or driver.module_map,
                "host_stage": self.host_stage or str(driver.host_stage or ""),
            }
        elif driver is not None and any((passes, *others)):
            raise StudyError(
                f"variant {self.name}: {self.policy} is not a model: there is nothing "
                "to compress, adapt or time"
            )
        for name, value in resolved.items():
            object.__setattr__(self, name, value)


@with_config(FORM)
@dataclass(frozen=True)
class Timing:
    """How latencies are measured, and which device they represent."""

    samples: AtLeastOne = 200  # timed inferences per model
    threads: AtLeastOne = 1
    # Median latency of the baseline on the target device; it sets one scale for all
    # models. None takes this machine as it is.
    baseline_median_s: Positive | None = None


@with_config(FORM)
@dataclass(frozen=True)
class StudyBlock:
    """Some variants under some conditions, named in the order of the block's tables."""

    name: str
    variants: Annotated[tuple[str, ...], Field(min_length=1)]
    conditions: Annotated[tuple[str, ...], Field(min_length=1)]


@with_config(FORM)
@dataclass(frozen=True)
class FramesToRecord:
    """Frames of the baseline that a study records itself, on fresh routes."""

    frames: AtLeastOne  # number of frames to calibrate on
    # Number of frames to measure fidelity and latency on, of the next seed
    held_out: AtLeastOne
    seed: Count = 0


class Pair(NamedTuple):
    """Two drives to compare, ``VARIANT.CONDITION`` of both."""

    of: str
    against: str


@with_config(FORM)
@dataclass(frozen=True)
class Study:
    """Variants x conditions on the same routes.

    Raises:
        StudyError: There is nothing to drive, a name is repeated or unknown, or passes
            or a trace lack frames.
        EvaluationError: The evaluator or its routes are unknown.
    """

    title: str
    # Variants and conditions are in the order of the tables
    variants: Annotated[tuple[Variant, ...], Field(alias="variant")]
    conditions: Annotated[tuple[Condition, ...], Field(alias="condition")]
    baseline: str  # name of the variant that the others are compared with
    # Empty only where the evaluator takes none
    routes: Annotated[Sequence[RouteInfo], PlainValidator(tuple)] = ()
    set_size: int = 0  # number of routes of the whole set
    frames: File | None = None  # folder of recorded frames that passes calibrate on
    # Folder of other frames, for measuring fidelity and latency
    held_out: File | None = None
    timing: Annotated[Timing, Field(alias="latency")] = field(default_factory=Timing)
    seed: Count = 0  # seed of bootstraps, of passes and of draws from traces
    provider: Provider = CPU  # execution provider for all models
    # Frames that the study records itself; None uses the folders
    to_record: Annotated[FramesToRecord | None, Field(alias="record")] = None
    # Which variants drive under which conditions; empty means all under all. Under each
    # condition the baseline drives too.
    blocks: Annotated[tuple[StudyBlock, ...], Field(alias="block")] = ()
    pairs: Annotated[tuple[Pair, ...], Field(alias="pair")] = ()  # drives to compare
    evaluator: str = "highway"  # `name{option=value}`
    policy: PolicyText = ""  # that of variants that name none
    plugins: tuple[File, ...] = ()  # libraries of operators for the provider

    def __post_init__(self) -> None:
        # Names must be unique, and known where they are referred to
        names = [variant.name for variant in self.variants]
        conditions = [condition.name for condition in self.conditions]
        check_unique("variant", names)
        check_unique("condition", conditions)
        check_known("baseline: no variant", self.baseline, names)
        for block in self.blocks:
            for name in block.variants:
                check_known(f"block {block.name}: no variant", name, names)
            for name in block.conditions:
                check_known(f"block {block.name}: no condition", name, conditions)
        drives = [f"{one}.{other}" for other in conditions for one in names]
        for name in itertools.chain.from_iterable(self.pairs):
            check_known("pair: no VARIANT.CONDITION", name, drives)
        # A mean is of a drive before its condition
        for number, condition in enumerate(self.conditions):
            if condition.mean_of:
                what = f"condition {condition.name}: mean_of: no VARIANT.CONDITION"
                before = drives[: number * len(names)]
                check_known(f"{what} before it", condition.mean_of, before)
        # Variants that name no policy take the study's
        variants = list[Variant]()
        for variant in self.variants:
            if not (variant.policy or self.policy):
                raise StudyError(
                    f"variant {variant.name}: neither it nor the study names a policy"
                )
            own = variant if variant.policy else replace(variant, policy=self.policy)
            variants.append(own)
        object.__setattr__(self, "variants", tuple(variants))
        # The evaluator must take all that variants and conditions ask for
        try:
            for variant in self.variants:
                asked = ["policy"] if variant.adapter is None else ["policy", "adapter"]
                self.driven_by.check_takes(asked, f"variant {variant.name}: ")
            for condition in self.conditions:
                asked = ["latency"] * (condition.latency != "none")
                whose = f"condition {condition.name}: "
                self.driven_by.check_takes([*asked, *condition.changed], whose)
            if self.routes:
                self.driven_by.check_takes(["routes"], "routes: ")
        except EvaluationError as error:
            raise StudyError(str(error)) from error
        if self.to_record is None:
            self._check_frames()

    @functools.cached_property
    def driven_by(self) -> Evaluator:
        """The evaluator, built from its text."""
        return evaluator_named(self.evaluator)

    @property
    def preview(self) -> str:
        """Suffix of titles if only a part of the routes is driven; empty otherwise."""
        driven, whole = len(self.routes), self.set_size
        return f" (preview: {driven} of {whole} routes)" if 0 < driven < whole else ""

    def _check_frames(self) -> None:
        """Check that there are frames for passes that calibrate and for latencies."""
        for variant in self.variants:
            for step in variant.passes:
                if step.needs_frames and self.frames is None:
                    raise StudyError(
                        f"variant {variant.name}: {step.name} measures on recorded"
                        " frames, and there are none (frames = FRAMES)"
                    )
        # Models without a trace are timed on held-out frames
        traced = [condition.name for condition in self.conditions if condition.traced]
        if not traced or self.held_out is not None:
            return
        for variant in self.variants:
            driver = driver_named(variant.policy)
            if isinstance(driver, OnnxDriver) and not variant.trace:
                raise StudyError(
                    f"condition {traced[0]}: the latency of {variant.name} is measured "
                    "on held-out frames, and there are none (held_out = FRAMES)"
                )

    def inputs(self) -> Iterator[str | Path]:
        """Yield the files and folders that it reads."""
        yield from filter(None, (self.frames, self.held_out))
        yield from self.provider.plugins
        for variant in self.variants:
            files = variant.policy, variant.module_map, variant.adapter, variant.trace
            yield from filter(None, files)
            yield from (file for step in variant.passes for file in step.files())

    def check(self) -> None:
        """Check that there are routes and recordings, and that files exist.

        Raises:
            StudyError: There are none, or one is not valid.
        """
        if not self.routes and "routes" in self.driven_by.takes:
            raise StudyError(f"{self.title}: there is no route to drive")
        for variant in self.variants:
            for key, file in (("adapter", variant.adapter), ("trace", variant.trace)):
                if file is not None and not file.is_file():
                    words = f"variant {variant.name}: {key} {file}: no such file"
                    raise StudyError(words)
        for name, folder in (("frames", self.frames), ("held_out", self.held_out)):
            try:
                if folder is not None:
                    CalibrationSet(folder)
            except FramesError as error:
                raise StudyError(f"{name}: {error}") from error

    def driven_under(self, condition: Condition) -> tuple[Variant, ...]:
        """Return the variants under a condition, with the baseline if there are any."""
        if not self.blocks:
            return self.variants
        blocks = [block for block in self.blocks if condition.name in block.conditions]
        names = {name for block in blocks for name in (*block.variants, self.baseline)}
        return tuple(variant for variant in self.variants if variant.name in names)

    def of_blocks(self, names: Sequence[str]) -> Study:
        """Return the part that some blocks need."""
        blocks = {block.name: block for block in self.blocks}
        for name in names:
            check_known("no block", name, list(blocks))
        chosen = tuple(blocks[name] for name in names)
        # Variants and conditions that no chosen block names are left out
        driven = {self.baseline, *(name for block in chosen for name in block.variants)}
        under = {name for block in chosen for name in block.conditions}
        variants = tuple(variant for variant in self.variants if variant.name in driven)
        conditions = tuple(one for one in self.conditions if one.name in under)
        return replace(self, blocks=chosen, variants=variants, conditions=conditions)

    @property
    def reference(self) -> Variant:
        """The baseline variant."""
        return next(one for one in self.variants if one.name == self.baseline)

    def drive_of(self, name: str) -> tuple[Variant, Condition]:
        """Return variant and condition of ``VARIANT.CONDITION``."""
        variants = {variant.name: variant for variant in self.variants}
        conditions = {condition.name: condition for condition in self.conditions}
        variant, _, condition = name.partition(".")
        return variants[variant], conditions[condition]


_STUDY = TypeAdapter(Study)


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
            policy, or libraries.

    Raises:
        GraphError: A policy is neither a file nor a shipped model.
        StudyError: The file is missing or not valid TOML, a key is unknown, missing or
            of another type, frames are invalid, code is not trusted, or the study is
            inconsistent.
        RecipeError: A recipe or pass is unknown.
        EvaluationError: Routes or latency are unknown.
        ProviderError: A provider or library is missing.
    """
    # Read the file; options of the caller take precedence
    path = Path(path)
    if not path.exists():
        raise StudyError(f"no study {path}: no such file")
    with documents.reading(path, StudyError, "not TOML"):
        content = documents.from_toml(documents.read_bytes(path))
    if "set_size" in content:  # Python's own
        raise StudyError(f"{path}: no key set_size")
    own_routes = content.pop("routes", None)
    which = own_routes if routes is None else routes
    if provider:
        content["provider"] = provider
    # Check its form: JSON has lists for tuples, but no dates
    try:
        text = json.dumps(content, default=lambda date: {"date": str(date)})
        study = _STUDY.validate_json(text, context=path.parent)
    except ValidationError as error:
        # An unknown key goes first: it may explain other errors
        errors = error.errors(include_url=False)
        unknown = [e for e in errors if e["type"] == "unexpected_keyword_argument"]
        where = ".".join(map(str, (unknown or errors)[0]["loc"]))
        words = f"no key {where}" if unknown else f"{where}: {errors[0]['msg']}"
        raise StudyError(f"{path}: {words}") from error
    except StudyError as error:
        raise StudyError(f"{path}: {error}") from error
    if study.to_record is not None and (study.frames or study.held_out):
        raise StudyError(f"{path}: give folders of frames, or what to record, not both")
    # Check that code is trusted, but for what the caller names
    policies = [variant.policy for variant in study.variants]
    code = [text for text in policies if isinstance(driver_named(text), PythonDriver)]
    code += map(str, (*study.plugins, *(() if provider else study.provider.plugins)))
    if code and not trust_code:
        raise StudyError(
            f"{path} runs code: {code[0]}; look at it first, then say --trust-code"
        )
    # Plugins of the study belong to its provider
    plugins = (*study.provider.plugins, *study.plugins)
    owner = replace(study.provider, plugins=plugins)
    study = replace(study, provider=owner, plugins=())
    owner.check()
    # Find the routes; an evaluator may take none
    if which is None and "routes" in study.driven_by.takes:
        which = "all"
    if which is not None:
        if isinstance(which, bool) or not isinstance(which, str | int):
            raise StudyError(f"{path}: routes: it must be a number, names or a file")
        study.driven_by.check_takes(["routes"], "routes: ")
        ours, size = study.driven_by.routes(str(which), path.parent)
        study = replace(study, routes=ours, set_size=size)
    study.check()
    return study

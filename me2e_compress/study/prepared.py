"""The file that drives: a model as it is, or made by passes once and stored."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from google.protobuf.message import DecodeError

from me2e_compress import graph
from me2e_compress.base import documents
from me2e_compress.base.errors import GraphError, Me2eError, StudyError
from me2e_compress.base.listener import Listener
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.commands.checks import try_first
from me2e_compress.commands.compress import compress, sidecar
from me2e_compress.commands.inspect import WEIGHTS
from me2e_compress.commands.options import CompressOptions
from me2e_compress.driving.adapter.outputs import state_and_plan
from me2e_compress.driving.host_stage import HOST_STAGES
from me2e_compress.driving.policies import Driver, driver_named
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.manager.recipe import to_text
from me2e_compress.metrics.measure import Measure
from me2e_compress.runtime.providers import CPU, PROVIDERS
from me2e_compress.study.definition import Study, Variant
from me2e_compress.study.workspace import Workspace
from me2e_compress.targets.onnxruntime.convert import slow_here
from me2e_compress.version import __version__


@dataclass(frozen=True)
class PlanFidelity:
    """The plan of a variant compared with the baseline's on held-out frames: m, dB."""

    plan_mean: Measure
    plan_max: Measure
    plan_sqnr: Measure
    frames: int = 0

    @classmethod
    def unknown(cls, reason: str) -> "PlanFidelity":
        """Return the result for a variant that was not compared."""
        metres = Measure(None, "m", reason)
        return cls(metres, metres, Measure(None, "dB", reason))


NOT_COMPARED = PlanFidelity.unknown("not compared")


@dataclass(frozen=True)
class PreparedVariant:
    """A variant whose driver is ready; what it costs, without drives."""

    variant: Variant
    driver: Driver
    model: Path | None = None
    source: str = ""  # name of the file that passes were applied to
    pipeline: str = ""  # the passes, as text; empty if the model is its own source
    sha256: str | None = None
    size_bytes: int | None = None  # with its weights
    failure: str = ""  # why there is no model that can drive; empty if there is one
    weights: str = ""  # origin of the weights, such as a checkpoint; empty if unknown
    # Plan and state of adapter and map, as metadata of the graph
    metadata: Mapping[str, str] = field(default_factory=dict)
    # Which inputs are state and which output is the plan, and from where
    known: str = ""
    # By percent; empty until it was timed
    latency_ms: Mapping[int, Measure] = field(default_factory=dict)
    fidelity: PlanFidelity = NOT_COMPARED

    @property
    def name(self) -> str:
        """Name of the variant."""
        return self.variant.name

    @property
    def size_mb(self) -> Measure:
        """Size of the model with its weights, 1e6 bytes."""
        if self.size_bytes is None:
            return Measure(None, "MB", self.failure or "no model")
        return Measure(self.size_bytes / 1e6, "MB")

    def to_json(self) -> dict[str, Any]:
        """Return all facts; everything timed is below the key `latency`."""
        return {
            "name": self.name,
            "policy": self.variant.policy,
            "pipeline": self.pipeline or None,
            "model_sha256": self.sha256,
            "weights": self.weights,
            "size": self.size_mb,
            "fidelity": self.fidelity,
            "latency": {f"p{percent}": e for percent, e in self.latency_ms.items()},
        }


def prepare_all(
    study: Study, workspace: Workspace, listener: Listener
) -> list[PreparedVariant]:
    """Prepare every variant; only a failure of the baseline is an error."""
    prepared = list[PreparedVariant]()
    for variant in study.variants:
        try:
            prepared.append(prepare_variant(study, variant, workspace, listener))
        except Me2eError as error:
            if variant == study.reference:
                raise
            listener.on_warning(f"variant {variant.name} is left out: {error}")
            driver = driver_named(variant.policy, variant.adapter)
            prepared.append(PreparedVariant(variant, driver, failure=str(error)))
    return prepared


def prepare_variant(
    study: Study, variant: Variant, workspace: Workspace, listener: Listener
) -> PreparedVariant:
    """Find or make a variant's driver, and open it once."""
    # Drivers without a file need no preparation
    driver = driver_named(variant.policy, variant.adapter, variant.module_map)
    if not isinstance(driver, OnnxDriver):
        study.driven_by.check_policy(driver)
        return PreparedVariant(variant, driver)
    # Apply the passes, if there are any
    model = source = driver.path
    if not source.is_file():
        raise StudyError(f"variant {variant.name}: {source}: no such model")
    if variant.passes:
        model = _compressed(study, variant, source, workspace, listener)
    stage = HOST_STAGES.parse(variant.host_stage) if variant.host_stage else None
    driver = replace(driver, path=model, provider=study.provider, host_stage=stage)
    # Fail early on a model that cannot run or drive
    try_first(model, model.name, listener=listener, provider=study.provider)
    study.driven_by.check_policy(driver)
    # Read from the file, and the report beside it, how it was made
    origin = source.name, to_text(variant.passes)
    if not variant.passes:
        origin = _origin_from_report(model) or origin
    loaded = graph.load(model)
    metadata, known = state_and_plan(
        loaded, model, variant.adapter, variant.module_map, {}
    )
    if slow := slow_here(loaded, study.provider):
        listener.on_warning(f"variant {variant.name}: {slow}")
    made_from, pipeline = origin
    return PreparedVariant(
        variant,
        driver,
        model,
        source=made_from,
        pipeline=pipeline,
        sha256=graph.sha256_of(model),
        size_bytes=graph.file_bytes(model),
        weights=loaded.metadata_props.get(WEIGHTS, ""),
        metadata=metadata,
        known=known,
    )


def _origin_from_report(model: Path) -> tuple[str, str] | None:
    """Read source and passes from the report next to a file, if it is of that file."""
    try:
        report = documents.from_json(sidecar(model, "report").read_bytes())
        if report["output"]["sha256"] != graph.sha256_of(model):
            return None
        return str(report["source"]["file"]), str(report["pipeline"])
    except (OSError, DecodeError, GraphError, ValueError, LookupError, TypeError):
        return None  # there is none, or it is not a report


def _compressed(
    study: Study,
    variant: Variant,
    source: Path,
    workspace: Workspace,
    listener: Listener,
) -> Path:
    """Apply the passes, unless a file exists that still matches its report."""
    # The file's name has a hash of everything that decides the result
    contents = list[str]()
    for file in (file for step in variant.passes for file in step.files()):
        try:
            contents.append(hashlib.sha256(file.read_bytes()).hexdigest())
        except OSError as error:
            raise StudyError(
                f"variant {variant.name}: {file}: cannot be read: {error.strerror}"
            ) from error
    frames, modules = study.frames, variant.module_map
    decisive = (
        __version__,
        graph.sha256_of(source),
        to_text(variant.passes),
        "" if frames is None else CalibrationSet(frames).fingerprint,
        "" if modules is None else repr(ModuleMap.load(modules)),
        str(study.seed),
        # the key of models made before these options existed stays valid
        *(() if study.provider == CPU else (PROVIDERS.text(study.provider),)),
        *(() if variant.adapter is None else (graph.sha256_of(variant.adapter),)),
        *contents,
    )
    key = hashlib.sha256("\n".join(decisive).encode()).hexdigest()
    path = workspace.model(variant, key)
    if path.is_file() and sidecar(path, "report").is_file():
        if _origin_from_report(path) is not None:
            return path
        listener.on_warning(f"{path}: not what its report is of: made again")

    def report(_: str, done: int, total: int, words: str) -> None:
        listener.on_progress(f"compress {variant.name}", done, total, words)

    # The study measures on its own frames; a result without int8 is no error here
    options = CompressOptions(
        force=True,  # files in the workspace may be replaced
        module_map=variant.module_map,
        adapter=variant.adapter,
        provider=study.provider,
        measure_frames=0,
        allow_empty=True,
    )
    own = Listener(report, listener.on_warning)
    compress(source, path, variant.passes, study.frames, options, own)
    return path

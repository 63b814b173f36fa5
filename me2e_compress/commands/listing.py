"""Names of everything that can be chosen, and abilities of this machine."""

import contextlib
import dataclasses
import importlib.metadata
import importlib.util
import os
import platform
import re
from collections.abc import Callable, Mapping
from functools import partial
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import onnxruntime
import psutil
import pynvml

from me2e_compress.base.display import Table, table
from me2e_compress.base.errors import RecipeError
from me2e_compress.base.registry import Entry, Registry, describe
from me2e_compress.calibration.observers import OBSERVERS
from me2e_compress.calibration.recording import LOGS
from me2e_compress.commands.result import Result, View
from me2e_compress.driving.host_stage import HOST_STAGES
from me2e_compress.driving.input_sources import INPUT_SOURCES
from me2e_compress.driving.latency import LATENCY_SOURCES
from me2e_compress.driving.policies import POLICIES
from me2e_compress.driving.shipped_adapters import adapter_file, shipped_adapters
from me2e_compress.evaluators import EVALUATORS
from me2e_compress.graph.modules.module_map import ModuleMap, presets
from me2e_compress.manager.report import versions
from me2e_compress.operators import OPERATORS
from me2e_compress.operators.kernels.kernel import KERNELS
from me2e_compress.operators.kernels.trampoline import why_not
from me2e_compress.passes import PASSES
from me2e_compress.quantization.rules import RULE_SETS, RULES
from me2e_compress.runtime.energy.energy_counter import (
    ENERGY_COUNTERS,
    EnergyRecording,
    open_counter,
)
from me2e_compress.runtime.energy.energy_result import Absent
from me2e_compress.runtime.providers import PROVIDERS
from me2e_compress.shipped.drivers import SHIPPED
from me2e_compress.targets import TARGETS

_OURS = "me2e-compress"
_COMMENT = re.compile(r"(?:#.*\n)+")
_SENTENCE = re.compile(r"(.+?\.)(?:\s|$)")


@dataclasses.dataclass(frozen=True, repr=False)
class ListResult(Result):
    """Names by kind, with descriptions; `closely` shows what each option means."""

    keys = ("*kinds",)
    kinds: Mapping[str, tuple[Entry, ...]]
    closely: bool = False

    def view(self) -> View:
        """Return a table of each kind: names, descriptions and options."""
        headline = ", ".join(f"{len(e)} {kind}" for kind, e in self.kinds.items())
        tables, by = list[Table](), "other packages add theirs by entry point: "
        for kind, entries in self.kinds.items():
            rows = list[tuple[str, str]]()
            for entry in entries:
                theirs = "" if entry.source == _OURS else f" ({entry.source})"
                about = entry.error or f"{entry.doc}{theirs}".replace("`", "")
                rows.append((entry.name, about))
                # Then the options: closely on rows of their own, else on one
                words = list[str]()
                for option in entry.options:
                    gap = " = " if self.closely else "="
                    default = "" if option.default is None else f"{gap}{option.default}"
                    text = f"{option.name}: {option.type}{default} {option.doc}"
                    words.append(text if self.closely else f"{option.name}{default}")
                if words and not self.closely:
                    words = [", ".join(words)]
                rows += [("", text.replace("`", "")) for text in words]
            note = by + REGISTRIES[kind].group if kind in REGISTRIES else ""
            tables.append(table(kind, ("name", "what it is"), rows, note, words=2))
        return View(headline, tables, ())


def _toml_entry(path: Traversable) -> Entry:
    """Describe a TOML file by the first sentence of the comment at its head."""
    comment = _COMMENT.match(path.read_text(encoding="utf-8"))
    text = " ".join((comment.group() if comment else "").replace("#", " ").split())
    sentence = _SENTENCE.match(text)
    doc = sentence[1] if sentence else text
    return Entry(path.name.removesuffix(".toml"), _OURS, doc)


# Registries to which other packages add
REGISTRIES: Mapping[str, Registry[Any]] = {
    "passes": PASSES,
    "rules": RULES,
    "rule-sets": RULE_SETS,
    "observers": OBSERVERS,
    "logs": LOGS,
    "targets": TARGETS,
    "policies": POLICIES,
    "latency-sources": LATENCY_SOURCES,
    "energy-counters": ENERGY_COUNTERS,
    "host-stages": HOST_STAGES,
    "input-sources": INPUT_SOURCES,
    "evaluators": EVALUATORS,
    "providers": PROVIDERS,
    "operators": OPERATORS,
}


# The functions that find the entries of a kind
KINDS: Mapping[str, Callable[[], tuple[Entry, ...]]] = {
    **{kind: partial(describe, registry) for kind, registry in REGISTRIES.items()},  # pyright: ignore[reportArgumentType]
    "recipes": lambda: tuple(
        _toml_entry(path)
        for path in sorted(
            resources.files("me2e_compress").joinpath("recipes").iterdir(),
            key=lambda path: path.name.removesuffix(".toml"),
        )
        if path.name.endswith(".toml")
    ),
    "adapters": lambda: tuple(
        _toml_entry(adapter_file(Path(name))) for name in shipped_adapters()
    ),
    "module-maps": lambda: tuple(
        Entry(modules.name, _OURS, ", ".join(modules.names()))
        for modules in map(ModuleMap.load, (*presets(), "whole"))
    ),
    "stacks": lambda: tuple(
        Entry(name, _OURS, "trained; ships with the package") for name in SHIPPED
    ),
}


def list_entries(kind: str | None = None) -> ListResult:
    """List what can be named, of one kind (with every option's meaning) or of all.

    Raises:
        RecipeError: There is no such kind.
    """
    if kind is not None and kind not in KINDS:
        raise RecipeError(f"no kind {kind!r}; there are {', '.join(KINDS)}")
    # options are only explained for a single kind, since all would be long
    chosen = KINDS if kind is None else {kind: KINDS[kind]}
    return ListResult({name: find() for name, find in chosen.items()}, kind is not None)


_EXTRAS = (
    ("highway_env", "highway", "drive models in closed loop"),
    ("openvino", "openvino", "run graphs in OpenVINO: --provider openvino"),
    ("tensorrt_rtx", "trt-check", "parse and build for TensorRT without a GPU"),
    ("onnxslim", "bench", "compare with onnxslim in the benchmarks"),
)


@dataclasses.dataclass(frozen=True)
class Checkup:
    """One thing a machine can do, or, where `found` is None, how to make it do so."""

    what: str
    found: str | None
    advice: str = ""


@dataclasses.dataclass(frozen=True, repr=False)
class DoctorResult(Result):
    """Everything that was looked for."""

    checkups: tuple[Checkup, ...]

    def view(self) -> View:
        """Return what was found, and what to do for the rest."""
        count = sum(checkup.found is not None for checkup in self.checkups)
        rows = [(one.what, one.found or "no", one.advice) for one in self.checkups]
        columns = ("what", "found", "to have it")
        return View(
            f"{count} of {len(self.checkups)} things found",
            [table("This machine", columns, rows, words=3)],
            (),
        )


def doctor() -> DoctorResult:
    """Look for everything that the toolkit can make use of."""
    memory = psutil.virtual_memory().total / 2**30
    enough = "" if memory >= 6 else "VAD-tiny needs 6 GiB to calibrate"
    checkups = [
        Checkup("cores", str(os.cpu_count())),
        Checkup("memory", f"{memory:.1f} GiB", enough),
        Checkup("platform", platform.platform()),
        Checkup("onnxruntime on", ", ".join(onnxruntime.get_available_providers())),
    ]
    # Packages, ours and optional ones
    checkups += [Checkup(name, version) for name, version in versions().items()]
    for module, extra, purpose in _EXTRAS:
        version, advice = None, f"{purpose}: pip install 'me2e-compress[{extra}]'"
        if importlib.util.find_spec(module) is not None:
            version, advice = "of unknown version", ""
            with contextlib.suppress(importlib.metadata.PackageNotFoundError):
                version = importlib.metadata.version(module.replace("_", "-"))
        checkups.append(Checkup(module, version, advice))
    # Compiled kernels, or why there are none
    why, names = why_not(), ", ".join(kernel.op_type for kernel in KERNELS)
    advice = f"fused operators run as their bodies: {why}" if why else ""
    checkups.append(Checkup("compiled kernels", None if why else names, advice))
    # A GPU: a driver without one fails later than a missing driver
    gpu, advice = None, ""
    try:
        pynvml.nvmlInit()
        try:
            gpu = str(pynvml.nvmlDeviceGetName(pynvml.nvmlDeviceGetHandleByIndex(0)))
        except pynvml.NVMLError as error:
            advice = f"the driver answers: {error}"
        finally:
            pynvml.nvmlShutdown()
    except pynvml.NVMLError as error:
        advice = f"no GPU is used ({error})"
    checkups.append(Checkup("NVIDIA GPU", gpu, advice))
    # A counter of energy, on the device or recorded
    counter, scope, advice = open_counter(), None, ""
    if isinstance(counter, Absent):
        advice = f"joules are not measured here: {counter.reason}"
    elif isinstance(counter, EnergyRecording):
        scope = counter.counter
    else:
        with contextlib.closing(counter):
            scope = f"{counter.counter} of {counter.device}: {counter.scope}"
    checkups.append(Checkup("energy counter", scope, advice))
    return DoctorResult(tuple(checkups))

"""The file that drives: given, or made by passes once and kept."""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path

from google.protobuf.message import DecodeError
from pydantic import BaseModel, ValidationError

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.driving.policies import Driver, driver_named
from me2e_compress.errors import StudyError
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.manager import PassManager
from me2e_compress.modules import ModuleMap, map_of
from me2e_compress.passes import Context, Pass
from me2e_compress.recipe import to_text
from me2e_compress.runtime.atomic import write_json
from me2e_compress.study.definition import Scheme, Study
from me2e_compress.study.workplace import Listener, Workplace
from me2e_compress.version import __version__


@dataclass(frozen=True)
class PreparedScheme:
    """A scheme whose driver is ready.

    Attributes:
        scheme: Which.
        driver: What drives.
        model: The ONNX file; None for a driver without one.
        source: Name of the file that passes were applied to.
        pipeline: The passes, as text; empty if the model is its own source.
        sha256: Of the model.
        size_bytes: Of the model with its weights.
    """

    scheme: Scheme
    driver: Driver
    model: Path | None = None
    source: str = ""
    pipeline: str = ""
    sha256: str | None = None
    size_bytes: int | None = None


def prepare_scheme(
    study: Study, scheme: Scheme, workplace: Workplace, listener: Listener
) -> PreparedScheme:
    """Find or make a scheme's driver, and open it once.

    Raises:
        StudyError: No such model, or a file that a pass reads is missing.
        EvaluationError: It cannot drive.
        Me2eError: A pass refused the graph or broke.
    """
    driver = driver_named(scheme.policy, scheme.adapter)
    if not isinstance(driver, OnnxDriver):
        driver.open()
        return PreparedScheme(scheme, driver)
    model = source = driver.path
    if not source.is_file():
        raise StudyError(f"scheme {scheme.name}: {source}: no such model")
    if scheme.passes:
        model = _compressed(study, scheme, workplace, listener)
    driver = replace(driver, path=model)
    driver.open()
    sha256 = graph.sha256_of(model)
    origin = source.name, to_text(scheme.passes)
    if not scheme.passes:
        origin = _told_beside(model, sha256) or origin
    return PreparedScheme(
        scheme, driver, model, *origin, sha256, graph.file_bytes(model)
    )


def _told_beside(model: Path, sha256: str) -> tuple[str, str] | None:
    """Read source and passes from the report beside a file, if it is of this file."""
    report = _report_of(model)
    if report is None or report.output.sha256 != sha256:
        return None
    return report.source.file, report.pipeline


def _unaltered(model: Path) -> bool:
    """Whether a file is the one that its report was written of."""
    try:
        return _told_beside(model, graph.sha256_of(model)) is not None
    except (OSError, DecodeError):
        return False


def _report_of(model: Path) -> "_Report | None":
    try:
        return _Report.model_validate_json(_report_path(model).read_bytes())
    except (OSError, ValidationError):
        return None


def _report_path(model: Path) -> Path:
    return model.with_name(f"{model.stem}.report.json")


class _File(BaseModel):
    file: str
    sha256: str


class _Report(BaseModel):
    source: _File
    output: _File
    pipeline: str


def _compressed(
    study: Study, scheme: Scheme, workplace: Workplace, listener: Listener
) -> Path:
    """Apply the passes, unless the same was done before; the report is written last.

    What is there is taken if it is still the file that its report was written of.
    """
    source = Path(scheme.policy)
    frames = None if study.frames is None else CalibrationSet(study.frames)
    path = workplace.model(scheme, _key(scheme, source, frames, study.seed))
    if path.is_file() and _report_path(path).is_file():
        if _unaltered(path):
            return path
        listener.on_warning(f"{path}: not what its report is of: made again")
    loaded = graph.load(source)
    if frames is not None:
        frames.check(loaded)
    context = Context(map_of(loaded, scheme.module_map), frames, study.seed)
    manager = PassManager(scheme.passes, reproducers=path.parent)
    stage = f"compress {scheme.name}"
    report = manager.run(
        loaded,
        context,
        lambda done, total, words: listener.on_progress(stage, done, total, words),
    )
    graph.save(report.model, path)
    write_json(_report_path(path), report.record(source, path), indent=2)
    return path


def _key(scheme: Scheme, source: Path, frames: CalibrationSet | None, seed: int) -> str:
    """Hash everything that decides what the passes make."""
    modules = scheme.module_map
    decisive = (
        __version__,
        graph.sha256_of(source),
        to_text(scheme.passes),
        "" if frames is None else frames.fingerprint,
        "" if modules is None else repr(ModuleMap.load(modules)),
        str(seed),
        *(_content(scheme, file) for file in _files_of(scheme.passes)),
    )
    return hashlib.sha256("\n".join(decisive).encode()).hexdigest()


def _files_of(passes: tuple[Pass, ...]) -> Iterator[Path]:
    """List the files that passes read, in the order of their options."""
    for current in filter(is_dataclass, passes):
        for field in fields(current):
            value = getattr(current, field.name)
            if isinstance(value, Path):
                yield value


def _content(scheme: Scheme, file: Path) -> str:
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError as error:
        raise StudyError(
            f"scheme {scheme.name}: {file}: cannot be read: {error.strerror}"
        ) from error

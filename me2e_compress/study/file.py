"""Read a study from a TOML file."""

import dataclasses
import json
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from me2e_compress.base import documents
from me2e_compress.base.errors import StudyError
from me2e_compress.driving.policies import PythonDriver, driver_named
from me2e_compress.study.definition import Study

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
    # Read the file and check its form; options of the caller take precedence
    path = Path(path)
    content = _content(path)
    which = content.pop("routes", None) if routes is None else routes
    content.pop("routes", None)
    if provider:
        content["provider"] = provider
    try:
        # JSON has lists for tuples, but no dates
        text = json.dumps(content, default=lambda date: {"date": str(date)})
        study = _STUDY.validate_json(text, context=path.parent)
    except ValidationError as error:
        raise StudyError(f"{path}: {_complaint(error)}") from error
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
    owner = dataclasses.replace(study.provider, plugins=plugins)
    study = dataclasses.replace(study, provider=owner, plugins=())
    owner.check()
    # Find the routes; an evaluator may take none
    if which is None and "routes" in study.driven_by.takes:
        which = "all"
    if which is not None:
        if isinstance(which, bool) or not isinstance(which, str | int):
            raise StudyError(f"{path}: routes: it must be a number, names or a file")
        study.driven_by.check_takes(["routes"], "routes: ")
        ours, size = study.driven_by.routes(str(which), path.parent)
        study = dataclasses.replace(study, routes=ours, set_size=size)
    study.check()
    return study


def _content(path: Path) -> dict[str, object]:
    """Return the keys and tables of a study's file."""
    if not path.exists():
        raise StudyError(f"no study {path}: no such file")
    with documents.reading(path, StudyError, "not TOML"):
        content = documents.from_toml(documents.read_bytes(path))
    if "set_size" in content:  # Python's own
        raise StudyError(f"{path}: no key set_size")
    return content


def _complaint(error: ValidationError) -> str:
    """Describe the first error; unknown keys go first, as they may explain others."""
    errors = error.errors(include_url=False)
    unknown = [e for e in errors if e["type"] == "unexpected_keyword_argument"]
    first = (unknown or errors)[0]
    where = ".".join(map(str, first["loc"]))
    if not unknown:
        return f"{where}: {first['msg']}"
    return f"no key {where}"

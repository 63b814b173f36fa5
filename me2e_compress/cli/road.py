"""The closed-loop score of an int8 variant: what measures sensitivity asks for it."""

from pathlib import Path
from tempfile import TemporaryDirectory

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.cli.extras import need_closed_loop
from me2e_compress.errors import EvaluationError
from me2e_compress.sensitivity import Drive, Int8Choice


def drives_of(recipe: Path) -> Path:
    """Give the folder of the drives that a recipe was chosen by, beside it."""
    return recipe.with_name(recipe.stem + ".drives")


def on_routes(
    routes: str, model: Path, folder: Path, adapter: Path | None, workers: int
) -> Drive:
    """Drive variants over routes of highway-env; the score is their mean DS, percent.

    Args:
        routes: as ``evaluate --routes`` takes them.
        model: that the variants are made of; it is tried before anything else.
        folder: keeps the episodes, a folder a variant; what is there is not driven
            again.
        adapter: TOML file that adapts the model to the policy contract.
        workers: routes at a time.

    Raises:
        MissingExtraError: driving needs the extra ``highway``.
        EvaluationError: no such route, or the model cannot drive.
    """
    need_closed_loop("what driving a variant needs")
    from me2e_compress.evaluators.highway.drivers import OnnxDriver, image_size_of
    from me2e_compress.evaluators.highway.engine import LocalEngine
    from me2e_compress.evaluators.highway.evaluation_options import routes_named
    from me2e_compress.evaluators.highway.evaluator import HighwayEvaluator
    from me2e_compress.evaluators.highway.runner import Conditions
    from me2e_compress.evaluators.highway.worker import Job
    from me2e_compress.metrics.scores import score

    picked, set_size = routes_named(routes)
    size = image_size_of(OnnxDriver(model, adapter).open())

    def drive(choice: Int8Choice, variant: ir.Model) -> float:
        results = folder / name_of(choice, variant)
        with TemporaryDirectory() as scratch:
            path = Path(scratch) / "variant.onnx"
            graph.save(variant, path)
            job = Job(OnnxDriver(path, adapter), Conditions(image_size=size))
            engine = LocalEngine(workers)
            evaluator = HighwayEvaluator(job, picked, results, set_size, engine)
            found = score(tuple(evaluator.episodes()), set_size).driving_score
        if found.value is None:
            raise EvaluationError(f"{results}: {found.measure.reason}")
        return found.value

    return drive


def name_of(choice: Int8Choice, model: ir.Model) -> str:
    """Name a variant: its int8 modules, and what tells it from all other graphs."""
    modules = "+".join(choice.modules) or "float"
    return f"{modules}-{graph.digest(model)[:12]}"

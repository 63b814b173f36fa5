from pathlib import Path

import pytest

from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.highway.conditions import Conditions
from me2e_compress.evaluators.highway.drivers import BlindDriver
from me2e_compress.evaluators.highway.engine import RayEngine
from me2e_compress.evaluators.highway.evaluator import HighwayEvaluator
from me2e_compress.evaluators.highway.worker import Job
from tests.evaluators.highway.drivers import CROSSING, PARKED

pytest.importorskip("ray", reason="the extra 'ray' is not installed")


@pytest.mark.filterwarnings("ignore")
def test_a_local_ray_writes_the_same_bytes(tmp_path: Path) -> None:
    job = Job(BlindDriver(), Conditions())
    routes = (CROSSING, PARKED)
    local = HighwayEvaluator(job, routes, tmp_path / "local", 220)
    cluster = HighwayEvaluator(job, routes, tmp_path / "ray", 220, RayEngine(2))

    assert tuple(cluster.episodes()) == tuple(local.episodes())
    for path in (tmp_path / "local").rglob("*.json"):
        twin = tmp_path / "ray" / path.relative_to(tmp_path / "local")
        assert twin.read_bytes() == path.read_bytes()


@pytest.mark.filterwarnings("ignore")
def test_no_cluster_is_one_line(tmp_path: Path) -> None:
    job = Job(BlindDriver(), Conditions())
    nowhere = RayEngine(1, "127.0.0.1:1")
    one = HighwayEvaluator(job, (PARKED,), tmp_path / "r", 220, nowhere)

    with pytest.raises(EvaluationError, match=r"ray: no cluster at 127\.0\.0\.1:1"):
        list(one.episodes())

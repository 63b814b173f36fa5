from pathlib import Path

import pytest

from me2e_compress.base.errors import EvaluationError
from me2e_compress.evaluators.highway.engine import RayEngine
from tests.evaluators.highway.drivers import CROSSING, PARKED
from tests.evaluators.highway.evaluations import driven

pytest.importorskip("ray", reason="the extra 'ray' is not installed")


@pytest.mark.filterwarnings("ignore")
def test_a_local_ray_writes_the_same_bytes(tmp_path: Path) -> None:
    routes = (CROSSING, PARKED)

    cluster = driven(tmp_path / "ray", routes, engine=RayEngine(2))

    assert cluster == driven(tmp_path / "local", routes)
    for path in (tmp_path / "local").rglob("*.json"):
        twin = tmp_path / "ray" / path.relative_to(tmp_path / "local")
        assert twin.read_bytes() == path.read_bytes()


@pytest.mark.filterwarnings("ignore")
def test_no_cluster_is_one_line(tmp_path: Path) -> None:
    nowhere = RayEngine(1, "127.0.0.1:1")

    with pytest.raises(EvaluationError, match=r"ray: no cluster at 127\.0\.0\.1:1"):
        driven(tmp_path / "r", (PARKED,), engine=nowhere)

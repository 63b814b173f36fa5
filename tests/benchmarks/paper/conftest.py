import pytest

from benchmarks.paper.__main__ import PAGE
from benchmarks.paper.records import read_paper
from benchmarks.paper.result import PaperResult
from me2e_compress.study import load_study
from tests.benchmarks.paper.made import write_records


@pytest.fixture(scope="session")
def result(tmp_path_factory: pytest.TempPathFactory) -> PaperResult:
    """What the paper's study finds in drives that nobody drove."""
    study, folder = PAGE.study, tmp_path_factory.mktemp("records")
    write_records(load_study(study, "11"), folder)
    return read_paper(load_study(study), folder)

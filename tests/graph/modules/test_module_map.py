from pathlib import Path

import pytest

from me2e_compress.base.errors import ModuleMapError
from me2e_compress.graph.modules.module_map import ModuleMap, Substitute, presets

TEXT = """
strip = ["model"]
[modules.head]
role = "prediction"
patterns = ["head"]
[modules.planner]
role = "prediction"
patterns = ["head.planner"]
optional = ["*.ego"]
substitutes = [{ scope = "*.ego", by = "*.agents" }, { scope = "*.lanes" }]
[modules.backbone]
role = "feature"
patterns = ["trunk"]
"""


@pytest.fixture
def read() -> ModuleMap:
    return ModuleMap.parse(TEXT, "mine")


def test_on_a_tie_the_one_written_out_wins_then_the_earlier() -> None:
    both = ModuleMap.parse(
        '[modules.a]\nrole = "feature"\npatterns = ["*.x"]\n'
        '[modules.b]\nrole = "feature"\npatterns = ["head.x"]\n'
        '[modules.c]\nrole = "feature"\npatterns = ["head.?"]',
        "both",
    )
    assert both.claims("head.x") == [("b", "head.x"), ("c", "head.?"), ("a", "*.x")]


def test_names_come_in_the_order_of_the_file(read: ModuleMap) -> None:
    assert read.match("head") == "head"
    assert read == ModuleMap.parse(TEXT, "mine")
    assert read.names() == ("head", "planner", "backbone")
    assert read.names("feature") == ("backbone",)
    assert read.names("prediction") == ("head", "planner")


def test_a_module_is_found_by_name(read: ModuleMap) -> None:
    assert read.module("planner").substitutes == (
        Substitute("*.ego", "*.agents"),
        Substitute("*.lanes", None),
    )
    with pytest.raises(ModuleMapError, match="occ: no such module in map mine; it has"):
        read.module("occ")


def test_a_file_is_named_after_itself(tmp_path: Path) -> None:
    (tmp_path / "ours.toml").write_text(TEXT)
    assert ModuleMap.load(tmp_path / "ours.toml").name == "ours"
    assert ModuleMap.load(str(tmp_path / "ours.toml")).names()[0] == "head"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("modules = [", "not TOML"),
        ("", "modules: Field required"),
        ("[modules]", "modules: "),
        ('[modules.a]\npatterns = ["a"]', "modules.a.role: Field required"),
        ('[modules.a]\nrole = "fun"\npatterns = ["a"]', "modules.a.role: "),
        ('[modules.a]\nrole = "feature"', "modules.a: Value error, it has no patterns"),
        ('[modules.a]\nrole = "feature"\npatterns = ["a..b"]', "'a..b' is not a patt"),
        ('[modules.a]\nrole = "feature"\npatern = ["a"]', "modules.a.patern: Extra"),
        ('[modules.a]\nrole = "feature"\npatterns = "a"', "modules.a.patterns: "),
        ('role = "feature"\n[modules.a]\nrole = "feature"\npatterns = ["a"]', "role: "),
    ],
)
def test_a_malformed_map_is_named_in_one_line(text: str, complaint: str) -> None:
    with pytest.raises(ModuleMapError) as caught:
        ModuleMap.parse(text, "mine", "mine.toml")
    message = str(caught.value)
    assert message.startswith("mine.toml: ")
    assert complaint in message
    assert "\n" not in message


def test_a_missing_file_and_an_unknown_preset_are_told_apart(tmp_path: Path) -> None:
    with pytest.raises(ModuleMapError, match=r"none\.toml: no such file"):
        ModuleMap.load(tmp_path / "none.toml")
    with pytest.raises(ModuleMapError, match=r"vadd: no such module map; presets are"):
        ModuleMap.load("vadd")


def test_every_preset_reads() -> None:
    assert ModuleMap.load("whole") == ModuleMap.whole()
    assert presets() == ("highway", "tcp", "uniad", "vad")
    for name in presets():
        read = ModuleMap.load(name)
        assert read.name == name
        assert read.names("feature")[0] == "backbone"
        assert read.required() == []

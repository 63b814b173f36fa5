"""Changes that tests should notice: what is drawn, and what becomes of each."""

import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.mutate import Fate, main, run, table
from benchmarks.mutations import mutations


@pytest.mark.parametrize(
    ("source", "changed"),
    [
        ("a = b < c", ["a = (b <= c)"]),
        ("a = b is None", ["a = (b is not None)"]),
        ("a = b and c and d", ["a = (b or c or d)"]),
        ("a = b + c * d", ["a = (b - c * d)", "a = b + (c / d)"]),
        ("a = 'text' + b", []),
        ("a = f'{b + 1}'", []),
        ("a: Literal[1] = True", ["a: Literal[1] = (False)"]),
        ("a = 2.5, None, ''", ["a = (6.0), None, ''"]),
        ("if TYPE_CHECKING:\n    a = 1", []),
        ("if a == b:\n    c()", ["if (a != b):\n    c()", "if a == b:\n    pass"]),
        ("a = b if c else d", ["a = b if (not (c)) else d"]),
        ("a = [b for b in c if b]", ["a = [b for b in c if (not (b))]"]),
        ("assert a > 1", []),
        ("def f():\n    '''1 < 2'''\n    return a, b, 'µ'",
         ["def f():\n    '''1 < 2'''\n    return (b, a, 'µ')"]),
        ("def f():\n    return a, a", []),
        ("a.b = c\nd = e\ndel a[f]", ["pass\nd = e\ndel a[f]", "a.b = c\nd = e\npass"]),
        ("a -= b", ["pass"]),
        ("'µ' if a(\n) else 1; b = 1",
         ["'µ' if (not (a())\n) else 1; b = 1", "'µ' if a(\n) else (2); b = 1",
          "'µ' if a(\n) else 1; b = (2)"]),
    ],
)  # fmt: skip
def test_every_single_change(source: str, changed: list[str]) -> None:
    raw = source.encode()

    found = [each.applied(raw).decode() for each in mutations(Path("a.py"), raw)]

    assert found == changed


@pytest.fixture
def toy(tmp_path: Path) -> Path:
    """A package of one room: its test looks at one side of a border alone."""
    room, tests = tmp_path / "toy" / "room", tmp_path / "tests" / "room"
    room.mkdir(parents=True)
    tests.mkdir(parents=True)
    (room / "sign.py").write_text("def positive(x):\n    return x > 0\n")
    (tests / "test_sign.py").write_text(
        "from toy.room.sign import positive\n\n"
        "def test_one():\n    assert positive(1) and not positive(-1)\n"
    )
    return tmp_path


WORDS = ("room", "--seed", "1", "--package", "toy")


def test_what_survives_is_told(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (toy / "toy" / "room" / "sign.py").read_bytes()

    main(WORDS, toy)

    assert capsys.readouterr().out.splitlines() == [
        "survived   toy/room/sign.py:2: x > 0  ->  x >= 0",
        "killed     toy/room/sign.py:2: 0  ->  1",
        "",
        "room, seed 1",
        "survived   toy/room/sign.py:2: x > 0  ->  x >= 0",
        "2 changes: killed 1, survived 1, timed out 0; 50 % killed",
    ]
    assert (toy / "toy" / "room" / "sign.py").read_bytes() == before


def test_tests_that_fail_anyway_prove_nothing(toy: Path) -> None:
    (toy / "toy" / "room" / "sign.py").write_text("def positive(x):\n    return x\n")

    with pytest.raises(SystemExit, match="tests/room: fails without any change"):
        main(WORDS, toy)


def test_a_room_without_tests_is_named(toy: Path) -> None:
    (toy / "tests" / "room" / "test_sign.py").unlink()

    with pytest.raises(SystemExit, match="tests/room: no tests"):
        main(WORDS, toy)


def test_what_takes_too_long_is_ended(tmp_path: Path) -> None:
    endless = (sys.executable, "-c", "while True: pass")

    with pytest.raises(subprocess.TimeoutExpired):
        run(endless, tmp_path, 0.2, {})


def test_the_table_ends_with_the_share() -> None:
    (change,) = mutations(Path("a.py"), b"a = 1")

    assert list(table([(change, Fate.KILLED)] * 3 + [(change, Fate.TIMED_OUT)])) == [
        "timed out  a.py:1: 1  ->  2",
        "4 changes: killed 3, survived 0, timed out 1; 75 % killed",
    ]

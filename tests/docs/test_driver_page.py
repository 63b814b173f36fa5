"""The page about the driver says what the driver is."""

import re
from pathlib import Path

from me2e_compress.shipped.drivers import shipped
from me2e_compress.workflows.inspect import inspect

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "driver.md"


def told() -> dict[str, tuple[int, float]]:
    """Parameters and million MACs by module, from the table."""
    row = r"^\| `(\w+)` \|.*\| ([\d,]+) \| ([\d.]+) \|$"
    rows = re.findall(row, PAGE.read_text(), re.MULTILINE)
    return {name: (int(n.replace(",", "")), float(macs)) for name, n, macs in rows}


def test_parameters_and_macs_are_those_of_the_file() -> None:
    found = {
        item.module: (item.parameters, round((item.macs or 0) / 1e6, 1))
        for item in inspect(shipped("highway"), None).modules
    }
    assert told() == found


def test_modules_are_told_in_the_order_of_the_map() -> None:
    names = [item.module for item in inspect(shipped("highway"), None).modules]
    assert list(told()) == names

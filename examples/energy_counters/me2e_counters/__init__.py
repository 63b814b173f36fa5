"""Energy counters of processors (RAPL) and of Jetsons (INA3221)."""

from pathlib import Path


def text_in(path: Path) -> str:
    """Return the text of a file of the system; empty if it cannot be read."""
    try:
        return path.read_text().strip()
    except OSError:
        return ""

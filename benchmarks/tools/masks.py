"""What may differ between two runs of the same code: clock, versions, machine, paths.

Every mask names the files that it is for and keeps all bytes around what it hides:
another number of digits, a missing value or a changed indentation still shows.
"""

import hashlib
import json
import re
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

TEXT = (".html", ".json", ".log", ".md")
"""Suffixes of files that are masked; all others are compared as they are."""

_NUMBER = r"\d+(?:\.\d+)?(?:e[+-]?\d+)?"
_PACKAGES = "python|me2e-compress|onnx|onnx-ir|onnxruntime|numpy"
_KEY = r"[0-9a-f]{16}"


@dataclass(frozen=True)
class Mask:
    """One thing that is hidden.

    Attributes:
        name: What stands in its place, in angle brackets.
        files: Glob of the paths, below the folder, that it is for.
        pattern: A group that is kept, then what is hidden.
    """

    name: str
    files: str
    pattern: str

    def hide(self, file: str, text: str) -> str:
        """Hide every occurrence; return the text as it is for other files."""
        if not fnmatchcase(file, self.files):
            return text
        return re.sub(self.pattern, rf"\1<{self.name}>", text)


MASKS = (
    Mask("CPU seconds", "*.report.json", rf'("seconds": ){_NUMBER}'),
    Mask("seconds", "*.log", rf'("seconds": ){_NUMBER}'),
    Mask("memory", "*.log", rf'("memory_mb": ){_NUMBER}'),
    Mask("version", "*.report.json", rf'("(?:{_PACKAGES})": )"\d[^"]*"'),
    Mask("version", "*/study.json", rf'("(?:{_PACKAGES})": )"\d[^"]*"'),
    Mask("version", "*/evaluation.json", r'("version": )"\d[^"]*"'),
    Mask("versions", "*.html", "(<dt>Versions</dt><dd>)[^<]+"),
    Mask("machine", "*/study.json", r'("machine": )"[^"]+"'),
    Mask("machine", "*.html", "(<dt>Machine</dt><dd>)[^<]+"),
    # of a compressed model that a study keeps; it depends on the version
    Mask("key", "*/models/*.report.json", rf'("file": "[\w+-]+\.){_KEY}(?=\.onnx")'),
)


def masked_name(file: str) -> str:
    """Return the path of a file with the key of a study's model hidden."""
    return re.sub(rf"(/models/[\w+-]+\.){_KEY}(?=\.)", r"\1<key>", file)


def masked(folder: Path, file: str, package: Path) -> bytes:
    """Return the content of a file with everything hidden that may differ.

    Args:
        folder: What the file lies below.
        file: Its path there.
        package: Folder of the package that wrote it; it is hidden where it is named.
    """
    content = (folder / file).read_bytes()
    if Path(file).suffix not in TEXT:
        return content
    text = _without_seal(folder / file, content.decode())
    text = re.sub(rf"{re.escape(str(package))}/(?:\w+/)*", "<package>/", text)
    for mask in MASKS:
        text = mask.hide(file, text)
    return text.encode()


def _without_seal(path: Path, text: str) -> str:
    """Hide the digest of an evaluation in its routes, if it is the right one.

    The evaluation names the version, and its digest changes with it.
    """
    evaluation = path.parents[1] / "evaluation.json"
    if path.parent.name != "routes" or not evaluation.is_file():
        return text
    stated = json.dumps(json.loads(evaluation.read_bytes()), sort_keys=True)
    seal = hashlib.sha256(stated.encode()).hexdigest()
    return text.replace(f'"fingerprint": "{seal}"', '"fingerprint": <right>', 1)

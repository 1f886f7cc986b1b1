"""Files of a benchmark's results."""

import json
from pathlib import Path
from typing import Any

from torchpcct.files import atomic_write

__all__ = ["write_results"]


def write_results(folder: Path, name: str, result: dict[str, Any], text: str) -> None:
    """``name.json`` with the result and ``name.md`` with its text, each whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    for ending, content in (("json", json.dumps(result, indent=1) + "\n"), ("md", text)):
        with atomic_write(folder / f"{name}.{ending}") as part:
            part.write_text(content, encoding="utf-8")

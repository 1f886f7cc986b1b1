"""Files of a benchmark's results."""

import json
from pathlib import Path
from typing import Any

from torchpcct.files import atomic_write

__all__ = ["REMARKS", "write_results"]

REMARKS = "<!-- Remarks: what follows stays when the page is written again. -->"


def write_results(folder: Path, name: str, result: Any, text: str) -> None:
    """``name.json`` with the result and ``name.md`` with its text, each whole or not at all.

    What stands in the page under the line ``REMARKS``, written by hand, is kept.
    """
    folder.mkdir(parents=True, exist_ok=True)
    page = folder / f"{name}.md"
    if page.exists():
        _, line, remarks = page.read_text(encoding="utf-8").partition(REMARKS)
        text = f"{text.rstrip()}\n\n{line}{remarks}" if line else text
    for ending, content in (("json", json.dumps(result, indent=1) + "\n"), ("md", text)):
        with atomic_write(folder / f"{name}.{ending}") as part:
            part.write_text(content, encoding="utf-8")

"""Execute every notebook, as `python -m tests.notebooks`; `--write` also stores the outputs in the files."""

from __future__ import annotations

import sys
import time
from pathlib import Path

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"


def main() -> None:
    import nbformat
    from nbclient import NotebookClient

    files = sorted(NOTEBOOKS.glob("*.ipynb"))
    if not files:
        raise SystemExit(f"no notebooks in {NOTEBOOKS}")
    for file in files:
        start = time.perf_counter()
        notebook = nbformat.read(file, as_version=4)
        nbformat.validate(notebook)
        NotebookClient(
            notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(NOTEBOOKS)}}
        ).execute()
        if "--write" in sys.argv[1:]:
            nbformat.write(notebook, file)
        print(f"{file.name}: executed in {time.perf_counter() - start:.1f} s")


if __name__ == "__main__":
    main()

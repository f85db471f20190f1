"""Notebooks of docs/notebooks: each runs without an error, in its own folder, from a fresh clone.

What they claim is asserted in their cells. Run as a program with names of notebooks, or without for all, this file runs them and
keeps their outputs: `python python/tests/test_notebooks.py first-look`.
"""

import base64
import re
import sys
import time
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "notebooks"
NOTEBOOKS = sorted(path.stem for path in FOLDER.glob("*.ipynb"))
#: A picture that is kept is at most so large, and all notebooks together, bytes.
LARGEST_PICTURE, LARGEST_SUM = 65_000, 1_000_000
#: Longest that one cell may take, s. Far above what any takes, so that nothing depends on the machine's speed.
TIMEOUT_S = 1800

PACKAGES = ("matplotlib", "nbclient", "ipykernel")


def read(name):
    nbformat = pytest.importorskip("nbformat", reason="notebooks are not run: nbformat is not installed")
    return nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)


def executed(notebook):
    """Runs a notebook, whose outputs become those of this run. Returns how long it took, s."""
    import matplotlib.font_manager  # noqa: F401 - makes its cache now: it would say so in the first notebook
    from nbclient import NotebookClient

    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs, cell.execution_count = [], None
    start = time.monotonic()
    resources = {"metadata": {"path": str(FOLDER)}}
    NotebookClient(notebook, timeout=TIMEOUT_S, kernel_name="python3", record_timing=False, resources=resources).execute()
    return time.monotonic() - start


def outputs(notebook):
    return [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]


def kinds(notebook):
    """Kinds of the outputs of each cell: streams by their names, others by their data."""
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]

    def kind(output):
        return output.get("name") or ("picture" if "image/png" in output.get("data", {}) else output.output_type)

    return [sorted({kind(output) for output in cell.outputs}) for cell in code]


def pictures(notebook):
    found = [output.data["image/png"] for output in outputs(notebook) if "image/png" in output.get("data", {})]
    return [base64.b64decode(data) for data in found]


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs(name, capsys):
    for package in PACKAGES:
        pytest.importorskip(package, reason=f"notebooks are not run: {package} is not installed")
    notebook = read(name)
    kept, files = kinds(notebook), sorted(FOLDER.iterdir())
    seconds = executed(notebook)
    with capsys.disabled():
        print(f"\n{name}: {seconds:.1f} s")
    # Cells that make a picture or print have one that is kept, and nothing was written to stderr.
    assert kinds(notebook) == kept
    assert sorted(FOLDER.iterdir()) == files, "a notebook leaves no files in its folder"


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_is_kept_with_its_outputs(name):
    notebook = read(name)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1)), "kept from one run, in order"
    assert not any("stderr" in cell for cell in kinds(notebook)), "no warnings"
    assert all(output.output_type != "error" for output in outputs(notebook))
    assert len(pictures(notebook)) >= 3 and all(len(picture) < LARGEST_PICTURE for picture in pictures(notebook))
    assert sum(cell.source.count("assert ") for cell in code) >= 4, "what a notebook claims is asserted"
    text = "".join(output.get("text", "") + output.get("data", {}).get("text/plain", "") for output in outputs(notebook))
    text += "".join(cell.source for cell in notebook.cells)
    assert not re.search(r"/(home|root|tmp|work|Users)/", text), "no paths of one machine"


def test_notebooks_are_small_and_listed():
    assert NOTEBOOKS
    assert sum((FOLDER / f"{name}.ipynb").stat().st_size for name in NOTEBOOKS) < LARGEST_SUM
    page = (FOLDER / "README.md").read_text()
    assert re.findall(r"\]\(([a-z-]+)\.ipynb\)", page) and set(re.findall(r"\]\(([a-z-]+)\.ipynb\)", page)) == set(NOTEBOOKS)


def keep(name):
    """Runs a notebook and writes it with its outputs."""
    import nbformat

    notebook = read(name)
    seconds = executed(notebook)
    # Which Python ran it is of no interest, and would change with every machine.
    notebook.metadata["language_info"] = {"name": "python"}
    nbformat.write(notebook, FOLDER / f"{name}.ipynb")
    print(f"{name}: {seconds:.1f} s")


if __name__ == "__main__":
    for given in sys.argv[1:] or NOTEBOOKS:
        keep(given)

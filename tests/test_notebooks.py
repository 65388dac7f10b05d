"""The notebooks run from top to bottom, and are stored as a reader should find them.

The cell tagged `parameters` has the sizes of the stored outputs; its metadata `tiny` has those of this test.
"""

import json
import os
import re
from pathlib import Path

import nbformat
import pytest
from jupyter_client import KernelManager
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def read(path):
    return nbformat.read(path, as_version=4)


def outputs(path):
    return [output for cell in read(path).cells if cell.cell_type == "code" for output in cell.outputs]


@pytest.fixture(scope="module")
def kernel():
    """A process for all notebooks, one after the other: it imports torch and Lightning once."""
    manager = KernelManager()
    manager.start_kernel(env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"})
    yield manager
    manager.shutdown_kernel(now=True)


@pytest.mark.slow
@notebook
def test_a_notebook_runs(path, kernel, tmp_path):
    content = read(path)
    (sizes,) = [cell for cell in content.cells if "parameters" in cell.metadata.get("tags", ())]
    (sizes.source,) = sizes.metadata.tiny

    begin = f"""\
%reset_selective -f ^[^_]
%cd -q {tmp_path}
__import__("sys").path.insert(0, {str(tmp_path)!r})  # for the processes that it starts
"""
    content.cells.insert(0, nbformat.v4.new_code_cell(begin))

    client = NotebookClient(content, km=kernel, timeout=300)
    try:
        client.execute()
    finally:
        client.kc.stop_channels()


@notebook
def test_a_notebook_is_stored_as_it_ran(path):
    cells = [cell for cell in read(path).cells if cell.cell_type == "code"]

    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert any("image/png" in output.get("data", {}) for output in outputs(path))


@notebook
def test_a_notebook_has_no_noise_in_its_outputs(path):
    text = json.dumps(outputs(path))

    assert "widget" not in json.dumps(read(path).metadata)
    assert not [output for output in outputs(path) if output.get("name") == "stderr" or output.output_type == "error"]
    assert not re.search(r"(/tmp|/home|/root|/work|/usr|[A-Z]:\\\\)/", text)  # no path of the machine it ran on
    assert path.stat().st_size < 1_000_000


@notebook
def test_the_cells_of_a_notebook_are_short(path):
    for cell in read(path).cells:
        assert len(cell.source.splitlines()) <= 50
        assert cell.cell_type == "markdown" or max(map(len, cell.source.splitlines())) <= 120


def test_there_are_six_notebooks():
    assert [path.stem[:2] for path in NOTEBOOKS] == ["01", "02", "03", "04", "05", "06"]

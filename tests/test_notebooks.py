"""The notebooks of the documentation, executed in fresh kernels."""

import base64
import io
import re
from pathlib import Path

import nbclient
import nbformat
import numpy as np
import pytest
from PIL import Image

NOTEBOOKS = Path(__file__).parent.parent / "docs" / "notebooks"

pytestmark = [
    pytest.mark.slow,
    # jupyter_client warns that its loopback connection is not encrypted, and zmq about event loops
    pytest.mark.filterwarnings("ignore"),
]


def executed(name: str) -> tuple[list[np.ndarray], str]:
    """Execute a notebook. Returns its images and its printed text."""
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", 4)
    nbclient.NotebookClient(notebook, timeout=600, kernel_name="python3").execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    pictures = []
    for output in outputs:
        if "image/png" in output.get("data", {}):
            with Image.open(io.BytesIO(base64.b64decode(output.data["image/png"]))) as picture:
                pictures.append(np.asarray(picture.convert("RGB")))
    return pictures, "".join(output.text for output in outputs if output.output_type == "stream")


@pytest.mark.parametrize(
    ("name", "number", "printed"),
    [
        ("press_and_light", 6, r"largest pressure: 1\.\d\d kPa, now 3\.\d\d kPa"),
        ("fit_a_pose", 2, r"blur  1\.5 mm: 0\.[01]\d\d mm and 0\.\d\d degrees off"),
        (
            "drop_train_predict",
            4,
            r"(?s)the predicted place is \d+ mm from the true one.*roll-out: \d+ mm from the true",
        ),
        (
            "a_gripper_that_feels",
            5,
            r"(?s)right presses on the object with (5\.9|6\.0)\d N.*carry 1\.4\d\d N"
            r".*grip 6\.0 N: the object comes down by -?0\.\d mm.*grip 3\.0 N: the object comes down by [1-9]",
        ),
    ],
)
def test_notebook_runs_and_shows_its_images(name, number, printed, monkeypatch):
    monkeypatch.delenv("XLA_FLAGS", raising=False)  # as for a user, see conftest.py
    pictures, text = executed(name)
    assert len(pictures) == number
    assert all(picture.std() > 5 for picture in pictures)
    assert re.search(printed, text)

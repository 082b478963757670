"""Clean executed notebooks before they are committed.

    python scripts/clean_notebooks.py notebooks/*.ipynb

The script removes run times, progress bars, messages about progress and local paths. It also
reduces figures to a palette of 256 colours if this hardly changes a pixel.
"""

import base64
import io
import json
import re
import sys
from pathlib import Path

import numpy as np
from PIL import Image

MAX_CHANGE = 8
"""Largest accepted change of a colour value (0 to 255) in 99 % of the pixels."""
BAR = re.compile(r"\d+%\|")
SAID = re.compile(
    r"^[^\n]*"
    r"\((?:a few seconds|about 20 s at first use|minutes on large grids|stored for later)\)\.\n"
    r"|^[^\n]*TqdmWarning[^\n]*\n(?: [^\n]*\n)?",
    flags=re.M,
)
"""Lines that depend on the speed of the machine, and the warning that bars will be plain text."""


def smaller(png: str) -> str:
    """Return a PNG image (base64) with a palette if that is smaller and looks the same."""
    image = Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB")
    kept = io.BytesIO()
    palette = image.quantize(256, kmeans=1)
    change = np.abs(np.subtract(palette.convert("RGB"), image, dtype=np.int16)).max(-1)
    if np.quantile(change, 0.99) > MAX_CHANGE:
        return png
    palette.save(kept, "PNG", optimize=True)
    found = base64.b64encode(kept.getvalue()).decode()
    return found if len(found) < len(png) else png


def without_progress(text: str) -> str:
    """Return a text of stderr without progress bars and what trustbo says while it computes."""
    text = "".join(part for part in text.split("\r") if not BAR.search(part))
    text = SAID.sub("", text)
    return text if text.strip() else ""


def clean(path: Path) -> None:
    """Rewrite a notebook in place."""
    notebook = json.loads(path.read_text())
    for cell in notebook["cells"]:
        cell["metadata"].pop("execution", None)
        if "outputs" in cell:
            for output in cell["outputs"]:
                if output.get("name") == "stderr":
                    kept = without_progress("".join(output["text"]))
                    output["text"] = kept.splitlines(keepends=True)
            cell["outputs"] = [output for output in cell["outputs"] if output.get("text") != []]
        for output in cell.get("outputs", []):
            if "text" in output:  # shorten local paths
                text = "".join(output["text"])
                text = re.sub(r"/\S+/(src/trustbo/|site-packages/|\d+\.py:)", r"\1", text)
                output["text"] = text.splitlines(keepends=True)
            data = output.get("data", {})
            if "image/png" in data:
                data["image/png"] = smaller("".join(data["image/png"]).strip())
    path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n")


for name in sys.argv[1:]:
    clean(Path(name))

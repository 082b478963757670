"""Clean executed notebooks before they are committed: no run times, no progress, smaller figures.

Figures get a palette of 256 colours where hardly a pixel changes.

python scripts/clean_notebooks.py notebooks/*.ipynb
"""

import base64
import io
import json
import re
import sys
from pathlib import Path

import numpy as np
from PIL import Image

MOST = 8
"""Largest change of a colour, of 255, of all but one pixel in a hundred."""


def smaller(png: str) -> str:
    """The same figure with a palette, if that is smaller and looks the same; both in base64."""
    image = Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB")
    kept = io.BytesIO()
    palette = image.quantize(256, kmeans=1)
    change = np.abs(np.subtract(palette.convert("RGB"), image, dtype=np.int16)).max(-1)
    if np.quantile(change, 0.99) > MOST:
        return png
    palette.save(kept, "PNG", optimize=True)
    found = base64.b64encode(kept.getvalue()).decode()
    return found if len(found) < len(png) else png


def is_progress(output: dict) -> bool:
    """Whether an output only has progress bars, or a line about them or about compilation."""
    text = "".join(output.get("text", []))
    about = text.startswith("compiling kernels") or "TqdmWarning" in text
    return about or bool(re.fullmatch(r"(\r[^\n]*)+", text))


def clean(path: Path) -> None:
    """Rewrite a notebook in place."""
    notebook = json.loads(path.read_text())
    for cell in notebook["cells"]:
        cell["metadata"].pop("execution", None)
        if "outputs" in cell:
            cell["outputs"] = [output for output in cell["outputs"] if not is_progress(output)]
        for output in cell.get("outputs", []):
            if "text" in output:  # no path of a machine
                text = "".join(output["text"])
                text = re.sub(r"/\S+/(src/trustbo/|site-packages/|\d+\.py:)", r"\1", text)
                output["text"] = text.splitlines(keepends=True)
            data = output.get("data", {})
            if "image/png" in data:
                data["image/png"] = smaller("".join(data["image/png"]).strip())
    path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n")


for name in sys.argv[1:]:
    clean(Path(name))

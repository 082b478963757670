"""Clean executed notebooks before they are committed.

    python scripts/clean_notebooks.py notebooks/*.ipynb

The script removes run times, progress bars and local paths. It also reduces figures to a palette of
256 colours if this hardly changes a pixel.
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


def is_progress(output: dict) -> bool:
    """Return whether an output is a progress bar or a message about bars or compilation."""
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

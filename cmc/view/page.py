"""A live picture as one HTML file: a slider over pictures computed beforehand, without a kernel.

The file holds all it needs and loads nothing, so it can be handed out or put on a static site.
"""

from __future__ import annotations

import base64
import html
import json
from pathlib import Path
from typing import Any

import numpy as np

from cmc.store import write_atomic
from cmc.view.canvas import SCRIPT, STYLE
from cmc.view.sliders import Explorer

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'">
<style>body {{ font: 15px sans-serif; margin: 1.5em; max-width: 75em; }}
label {{ display: flex; gap: 1em; align-items: center; margin-bottom: 1em; }}
input {{ width: 24em; max-width: 60vw; }}
{style}</style></head><body>
<p>{title}</p>
<label>{label}<input id="control" type="range" min="0" max="{last}" value="{first}"
><output id="value"></output></label>
<div id="view"></div>
<script type="module">
{script}
const {{ values, frames, description }} = {content};
const handlers = {{}};
const state = {{ description, error: "" }};
const model = {{
  get: (name) => state[name],
  on: (name, handler) => (handlers[name] = handler),
  off: (name) => delete handlers[name],
}};
const control = document.getElementById("control");
function choose() {{
  const k = +control.value;
  const bytes = Uint8Array.from(atob(frames[k].data), (c) => c.charCodeAt(0));
  state.frame = {{ ...frames[k], serial: k + 1, data: bytes }};
  document.getElementById("value").textContent = values[k];
  control.setAttribute("aria-valuetext", values[k]);
  handlers["change:frame"]?.();
}}
choose();
render({{ model, el: document.getElementById("view") }});
control.addEventListener("input", choose);
</script></body></html>
"""


def write_page(
    explorer: Explorer, path: str | Path, control: str | None = None, count: int = 41
) -> Path:
    """Write an explorer as one HTML file in which one of its controls can be moved.

    Args:
        explorer: what `explore` returned; its other controls keep their present values.
        path: the file.
        control: name of a numeric control; the first one by default.
        count: number of pictures along the slider.

    Returns:
        The path of the file.

    Raises:
        ValueError: if there is no such control, or it is no slider.
    """
    name = next(iter(explorer.controls)) if control is None else control
    widget: Any = explorer.controls.get(name)
    if widget is None or not hasattr(widget, "min"):
        raise ValueError(f"wanted a slider among {sorted(explorer.controls)}, got {name!r}")
    whole = isinstance(widget.value, int)
    values = np.linspace(widget.min, widget.max, count)
    values = np.unique(values.round().astype(int)) if whole else values
    first, frames = explorer.values[name], []
    for value in values:
        explorer.evaluate(**{name: value.item()})
        frame = dict(explorer.canvas.frame)
        frame["data"] = base64.b64encode(frame["data"]).decode()
        frames.append(frame)
    explorer.evaluate()
    content = {
        "values": [f"{value:.4g}" for value in values],
        "frames": frames,
        "description": explorer.canvas.description,
    }
    text = _PAGE.format(
        title=html.escape(explorer.canvas.description),
        label=html.escape(widget.description),
        last=len(values) - 1,
        first=int(np.argmin(np.abs(values - first))),
        style=STYLE.read_text(encoding="utf-8"),
        script=SCRIPT.read_text(encoding="utf-8").replace("export default { render };", ""),
        # A closing tag inside the data would end the script.
        content=json.dumps(content, allow_nan=False).replace("</", "<\\/"),
    )
    return write_atomic(path, lambda file: file.write(text.encode()))

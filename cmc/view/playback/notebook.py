"""Recorded scenes in a notebook: a frame on the saved page, or one that holds the page itself.

A slider beside the page, if wanted, is an ordinary ipywidgets slider joined by `jslink` to a widget
without a picture that passes its value on by `postMessage`: no kernel takes part.
"""

from __future__ import annotations

import html
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import anywidget
import ipywidgets
import traitlets
from IPython.display import IFrame

from cmc.store import write_atomic
from cmc.view.playback.page import page, page_id
from cmc.view.playback.scene import Scene

# Every frame of the notebook gets the message; only the page with the same id heeds it.
LINK_SOURCE = """
function send(model) {
  const message = { cmcPlayback: model.get("scene"), seek: model.get("value") };
  for (const frame of document.querySelectorAll("iframe")) {
    frame.contentWindow.postMessage(message, "*");
  }
}
function initialize({ model }) {
  model.on("change:value", () => send(model));
}
function render() {}
export default { initialize, render };
"""


class SceneLink(anywidget.AnyWidget):
    """Passes `value`, a time in seconds, to the playback page of `scene` in the same document."""

    _esm = LINK_SOURCE
    scene = traitlets.Unicode().tag(sync=True)
    value = traitlets.Float(0.0).tag(sync=True)


def show(
    scenes: Sequence[Scene],
    path: str | Path | None = None,
    *,
    height: int = 480,
    slider: ipywidgets.Widget | None = None,
) -> Any:
    """Scenes in a frame, for a notebook to display; see `recorder.Playable.show`.

    Raises:
        ValueError: for an absolute path, or one that leads upwards: no server would deliver it.
    """
    text = page(scenes, slider=slider is None)
    frame: Any = Embedded(text, height)
    if path is not None and not must_embed():
        path = Path(path)
        if path.is_absolute() or ".." in path.parts:
            raise ValueError(f"path must be relative and below the notebook, got {path}")
        write_atomic(path, lambda file: file.write(text.encode()))
        frame = IFrame(path.as_posix(), width="100%", height=height)
    if slider is None:
        return frame
    link = SceneLink(scene=page_id(scenes))
    ipywidgets.jslink((slider, "value"), (link, "value"))
    return ipywidgets.VBox([ipywidgets.HTML(frame._repr_html_()), slider, link])


def must_embed() -> bool:
    """Whether no server here would deliver a file beside the notebook, or CMC_EMBED is 1."""
    served = os.environ.get("SERVER_SOFTWARE", "")
    return (
        os.environ.get("CMC_EMBED", "0") not in ("", "0")
        or "VSCODE_PID" in os.environ
        or "google.colab" in sys.modules
        or served.startswith("voila")
    )


@dataclass(frozen=True)
class Embedded:
    """A frame that holds a page, with no rights but to run its scripts."""

    text: str
    height: int

    def _repr_html_(self) -> str:
        return (
            f'<iframe srcdoc="{html.escape(self.text)}" sandbox="allow-scripts" '
            f'title="3D playback" style="width:100%;height:{self.height}px;border:0"></iframe>'
        )

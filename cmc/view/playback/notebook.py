"""A recorded scene in a notebook: an IFrame on the saved file, scrubbed by a slider in the browser.

The page is a file beside the notebook, not part of it, so the notebook stays small. The slider is
an ordinary ipywidgets slider joined by `jslink` to a widget without a picture that passes its value
to the page by `postMessage`: no kernel takes part, and it works in a page saved with its widgets.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import anywidget
import ipywidgets
import traitlets
from IPython.display import IFrame, display

from cmc.view.playback.page import scene_id

if TYPE_CHECKING:
    from cmc.view.playback.live import LiveView
    from cmc.view.playback.recorder import Recording

# Every frame of the page gets the message; only the one with the same scene heeds it.
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


def time_slider(recording: Recording) -> ipywidgets.FloatSlider:
    """Slider over the time of a recording, one step per frame, from 0 to its duration."""
    times = recording.times - recording.times[0]
    step = times[-1] / (len(times) - 1) if len(times) > 1 else 1.0
    return ipywidgets.FloatSlider(
        value=0.0,
        min=0.0,
        max=float(times[-1]) or 1.0,
        step=float(step),
        description="time [s]",
        readout_format=".2f",
        layout=ipywidgets.Layout(width="90%"),
    )


def link(recording: Recording, slider: ipywidgets.Widget) -> ipywidgets.Widget:
    """Let a slider in seconds scrub the shown page of a recording, in the browser alone.

    Display the returned widget (it has no picture) together with the slider.
    """
    scene = SceneLink(scene=scene_id(recording))
    ipywidgets.jslink((slider, "value"), (scene, "value"))
    return scene


def show(
    recording: Recording,
    path: str | Path,
    *,
    height: int = 480,
    slider: ipywidgets.Widget | None = None,
) -> ipywidgets.Widget:
    """Save the page, show it in a frame, and return a slider for it.

    Args:
        recording: what to show.
        path: where to save, relative to the notebook, so that its server can deliver it.
        height: height of the frame in pixels.
        slider: a slider in seconds to use instead of the one made here, for example one that also
            moves a figure; it is linked and returned.

    Raises:
        ValueError: for an absolute path, or one that leads upwards: no server would deliver it.
    """
    path = Path(path)
    if path.is_absolute() or ".." in path.parts:
        raise ValueError(f"path must be relative and below the notebook, got {path}")
    recording.save(path)
    display(IFrame(path.as_posix(), width="100%", height=height))
    chosen = time_slider(recording) if slider is None else slider
    return ipywidgets.VBox([chosen, link(recording, chosen)])


def show_live(recording: Recording, *, height: int = 480) -> LiveView:
    """Serve the scene on the loopback interface and show it in a frame.

    Only a browser on the same machine reaches it. Keep the returned view, `update` it, and `close`
    it; otherwise it closes itself after its timeout.
    """
    view = recording.serve()
    display(IFrame(view.url, width="100%", height=height))
    return view

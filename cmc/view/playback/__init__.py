"""3D playback: record a MuJoCo motion and get one HTML file that plays anywhere, offline.

A recording is saved, shown, put beside another one, or served:

    recording = record(model, qpos, times, trails=["tip"])
    recording.save("maze.html")           # a file to open, mail or publish
    recording.show("playback/maze.html")  # in a notebook; without a path, inside the notebook
    beside(success, failure).show()       # two scenes under one time slider
    with recording.serve() as live:       # meshcat live on the loopback interface
        live.update(data)
"""

from cmc.view.playback.cameras import Camera, around
from cmc.view.playback.recorder import Arrow, Marker, Recording, beside, framed, record

__all__ = ["Arrow", "Camera", "Marker", "Recording", "around", "beside", "framed", "record"]

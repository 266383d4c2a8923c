"""JupyterLab for the course: loopback only, with its token, no look for updates, no news."""

import os
from pathlib import Path

c = get_config()  # noqa: F821  Jupyter offers it to configuration files

c.ServerApp.ip = "127.0.0.1"
c.ServerApp.port_retries = 0  # a taken port is an error, not another address
c.ServerApp.root_dir = str(Path(__file__).resolve().parents[2] / "notebooks")
c.ServerApp.allow_root = hasattr(os, "geteuid") and os.geteuid() == 0
c.LabApp.default_url = "/lab/tree/00_start_here.ipynb"
c.LabApp.check_for_updates_class = "jupyterlab.handlers.announcements.NeverCheckForUpdate"
c.LabApp.news_url = None

"""A Panda in the browser: physics, control and policies in one HTML file."""

from cmc.view.simulator.page import live_page

__all__ = ["live_page"]

"""Old name of `cmc.learning.state`."""

from cmc.learning.state import single_thread

__all__ = ["single_thread"]

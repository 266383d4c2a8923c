"""Old name of `cmc.learning.td3`."""

from cmc.learning.td3 import Batch, Replay

__all__ = ["Batch", "Replay"]

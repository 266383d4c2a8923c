"""Old name of `cmc.learning.latent`."""

from cmc.learning.latent import LatentConfig, LatentLow, LatentModel

__all__ = ["LatentConfig", "LatentLow", "LatentModel"]

"""How far an answer is to be believed: what chance does, and what else explains the closures.

    places   closures beside each other along both ways are one witness
    chance   how often closures of which none is right agree as well
"""

from pcm_jax.integrity.chance import ChanceLevel, chance_level
from pcm_jax.integrity.places import Places, places_of, way_of

__all__ = ["ChanceLevel", "Places", "chance_level", "places_of", "way_of"]

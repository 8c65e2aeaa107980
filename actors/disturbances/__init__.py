"""Disturbances of an episode: of the scene, of the situation, and of the picture."""

"""Experiment I of the paper: reach over an obstacle, grasp a box, lift it."""

"""Experiment II of the paper: grasp the object at which a person on a screen points."""

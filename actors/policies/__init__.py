"""Policies, which choose the robot's actions: the tutor, baselines and trained networks."""

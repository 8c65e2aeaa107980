"""Figures: of the paper, and of where a policy fails; what they show, computed and drawn."""

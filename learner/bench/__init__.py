"""How fast training is, and the step-by-step reference that it is measured against."""

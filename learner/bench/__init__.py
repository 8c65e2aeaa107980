"""The speed of training, and the step-by-step reference that it is compared with."""

"""Training: pre-training of the vision, coupled training, and what both need."""

"""What serves: hub, evaluator, recorder, watch, and the command line."""

DISTRIBUTION = "vmdnn"  # vmdnn.py sees by it whether another package took this name

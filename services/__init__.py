"""What serves: hub, evaluator, recorder, watch, and the command line."""

DISTRIBUTION = "vmdnn"  # vmdnn.py checks that no other distribution has replaced this package

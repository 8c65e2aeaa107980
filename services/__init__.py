"""What serves: hub, evaluator, recorder, watch, and the command line."""

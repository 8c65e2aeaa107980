"""What is kept of a run's numbers and shown in other programs: history, TensorBoard, Prometheus."""

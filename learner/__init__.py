"""The network of Hwang et al. (2015), its training, and the process that trains it."""

DISTRIBUTION = "vmdnn"  # vmdnn.py sees by it whether another package took this name

"""The network of Hwang et al. (2015), its training, and the process that trains it."""

DISTRIBUTION = "vmdnn"  # vmdnn.py checks that no other distribution has replaced this package

"""What is simulated: the iCub with a right hand of our own, built from the official model."""

DISTRIBUTION = "vmdnn"  # vmdnn.py checks that no other distribution has replaced this package

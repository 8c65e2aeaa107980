"""What is simulated: the iCub with a right hand of our own, built from the official model."""

DISTRIBUTION = "vmdnn"  # vmdnn.py sees by it whether another package took this name

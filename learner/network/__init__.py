"""The network VMDNN: its subnets, the code of its outputs, and the networks that act."""

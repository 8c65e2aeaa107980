"""The network VMDNN: its subnets, its outputs' code, and the form that acts."""

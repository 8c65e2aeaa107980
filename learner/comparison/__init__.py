"""Networks of other kinds that learn the same sequences, to compare VMDNN with."""

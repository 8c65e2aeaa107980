"""Networks of other kinds that VMDNN is compared with."""

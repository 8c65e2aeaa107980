"""Checks whether this machine has what a run needs: driver, packages, ports."""

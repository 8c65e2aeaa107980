"""What a run needs of this machine: driver, packages, ports."""

"""What acts: simulator backends, tasks, the tutor, the episode player and the actor process."""

DISTRIBUTION = "vmdnn"  # vmdnn.py checks that no other distribution has replaced this package

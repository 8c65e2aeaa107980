"""What acts: simulator backends, tasks, the tutor, the episode player and the actor process."""

DISTRIBUTION = "vmdnn"  # vmdnn.py sees by it whether another package took this name

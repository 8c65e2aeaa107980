"""What acts: simulator backends, tasks, the tutor, the episode player and the actor process."""

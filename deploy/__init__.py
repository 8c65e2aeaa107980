"""What starts the system: set-up, supervision, configs. Nothing else imports this package."""

DISTRIBUTION = "vmdnn"  # vmdnn.py sees by it whether another package took this name

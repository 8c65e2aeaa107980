"""What starts the system: set-up, supervision, configs. Nothing else imports this package."""

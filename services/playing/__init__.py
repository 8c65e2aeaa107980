"""Playing episodes without the bus: worker processes, tutoring, videos."""

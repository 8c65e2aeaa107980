"""A person tutors the robot by hand, from the browser."""

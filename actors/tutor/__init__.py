"""The tutor: key postures as smooth functions of the situation, and the plan through them."""

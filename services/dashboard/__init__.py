"""A page in the browser that shows a run while it happens, and its recordings."""

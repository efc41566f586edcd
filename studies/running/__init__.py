"""A running service under study: its process, the frames sent to it, and scenarios."""

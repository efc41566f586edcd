"""A service under study: its process, the frames sent to it, and the outcomes of scenarios."""

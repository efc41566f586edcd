"""Hard frames: pictures that should not be believed, long runs."""

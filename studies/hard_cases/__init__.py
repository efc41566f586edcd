"""Hard cases of single functions, on every backend."""

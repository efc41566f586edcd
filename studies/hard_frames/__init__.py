"""Studies of faulty pictures and cameras, and long runs."""

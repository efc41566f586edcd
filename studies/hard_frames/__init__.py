"""Studies of faulty images and cameras, and of long runs."""

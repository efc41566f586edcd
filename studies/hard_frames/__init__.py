"""Studies of faulty and unsynchronized cameras."""

"""The service under load, faults and strangers."""
